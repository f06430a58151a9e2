"""What the forcing term and the spring of an orientation act on, as a part by name.

- `"log"`: on the error to the goal itself, which then moves linearly; see `LogFormulation`.
- `"ude"`: on the angular velocity, as Ude et al. 2014 have it; see `ude.py`.

Either keeps the error e and de/ds as its state, so that all else is shared.
"""

from dataclasses import replace
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp.arrays import ArrayLike
from hrc_learn.dmp.fitting.samples import Samples
from hrc_learn.dmp.joint import JointDMP
from hrc_learn.dmp.rotation import error as error_space
from hrc_learn.dmp.rotation.ude import UdeFormulation, UdeMotion
from hrc_learn.dmp.state import DMPState
from hrc_learn.dmp.trajectory import Trajectory

type ErrorMotion = Trajectory | UdeMotion


@runtime_checkable
class Formulation(Protocol):
    """How a primitive of the error, its weights and gains, moves an orientation."""

    def adapt(self, motion: JointDMP, errors: Samples) -> None:
        """Change a fitted primitive so that this formulation repeats the errors it is of.

        Raises:
            ValueError: The formulation cannot repeat it.
        """
        ...

    def rollout(
        self,
        motion: JointDMP,
        time: ArrayLike | None,
        start: Float[Tensor, "*#batch 3"],
        duration: Float[Tensor, "*#batch"],
        rate: Float[Tensor, "*#batch 3"],
    ) -> ErrorMotion:
        """Motion of the error from `start` [rad] with its `rate` [rad/s]."""
        ...

    def step(
        self,
        motion: JointDMP,
        state: DMPState,
        dt: ArrayLike,
        goal_filter: float | None,
        slowdown: ArrayLike | None,
    ) -> DMPState:
        """Advance by `dt`; arguments as in `JointDMP.step`."""
        ...

    def retarget(
        self,
        motion: JointDMP,
        state: DMPState,
        old_goal: Float[Tensor, "*batch 4"],
        goal: Float[Tensor, "*batch 4"],
    ) -> DMPState:
        """The same motion of the orientation, as errors to a new goal."""
        ...


class LogFormulation:
    """e'' = alpha (beta (0 - e) - e') + f, linear (Koutras and Doulgeri 2019)."""

    def adapt(self, motion: JointDMP, errors: Samples) -> None:
        """Nothing to change: it is what was fitted."""

    def rollout(
        self,
        motion: JointDMP,
        time: ArrayLike | None,
        start: Float[Tensor, "*#batch 3"],
        duration: Float[Tensor, "*#batch"],
        rate: Float[Tensor, "*#batch 3"],
    ) -> ErrorMotion:
        """Exact."""
        return motion.rollout(time, start, None, duration, rate)

    def step(
        self,
        motion: JointDMP,
        state: DMPState,
        dt: ArrayLike,
        goal_filter: float | None,
        slowdown: ArrayLike | None,
    ) -> DMPState:
        """Exact at any step length."""
        return motion.step(state, dt, goal_filter=goal_filter, slowdown=slowdown)

    def retarget(
        self,
        motion: JointDMP,
        state: DMPState,
        old_goal: Float[Tensor, "*batch 4"],
        goal: Float[Tensor, "*batch 4"],
    ) -> DMPState:
        """With a goal filter the angular acceleration goes on as it was."""
        error, rate, curvature = error_space.retarget(
            state.position, state.rate, motion.curvature(state), old_goal, goal
        )
        state = replace(state, position=error, rate=rate)
        return replace(state, goal=motion.resting_point(state, curvature))


FORMULATIONS: dict[str, Formulation] = {"log": LogFormulation(), "ude": UdeFormulation()}


class UnknownFormulationError(ValueError):
    """No formulation of that name."""


def find_formulation(name: str) -> Formulation:
    """The part of that name."""
    if name not in FORMULATIONS:
        known = ", ".join(FORMULATIONS)
        raise UnknownFormulationError(f"unknown formulation {name!r}; there are {known}")
    return FORMULATIONS[name]
