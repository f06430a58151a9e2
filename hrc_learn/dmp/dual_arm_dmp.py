"""Movement primitive of two arms that hold on to each other's motion."""

from dataclasses import dataclass
from pathlib import Path
from typing import Unpack

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.dmp._types import ArrayLike, to_tensor
from hrc_learn.dmp.coupling import velocity_coupling
from hrc_learn.dmp.fitting.solvers import FitOptions
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.orientation_error import intrinsic_mean
from hrc_learn.dmp.pose_dmp import PoseDMP, PoseState, PoseTrajectory
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.storage import SavedModel, write_model


def relation(pose: Pose, twist: Tensor) -> tuple[Pose, Float[Tensor, "*batch 2 6"]]:
    """Pose and twist of each hand in the frame of the other.

    Args:
        pose: Of both hands, (*batch, 2).
        twist: (linear [m/s], angular [rad/s]) in the base frame, (*batch, 2, 6).
    """
    other, other_twist = _flipped(pose), twist.flip(-2)
    offset = pose.position - other.position
    linear, angular = (twist - other_twist).split(3, dim=-1)
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
    def pose(self) -> Pose:
        """Of both hands, (*batch, 2)."""
        return self.arms.pose

    @property
    def twist(self) -> Float[Tensor, "*batch 2 6"]:
        """(linear [m/s], angular [rad/s]) of both hands in the base frame."""
        return self.arms.twist


torch.export.register_dataclass(DualArmState, serialized_type_name="hrc_learn.dmp.DualArmState")


class DualArmDMP(nn.Module):
    """Two pose primitives under one phase, coupled by their relative pose.

    Each arm is pulled to where it should be as seen from the other: where both are as planned
    nothing acts, and what moves one away moves the other along (after Gams et al. 2014, here
    for whole poses: when one hand is turned, the other moves around it). The goal of both is
    one pose, the object's.
    """

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
        time: ArrayLike,
        position: ArrayLike,
        orientation: ArrayLike,
        n_basis: int = 50,
        mask: ArrayLike | None = None,
        *,
        object_goal: Pose | None = None,
        hold: bool = False,
        gain: float | int = 20.0,
        share: tuple[float | int, float | int] = (0.5, 0.5),
        **options: Unpack[FitOptions],
    ) -> "DualArmDMP":
        """Learn one primitive from each demonstration.

        Args:
            time: Stamps [s], (T,) or (*B, T), the same for both arms.
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
        return (self.arms.goal @ self.grasp.inverse())[..., 0]

    @property
    def duration(self) -> Float[Tensor, "*batch"]:
        """Of the demonstration [s]."""
        return self.arms.duration[..., 0]

    def rollout(
        self,
        time: ArrayLike | None = None,
        start: Pose | None = None,
        goal: Pose | None = None,
        duration: ArrayLike | None = None,
        *,
        speed: ArrayLike | None = None,
    ) -> PoseTrajectory:
        """Motion of both hands, (*batch, 2), with nothing to push them.

        Args:
            time: Since the start of the motion [s], (T,) or (*batch, T).
            start: Of both hands, (*batch, 2).
            goal: Of the object, (*batch).
            duration: [s], (*batch).
            speed: Instead of a duration, how many times faster than the demonstration.
        """
        return self.arms.rollout(
            None if time is None else _for_both(self._as_tensor(time)),
            start,
            self._goals(goal),
            self._each(duration),
            speed=self._each(speed),
        )

    def initial_state(
        self,
        start: Pose | None = None,
        goal: Pose | None = None,
        duration: ArrayLike | None = None,
        *,
        speed: ArrayLike | None = None,
    ) -> DualArmState:
        """State at the start of a motion, for `step`; arguments as in `rollout`."""
        ends = start, self._goals(goal), self._each(duration)
        arms, planned = (
            self.arms.initial_state(*ends, speed=self._each(speed)) for _ in range(2)
        )
        held, _ = relation(arms.pose, arms.twist)
        return DualArmState(arms=arms, planned=planned, held=held)

    def step(
        self,
        state: DualArmState,
        dt: ArrayLike,
        *,
        goal: Pose | None = None,
        goal_filter: float | None = None,
        coupling: ArrayLike | None = None,
        slowdown: ArrayLike | None = None,
    ) -> DualArmState:
        """Advance by `dt`, as `PoseDMP.step`; of first order where the arms are pushed.

        Args:
            state: From `initial_state` or the last step.
            dt: [s], (*batch).
            goal: New goal of the object, (*batch).
            goal_filter: Rate, per duration, at which goals move there.
            coupling: Acceleration added to each hand, (*batch, 2, 6), in the base frame.
            slowdown: The clock runs 1 + slowdown times slower, (*batch), >= 0.
        """
        push = self._hold_on(state)
        if coupling is not None:
            push = push + self._as_tensor(coupling)
        goals, slowdown = self._goals(goal), self._each(slowdown)
        dt = self._as_tensor(dt)[..., None]
        arms, planned = (
            self.arms.step(
                hands,
                dt,
                goal=goals,
                goal_filter=goal_filter,
                coupling=acceleration,
                slowdown=slowdown,
            )
            for hands, acceleration in ((state.arms, push), (state.planned, None))
        )
        return DualArmState(arms=arms, planned=planned, held=state.held)

    def save(self, folder: str | Path) -> None:
        """Write config.json and model.safetensors into `folder`, replacing an older save."""
        own = {name: getattr(self, name) for name in ("grasp_position", "grasp_orientation")}
        own["goal_orientation"] = self.arms.goal_orientation
        config = {"hold": self.hold, "gain": self.gain, "share": list(self.share)}
        motion = self.arms.motion
        write_model(folder, "DualArmDMP", motion.config() | config, own | motion.tensors())

    @classmethod
    def load(cls, folder: str | Path) -> "DualArmDMP":
        """Read what `save` wrote; complains as `JointDMP.load`."""
        saved = SavedModel(folder, "DualArmDMP")
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

    def _hold_on(self, state: DualArmState) -> Float[Tensor, "*batch 2 6"]:
        """Acceleration of each hand towards its place beside the other."""
        wanted, rate = relation(state.planned.pose, state.planned.twist)
        if self.hold:
            wanted, rate = state.held, torch.zeros_like(rate)
        error, rate = relative_pose_error(state.pose, state.twist, wanted, rate)
        share = self.gain * self._as_tensor(self.share)[:, None]
        return velocity_coupling(
            share * error,
            share * rate,
            spring=self.arms.motion.spring,
            duration=state.arms.motion.duration,
        )

    def _goals(self, goal: Pose | None) -> Pose | None:
        return None if goal is None else _paired(goal) @ self.grasp

    def _each(self, value: ArrayLike | None) -> Tensor | None:
        return None if value is None else self._as_tensor(value)[..., None]

    def _as_tensor(self, value: ArrayLike) -> Tensor:
        return to_tensor(value, self.grasp_position.dtype, self.grasp_position.device)


def _paired(pose: Pose) -> Pose:
    """The same for both hands."""
    return Pose(pose.position[..., None, :], pose.orientation[..., None, :])


def _for_both(values: Tensor) -> Tensor:
    """Rows (*batch, T) for both hands; one row serves all anyway."""
    return values if values.ndim < 2 else values[..., None, :]
