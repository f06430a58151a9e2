"""Movement primitive of an orientation."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.dmp.arrays import ArrayLike, to_tensor
from hrc_learn.dmp.fitting.report import FitReport
from hrc_learn.dmp.fitting.samples import check_samples, demo_label
from hrc_learn.dmp.joint import JointDMP
from hrc_learn.dmp.rotation import error as error_space
from hrc_learn.dmp.rotation.formulation import (
    ErrorMotion,
    UnknownFormulationError,
    find_formulation,
)
from hrc_learn.dmp.state import DMPState
from hrc_learn.dmp.system.basis import Basis
from hrc_learn.dmp.system.spring import SpringDamper
from hrc_learn.geometry import quaternion
from hrc_learn.storage import SavedModel, write_model

NORM_TOLERANCE = 1e-2
"""How far from one the norm of a recorded quaternion may be before it is called broken."""


class OrientationDMP(nn.Module):
    """Discrete movement primitive of an orientation.

    The error e to the goal is the state of a linear primitive that ends at e = 0, exact at
    all angles, or of that of Ude et al. 2014; see `formulation`. Both signs of any quaternion
    give the same motion.
    """

    goal: Tensor
    formulation: str
    """`"log"` or `"ude"`."""

    def __init__(
        self, motion: JointDMP, goal: Float[Tensor, "*batch 4"], formulation: str = "log"
    ):
        """Put a primitive together; `fit` is the usual way to one.

        Args:
            motion: Of the error [rad], D = 3, with its goal at zero.
            goal: Unit quaternion (w, x, y, z) that the error is taken to.
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
        method: str = "trajectory",
        approach: float = 0.0,
        basis: Basis | None = None,
        spring: SpringDamper | None = None,
        regularization: float = 1e-7,
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
            method: As for `JointDMP.fit`, like all that follow.
            approach: Share of the motion along which new ends are taken up.
            basis: Shape of the forcing term.
            spring: Gains.
            regularization: Ridge.

        Raises:
            ValueError: Bad samples (says which), or no such formulation.
        """
        dynamics = find_formulation(formulation)
        error, goal = fitted_error(time, orientation, mask)
        motion = JointDMP.fit(
            time,
            error,
            n_basis,
            mask=mask,
            method=method,
            approach=approach,
            basis=basis,
            spring=spring,
            regularization=regularization,
        )
        dynamics.adapt(motion, check_samples(time, error, mask=mask))
        return cls(motion, goal, formulation)

    @property
    def start(self) -> Float[Tensor, "*batch 4"]:
        """Where the demonstration starts."""
        return error_space.to_orientation(self.motion.start, self.goal)

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
        """
        error, rate, goal, duration = self._ends(start, goal, duration, start_velocity, speed)
        errors = self._dynamics.rollout(self.motion, time, error, duration, rate)
        return OrientationTrajectory(errors, goal)

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
        error, rate, goal, duration = self._ends(start, goal, duration, start_velocity, speed)
        motion = self.motion.initial_state(error, None, duration, rate)
        return OrientationState(motion=motion, goal=goal.expand(*motion.position.shape[:-1], 4))

    def step(
        self,
        state: OrientationState,
        dt: ArrayLike,
        *,
        goal: ArrayLike | None = None,
        goal_filter: float | None = None,
        slowdown: ArrayLike | None = None,
    ) -> OrientationState:
        """Advance by `dt`; arguments as in `JointDMP.step`.

        A new goal changes neither orientation nor angular velocity at that moment, nor, with
        a `goal_filter`, the angular acceleration.
        """
        motion, target = state.motion, state.goal
        if goal is not None:
            target = unit_quaternion(goal, state.goal).expand_as(state.goal)
            motion = self._dynamics.retarget(self.motion, motion, state.goal, target)
        motion = self._dynamics.step(self.motion, motion, dt, goal_filter, slowdown)
        return OrientationState(motion=motion, goal=target)

    def save(self, folder: str | Path) -> None:
        """Write config.json and model.safetensors into `folder`, replacing an older save."""
        tensors = {"goal_orientation": self.goal, **self.motion.tensors()}
        config = self.motion.config() | {"formulation": self.formulation}
        write_model(folder, "OrientationDMP", config, tensors)

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
        """Error at the start, its rate [rad/s], goal, and duration."""
        duration = self.motion.resolve_duration(duration, speed)
        rate = self.motion.start_velocity * (self.motion.duration / duration)[..., None]
        error, rate, goal = error_ends(
            self.motion.start, rate, self.goal, start, goal, velocity
        )
        return error, rate, goal, duration
