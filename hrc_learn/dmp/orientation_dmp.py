"""Movement primitive of an orientation, whose linear columns are its error to a reference.

e'' = alpha (beta (0 - e) - e') + f, exact at all angles (Koutras and Doulgeri 2019). The
reference is the goal by default; see `orientation_error.py` for the error and
`ude_formulation.py` for the other formulation.
"""

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp import orientation_error
from hrc_learn.dmp._arguments import Mask, Points, Quaternions, Times, to_tensor
from hrc_learn.dmp._system.trajectory import ArrayOutputs, output
from hrc_learn.dmp.closed_loop_step import DMPState
from hrc_learn.dmp.fitting.motion_fit import FitOptions
from hrc_learn.dmp.fitting.samples import Samples, check_samples, padded
from hrc_learn.dmp.joint_dmp import JointDMP, via_values
from hrc_learn.dmp.linear_primitive import Boundary, LinearPrimitive
from hrc_learn.dmp.motion_primitive import (
    ColumnPoints,
    CoordinateAdapter,
    Retargeted,
    WrappedPrimitive,
)
from hrc_learn.dmp.orientation_error import (
    error_boundary,
    fitted_error,
    reference_of,
    to_orientation,
    unit_quaternion,
)
from hrc_learn.geometry import quaternion
from hrc_learn.model_files import SavedModel


class OrientationTrajectory(ArrayOutputs):
    """Orientation over time; each output is computed on first access."""

    outputs = ("time", "orientation", "angular_velocity", "angular_acceleration")

    def __init__(self, errors: Any, reference: Float[Tensor, "*batch 4"], first: int = 0):
        """Read the error from columns `first` to `first` + 3 of `errors`."""
        self._errors = errors
        self._reference = reference
        self._columns = slice(first, first + 3)

    @property
    def time(self) -> Float[Tensor, "*batch T"]:
        """Time since the start of the motion [s]."""
        return self._errors.time

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
        second = self._errors.acceleration[..., self._columns]
        return orientation_error.angular_acceleration(self._error, self._rate, second)

    @property
    def _error(self) -> Tensor:
        return self._errors.position[..., self._columns]

    @property
    def _rate(self) -> Tensor:
        return self._errors.velocity[..., self._columns]


@dataclass(frozen=True, kw_only=True, eq=False)
class OrientationState:
    """State of an orientation primitive in closed loop."""

    motion: DMPState
    """State of the error to the reference."""
    reference: Float[Tensor, "*batch 4"]
    """Reference of the error; the goal by default."""

    @property
    def orientation(self) -> Float[Tensor, "*batch 4"]:
        """Unit quaternion (w, x, y, z)."""
        return orientation_error.to_orientation(self.motion.position, self.reference)

    @property
    def angular_velocity(self) -> Float[Tensor, "*batch 3"]:
        """Angular velocity in the base frame [rad/s]."""
        return orientation_error.angular_velocity(self.motion.position, self.motion.velocity)


torch.export.register_dataclass(
    OrientationState, serialized_type_name="hrc_learn.dmp.OrientationState"
)


@dataclass(frozen=True, eq=False)
class OrientationCoordinates(
    CoordinateAdapter[Quaternions, OrientationTrajectory, OrientationState]
):
    """Three columns of error; the frame is its reference."""

    goal: Tensor
    """Unit quaternion at the end of the demonstration, (*batch, 4)."""
    error_columns: ClassVar[slice] = slice(0, 3)

    @staticmethod
    def refit(motion: LinearPrimitive, errors: Samples) -> None:
        """Adapt fitted weights to a formulation that is not linear; this one is."""

    def reference(self, motion: LinearPrimitive) -> Float[Tensor, "*batch 4"]:
        """Reference of the demonstrated error."""
        return reference_of(motion.goal, self.goal)

    def boundary(
        self, motion: LinearPrimitive, given: Boundary, duration: Tensor
    ) -> tuple[Boundary, Tensor]:
        """Error at the start and its rate; a goal moves the reference, not the columns."""
        rate = motion.start_velocity * (motion.duration / duration)[..., None]
        error, rate, reference = error_boundary(
            motion.start, rate, motion.goal, self.goal, *given
        )
        return Boundary(error, None, rate), reference

    def trajectory(self, columns: Any, frame: Tensor) -> OrientationTrajectory:
        """Orientations of the errors."""
        return OrientationTrajectory(columns, frame)

    def state(self, columns: DMPState, frame: Tensor) -> OrientationState:
        """Error and reference."""
        return OrientationState(motion=columns, reference=frame)

    def columns(self, state: OrientationState) -> tuple[DMPState, Tensor]:
        """Error and reference."""
        return state.motion, state.reference

    def retarget(
        self,
        motion: LinearPrimitive,
        columns: DMPState,
        frame: Tensor,
        goal: Quaternions | None,
    ) -> Retargeted:
        """Error to a new reference, for the same motion of the orientation."""
        if goal is None:
            return Retargeted(columns, frame)
        new = reference_of(motion.goal, unit_quaternion(goal, frame)).expand_as(frame)
        return Retargeted(self._to_reference(motion, columns, frame, new), new)

    def external_acceleration(
        self, motion: LinearPrimitive, columns: DMPState, frame: Tensor, coupling: Any
    ) -> Tensor | None:
        """Second derivative of e, linear in the angular acceleration in the base frame."""
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
        """Errors on the branch nearest to that of the motion, and their rates."""
        return via_errors(self.reference(motion), now.position, value, velocity)

    def _to_reference(
        self, motion: LinearPrimitive, columns: DMPState, old: Tensor, new: Tensor
    ) -> DMPState:
        """Error to another reference; with a goal filter, the acceleration is continuous."""
        error, rate, second = orientation_error.retarget(
            columns.position, columns.rate, motion.second_derivative(columns), old, new
        )
        columns = replace(columns, position=error, rate=rate)
        return replace(columns, goal=motion.equilibrium_goal(columns, second))


def via_errors(reference: Tensor, error: Tensor, value: Any, velocity: Any) -> ColumnPoints:
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
    return ColumnPoints(via.masked_fill(free, torch.nan), rate.masked_fill(unknown, torch.nan))


FORMULATIONS: dict[str, type[OrientationCoordinates]] = {"log": OrientationCoordinates}
"""Formulations by name; `ude_formulation.py` adds its own."""


class UnknownFormulationError(ValueError):
    """There is no formulation with this name."""


class OrientationDMP(WrappedPrimitive[Quaternions, OrientationTrajectory, OrientationState]):
    """Movement primitive of an orientation.

    The error e to a reference, the goal by default, is the state of a linear primitive that is
    exact at all angles, or of the formulation of Ude et al. 2014; see `formulation`. Both signs
    of a quaternion give the same motion. Values are unit quaternions (w, x, y, z), (*batch, 4);
    velocities and couplings are angular, in the base frame, (*batch, 3). A new start or goal is
    reached in the sense of rotation of the demonstration. The fit report has residuals of the
    components of the error [rad], which bound those of the angle.
    """

    goal: Tensor
    motion: JointDMP
    formulation: str
    """`"log"` or `"ude"`: the state on which forcing term and spring act."""

    def __init__(
        self, motion: JointDMP, goal: Float[Tensor, "*batch 4"], formulation: str = "log"
    ):
        """Assemble a primitive; `fit` is the usual way to make one.

        Args:
            motion: Motion of the error [rad], D = 3. If its own goal is not zero, the reference
                of the error is exp(that) * goal, as for primitives with different goals.
            goal: Unit quaternion (w, x, y, z) at the end.
            formulation: `"log"` or `"ude"`.

        Raises:
            ValueError: Unknown formulation.
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
        """Fit one primitive to each demonstration.

        Args:
            time: Timestamps [s], (T,) or (*B, T).
            orientation: Unit quaternions (w, x, y, z), (*B, T, 4). Signs may flip; neighbours
                must be less than half a turn apart.
            n_basis: N, unless `basis` is given; None as for `JointDMP.fit`.
            mask: (*B, T), false at samples to ignore.
            formulation: `"log"`, exact, or `"ude"`, integrated, for turns below 360 degrees.
            options: Options of the fit; see `FitOptions`.

        Raises:
            ValueError: Bad samples (the message names them), or an unknown formulation.
        """
        _check_formulation(formulation)
        time, mask, (orientation,) = padded(time, mask, orientation)
        error, goal = fitted_error(time, orientation, mask)
        motion = JointDMP.fit(time, error, n_basis, mask=mask, **options)
        if not FORMULATIONS[formulation].linear:
            if options.get("robust"):
                # The robust fit replaces samples that may be outliers.
                error = motion.rollout().position.detach()
            FORMULATIONS[formulation].refit(motion, check_samples(time, error, mask=mask))
        return cls(motion, goal, formulation)

    @property
    def adapter(self) -> OrientationCoordinates:
        """Errors to a reference."""
        return FORMULATIONS[self.formulation](self.goal)

    @property
    def start(self) -> Float[Tensor, "*batch 4"]:
        """Orientation at the start of the demonstration."""
        return to_orientation(self.motion.start, self.reference)

    @property
    def reference(self) -> Float[Tensor, "*batch 4"]:
        """Reference of the error."""
        return reference_of(self.motion.goal, self.goal)

    def with_motion[S: "OrientationDMP"](
        self: S, motion: JointDMP, frame: Tensor | None = None
    ) -> S:
        """Primitive with another motion of the error, to this reference or another."""
        reference = self.reference if frame is None else frame
        return type(self)(motion, to_orientation(motion.goal, reference), self.formulation)

    def _own_config(self) -> dict[str, Any]:
        return {"formulation": self.formulation}

    def _own_tensors(self) -> dict[str, Tensor]:
        return {"goal_orientation": self.goal}

    @classmethod
    def _restored[S: "OrientationDMP"](cls: type[S], saved: SavedModel) -> S:
        # Older files have no formulation, because there was only one.
        name = saved.get("formulation", str) if "formulation" in saved.config else "log"
        try:
            return cls(JointDMP.restore(saved), saved.tensor("goal_orientation"), name)
        except UnknownFormulationError as error:
            raise saved.invalid_field("formulation", error) from None


def _check_formulation(name: str) -> None:
    if name not in FORMULATIONS:
        known = ", ".join(FORMULATIONS)
        raise UnknownFormulationError(f"unknown formulation {name!r}; choose from {known}")
