"""An orientation primitive's closed-loop step in NumPy."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from hrc_learn.dmp.orientation import OrientationDMP
from hrc_learn.dmp.rotation import arrays
from hrc_learn.dmp.stepper import Stepper, StepperState


class OrientationStepperState(NamedTuple):
    """Where a primitive is while it is stepped; every step makes a new one."""

    motion: StepperState
    """Of the error to the goal [rad]."""
    reference: Float64[np.ndarray, "4"]
    """The goal, unless the primitive says otherwise."""

    @property
    def orientation(self) -> Float64[np.ndarray, "4"]:
        """Unit quaternion (w, x, y, z)."""
        return arrays.to_orientation(self.motion.position, self.reference)

    @property
    def angular_velocity(self) -> Float64[np.ndarray, "3"]:
        """In the base frame [rad/s]."""
        return arrays.angular_velocity(self.motion.position, self.motion.velocity)


class OrientationStepper:
    """One unbatched primitive, frozen; `step` does what `OrientationDMP.step` does."""

    def __init__(self, dmp: OrientationDMP):
        """Freeze a primitive.

        Raises:
            ValueError: The primitive is a batch, or of the formulation of Ude et al.
        """
        if dmp.formulation != "log":
            raise ValueError(
                f"a stepper takes the formulation 'log', got {dmp.formulation!r}, whose steps "
                f"are integrated: use the exported program"
            )
        self._motion = Stepper(dmp.motion)
        self._goal = dmp.motion.goal.detach().double().cpu().numpy()
        self._dmp = dmp

    def initial_state(self, **arguments: Any) -> OrientationStepperState:
        """State at the start of a motion; arguments as in `OrientationDMP.rollout`."""
        state = self._dmp.initial_state(**arguments)
        motion = start_stepper(self._motion, state.motion)
        return OrientationStepperState(motion, state.reference.detach().double().cpu().numpy())

    def step(
        self,
        state: OrientationStepperState,
        dt: float,
        goal: Float64[np.ndarray, "4"] | None = None,
        slowdown: float = 0.0,
    ) -> OrientationStepperState:
        """Advance by `dt` [s]; a new goal is there at once."""
        motion, reference = state
        if goal is not None:
            reference = arrays.reference_of(self._goal, goal)
            ends = arrays.retarget(motion.y[0], motion.y[1], state.reference, reference)
            motion = motion._replace(y=np.stack(ends))
        motion = self._motion.step(motion, dt, slowdown=slowdown)
        return OrientationStepperState(motion, reference)


def start_stepper(stepper: Stepper, state: Any) -> StepperState:
    """State of a stepper at the start, from that of the primitive it is of."""
    start, goal, velocity = (
        x.detach().double().cpu().numpy() for x in (state.start, state.goal, state.velocity)
    )
    return stepper.initial_state(start, goal, state.duration.item(), velocity)
