"""Movement primitives of an orientation, described by its error e to a reference.

The components of e are columns of a linear primitive (see `linear_primitive`).

The equation of motion, e'' = alpha (beta (0 - e) - e') + f with the forcing term f, contains no
approximation for small angles (Koutras and Doulgeri 2019). The reference is the goal by
default; `orientation_error.py` defines e.
"""

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Unpack

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp import orientation_error, ude_formulation
from hrc_learn.dmp._arguments import (
    Mask,
    Points,
    Quaternions,
    Times,
    Vectors,
    broadcast_shapes,
    checked_vector,
    fits_numpy,
    to_tensor,
)
from hrc_learn.dmp.closed_loop_step import DMPState
from hrc_learn.dmp.joint_dmp import FitOptions, JointDMP
from hrc_learn.dmp.linear_primitive import Boundary
from hrc_learn.dmp.motion_primitive import WrappedPrimitive, via_values
from hrc_learn.dmp.orientation_error import (
    exp_numbers,
    fitted_error,
    reference_of,
    retarget_numbers,
    to_orientation,
    unit_quaternion,
)
from hrc_learn.dmp.samples import check_samples, padded
from hrc_learn.dmp.trajectory import ArrayOutputs, Trajectory, output
from hrc_learn.dmp.ude_formulation import UdePrimitive
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.model_files import SavedModel


class ErrorColumns:
    """Access to the orientation error in the columns of a trajectory or of a state."""

    error_columns: ClassVar[slice] = slice(0, 3)
    motion: Any

    @property
    def _error(self) -> Tensor:
        return self.motion.position[..., self.error_columns]

    @property
    def _rate(self) -> Tensor:
        return self.motion.velocity[..., self.error_columns]


class OrientationTrajectory(ErrorColumns, ArrayOutputs):
    """Orientation over time; each output is computed on first access."""

    outputs = ("time", "orientation", "angular_velocity", "angular_acceleration")

    def __init__(self, motion: Trajectory, reference: Float[Tensor, "*batch 4"]):
        """Describe an orientation by the motion of its error columns and their reference."""
        self.motion = motion
        """Motion of the columns."""
        self._reference = reference

    @property
    def time(self) -> Float[Tensor, "*batch T"]:
        """Time since the start of the motion [s]."""
        return self.motion.time

    @output
    def orientation(self) -> Float[Tensor, "*batch T 4"]:
        """Unit quaternions (w, x, y, z), continuous in sign."""
        return orientation_error.to_orientations(self._error, self._reference)

    @output
    def angular_velocity(self) -> Float[Tensor, "*batch T 3"]:
        """Angular velocity in the base frame [rad/s]."""
        return orientation_error.angular_velocity(self._error, self._rate)

    @output
    def angular_acceleration(self) -> Float[Tensor, "*batch T 3"]:
        """Angular acceleration in the base frame [rad/s^2]."""
        second = self.motion.acceleration[..., self.error_columns]
        return orientation_error.angular_acceleration(self._error, self._rate, second)


@dataclass(frozen=True, kw_only=True, eq=False)
class OrientationState(ErrorColumns):
    """State of an orientation primitive in closed loop."""

    motion: DMPState
    """State of the columns, which include the error to the reference."""
    reference: Float[Tensor, "*batch 4"]
    """Reference of the error; the goal by default."""

    @property
    def orientation(self) -> Float[Tensor, "*batch 4"]:
        """Unit quaternion (w, x, y, z)."""
        return to_orientation(self._error, self.reference)

    @property
    def angular_velocity(self) -> Float[Tensor, "*batch 3"]:
        """Angular velocity in the base frame [rad/s]."""
        return orientation_error.angular_velocity(self._error, self._rate)


torch.export.register_dataclass(
    OrientationState, serialized_type_name="hrc_learn.dmp.OrientationState"
)


class OrientedPrimitive[Value, Path, State: OrientationState](
    WrappedPrimitive[Value, Path, State]
):
    """Primitive whose columns are a position, an orientation error, and body coordinates.

    Body coordinates are, for example, an arm angle or a redundant joint.

    Position and body may have no columns. In the methods, `frame` is the reference.
    """

    goal_orientation: Tensor
    """Unit quaternion at the end of the demonstration, (*batch, 4)."""
    motion: JointDMP
    error_columns: ClassVar[slice]
    state_type: ClassVar[type]
    trajectory_type: ClassVar[type]

    def __init__(self, motion: JointDMP, goal_orientation: Float[Tensor, "*batch 4"]):
        """Assemble a primitive; `fit` is the usual way to make one.

        Args:
            motion: Motion of the columns. If e is the orientation error in `motion.goal`, the
                reference is exp(e) * goal_orientation. An error other than zero allows
                primitives with different goals to have one common reference.
            goal_orientation: Unit quaternion (w, x, y, z) at the end.
        """
        super().__init__()
        self.motion = motion
        self.register_buffer("goal_orientation", goal_orientation)

    @abstractmethod
    def _parts(self, name: str, value: Any) -> tuple[Tensor | None, Any]:
        """Position and orientation of a value; None for a part that is missing.

        Raises:
            ValueError: A value of another kind.
        """

    @property
    def reference(self) -> Float[Tensor, "*batch 4"]:
        """Reference of the orientation error."""
        return reference_of(self.motion.goal[..., self.error_columns], self.goal_orientation)

    def with_motion[S: "OrientedPrimitive"](
        self: S, motion: JointDMP, frame: Tensor | None = None
    ) -> S:
        """Primitive with another motion of the columns, in `frame`; None: the current frame."""
        reference = self.reference if frame is None else frame
        return type(self)(
            motion, to_orientation(motion.goal[..., self.error_columns], reference)
        )

    def state_of(self, columns: DMPState, frame: Tensor) -> State:
        """State of the columns and their reference."""
        return self.state_type(motion=columns, reference=frame)

    def tensors(self) -> dict[str, Tensor]:
        """Tensors of the columns, and the goal orientation."""
        return self.motion.tensors() | {"goal_orientation": self.goal_orientation}

    def with_tensors[S: "OrientedPrimitive"](self: S, tensors: Mapping[str, Tensor]) -> S:
        """Primitive with other tensors, named as in `tensors`."""
        return type(self)(self.motion.with_tensors(tensors), tensors["goal_orientation"])

    def _columns(self, state: State) -> tuple[DMPState, Tensor]:
        return state.motion, state.reference

    def _trajectory(self, columns: Trajectory, frame: Tensor) -> Path:
        return self.trajectory_type(columns, frame)

    @property
    def _others(self) -> tuple[slice, slice]:
        """Columns of the position and of the body."""
        return slice(0, self.error_columns.start), slice(self.error_columns.stop, None)

    def _joined(
        self, usual: Tensor, position: Any, error: Any, body: Any
    ) -> Float[Tensor, "*batch columns"]:
        """Columns of the given parts, broadcast; a part that is None has its `usual` values."""
        columns, (P, B) = [], self._others
        for part, x in ((P, position), (self.error_columns, error), (B, body)):
            x = usual[..., part] if x is None else to_tensor(x, usual.dtype, usual.device)
            columns.append(x)
        batch = broadcast_shapes(*(column.shape[:-1] for column in columns))
        return torch.cat([column.expand(*batch, -1) for column in columns], dim=-1)

    def _boundary(
        self,
        given: Boundary,
        duration: Tensor,
        start_body: Vectors | None = None,
        goal_body: Vectors | None = None,
    ) -> tuple[Boundary, Tensor]:
        motion, E, P = self.motion, self.error_columns, self._others[0]
        if all(x is None for x in (*given, start_body, goal_body)):
            return given, self.reference
        start, rotation = self._parts("start", given.start)
        goal, goal_rotation = self._parts("goal", given.goal)
        like, demonstrated = motion.start, motion.start_velocity
        demonstrated = demonstrated * (motion.duration / duration)[..., None]
        twist, omega = given.start_velocity, None
        if twist is not None:
            twist = checked_vector("start_velocity", twist, like[..., : E.stop])
            omega = twist[..., P.stop :]
        error, rate, reference = self._error_boundary(
            demonstrated[..., E], rotation, goal_rotation, omega
        )
        start_columns = self._joined(like, start, error, start_body)
        goal_columns = self._joined(motion.goal, goal, None, goal_body)
        if twist is None:
            # The scaling may rotate and scale the start velocity.
            per_s = motion.start_rate(start_columns, goal_columns)
            linear = (per_s / duration[..., None])[..., P]
        else:
            linear = twist[..., P]
        # A twist does not include the body, which starts with its demonstrated velocity.
        velocity = self._joined(demonstrated, linear, rate, None)
        return Boundary(start_columns, goal_columns, velocity), reference

    def _error_boundary(
        self,
        rate: Float[Tensor, "*#batch 3"],
        start: Quaternions | None,
        goal: Quaternions | None,
        omega: Float[Tensor, "*#batch 3"] | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Error at the start of a motion, its rate [rad/s], and the reference of the error.

        Args:
            rate: Demonstrated rate, adapted to the duration of the motion.
            start: New start; None keeps the demonstrated value, here and below.
            goal: New goal.
            omega: New angular velocity at the start [rad/s].
        """
        E, reference = self.error_columns, self.reference
        error = self.motion.start[..., E]
        if start is None and goal is None and omega is None:
            return error, rate, reference
        if omega is None:
            omega = orientation_error.angular_velocity(*torch.broadcast_tensors(error, rate))
        q = to_orientation(error, reference) if start is None else unit_quaternion(start, error)
        if goal is not None:
            reference = reference_of(self.motion.goal[..., E], unit_quaternion(goal, error))
        error = orientation_error.nearest_turn(orientation_error.to_error(q, reference), error)
        return error, orientation_error.error_rate(error, omega), reference

    def _retarget(
        self,
        columns: DMPState,
        frame: Tensor,
        goal: Value | None,
        filtered: bool,
        goal_body: Vectors | None = None,
    ) -> tuple[DMPState, Tensor, Tensor]:
        B = self._others[1]
        moved = None if filtered else self._retarget_numbers(columns, frame, goal)
        if moved is not None:
            columns, frame = moved
        elif goal is not None:
            position, rotation = self._parts("goal", goal)
            rotation = unit_quaternion(rotation, frame)
            new = reference_of(self.motion.goal[..., self.error_columns], rotation)
            new = new.expand_as(frame)
            columns, frame = self._to_reference(columns, frame, new, filtered), new
            if position is not None:
                position = checked_vector("position of goal", position, frame[..., :3])
                target = self._joined(columns.target, position, None, None)
                columns = replace(columns, target=target)
        if goal_body is None:
            return columns, frame, columns.target
        goal_body = checked_vector("goal_body", goal_body, columns.target[..., B])
        return columns, frame, self._joined(columns.target, None, None, goal_body)

    def _retarget_numbers(
        self, columns: DMPState, frame: Tensor, goal: Value | None
    ) -> tuple[DMPState, Tensor] | None:
        """Columns and reference of one motion for a goal that jumps, computed without tensors.

        Returns:
            Columns and reference. None where PyTorch has to compute them, or if a value is
            wrong; the computation in PyTorch then reports it.
        """
        E, motion = self.error_columns, self.motion
        given = columns.position, columns.rate, columns.target
        plain = type(motion) is JointDMP and fits_numpy(frame, *given)
        if goal is None or frame.ndim != 1 or not plain:
            return None
        parts: list[Any] = [goal]
        if isinstance(goal, Pose):
            parts = [goal.orientation, goal.position]
        parts = [to_tensor(x, frame.dtype, frame.device) for x in parts]
        if [x.shape for x in parts] != [(4,), (3,)][: 1 + (E.start > 0)]:
            return None
        numbers = [number for x in parts for number in x.tolist()]
        q, place = numbers[:4], numbers[4:]
        if not (0.5 < (norm := math.hypot(*q)) < math.inf and math.isfinite(sum(place))):
            return None
        offset = motion.goal.tolist()[E]
        q = quaternion.product_of_components(exp_numbers(offset), [x / norm for x in q])
        y, rate, target = moved = [x.tolist() for x in given]
        y[E], rate[E] = retarget_numbers(y[E], rate[E], frame.tolist(), q)
        target[: E.start] = place
        y, rate, target = map(torch.from_numpy, np.array(moved, frame.numpy().dtype))
        return replace(columns, position=y, rate=rate, target=target), frame.new_tensor(q)

    def _to_reference(
        self, columns: DMPState, old: Tensor, new: Tensor, filtered: bool
    ) -> DMPState:
        """Columns with the error to another reference.

        Orientation and angular velocity stay the same, and if `filtered`, so does the angular
        acceleration.
        """
        motion, E = self.motion, self.error_columns
        error = columns.position[..., E], columns.rate[..., E]
        turned = orientation_error.retarget(*error, old, new)
        position = self._joined(columns.position, None, turned[0], None)
        rate = self._joined(columns.rate, None, turned[1], None)
        moved = replace(columns, position=position, rate=rate)
        if not filtered:
            return moved
        second = motion.second_derivative(columns)
        slope = orientation_error.angular_acceleration(*error, second[..., E])
        # The angular acceleration is linear in e'', plus a bias from the rotation.
        bias = orientation_error.angular_acceleration(*turned, torch.zeros_like(slope))
        curve = orientation_error.error_rate(turned[0], slope - bias)
        goal = motion.equilibrium_goal(moved, self._joined(second, None, curve, None))
        return replace(moved, goal=goal)

    def _acceleration(self, columns: DMPState, frame: Tensor, coupling: Any) -> Tensor:
        """Second derivatives of the columns for a linear acceleration, an angular one, or both.

        The error's second derivative is linear in the angular acceleration in the base frame.
        """
        values, E, (P, _) = columns.position, self.error_columns, self._others
        coupling = to_tensor(coupling, values.dtype, values.device)
        if coupling.shape[-1:] != (P.stop,):  # not a linear acceleration alone
            checked_vector("coupling", coupling, values[..., : E.stop])
        rate = None
        if coupling.shape[-1] > P.stop:
            rate = orientation_error.error_rate(values[..., E], coupling[..., P.stop :])
        return self._joined(torch.zeros_like(values), coupling[..., P], rate, None)

    def _via(
        self, now: Tensor, value: Value | None, velocity: Points | None
    ) -> tuple[Tensor, Tensor]:
        E, (P, B) = self.error_columns, self._others
        place, rotation = self._parts("value", value)
        twist = via_values(velocity, now, "velocity", columns=E.stop)
        error, rate = _via_errors(self.reference, now[..., E], rotation, twist[..., P.stop :])
        place, body = via_values(place, now[..., P]), via_values(None, now[..., B])
        return torch.cat([place, error, body], -1), torch.cat([twist[..., P], rate, body], -1)

    @classmethod
    def restore[S: "OrientedPrimitive"](cls: type[S], saved: SavedModel) -> S:
        return cls(JointDMP.restore(saved), saved.tensor("goal_orientation"))


class OrientationDMP(OrientedPrimitive[Quaternions, OrientationTrajectory, OrientationState]):
    """Movement primitive of an orientation.

    The columns are the error e to a reference, which is the goal by default. By default,
    forcing term and spring act on e and its derivative, without an approximation for small
    angles. The formulation `"ude"` uses the state of Ude et al. 2014 instead. Both signs of a
    quaternion give the same motion.

    Values are unit quaternions (w, x, y, z), (*batch, 4); velocities and couplings are angular,
    in the base frame, (*batch, 3). Motions to a new start or goal rotate in the same direction
    as the demonstration. The fit report has residuals of the components of the error [rad],
    which bound the residual of the angle.
    """

    error_columns: ClassVar[slice] = OrientationState.error_columns
    state_type: ClassVar[type] = OrientationState
    trajectory_type: ClassVar[type] = OrientationTrajectory

    @classmethod
    def fit(
        cls,
        time: Times,
        orientation: Quaternions,
        n_basis: int | None = None,
        mask: Mask | None = None,
        *,
        formulation: str = "log",
        **options: Unpack[FitOptions],
    ) -> "OrientationDMP":
        """Fit one primitive to each demonstration.

        Args:
            time: Timestamps [s], (T,) or (*B, T).
            orientation: Unit quaternions (w, x, y, z), (*B, T, 4). Signs may flip; neighbours
                must be less than half a turn apart.
            n_basis: Number N of basis functions, unless `basis` is given; None as for
                `JointDMP.fit`.
            mask: Mask (*B, T), false at samples to ignore.
            formulation: `"log"`, or `"ude"` for the formulation of Ude et al. 2014.
            options: Options of the fit; see `FitOptions`.

        Raises:
            ValueError: Bad samples (the message names them), or an unknown formulation.
        """
        kind = _formulated(formulation)
        time, mask, (orientation,) = padded(time, mask, orientation)
        error, goal = fitted_error(time, orientation, mask)
        motion = JointDMP.fit(time, error, n_basis, mask=mask, **options)
        if kind is UdePrimitive:
            motion = kind.refitted(motion, check_samples(time, error, mask=mask))
        return cls(motion, goal)

    @property
    def formulation(self) -> str:
        """State on which forcing term and spring act: `"log"` (e and e') or `"ude"`."""
        return "ude" if isinstance(self.motion, UdePrimitive) else "log"

    @property
    def start(self) -> Float[Tensor, "*batch 4"]:
        """Orientation at the start of the demonstration."""
        return to_orientation(self.motion.start, self.reference)

    @property
    def goal(self) -> Float[Tensor, "*batch 4"]:
        """Orientation at the end of the demonstration."""
        return self.goal_orientation

    def _parts(self, name: str, value: Any) -> tuple[None, Any]:
        return None, value

    def _to_reference(
        self, columns: DMPState, old: Tensor, new: Tensor, filtered: bool
    ) -> DMPState:
        if isinstance(self.motion, UdePrimitive):
            return ude_formulation.to_reference(columns, old, new)
        return super()._to_reference(columns, old, new, filtered)

    def _acceleration(self, columns: DMPState, frame: Tensor, coupling: Any) -> Tensor:
        if isinstance(self.motion, UdePrimitive):
            # The rate in this formulation is minus the angular velocity.
            return -checked_vector("coupling", coupling, columns.position)
        return super()._acceleration(columns, frame, coupling)

    @classmethod
    def restore[S: "OrientationDMP"](cls: type[S], saved: SavedModel) -> S:
        named = "formulation" in saved.config
        kind = saved.part("formulation", str, _formulated) if named else JointDMP
        return cls(kind.restore(saved), saved.tensor("goal_orientation"))


def _formulated(name: Any) -> type[JointDMP]:
    """Class of the primitive that moves the error in this formulation."""
    formulations = {"log": JointDMP, "ude": UdePrimitive}
    if name not in formulations:
        known = ", ".join(formulations)
        raise ValueError(f"unknown formulation {name!r}; choose from {known}")
    return formulations[name]


def _via_errors(
    reference: Tensor, error: Tensor, value: Any, velocity: Any
) -> tuple[Tensor, Tensor]:
    """Via points of an orientation as errors and their rates [rad/s]; NaN where free.

    Args:
        reference: Reference of the errors, (*batch, 4).
        error: Errors of the unchanged motion, (*batch, n, 3).
        value: Unit quaternions, (*batch, n, 4), or None.
        velocity: Angular velocities [rad/s], (*batch, n, 3), or None.
    """
    q = via_values(value, error, columns=4)
    free = q.isnan().any(-1, keepdim=True)
    reference = reference.detach().double()[..., None, :].expand_as(q)
    # NaN is replaced before any function, because it would make gradients NaN.
    q = quaternion.normalize(torch.where(free, reference, q))
    via = orientation_error.nearest_turn(orientation_error.to_error(q, reference), error)
    omega = via_values(velocity, error, "velocity")
    unknown = omega.isnan().any(-1, keepdim=True)
    rate = orientation_error.error_rate(torch.where(free, error, via), omega.nan_to_num())
    return via.masked_fill(free, torch.nan), rate.masked_fill(unknown, torch.nan)
