"""Movement primitive of an orientation."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Unpack

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.dmp import orientation_error as error_space
from hrc_learn.dmp._types import ArrayLike, to_tensor
from hrc_learn.dmp.closed_loop import DMPState
from hrc_learn.dmp.fitting.motion_samples import FitReport, check_samples
from hrc_learn.dmp.fitting.solvers import FitOptions
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.orientation_error import (
    error_ends,
    fitted_error,
    reference_of,
    to_orientation,
    unit_quaternion,
)
from hrc_learn.dmp.orientation_formulation import (
    ErrorMotion,
    UnknownFormulationError,
    find_formulation,
)
from hrc_learn.storage import SavedModel, write_model


class OrientationTrajectory:
    """An orientation over time, each output computed when first asked for."""

    def __init__(
        self, errors: ErrorMotion, reference: Float[Tensor, "*batch 4"], first: int = 0
    ):
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
        return error_space.to_orientations(self._error, self._reference)

    @cached_property
    def angular_velocity(self) -> Float[Tensor, "*batch T 3"]:
        """In the base frame [rad/s]."""
        return error_space.angular_velocity(self._error, self._rate)

    @cached_property
    def angular_acceleration(self) -> Float[Tensor, "*batch T 3"]:
        """In the base frame [rad/s^2]."""
        curvature = self._errors.acceleration[..., self._columns]
        return error_space.angular_acceleration(self._error, self._rate, curvature)

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
        return error_space.to_orientation(self.motion.position, self.reference)

    @property
    def angular_velocity(self) -> Float[Tensor, "*batch 3"]:
        """In the base frame [rad/s]."""
        return error_space.angular_velocity(self.motion.position, self.motion.velocity)


torch.export.register_dataclass(
    OrientationState, serialized_type_name="hrc_learn.dmp.OrientationState"
)


class OrientationDMP(nn.Module):
    """Movement primitive of an orientation.

    The error e to a reference, the goal unless said otherwise, is the state of a linear
    primitive, exact at all angles, or of that of Ude et al. 2014; see `formulation`. Both
    signs of any quaternion give the same motion.
    """

    goal: Tensor
    formulation: str
    """`"log"` or `"ude"`."""

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
        self._dynamics = find_formulation(formulation)
        self.formulation = formulation
        self.motion = motion
        self.register_buffer("goal", goal)

    @classmethod
    def fit(
        cls,
        time: ArrayLike,
        orientation: ArrayLike,
        n_basis: int = 50,
        mask: ArrayLike | None = None,
        *,
        formulation: str = "log",
        **options: Unpack[FitOptions],
    ) -> "OrientationDMP":
        """Learn one primitive from each demonstration.

        Args:
            time: Stamps [s], (T,) or (*B, T).
            orientation: Unit quaternions (w, x, y, z), (*B, T, 4). Signs may flip; neighbours
                must be less than half a turn apart.
            n_basis: N, unless `basis` is given.
            mask: (*B, T), false where a sample does not count.
            formulation: `"log"`, exact, or `"ude"`, integrated and for turns of less than 360
                degrees.
            options: How to fit; see `FitOptions`.

        Raises:
            ValueError: Bad samples (says which), or no such formulation.
        """
        dynamics = find_formulation(formulation)
        error, goal = fitted_error(time, orientation, mask)
        motion = JointDMP.fit(time, error, n_basis, mask=mask, **options)
        if options.get("robust"):
            # What it found stands for samples that may be far off.
            error = motion.rollout().position.detach()
        dynamics.adapt(motion, check_samples(time, error, mask=mask))
        return cls(motion, goal, formulation)

    @property
    def start(self) -> Float[Tensor, "*batch 4"]:
        """Where the demonstration starts."""
        return to_orientation(self.motion.start, self.reference)

    @property
    def reference(self) -> Float[Tensor, "*batch 4"]:
        """What the error is taken to."""
        return reference_of(self.motion.goal, self.goal)

    @property
    def duration(self) -> Float[Tensor, "*batch"]:
        """Of the demonstration [s]."""
        return self.motion.duration

    @property
    def fit_report(self) -> FitReport | None:
        """Residuals of the error's components [rad]; they bound those of the angle."""
        return self.motion.fit_report

    def rollout(
        self,
        time: ArrayLike | None = None,
        start: ArrayLike | None = None,
        goal: ArrayLike | None = None,
        duration: ArrayLike | None = None,
        start_velocity: ArrayLike | None = None,
        *,
        speed: ArrayLike | None = None,
        amplitude: ArrayLike | None = None,
    ) -> OrientationTrajectory:
        """Motion from start to goal; without arguments, the demonstrated one.

        All arguments broadcast over the batch, and gradients flow to each of them. A new
        start or goal is reached the way round that the demonstration took.

        Args:
            time: Since the start of the motion [s], (T,) or (*batch, T).
            start: Unit quaternion, (*batch, 4).
            goal: Unit quaternion, (*batch, 4).
            duration: [s], (*batch).
            start_velocity: Angular, in the base frame [rad/s], (*batch, 3).
            speed: Instead of a duration, how many times faster than the demonstration.
            amplitude: Factor on the forcing term, (*batch): how wide a rhythm swings.
        """
        error, rate, reference, duration = self._ends(
            start, goal, duration, start_velocity, speed
        )
        errors = self._dynamics.rollout(self.motion, time, error, duration, rate, amplitude)
        return OrientationTrajectory(errors, reference)

    def initial_state(
        self,
        start: ArrayLike | None = None,
        goal: ArrayLike | None = None,
        duration: ArrayLike | None = None,
        start_velocity: ArrayLike | None = None,
        *,
        speed: ArrayLike | None = None,
    ) -> OrientationState:
        """State at the start of a motion, for `step`; arguments as in `rollout`."""
        error, rate, reference, duration = self._ends(
            start, goal, duration, start_velocity, speed
        )
        motion = self.motion.initial_state(error, None, duration, rate)
        reference = reference.expand(*motion.position.shape[:-1], 4)
        return OrientationState(motion=motion, reference=reference)

    def step(
        self,
        state: OrientationState,
        dt: ArrayLike,
        *,
        goal: ArrayLike | None = None,
        goal_filter: float | None = None,
        coupling: ArrayLike | None = None,
        slowdown: ArrayLike | None = None,
        amplitude: ArrayLike | None = None,
    ) -> OrientationState:
        """Advance by `dt`; arguments as in `JointDMP.step`.

        A new goal changes neither orientation nor angular velocity at that moment, nor, with
        a `goal_filter`, the angular acceleration. `coupling` is one, in the base frame
        [rad/s^2], (*batch, 3).
        """
        if goal is not None:
            state = self.retarget(state, goal)
        motion, reference = state.motion, state.reference
        if coupling is not None:
            coupling = self._dynamics.push(
                motion, to_tensor(coupling, reference.dtype, reference.device)
            )
        motion = self._dynamics.step(
            self.motion,
            motion,
            dt,
            goal_filter=goal_filter,
            coupling=coupling,
            slowdown=slowdown,
            amplitude=amplitude,
        )
        return OrientationState(motion=motion, reference=reference)

    def retarget(self, state: OrientationState, goal: ArrayLike) -> OrientationState:
        """The same orientation, angular velocity and acceleration, with a new goal to go to.

        The acceleration lasts if the next steps have a `goal_filter`.

        Args:
            state: Of a motion.
            goal: Unit quaternion, (*batch, 4).
        """
        old = state.reference
        new = reference_of(self.motion.goal, unit_quaternion(goal, old)).expand_as(old)
        motion = self._dynamics.retarget(self.motion, state.motion, old, new)
        return OrientationState(motion=motion, reference=new)

    def save(self, folder: str | Path) -> None:
        """Write config.json and model.safetensors into `folder`, replacing an older save."""
        tensors = {"goal_orientation": self.goal, **self.motion.tensors()}
        config = self.motion.config() | {"formulation": self.formulation}
        write_model(folder, "OrientationDMP", config, tensors)

    def export(self, *, goal_filter: float | None = None) -> Any:
        """An `ExportedDMP`: NumPy stepper, and the step as a `torch.export` program.

        Args:
            goal_filter: Of the program, as in `step`.

        Raises:
            ValueError: The primitive is a batch.
        """
        from hrc_learn.dmp.exported_dmp import export_dmp

        return export_dmp(self, goal_filter=goal_filter)

    @classmethod
    def load(cls, folder: str | Path) -> "OrientationDMP":
        """Read what `save` wrote; complains as `JointDMP.load`."""
        saved = SavedModel(folder, "OrientationDMP")
        # Older files have no formulation: there was one only.
        name = saved.get("formulation", str) if "formulation" in saved.config else "log"
        try:
            return cls(JointDMP.restore(saved), saved.tensor("goal_orientation"), name)
        except UnknownFormulationError as error:
            raise saved.invalid_field("formulation", error) from None

    def _ends(
        self,
        start: ArrayLike | None,
        goal: ArrayLike | None,
        duration: ArrayLike | None,
        velocity: ArrayLike | None,
        speed: ArrayLike | None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Error at the start, its rate [rad/s], what it is taken to, and duration."""
        duration = self.motion.resolve_duration(duration, speed)
        rate = self.motion.start_velocity * (self.motion.duration / duration)[..., None]
        error, rate, reference = error_ends(
            self.motion.start, rate, self.motion.goal, self.goal, start, goal, velocity
        )
        return error, rate, reference, duration
