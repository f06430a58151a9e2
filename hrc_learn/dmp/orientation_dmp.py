"""Movement primitive of an orientation, whose linear columns are its error to a reference.

e'' = alpha (beta (0 - e) - e') + f, exact at all angles (Koutras and Doulgeri 2019). The
reference is the goal unless said; see `orientation_error.py` for the error and
`_ude_formulation.py` for the other formulation.
"""

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
    Samples,
    Times,
    check_samples,
    padded,
    to_tensor,
)
from hrc_learn.dmp._closed_loop_step import DMPState
from hrc_learn.dmp._fitting import FitOptions
from hrc_learn.dmp._system.response import ArrayOutputs
from hrc_learn.dmp.coordinate_adapter import ColumnPoints, CoordinateAdapter, Retargeted
from hrc_learn.dmp.joint_dmp import JointDMP, given_points
from hrc_learn.dmp.linear_primitive import Ends, LinearPrimitive
from hrc_learn.dmp.motion_primitive import WrappedPrimitive
from hrc_learn.dmp.orientation_error import (
    error_ends,
    fitted_error,
    reference_of,
    to_orientation,
    unit_quaternion,
)
from hrc_learn.geometry import quaternion
from hrc_learn.model_files import SavedModel


class OrientationTrajectory(ArrayOutputs):
    """An orientation over time, each output computed when first asked for."""

    outputs = ("time", "orientation", "angular_velocity", "angular_acceleration")

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

    @staticmethod
    def follow(motion: LinearPrimitive, errors: Samples) -> None:
        """Change weights fitted to errors to those of a formulation that is not linear."""

    def reference(self, motion: LinearPrimitive) -> Float[Tensor, "*batch 4"]:
        """What the demonstrated error is taken to."""
        return reference_of(motion.goal, self.goal)

    def ends(
        self, motion: LinearPrimitive, given: Ends, duration: Tensor
    ) -> tuple[Ends, Tensor]:
        """Error at the start and its rate; the goal moves the reference, not the columns."""
        rate = motion.start_velocity * (motion.duration / duration)[..., None]
        error, rate, reference = error_ends(motion.start, rate, motion.goal, self.goal, *given)
        return Ends(error, None, rate), reference

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
        now: ColumnPoints,
        value: Quaternions | None,
        velocity: Points | None,
    ) -> ColumnPoints:
        """Errors on the branch nearest to the motion's, and their rates."""
        return via_errors(self.reference(motion), now.position, value, velocity)

    def _to_reference(
        self, motion: LinearPrimitive, columns: DMPState, old: Tensor, new: Tensor
    ) -> DMPState:
        """With a goal filter the angular acceleration goes on as it was."""
        error, rate, curvature = orientation_error.retarget(
            columns.position, columns.rate, motion.curvature(columns), old, new
        )
        columns = replace(columns, position=error, rate=rate)
        return replace(columns, goal=motion.resting_point(columns, curvature))


def via_errors(reference: Tensor, error: Tensor, value: Any, velocity: Any) -> ColumnPoints:
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
    return ColumnPoints(via.masked_fill(free, torch.nan), rate.masked_fill(still, torch.nan))


FORMULATIONS: dict[str, type[OrientationCoordinates]] = {"log": OrientationCoordinates}
"""By name; `_ude_formulation.py` adds its own."""


class UnknownFormulationError(ValueError):
    """No formulation of that name."""


class OrientationDMP(WrappedPrimitive[Quaternions, OrientationTrajectory, OrientationState]):
    """Movement primitive of an orientation.

    The error e to a reference, the goal unless said otherwise, is the state of a linear
    primitive, exact at all angles, or of that of Ude et al. 2014; see `formulation`. Both
    signs of any quaternion give the same motion. Values are unit quaternions (w, x, y, z),
    (*batch, 4); velocities and couplings are angular, in the base frame, (*batch, 3). A new
    start or goal is reached the way round that the demonstration took. The fit report has
    residuals of the error's components [rad]; they bound those of the angle.
    """

    goal: Tensor
    motion: JointDMP
    formulation: str
    """`"log"` or `"ude"`: what forcing term and spring act on."""

    def __init__(
        self, motion: JointDMP, goal: Float[Tensor, "*batch 4"], formulation: str = "log"
    ):
        """Put a primitive together; `fit` is the usual way to one.

        Args:
            motion: Of the error [rad], D = 3. Where its own goal is not zero, the error is
                taken to the reference exp(that) * goal: as primitives of several goals need.
            goal: Unit quaternion (w, x, y, z) at which it ends.
            formulation: `"log"` or `"ude"`, what `motion` acts on.

        Raises:
            ValueError: No such formulation.
        """
        super().__init__()
        _check_formulation(formulation)
        self.formulation = formulation
        self.motion = motion
        self.register_buffer("goal", goal)

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
        """Learn one primitive from each demonstration.

        Args:
            time: Timestamps [s], (T,) or (*B, T).
            orientation: Unit quaternions (w, x, y, z), (*B, T, 4). Signs may flip; neighbours
                must be less than half a turn apart.
            n_basis: N, unless `basis` is given; None as for `JointDMP.fit`.
            mask: (*B, T), false where a sample does not count.
            formulation: `"log"`, exact, or `"ude"`, integrated and for turns of less than 360
                degrees.
            options: How to fit; see `FitOptions`.

        Raises:
            ValueError: Bad samples (says which), or no such formulation.
        """
        _check_formulation(formulation)
        time, mask, (orientation,) = padded(time, mask, orientation)
        error, goal = fitted_error(time, orientation, mask)
        motion = JointDMP.fit(time, error, n_basis, mask=mask, **options)
        if not FORMULATIONS[formulation].linear:
            if options.get("robust"):
                # What it found stands for samples that may be far off.
                error = motion.rollout().position.detach()
            FORMULATIONS[formulation].follow(motion, check_samples(time, error, mask=mask))
        return cls(motion, goal, formulation)

    @property
    def adapter(self) -> OrientationCoordinates:
        """Errors to a reference."""
        return FORMULATIONS[self.formulation](self.goal)

    @property
    def start(self) -> Float[Tensor, "*batch 4"]:
        """Where the demonstration starts."""
        return to_orientation(self.motion.start, self.reference)

    @property
    def reference(self) -> Float[Tensor, "*batch 4"]:
        """What the error is taken to."""
        return reference_of(self.motion.goal, self.goal)

    def with_motion[S: "OrientationDMP"](
        self: S, motion: JointDMP, frame: Tensor | None = None
    ) -> S:
        """Around another motion of the error, to this reference or another."""
        reference = self.reference if frame is None else frame
        return type(self)(motion, to_orientation(motion.goal, reference), self.formulation)

    def _own_config(self) -> dict[str, Any]:
        return {"formulation": self.formulation}

    def _own_tensors(self) -> dict[str, Tensor]:
        return {"goal_orientation": self.goal}

    @classmethod
    def _restored[S: "OrientationDMP"](cls: type[S], saved: SavedModel) -> S:
        # Older files have no formulation: there was one only.
        name = saved.get("formulation", str) if "formulation" in saved.config else "log"
        try:
            return cls(JointDMP.restore(saved), saved.tensor("goal_orientation"), name)
        except UnknownFormulationError as error:
            raise saved.invalid_field("formulation", error) from None


def _check_formulation(name: str) -> None:
    if name not in FORMULATIONS:
        known = ", ".join(FORMULATIONS)
        raise UnknownFormulationError(f"unknown formulation {name!r}; there are {known}")
