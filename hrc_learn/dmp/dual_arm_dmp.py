"""Movement primitive of two arms that hold on to each other's motion."""

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Unpack

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils._pytree import tree_map

from hrc_learn.dmp._arguments import (
    FitReport,
    Mask,
    Points,
    Quaternions,
    Scalars,
    Times,
    Vectors,
    to_tensor,
)
from hrc_learn.dmp._closed_loop_step import DMPState
from hrc_learn.dmp._fitting import FitOptions
from hrc_learn.dmp._system.response import Trajectory
from hrc_learn.dmp.coordinate_adapter import ColumnPoints, CoordinateAdapter, Retargeted
from hrc_learn.dmp.coupling import velocity_coupling
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.linear_primitive import Ends, LinearPrimitive
from hrc_learn.dmp.motion_primitive import AdaptedPrimitive
from hrc_learn.dmp.orientation_error import intrinsic_mean
from hrc_learn.dmp.pose_dmp import PoseCoordinates, PoseDMP, PoseState, PoseTrajectory
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.model_files import SavedModel


@dataclass(frozen=True, kw_only=True, eq=False)
class DualArmState:
    """Where two arms are while they are stepped; a pytree."""

    arms: PoseState
    """Of both, (*batch, 2)."""
    planned: PoseState
    """Where they would be had nothing pushed them."""
    held: Pose
    """Pose of each arm in the frame of the other as the motion began, (*batch, 2)."""

    @property
    def motion(self) -> DMPState:
        """Columns of both hands."""
        return self.arms.motion

    @property
    def pose(self) -> Pose:
        """Of both hands, (*batch, 2)."""
        return self.arms.pose

    @property
    def twist(self) -> Float[Tensor, "*batch 2 6"]:
        """(linear [m/s], angular [rad/s]) of both hands in the base frame."""
        return self.arms.twist


torch.export.register_dataclass(DualArmState, serialized_type_name="hrc_learn.dmp.DualArmState")


class HandsFrame(NamedTuple):
    """What the columns of both hands are relative to."""

    reference: Tensor
    """Of the orientation errors: as they are and as planned, (2, *batch, 2, 4)."""
    held: Pose
    """Pose of each hand in the frame of the other as the motion began, (*batch, 2)."""


@dataclass(frozen=True, eq=False)
class DualArmCoordinates(CoordinateAdapter[Pose, PoseTrajectory, DualArmState]):
    """Two hands are a batch (*batch, 2) of poses, with one goal: the object's.

    In closed loop they are stepped along with the motion they would have had nothing pushed
    them, (2, *batch, 2): hands as they are first, as planned second.
    """

    hands: PoseCoordinates
    grasp: Pose
    """Of each hand in the frame of the object, (*batch, 2)."""
    hold: bool
    gain: float
    share: tuple[float, float]
    has_body: ClassVar[bool] = True

    def ends(
        self,
        motion: LinearPrimitive,
        given: Ends,
        duration: Tensor,
        **body: Vectors | None,
    ) -> tuple[Ends, Tensor]:
        """Start of both hands, goal of the object."""
        goals = None if given.goal is None else self._goals(given.goal)
        return self.hands.ends(motion, given._replace(goal=goals), duration, **body)

    def trajectory(self, columns: Trajectory, frame: Tensor) -> PoseTrajectory:
        """Of both hands, with nothing to push them."""
        return self.hands.trajectory(columns, frame)

    def begin(self, columns: DMPState, frame: Tensor) -> tuple[DMPState, HandsFrame]:
        """Twice the same, and how the hands are held."""
        state = self.hands.state(*self.hands.begin(columns, frame))
        held, _ = relation(state.pose, state.twist)
        twice = tree_map(lambda x: torch.stack([x, x]), state)
        return twice.motion, HandsFrame(twice.reference, held)

    def state(self, columns: DMPState, frame: HandsFrame) -> DualArmState:
        """Hands as they are and as planned, apart."""
        both = PoseState(motion=columns, reference=frame.reference)
        arms, planned = tree_map(lambda x: x[0], both), tree_map(lambda x: x[1], both)
        return DualArmState(arms=arms, planned=planned, held=frame.held)

    def columns(self, state: DualArmState) -> tuple[DMPState, HandsFrame]:
        """Both in one batch, so that one step serves them."""
        both = tree_map(lambda *x: torch.stack(x), state.arms, state.planned)
        return both.motion, HandsFrame(both.reference, state.held)

    def retarget(
        self,
        motion: LinearPrimitive,
        columns: DMPState,
        frame: HandsFrame,
        goal: Pose | None,
        **body: Vectors | None,
    ) -> Retargeted:
        """A goal of the object is one of each hand."""
        goals = None if goal is None else self._goals(goal)
        new = self.hands.retarget(motion, columns, frame.reference, goals, **body)
        return new._replace(frame=HandsFrame(new.frame, frame.held))

    def external_acceleration(
        self, motion: LinearPrimitive, columns: DMPState, frame: HandsFrame, coupling: Any
    ) -> Tensor:
        """What takes each hand to its place beside the other, and a `coupling` to both."""
        now = self.state(columns, frame)
        push = self._hold_on(motion, now)
        if coupling is not None:
            push = push + to_tensor(coupling, push.dtype, push.device)
        arms = now.arms
        pushed = self.hands.external_acceleration(motion, arms.motion, arms.reference, push)
        assert pushed is not None  # a push there is
        return torch.stack([pushed, torch.zeros_like(pushed)])

    def via_points(
        self,
        motion: LinearPrimitive,
        now: ColumnPoints,
        value: Pose | Any,
        velocity: Points | None,
        **body: Points | None,
    ) -> ColumnPoints:
        """Poses of both hands, (*batch, 2, n)."""
        return self.hands.via_points(motion, now, value, velocity, **body)

    def each(self, value: Scalars | None) -> Tensor | None:
        """The same for both hands."""
        return None if value is None else self._as_tensor(value)[..., None]

    def times(self, time: Times) -> Tensor:
        """Rows for both hands."""
        return _for_both(self._as_tensor(time))

    def _hold_on(
        self, motion: LinearPrimitive, state: DualArmState
    ) -> Float[Tensor, "*batch 2 6"]:
        """Acceleration of each hand towards its place beside the other."""
        wanted, rate = relation(state.planned.pose, state.planned.twist)
        if self.hold:
            wanted, rate = state.held, torch.zeros_like(rate)
        error, rate = relative_pose_error(state.pose, state.twist, wanted, rate)
        share = self.gain * self._as_tensor(self.share)[:, None]
        return velocity_coupling(
            share * error,
            share * rate,
            spring=motion.spring,
            duration=state.arms.motion.duration,
        )

    def _goals(self, goal: Pose) -> Pose:
        return _paired(goal) @ self.grasp

    def _as_tensor(self, value: Scalars | Times) -> Tensor:
        return to_tensor(value, self.grasp.position.dtype, self.grasp.position.device)


class DualArmDMP(AdaptedPrimitive[Pose, PoseTrajectory, DualArmState]):
    """Two pose primitives under one phase, coupled by their relative pose.

    Each arm is pulled to where it should be as seen from the other: where both are as planned
    nothing acts, and what moves one away moves the other along (after Gams et al. 2014, here
    for whole poses: when one hand is turned, the other moves around it). The goal of both is
    one pose, the object's, (*batch); starts and via points are poses of both hands,
    (*batch, 2), velocities twists and couplings accelerations of both, (*batch, 2, 6). Steps
    are of first order where the arms are pushed.
    """

    arms: PoseDMP
    grasp_position: Tensor
    grasp_orientation: Tensor

    def __init__(
        self,
        arms: PoseDMP,
        grasp: Pose,
        *,
        hold: bool = False,
        gain: float | int = 20.0,
        share: tuple[float | int, float | int] = (0.5, 0.5),
    ):
        """Put a primitive together; `fit` is the usual way to one.

        Args:
            arms: Of both hands, (*batch, 2).
            grasp: Pose of each hand in the frame of the object, (*batch, 2).
            hold: Whether the relative pose is that at the start, as with one rigid object;
                else the demonstrated one, which may change along the motion.
            gain: Rate [1/s] at which errors of the relative pose are taken back; keep it well
                below one over the step length.
            share: How much of an error each arm takes back; (0, 1): the second follows.

        Raises:
            ValueError: Primitives that are not pairs.
        """
        super().__init__()
        if arms.motion.weights.ndim < 3 or arms.motion.weights.shape[-3] != 2:
            raise ValueError("two arms are a batch (..., 2) of pose primitives")
        self.arms = arms
        self.register_buffer("grasp_position", grasp.position)
        self.register_buffer("grasp_orientation", grasp.orientation)
        self.hold, self.gain, self.share = hold, float(gain), (float(share[0]), float(share[1]))

    @classmethod
    def fit(
        cls,
        time: Times,
        position: Points,
        orientation: Quaternions,
        n_basis: int | None = None,
        mask: Mask | None = None,
        *,
        object_goal: Pose | None = None,
        hold: bool = False,
        gain: float | int = 20.0,
        share: tuple[float | int, float | int] = (0.5, 0.5),
        **options: Unpack[FitOptions],
    ) -> "DualArmDMP":
        """Learn one primitive from each demonstration.

        Args:
            time: Timestamps [s], (T,) or (*B, T), the same for both arms.
            position: Of both hands [m], (*B, T, 2, 3).
            orientation: Unit quaternions (w, x, y, z), (*B, T, 2, 4).
            n_basis: N.
            mask: (*B, T), false where a sample does not count.
            object_goal: Where the object is at the end, (*B); in the middle between the hands
                unless given.
            hold: See `DualArmDMP`, like gain and share.
            gain: [1/s].
            share: Of each arm.
            options: As for `PoseDMP.fit`.

        Raises:
            ValueError: Bad samples; says which.
        """
        position, orientation = to_tensor(position), to_tensor(orientation)
        for name, x, width in (("position", position, 3), ("orientation", orientation, 4)):
            if x.ndim < 3 or x.shape[-2:] != (2, width):
                raise ValueError(f"{name} must be (..., T, 2, {width}), got {tuple(x.shape)}")
        arms = PoseDMP.fit(
            _for_both(to_tensor(time)),
            position.movedim(-2, -3),
            orientation.movedim(-2, -3),
            n_basis,
            mask=None if mask is None else _for_both(to_tensor(mask)),
            **options,
        )
        ends = arms.goal
        if object_goal is None:
            middle = intrinsic_mean(ends.orientation)
            object_goal = Pose(ends.position.mean(-2), middle)
        grasp = _paired(object_goal).inverse() @ ends
        return cls(arms, grasp, hold=hold, gain=gain, share=share)

    @property
    def motion(self) -> JointDMP:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Columns of both hands."""
        return self.arms.motion

    @property
    def adapter(self) -> DualArmCoordinates:
        """Both hands' poses, held together."""
        hands = self.arms.adapter
        return DualArmCoordinates(hands, self.grasp, self.hold, self.gain, self.share)

    @property
    def grasp(self) -> Pose:
        """Of each hand in the frame of the object."""
        return Pose(self.grasp_position, self.grasp_orientation)

    @property
    def start(self) -> Pose:
        """Of both hands, (*batch, 2)."""
        return self.arms.start

    @property
    def goal(self) -> Pose:
        """Of the object, (*batch)."""
        # Either hand tells where the object is.
        return (self.arms.goal @ self.grasp.inverse())[..., 0]

    @property
    def duration(self) -> Float[Tensor, "*batch"]:
        """Of the demonstration [s]."""
        return self.arms.duration[..., 0]

    @property
    def fit_report(self) -> FitReport | None:
        """As of a `PoseDMP`, (*batch, 2)."""
        return self.arms.fit_report

    def with_motion[S: "DualArmDMP"](
        self: S, motion: JointDMP, frame: Tensor | None = None
    ) -> S:
        """Around another motion of the hands."""
        arms = self.arms.with_motion(motion, frame)
        options = {"hold": self.hold, "gain": self.gain, "share": self.share}
        return type(self)(arms, self.grasp, **options)

    def _own_config(self) -> dict[str, Any]:
        return {"hold": self.hold, "gain": self.gain, "share": list(self.share)}

    def _own_tensors(self) -> dict[str, Tensor]:
        own = {name: getattr(self, name) for name in ("grasp_position", "grasp_orientation")}
        return own | {"goal_orientation": self.arms.goal_orientation}

    @classmethod
    def _restored[S: "DualArmDMP"](cls: type[S], saved: SavedModel) -> S:
        arms = PoseDMP(JointDMP.restore(saved), saved.tensor("goal_orientation"))
        grasp = Pose(saved.tensor("grasp_position"), saved.tensor("grasp_orientation"))
        first, second = saved.get("share", list)
        return cls(
            arms,
            grasp,
            hold=saved.flag("hold"),
            gain=saved.get("gain", float, int),
            share=(first, second),
        )


def relation(pose: Pose, twist: Tensor) -> tuple[Pose, Float[Tensor, "*batch 2 6"]]:
    """Pose and twist of each hand in the frame of the other.

    Args:
        pose: Of both hands, (*batch, 2).
        twist: (linear [m/s], angular [rad/s]) in the base frame, (*batch, 2, 6).
    """
    other, other_twist = _flipped(pose), twist.flip(-2)
    offset = pose.position - other.position
    linear, angular = (twist - other_twist).split(3, dim=-1)
    # A frame that turns sees what rests move backwards: minus omega x offset.
    linear = linear - torch.linalg.cross(other_twist[..., 3:], offset)
    inverse = quaternion.conjugate(other.orientation)
    seen = [quaternion.rotate(inverse, part) for part in (linear, angular)]
    return other.inverse() @ pose, torch.cat(seen, dim=-1)


def relative_pose_error(
    pose: Pose, twist: Tensor, wanted: Pose, wanted_twist: Tensor
) -> tuple[Float[Tensor, "*batch 2 6"], Float[Tensor, "*batch 2 6"]]:
    """Motion (linear [m], angular [rad]) of each hand to its place beside the other; its rate.

    Args:
        pose: Of both hands, (*batch, 2).
        twist: In the base frame.
        wanted: Of each hand in the frame of the other, as `relation` gives it.
        wanted_twist: Of that.
    """
    other, other_twist = _flipped(pose), twist.flip(-2)
    place = other @ wanted
    linear, angular = (
        quaternion.rotate(other.orientation, part) for part in wanted_twist.split(3, dim=-1)
    )
    turning = other_twist[..., 3:]
    swung = torch.linalg.cross(turning, place.position - other.position)
    carried = torch.cat([other_twist[..., :3] + swung + linear, turning + angular], dim=-1)
    return pose.twist_to(place), carried - twist


def _flipped(pose: Pose) -> Pose:
    return Pose(pose.position.flip(-2), pose.orientation.flip(-2))


def _paired(pose: Pose) -> Pose:
    """The same for both hands."""
    return Pose(pose.position[..., None, :], pose.orientation[..., None, :])


def _for_both(values: Tensor) -> Tensor:
    """Rows (*batch, T) for both hands; one row serves all anyway."""
    return values if values.ndim < 2 else values[..., None, :]
