"""Movement primitive of a pose, and of the arm's body along with it."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp import orientation_error
from hrc_learn.dmp._arguments import (
    Mask,
    Points,
    Quaternions,
    Times,
    Vectors,
    check_samples,
    finite,
    padded,
    to_tensor,
)
from hrc_learn.dmp._closed_loop_step import DMPState
from hrc_learn.dmp._fitting import FitOptions
from hrc_learn.dmp._system.response import ArrayOutputs, Trajectory, broadcast_shapes
from hrc_learn.dmp.coordinate_adapter import ColumnPoints, CoordinateAdapter, Retargeted
from hrc_learn.dmp.forcing_scale import find_scaling
from hrc_learn.dmp.joint_dmp import JointDMP, given_points
from hrc_learn.dmp.linear_primitive import Ends, LinearPrimitive
from hrc_learn.dmp.motion_primitive import WrappedPrimitive
from hrc_learn.dmp.orientation_dmp import OrientationTrajectory, via_errors
from hrc_learn.dmp.orientation_error import (
    error_ends,
    fitted_error,
    reference_of,
    to_orientation,
    unit_quaternion,
)
from hrc_learn.geometry import Pose
from hrc_learn.model_files import SavedModel

POSITION, ERROR, BODY = slice(0, 3), slice(3, 6), slice(6, None)
"""Columns of a pose: position [m], orientation error [rad], and what moves along."""


class PoseTrajectory(ArrayOutputs):
    """A pose over time, each output computed when first asked for."""

    outputs = (
        *("time", "position", "orientation", "velocity", "angular_velocity"),
        *("acceleration", "angular_acceleration", "body", "body_velocity"),
    )

    def __init__(self, motion: Trajectory, reference: Float[Tensor, "*batch 4"]):
        self._motion = motion
        self._rotation = OrientationTrajectory(motion, reference, first=ERROR.start)

    @property
    def time(self) -> Float[Tensor, "*batch T"]:
        """Since the start of the motion [s]."""
        return self._motion.time

    @property
    def position(self) -> Float[Tensor, "*batch T 3"]:
        """[m]."""
        return self._motion.position[..., POSITION]

    @property
    def orientation(self) -> Float[Tensor, "*batch T 4"]:
        """Unit quaternions (w, x, y, z), continuous in sign."""
        return self._rotation.orientation

    @property
    def pose(self) -> Pose:
        """Position and orientation, (*batch, T)."""
        return Pose(self.position, self.orientation)

    @property
    def velocity(self) -> Float[Tensor, "*batch T 3"]:
        """Linear [m/s]."""
        return self._motion.velocity[..., POSITION]

    @property
    def angular_velocity(self) -> Float[Tensor, "*batch T 3"]:
        """In the base frame [rad/s]."""
        return self._rotation.angular_velocity

    @cached_property
    def twist(self) -> Float[Tensor, "*batch T 6"]:
        """(linear [m/s], angular [rad/s]) in the base frame."""
        return torch.cat([self.velocity, self.angular_velocity], dim=-1)

    @property
    def acceleration(self) -> Float[Tensor, "*batch T 3"]:
        """Linear [m/s^2]."""
        return self._motion.acceleration[..., POSITION]

    @property
    def angular_acceleration(self) -> Float[Tensor, "*batch T 3"]:
        """In the base frame [rad/s^2]."""
        return self._rotation.angular_acceleration

    @property
    def body(self) -> Float[Tensor, "*batch T K"]:
        """Coordinates learned along; K = 0 without any."""
        return self._motion.position[..., BODY]

    @property
    def body_velocity(self) -> Float[Tensor, "*batch T K"]:
        """The same per second."""
        return self._motion.velocity[..., BODY]


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseState:
    """Where a pose primitive is while it is stepped."""

    motion: DMPState
    """Of position, error to the reference, and body."""
    reference: Float[Tensor, "*batch 4"]
    """The goal's orientation, unless the primitive says otherwise."""

    @property
    def pose(self) -> Pose:
        """Position [m] and orientation."""
        columns = self.motion.position
        rotation = orientation_error.to_orientation(columns[..., ERROR], self.reference)
        return Pose(columns[..., POSITION], rotation)

    @property
    def twist(self) -> Float[Tensor, "*batch 6"]:
        """(linear [m/s], angular [rad/s]) in the base frame."""
        columns, velocity = self.motion.position, self.motion.velocity
        angular = orientation_error.angular_velocity(columns[..., ERROR], velocity[..., ERROR])
        return torch.cat([velocity[..., POSITION], angular], dim=-1)

    @property
    def body(self) -> Float[Tensor, "*batch K"]:
        """Coordinates learned along."""
        return self.motion.position[..., BODY]


torch.export.register_dataclass(PoseState, serialized_type_name="hrc_learn.dmp.PoseState")


@dataclass(frozen=True, eq=False)
class PoseCoordinates(CoordinateAdapter[Pose, PoseTrajectory, PoseState]):
    """Position, orientation error and body side by side; the frame is the error's reference."""

    goal_orientation: Tensor
    """Unit quaternion at which the demonstration ends, (*batch, 4)."""
    error_columns: ClassVar[slice] = ERROR
    has_body: ClassVar[bool] = True

    def reference(self, motion: LinearPrimitive) -> Float[Tensor, "*batch 4"]:
        """What the demonstrated error is taken to."""
        return reference_of(motion.goal[..., ERROR], self.goal_orientation)

    def ends(
        self,
        motion: LinearPrimitive,
        given: Ends,
        duration: Tensor,
        start_body: Vectors | None = None,
        goal_body: Vectors | None = None,
    ) -> tuple[Ends, Tensor]:
        """A new orientation moves the start's error or the reference, the rest its columns."""
        like, (start, goal, velocity) = motion.start, given
        check_pose("start", start)
        check_pose("goal", goal)
        demonstrated = motion.start_velocity * (motion.duration / duration)[..., None]
        twist = None if velocity is None else to_tensor(velocity, like.dtype, like.device)
        error, rate, reference = error_ends(
            like[..., ERROR],
            demonstrated[..., ERROR],
            motion.goal[..., ERROR],
            self.goal_orientation,
            None if start is None else start.orientation,
            None if goal is None else goal.orientation,
            None if twist is None else twist[..., 3:],
        )
        start_columns = joined(
            like[..., POSITION] if start is None else start.position,
            error,
            like[..., BODY] if start_body is None else start_body,
            like,
        )
        goal_columns = joined(
            motion.goal[..., POSITION] if goal is None else goal.position,
            motion.goal[..., ERROR],
            motion.goal[..., BODY] if goal_body is None else goal_body,
            like,
        )
        if twist is None:
            # Turned and dilated with the way, if the scaling has it so.
            per_s = motion.start_rate(start_columns, goal_columns)
            linear = (per_s / duration[..., None])[..., POSITION]
        else:
            linear = twist[..., :3]
        # The body goes on as demonstrated: a twist says nothing of it.
        velocity_columns = joined(linear, rate, demonstrated[..., BODY], like)
        return Ends(start_columns, goal_columns, velocity_columns), reference

    def trajectory(self, columns: Trajectory, frame: Tensor) -> PoseTrajectory:
        """Poses along the columns."""
        return PoseTrajectory(columns, frame)

    def begin(self, columns: DMPState, frame: Tensor) -> tuple[DMPState, Tensor]:
        """A reference for each of the batch."""
        return columns, frame.expand(*columns.position.shape[:-1], 4)

    def state(self, columns: DMPState, frame: Tensor) -> PoseState:
        """The columns with their reference."""
        return PoseState(motion=columns, reference=frame)

    def columns(self, state: PoseState) -> tuple[DMPState, Tensor]:
        """The columns and their reference."""
        return state.motion, state.reference

    def retarget(
        self,
        motion: LinearPrimitive,
        columns: DMPState,
        frame: Tensor,
        goal: Pose | None,
        goal_body: Vectors | None = None,
    ) -> Retargeted:
        """The same pose, twist and acceleration, as the error to a new reference."""
        target = columns.target
        if goal is not None:
            check_pose("goal", goal)
            rotation = unit_quaternion(goal.orientation, frame)
            new = reference_of(motion.goal[..., ERROR], rotation).expand_as(frame)
            values = columns.position, columns.rate, motion.curvature(columns)
            error, error_rate, error_curvature = (x[..., ERROR] for x in values)
            turned = orientation_error.retarget(error, error_rate, error_curvature, frame, new)
            position, rate, curvature = (
                replaced(x, ERROR, part) for x, part in zip(values, turned, strict=True)
            )
            target = replaced(target, POSITION, goal.position)
            columns = replace(columns, position=position, rate=rate)
            columns = replace(columns, goal=motion.resting_point(columns, curvature))
            frame = new
        if goal_body is not None:
            target = replaced(target, BODY, goal_body)
        return Retargeted(columns, frame, target)

    def external_acceleration(
        self, motion: LinearPrimitive, columns: DMPState, frame: Tensor, coupling: Any
    ) -> Tensor | None:
        """Of the position [m/s^2], (3), or of the pose, (6), in the base frame."""
        if coupling is None:
            return None
        values = columns.position
        coupling = to_tensor(coupling, values.dtype, values.device)
        push = replaced(torch.zeros_like(values), POSITION, coupling[..., :3])
        if coupling.shape[-1] == 3:
            return push
        # The second derivative of the error is linear in the angular acceleration.
        rate = orientation_error.error_rate(values[..., ERROR], coupling[..., 3:])
        return replaced(push, ERROR, rate)

    def via_points(
        self,
        motion: LinearPrimitive,
        now: ColumnPoints,
        value: Pose | Any,
        velocity: Points | None,
        body: Points | None = None,
        body_velocity: Points | None = None,
    ) -> ColumnPoints:
        """Each part of a pose on its own; NaN leaves it free."""
        if value is not None and not isinstance(value, Pose):
            raise ValueError(
                "the value of a pose's via points is a Pose; NaN leaves parts free"
            )
        place = None if value is None else value.position
        rotation = None if value is None else value.orientation
        position = now.position
        twist = given_points(velocity, now.velocity, "velocity", columns=6)
        error, error_rate = via_errors(
            self.reference(motion), position[..., ERROR], rotation, twist[..., 3:]
        )
        place = given_points(place, position[..., POSITION])
        body = given_points(body, position[..., BODY], "body")
        body_rate = given_points(body_velocity, now.velocity[..., BODY], "body_velocity")
        return ColumnPoints(
            torch.cat([place, error, body], dim=-1),
            torch.cat([twist[..., :3], error_rate, body_rate], dim=-1),
        )


class PoseDMP(WrappedPrimitive[Pose, PoseTrajectory, PoseState]):
    """Discrete movement primitive of a pose under one phase.

    Position, orientation error (see `orientation_error`) and, if given, K coordinates of the
    arm's body shape are columns of one linear primitive. The body, such as a redundant joint
    or an arm angle, keeps its demonstrated shape when the pose is sent to another goal.

    Values are `Pose`s, velocities twists (linear [m/s], angular [rad/s]), (*batch, 6),
    couplings accelerations of the position [m/s^2], (*batch, 3), or of the pose, (*batch, 6),
    the angular part in the base frame. `rollout`, `initial_state` and `with_ends` also take
    `start_body` and `goal_body`, (*batch, K), and so does `step` take `goal_body`.

    The fit report has residuals by column: position [m], orientation error [rad], body. Those
    of the error's components bound those of the angle. The largest range, which `nrmse`
    divides by, mixes units: prefer `select` and read one kind at a time.
    """

    goal_orientation: Tensor
    motion: JointDMP

    def __init__(self, motion: JointDMP, goal_orientation: Float[Tensor, "*batch 4"]):
        """Put a primitive together; `fit` is the usual way to one.

        Args:
            motion: Of position (3), orientation error (3) and body (K).
            goal_orientation: Unit quaternion (w, x, y, z) at which it ends; the error is taken
                to a reference as in `OrientationDMP`.
        """
        super().__init__()
        self.motion = motion
        self.register_buffer("goal_orientation", goal_orientation)

    @classmethod
    def fit(
        cls,
        time: Times,
        position: Points,
        orientation: Quaternions,
        n_basis: int | None = None,
        body: Points | None = None,
        mask: Mask | None = None,
        *,
        scaling: str = "none",
        **options: Unpack[FitOptions],
    ) -> "PoseDMP":
        """Learn one primitive from each demonstration.

        Args:
            time: Timestamps [s], (T,) or (*B, T).
            position: (*B, T, 3) [m]. Its floating dtype is the primitive's.
            orientation: Unit quaternions (w, x, y, z), (*B, T, 4); signs may flip.
            n_basis: N, unless `basis` is given; None as for `JointDMP.fit`.
            body: Coordinates learned along, (*B, T, K), or (T,) for one.
            mask: (*B, T), false where a sample does not count.
            scaling: Of the forcing term of the position, as for `JointDMP.fit`; `"rotation"`
                turns and dilates its path with the way from start to goal.
            options: How to fit; see `FitOptions`.

        Raises:
            ValueError: Bad samples (says which), or a scaling that the motion forbids.
        """
        time, mask, (position, orientation, body) = padded(
            time, mask, position, orientation, body
        )
        error, goal = fitted_error(time, orientation, mask)
        coordinates = demonstrated_columns(time, position, error, body, mask)
        motion = JointDMP.fit(
            time,
            coordinates,
            n_basis,
            mask=mask,
            units="m, rad, body",
            scaling=find_scaling(scaling, columns=POSITION.stop),
            **options,
        )
        return cls(motion, goal.to(coordinates))

    @property
    def adapter(self) -> PoseCoordinates:
        """Position, error and body."""
        return PoseCoordinates(self.goal_orientation)

    @property
    def start(self) -> Pose:
        """Where the demonstration starts."""
        rotation = to_orientation(self.motion.start[..., ERROR], self.reference)
        return Pose(self.motion.start[..., POSITION], rotation)

    @property
    def goal(self) -> Pose:
        """Where the demonstration ends."""
        return Pose(self.motion.goal[..., POSITION], self.goal_orientation)

    @property
    def reference(self) -> Float[Tensor, "*batch 4"]:
        """What the orientation error is taken to."""
        return reference_of(self.motion.goal[..., ERROR], self.goal_orientation)

    def with_motion[S: "PoseDMP"](self: S, motion: JointDMP, frame: Tensor | None = None) -> S:
        """Around another motion of the columns, to this reference or another."""
        reference = self.reference if frame is None else frame
        return type(self)(motion, to_orientation(motion.goal[..., ERROR], reference))

    def _own_tensors(self) -> dict[str, Tensor]:
        return {"goal_orientation": self.goal_orientation}

    @classmethod
    def _restored[S: "PoseDMP"](cls: type[S], saved: SavedModel) -> S:
        return cls(JointDMP.restore(saved), saved.tensor("goal_orientation"))


def check_pose(name: str, value: Any) -> None:
    """Raise ValueError unless a value is None or a finite `Pose`."""
    if value is None:
        return
    if not isinstance(value, Pose):
        raise ValueError(
            f"{name} of a pose primitive must be a Pose, got {type(value).__name__}: "
            "Pose(position, orientation), (..., 3) and (..., 4) as (w, x, y, z)"
        )
    finite(f"position of {name}", value.position)
    finite(f"orientation of {name}", value.orientation)


def demonstrated_columns(
    time: Times,
    position: Points,
    error: Tensor,
    body: Points | None,
    mask: Mask | None,
) -> Tensor:
    """Checked samples (*B, T, 6 + K), in the dtype of the position.

    Raises:
        ValueError: Bad samples; says which.
    """
    checked = check_samples(time, position, mask=mask)
    if checked.position.shape[-2] != 3:
        raise ValueError(f"position must have 3 columns, got {checked.position.shape[-2]}")
    columns = [checked.columns, error.to(checked.position)]
    if body is not None:
        columns.append(check_samples(time, body, mask=mask, name="body").columns)
    try:
        return torch.cat(columns, dim=-1)
    except RuntimeError:
        shapes = ", ".join(str(tuple(column.shape)) for column in columns)
        raise ValueError(f"position, orientation error and body differ: {shapes}") from None


def joined(position: Tensor, error: Tensor, body: Vectors, like: Tensor) -> Tensor:
    """The columns of a linear primitive, broadcast and side by side."""
    columns = [to_tensor(part, like.dtype, like.device) for part in (position, error, body)]
    batch = broadcast_shapes(*(column.shape[:-1] for column in columns))
    return torch.cat([column.expand(*batch, -1) for column in columns], dim=-1)


def replaced(values: Tensor, columns: slice, new: Vectors) -> Tensor:
    """`values` with some columns exchanged; differentiable in both."""
    new = to_tensor(new, values.dtype, values.device)
    stop = values.shape[-1] if columns.stop is None else columns.stop
    new = new.expand(*values.shape[:-1], stop - columns.start)
    return torch.cat([values[..., : columns.start], new, values[..., stop:]], dim=-1)
