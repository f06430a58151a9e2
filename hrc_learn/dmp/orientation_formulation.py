"""What the forcing term and the spring of an orientation act on, as a part by name.

- `"log"`: on the error to the goal itself, which then moves linearly; see `LogFormulation`.
- `"ude"`: on the angular velocity, as Ude et al. 2014 have it; see `ude.py`.

Either keeps the error e and de/ds as its state, so that all else is shared.
"""

from dataclasses import replace
from typing import Protocol, Unpack, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp import orientation_error as error_space
from hrc_learn.dmp._system.response import Trajectory
from hrc_learn.dmp._types import ArrayLike
from hrc_learn.dmp.closed_loop import DMPState
from hrc_learn.dmp.fitting.motion_samples import Samples
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.ude_formulation import Influences, UdeFormulation, UdeMotion

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
        amplitude: ArrayLike | None,
    ) -> ErrorMotion:
        """Motion of the error from `start` [rad] with its `rate` [rad/s]."""
        ...

    def step(
        self,
        motion: JointDMP,
        state: DMPState,
        dt: ArrayLike,
        **influences: Unpack[Influences],
    ) -> DMPState:
        """Advance by `dt`; arguments as in `JointDMP.step`."""
        ...

    def push(
        self, state: DMPState, acceleration: Float[Tensor, "*#batch 3"]
    ) -> Float[Tensor, "*batch 3"]:
        """The coupling of `step` for an angular acceleration [rad/s^2]."""
        ...

    def retarget(
        self,
        motion: JointDMP,
        state: DMPState,
        old: Float[Tensor, "*batch 4"],
        new: Float[Tensor, "*batch 4"],
    ) -> DMPState:
        """The same motion of the orientation, as errors to a new reference."""
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
        amplitude: ArrayLike | None,
    ) -> ErrorMotion:
        """Exact."""
        return motion.rollout(time, start, None, duration, rate, amplitude=amplitude)

    def step(
        self,
        motion: JointDMP,
        state: DMPState,
        dt: ArrayLike,
        **influences: Unpack[Influences],
    ) -> DMPState:
        """Exact at any step length."""
        return motion.step(state, dt, **influences)

    def push(
        self, state: DMPState, acceleration: Float[Tensor, "*#batch 3"]
    ) -> Float[Tensor, "*batch 3"]:
        """Linear in the second derivative of the error."""
        return error_space.error_rate(state.position, acceleration)

    def retarget(
        self,
        motion: JointDMP,
        state: DMPState,
        old: Float[Tensor, "*batch 4"],
        new: Float[Tensor, "*batch 4"],
    ) -> DMPState:
        """With a goal filter the angular acceleration goes on as it was."""
        error, rate, curvature = error_space.retarget(
            state.position, state.rate, motion.curvature(state), old, new
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
