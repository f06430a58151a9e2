"""Movement primitive of a pose, and of body coordinates such as an arm angle along with it."""

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
    broadcast_shapes,
    finite,
    to_tensor,
)
from hrc_learn.dmp._system.trajectory import ArrayOutputs, Trajectory
from hrc_learn.dmp.closed_loop_step import DMPState
from hrc_learn.dmp.fitting.motion_fit import FitOptions
from hrc_learn.dmp.fitting.samples import check_samples, padded
from hrc_learn.dmp.forcing_scale import find_scaling
from hrc_learn.dmp.joint_dmp import JointDMP, via_values
from hrc_learn.dmp.linear_primitive import Boundary, LinearPrimitive
from hrc_learn.dmp.motion_primitive import (
    ColumnPoints,
    CoordinateAdapter,
    Retargeted,
    WrappedPrimitive,
)
from hrc_learn.dmp.orientation_dmp import OrientationTrajectory, via_errors
from hrc_learn.dmp.orientation_error import (
    error_boundary,
    fitted_error,
    reference_of,
    to_orientation,
    unit_quaternion,
)
from hrc_learn.geometry import Pose
from hrc_learn.model_files import SavedModel

POSITION, ERROR, BODY = slice(0, 3), slice(3, 6), slice(6, None)
"""Columns of a pose: position [m], orientation error [rad], and body coordinates."""


class PoseTrajectory(ArrayOutputs):
    """Pose over time; each output is computed on first access."""

    outputs = (
        *("time", "position", "orientation", "velocity", "angular_velocity"),
        *("acceleration", "angular_acceleration", "body", "body_velocity"),
    )

    def __init__(self, motion: Trajectory, reference: Float[Tensor, "*batch 4"]):
        self._motion = motion
        self._rotation = OrientationTrajectory(motion, reference, first=ERROR.start)

    @property
    def time(self) -> Float[Tensor, "*batch T"]:
        """Time since the start of the motion [s]."""
        return self._motion.time

    @property
    def position(self) -> Float[Tensor, "*batch T 3"]:
        """Position [m]."""
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
        """Linear velocity [m/s]."""
        return self._motion.velocity[..., POSITION]

    @property
    def angular_velocity(self) -> Float[Tensor, "*batch T 3"]:
        """Angular velocity in the base frame [rad/s]."""
        return self._rotation.angular_velocity

    @cached_property
    def twist(self) -> Float[Tensor, "*batch T 6"]:
        """Twist (linear [m/s], angular [rad/s]) in the base frame."""
        return torch.cat([self.velocity, self.angular_velocity], dim=-1)

    @property
    def acceleration(self) -> Float[Tensor, "*batch T 3"]:
        """Linear acceleration [m/s^2]."""
        return self._motion.acceleration[..., POSITION]

    @property
    def angular_acceleration(self) -> Float[Tensor, "*batch T 3"]:
        """Angular acceleration in the base frame [rad/s^2]."""
        return self._rotation.angular_acceleration

    @property
    def body(self) -> Float[Tensor, "*batch T K"]:
        """Body coordinates; K = 0 if none were learned."""
        return self._motion.position[..., BODY]

    @property
    def body_velocity(self) -> Float[Tensor, "*batch T K"]:
        """Velocity of the body coordinates, per second."""
        return self._motion.velocity[..., BODY]


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseState:
    """State of a pose primitive in closed loop."""

    motion: DMPState
    """State of position, error to the reference, and body."""
    reference: Float[Tensor, "*batch 4"]
    """Reference of the error; the goal's orientation by default."""

    @property
    def pose(self) -> Pose:
        """Position [m] and orientation."""
        columns = self.motion.position
        rotation = orientation_error.to_orientation(columns[..., ERROR], self.reference)
        return Pose(columns[..., POSITION], rotation)

    @property
    def twist(self) -> Float[Tensor, "*batch 6"]:
        """Twist (linear [m/s], angular [rad/s]) in the base frame."""
        columns, velocity = self.motion.position, self.motion.velocity
        angular = orientation_error.angular_velocity(columns[..., ERROR], velocity[..., ERROR])
        return torch.cat([velocity[..., POSITION], angular], dim=-1)

    @property
    def body(self) -> Float[Tensor, "*batch K"]:
        """Body coordinates."""
        return self.motion.position[..., BODY]


torch.export.register_dataclass(PoseState, serialized_type_name="hrc_learn.dmp.PoseState")


@dataclass(frozen=True, eq=False)
class PoseCoordinates(CoordinateAdapter[Pose, PoseTrajectory, PoseState]):
    """Position, orientation error and body as columns; the frame is the error's reference."""

    goal_orientation: Tensor
    """Unit quaternion at the end of the demonstration, (*batch, 4)."""
    error_columns: ClassVar[slice] = ERROR
    options: ClassVar[frozenset[str]] = frozenset(
        {"start_body", "goal_body", "body", "body_velocity"}
    )

    def reference(self, motion: LinearPrimitive) -> Float[Tensor, "*batch 4"]:
        """Reference of the demonstrated error."""
        return reference_of(motion.goal[..., ERROR], self.goal_orientation)

    def boundary(
        self,
        motion: LinearPrimitive,
        given: Boundary,
        duration: Tensor,
        start_body: Vectors | None = None,
        goal_body: Vectors | None = None,
    ) -> tuple[Boundary, Tensor]:
        """Columns of start and goal; a goal orientation moves the reference of the error."""
        like, (start, goal, velocity) = motion.start, given
        check_pose("start", start)
        check_pose("goal", goal)
        demonstrated = motion.start_velocity * (motion.duration / duration)[..., None]
        twist = None if velocity is None else to_tensor(velocity, like.dtype, like.device)
        error, rate, reference = error_boundary(
            like[..., ERROR],
            demonstrated[..., ERROR],
            motion.goal[..., ERROR],
            self.goal_orientation,
            None if start is None else start.orientation,
            None if goal is None else goal.orientation,
            None if twist is None else twist[..., 3:],
        )
        start_columns = _join(
            like[..., POSITION] if start is None else start.position,
            error,
            like[..., BODY] if start_body is None else start_body,
            like,
        )
        goal_columns = _join(
            motion.goal[..., POSITION] if goal is None else goal.position,
            motion.goal[..., ERROR],
            motion.goal[..., BODY] if goal_body is None else goal_body,
            like,
        )
        if twist is None:
            # The scaling may rotate and scale the start velocity.
            per_s = motion.start_rate(start_columns, goal_columns)
            linear = (per_s / duration[..., None])[..., POSITION]
        else:
            linear = twist[..., :3]
        # A twist does not include the body, which starts as demonstrated.
        velocity_columns = _join(linear, rate, demonstrated[..., BODY], like)
        return Boundary(start_columns, goal_columns, velocity_columns), reference

    def trajectory(self, columns: Trajectory, frame: Tensor) -> PoseTrajectory:
        """Poses of the columns."""
        return PoseTrajectory(columns, frame)

    def state(self, columns: DMPState, frame: Tensor) -> PoseState:
        """Columns and reference."""
        return PoseState(motion=columns, reference=frame)

    def columns(self, state: PoseState) -> tuple[DMPState, Tensor]:
        """Columns and reference."""
        return state.motion, state.reference

    def retarget(
        self,
        motion: LinearPrimitive,
        columns: DMPState,
        frame: Tensor,
        goal: Pose | None,
        goal_body: Vectors | None = None,
    ) -> Retargeted:
        """Columns with the error to a new reference; pose, twist and acceleration stay."""
        target = columns.target
        if goal is not None:
            check_pose("goal", goal)
            rotation = unit_quaternion(goal.orientation, frame)
            new = reference_of(motion.goal[..., ERROR], rotation).expand_as(frame)
            columns = self._to_reference(motion, columns, frame, new)
            target = _with_columns(target, POSITION, goal.position)
            frame = new
        if goal_body is not None:
            target = _with_columns(target, BODY, goal_body)
        return Retargeted(columns, frame, target)

    def external_acceleration(
        self, motion: LinearPrimitive, columns: DMPState, frame: Tensor, coupling: Any
    ) -> Tensor | None:
        """Second derivative of the columns for a linear, (3), or spatial acceleration, (6)."""
        if coupling is None:
            return None
        values = columns.position
        coupling = to_tensor(coupling, values.dtype, values.device)
        push = _with_columns(torch.zeros_like(values), POSITION, coupling[..., :3])
        if coupling.shape[-1] == 3:
            return push
        # The second derivative of the error is linear in the angular acceleration.
        rate = orientation_error.error_rate(values[..., ERROR], coupling[..., 3:])
        return _with_columns(push, ERROR, rate)

    def via_points(
        self,
        motion: LinearPrimitive,
        now: ColumnPoints,
        value: Pose | Any,
        velocity: Points | None,
        body: Points | None = None,
        body_velocity: Points | None = None,
    ) -> ColumnPoints:
        """Via points of position, orientation and body; NaN leaves a part free."""
        if value is not None and not isinstance(value, Pose):
            raise ValueError(
                "the value of a pose's via points is a Pose; NaN leaves parts free"
            )
        position = now.position
        twist = via_values(velocity, now.velocity, "velocity", columns=6)
        error, error_rate = via_errors(
            self.reference(motion),
            position[..., ERROR],
            None if value is None else value.orientation,
            twist[..., 3:],
        )
        place = None if value is None else value.position
        place = via_values(place, position[..., POSITION])
        body = via_values(body, position[..., BODY], "body")
        body_rate = via_values(body_velocity, now.velocity[..., BODY], "body_velocity")
        return ColumnPoints(
            torch.cat([place, error, body], dim=-1),
            torch.cat([twist[..., :3], error_rate, body_rate], dim=-1),
        )

    def _to_reference(
        self, motion: LinearPrimitive, columns: DMPState, old: Tensor, new: Tensor
    ) -> DMPState:
        """Columns with the error to another reference, for the same motion of the pose."""
        values = columns.position, columns.rate, motion.second_derivative(columns)
        error, error_rate, second = (x[..., ERROR] for x in values)
        turned = orientation_error.retarget(error, error_rate, second, old, new)
        position, rate, second = (
            _with_columns(x, ERROR, part) for x, part in zip(values, turned, strict=True)
        )
        columns = replace(columns, position=position, rate=rate)
        return replace(columns, goal=motion.equilibrium_goal(columns, second))


class PoseDMP(WrappedPrimitive[Pose, PoseTrajectory, PoseState]):
    """Discrete movement primitive of a pose under one phase.

    Position, orientation error (see `orientation_error`) and, if given, K body coordinates are
    columns of one linear primitive. The body, such as a redundant joint or an arm angle, keeps
    its demonstrated shape when the pose moves to another goal.

    Values are `Pose`s; velocities are twists (linear [m/s], angular [rad/s]), (*batch, 6);
    couplings are accelerations of the position [m/s^2], (*batch, 3), or of the pose,
    (*batch, 6), with the angular part in the base frame. `rollout`, `initial_state` and
    `with_boundary` also take `start_body` and `goal_body`, (*batch, K); `step` takes
    `goal_body`.

    The fit report has residuals by column: position [m], orientation error [rad], body. Those
    of the components of the error bound those of the angle. The largest range, by which
    `nrmse` divides, mixes units: use `select` to read one kind at a time.
    """

    goal_orientation: Tensor
    motion: JointDMP

    def __init__(self, motion: JointDMP, goal_orientation: Float[Tensor, "*batch 4"]):
        """Assemble a primitive; `fit` is the usual way to make one.

        Args:
            motion: Motion of position (3), orientation error (3) and body (K).
            goal_orientation: Unit quaternion (w, x, y, z) at the end; the reference of the
                error follows from it as in `OrientationDMP`.
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
        """Fit one primitive to each demonstration.

        Args:
            time: Timestamps [s], (T,) or (*B, T).
            position: (*B, T, 3) [m]. Its floating-point dtype is that of the primitive.
            orientation: Unit quaternions (w, x, y, z), (*B, T, 4); signs may flip.
            n_basis: N, unless `basis` is given; None as for `JointDMP.fit`.
            body: Body coordinates, (*B, T, K), or (T,) for one.
            mask: (*B, T), false at samples to ignore.
            scaling: Scaling of the position's forcing term, as for `JointDMP.fit`;
                `"rotation"` turns and scales the path with the displacement.
            options: Options of the fit; see `FitOptions`.

        Raises:
            ValueError: Bad samples (the message names them), or a motion for which the scaling
                is singular.
        """
        time, mask, (position, orientation, body) = padded(
            time, mask, position, orientation, body
        )
        error, goal = fitted_error(time, orientation, mask)
        columns = pose_columns(time, position, error, body, mask)
        motion = JointDMP.fit(
            time,
            columns,
            n_basis,
            mask=mask,
            units="m, rad, body",
            scaling=find_scaling(scaling, columns=POSITION.stop),
            **options,
        )
        return cls(motion, goal.to(columns))

    @property
    def adapter(self) -> PoseCoordinates:
        """Position, error and body."""
        return PoseCoordinates(self.goal_orientation)

    @property
    def start(self) -> Pose:
        """Pose at the start of the demonstration."""
        rotation = to_orientation(self.motion.start[..., ERROR], self.reference)
        return Pose(self.motion.start[..., POSITION], rotation)

    @property
    def goal(self) -> Pose:
        """Pose at the end of the demonstration."""
        return Pose(self.motion.goal[..., POSITION], self.goal_orientation)

    @property
    def reference(self) -> Float[Tensor, "*batch 4"]:
        """Reference of the orientation error."""
        return self.adapter.reference(self.motion)

    def with_motion[S: "PoseDMP"](self: S, motion: JointDMP, frame: Tensor | None = None) -> S:
        """Primitive with another motion of the columns, to this reference or another."""
        reference = self.reference if frame is None else frame
        return type(self)(motion, to_orientation(motion.goal[..., ERROR], reference))

    def _own_tensors(self) -> dict[str, Tensor]:
        return {"goal_orientation": self.goal_orientation}

    @classmethod
    def _restored[S: "PoseDMP"](cls: type[S], saved: SavedModel) -> S:
        return cls(JointDMP.restore(saved), saved.tensor("goal_orientation"))


def check_pose(name: str, value: Any) -> None:
    """Raise ValueError unless the value is None or a finite `Pose`."""
    if value is None:
        return
    if not isinstance(value, Pose):
        raise ValueError(
            f"{name} of a pose primitive must be a Pose, got {type(value).__name__}: "
            "Pose(position, orientation), (..., 3) and (..., 4) as (w, x, y, z)"
        )
    finite(f"position of {name}", value.position)
    finite(f"orientation of {name}", value.orientation)


def pose_columns(
    time: Times,
    position: Points,
    error: Tensor,
    body: Points | None,
    mask: Mask | None,
) -> Float[Tensor, "*B T columns"]:
    """Checked samples of position, error and body in one tensor, in the dtype of the position.

    Raises:
        ValueError: Bad samples; the message names them.
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


def _join(
    position: Tensor, error: Tensor, body: Vectors, like: Tensor
) -> Float[Tensor, "*batch columns"]:
    """Columns of a linear primitive, broadcast and concatenated."""
    columns = [to_tensor(part, like.dtype, like.device) for part in (position, error, body)]
    batch = broadcast_shapes(*(column.shape[:-1] for column in columns))
    return torch.cat([column.expand(*batch, -1) for column in columns], dim=-1)


def _with_columns(values: Tensor, columns: slice, new: Vectors) -> Float[Tensor, "*batch D"]:
    """Values with some columns replaced; differentiable in both."""
    new = to_tensor(new, values.dtype, values.device)
    stop = values.shape[-1] if columns.stop is None else columns.stop
    new = new.expand(*values.shape[:-1], stop - columns.start)
    return torch.cat([values[..., : columns.start], new, values[..., stop:]], dim=-1)
