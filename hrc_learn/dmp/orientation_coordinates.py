"""An orientation in linear columns: its error to a reference, which is the goal unless said.

e'' = alpha (beta (0 - e) - e') + f, exact at all angles (Koutras and Doulgeri 2019); see
`orientation_error.py` for the error and `ude_formulation.py` for the other formulation.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp import orientation_error
from hrc_learn.dmp._types import Points, Quaternions, Vectors, to_tensor
from hrc_learn.dmp.closed_loop_step import DMPState
from hrc_learn.dmp.coordinate_adapter import CoordinateAdapter, Retargeted
from hrc_learn.dmp.joint_dmp import given_points
from hrc_learn.dmp.linear_primitive import ColumnEnds, LinearPrimitive
from hrc_learn.dmp.orientation_error import error_ends, reference_of, unit_quaternion
from hrc_learn.geometry import quaternion


class OrientationTrajectory:
    """An orientation over time, each output computed when first asked for."""

    def __init__(self, errors: Any, reference: Float[Tensor, "*batch 4"], first: int = 0):
        """Read the motion of an error, found in columns `first` to `first` + 3 of `errors`."""
        self._errors = errors
        self._reference = reference
        self._columns = slice(first, first + 3)

    @property
    def time(self) -> Float[Tensor, "*batch T"]:
        """Since the start of the motion [s]."""
        return self._errors.time

    @cached_property
    def orientation(self) -> Float[Tensor, "*batch T 4"]:
        """Unit quaternions (w, x, y, z), continuous in sign."""
        return orientation_error.to_orientations(self._error, self._reference)

    @cached_property
    def angular_velocity(self) -> Float[Tensor, "*batch T 3"]:
        """In the base frame [rad/s]."""
        return orientation_error.angular_velocity(self._error, self._rate)

    @cached_property
    def angular_acceleration(self) -> Float[Tensor, "*batch T 3"]:
        """In the base frame [rad/s^2]."""
        curvature = self._errors.acceleration[..., self._columns]
        return orientation_error.angular_acceleration(self._error, self._rate, curvature)

    @property
    def _error(self) -> Tensor:
        return self._errors.position[..., self._columns]

    @property
    def _rate(self) -> Tensor:
        return self._errors.velocity[..., self._columns]


@dataclass(frozen=True, kw_only=True, eq=False)
class OrientationState:
    """Where an orientation primitive is while it is stepped."""

    motion: DMPState
    """Of the error to the reference."""
    reference: Float[Tensor, "*batch 4"]
    """The goal, unless the primitive says otherwise."""

    @property
    def orientation(self) -> Float[Tensor, "*batch 4"]:
        """Unit quaternion (w, x, y, z)."""
        return orientation_error.to_orientation(self.motion.position, self.reference)

    @property
    def angular_velocity(self) -> Float[Tensor, "*batch 3"]:
        """In the base frame [rad/s]."""
        return orientation_error.angular_velocity(self.motion.position, self.motion.velocity)


torch.export.register_dataclass(
    OrientationState, serialized_type_name="hrc_learn.dmp.OrientationState"
)


@dataclass(frozen=True, eq=False)
class OrientationCoordinates(
    CoordinateAdapter[Quaternions, OrientationTrajectory, OrientationState]
):
    """Three columns of error; the frame is the reference that it is taken to."""

    goal: Tensor
    """Unit quaternion at which the demonstration ends, (*batch, 4)."""
    error_columns: ClassVar[slice] = slice(0, 3)

    def reference(self, motion: LinearPrimitive) -> Float[Tensor, "*batch 4"]:
        """What the demonstrated error is taken to."""
        return reference_of(motion.goal, self.goal)

    def ends(
        self,
        motion: LinearPrimitive,
        start: Quaternions | None,
        goal: Quaternions | None,
        duration: Tensor,
        velocity: Vectors | None,
    ) -> tuple[ColumnEnds, Tensor]:
        """Error at the start and its rate; the goal moves the reference, not the columns."""
        rate = motion.start_velocity * (motion.duration / duration)[..., None]
        error, rate, reference = error_ends(
            motion.start, rate, motion.goal, self.goal, start, goal, velocity
        )
        return ColumnEnds(error, None, rate), reference

    def trajectory(self, columns: Any, frame: Tensor) -> OrientationTrajectory:
        """Orientations along the error."""
        return OrientationTrajectory(columns, frame)

    def begin(self, columns: DMPState, frame: Tensor) -> tuple[DMPState, Tensor]:
        """A reference for each of the batch."""
        return columns, frame.expand(*columns.position.shape[:-1], 4)

    def state(self, columns: DMPState, frame: Tensor) -> OrientationState:
        """The error with its reference."""
        return OrientationState(motion=columns, reference=frame)

    def columns(self, state: OrientationState) -> tuple[DMPState, Tensor]:
        """The error and its reference."""
        return state.motion, state.reference

    def retarget(
        self,
        motion: LinearPrimitive,
        columns: DMPState,
        frame: Tensor,
        goal: Quaternions | None,
    ) -> Retargeted:
        """The same motion of the orientation, as the error to a new reference."""
        if goal is None:
            return Retargeted(columns, frame)
        new = reference_of(motion.goal, unit_quaternion(goal, frame)).expand_as(frame)
        return Retargeted(self._to_reference(motion, columns, frame, new), new)

    def external_acceleration(
        self, motion: LinearPrimitive, columns: DMPState, frame: Tensor, coupling: Any
    ) -> Tensor | None:
        """An angular acceleration in the base frame [rad/s^2], in which e'' is linear."""
        if coupling is None:
            return None
        coupling = to_tensor(coupling, frame.dtype, frame.device)
        return orientation_error.error_rate(columns.position, coupling)

    def via_points(
        self,
        motion: LinearPrimitive,
        s: Tensor,
        position: Tensor,
        velocity: Tensor,
        value: Quaternions | None,
        rate: Points | None,
    ) -> tuple[Tensor, Tensor]:
        """Errors on the branch nearest to the motion's, and their rates."""
        return via_errors(self.reference(motion), position, value, rate)

    def _to_reference(
        self, motion: LinearPrimitive, columns: DMPState, old: Tensor, new: Tensor
    ) -> DMPState:
        """With a goal filter the angular acceleration goes on as it was."""
        error, rate, curvature = orientation_error.retarget(
            columns.position, columns.rate, motion.curvature(columns), old, new
        )
        columns = replace(columns, position=error, rate=rate)
        return replace(columns, goal=motion.resting_point(columns, curvature))


def via_errors(
    reference: Tensor, error: Tensor, value: Any, velocity: Any
) -> tuple[Tensor, Tensor]:
    """Via points of an orientation as errors and their rates [rad/s]; NaN where free.

    Args:
        reference: What errors are taken to, (*batch, 4).
        error: There when nothing else is asked for, (*batch, n, 3).
        value: Unit quaternions, (*batch, n, 4), or None.
        velocity: Angular [rad/s], (*batch, n, 3), or None.
    """
    q = given_points(value, error, columns=4)
    free = q.isnan().any(-1, keepdim=True)
    reference = reference.detach().double()[..., None, :].expand_as(q)
    # Nothing that is not a number goes through a function, or no gradient comes back.
    q = quaternion.normalize(torch.where(free, reference, q))
    via = orientation_error.nearest_turn(orientation_error.to_error(q, reference), error)
    omega = given_points(velocity, error, "velocity")
    still = omega.isnan().any(-1, keepdim=True)
    rate = orientation_error.error_rate(torch.where(free, error, via), omega.nan_to_num())
    return via.masked_fill(free, torch.nan), rate.masked_fill(still, torch.nan)
