"""A pose primitive's closed-loop step in NumPy."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from hrc_learn.dmp.orientation_stepper import start_stepper
from hrc_learn.dmp.pose import PoseDMP
from hrc_learn.dmp.pose_columns import BODY, ERROR, POSITION
from hrc_learn.dmp.rotation import arrays
from hrc_learn.dmp.stepper import Stepper, StepperState


class PoseStepperState(NamedTuple):
    """Where a primitive is while it is stepped; every step makes a new one."""

    motion: StepperState
    """Of position, error to the goal, and body."""
    reference: Float64[np.ndarray, "4"]
    """The goal's orientation, unless the primitive says otherwise."""

    @property
    def position(self) -> Float64[np.ndarray, "3"]:
        """[m]."""
        return self.motion.position[POSITION]

    @property
    def orientation(self) -> Float64[np.ndarray, "4"]:
        """Unit quaternion (w, x, y, z)."""
        return arrays.to_orientation(self.motion.position[ERROR], self.reference)

    @property
    def body(self) -> Float64[np.ndarray, "K"]:
        """Coordinates learned along."""
        return self.motion.position[BODY]

    @property
    def twist(self) -> Float64[np.ndarray, "6"]:
        """(linear [m/s], angular [rad/s]) in the base frame."""
        position, velocity = self.motion.position, self.motion.velocity
        angular = arrays.angular_velocity(position[ERROR], velocity[ERROR])
        return np.concatenate([velocity[POSITION], angular])


class PoseStepper:
    """One unbatched primitive, frozen; `step` does what `PoseDMP.step` does."""

    def __init__(self, dmp: PoseDMP):
        """Freeze a primitive.

        Raises:
            ValueError: The primitive is a batch.
        """
        self._motion = Stepper(dmp.motion)
        self._goal = dmp.motion.goal[ERROR].detach().double().cpu().numpy()
        self._dmp = dmp

    def initial_state(self, **arguments: Any) -> PoseStepperState:
        """State at the start of a motion; arguments as in `PoseDMP.rollout`."""
        state = self._dmp.initial_state(**arguments)
        rotation = state.reference.detach().double().cpu().numpy()
        return PoseStepperState(start_stepper(self._motion, state.motion), rotation)

    def step(
        self,
        state: PoseStepperState,
        dt: float,
        position: Float64[np.ndarray, "3"] | None = None,
        orientation: Float64[np.ndarray, "4"] | None = None,
        body: Float64[np.ndarray, "K"] | None = None,
        coupling: Float64[np.ndarray, "3"] | None = None,
        slowdown: float = 0.0,
    ) -> PoseStepperState:
        """Advance by `dt` [s].

        Args:
            state: From `initial_state` or the last step.
            dt: [s].
            position: Of the goal from here on [m].
            orientation: Of the goal, likewise.
            body: Goal of the body, likewise.
            coupling: Acceleration added to the position [m/s^2].
            slowdown: The clock runs 1 + slowdown times slower.
        """
        motion, rotation = state
        goal, push = motion.goal, None
        for columns, value in ((POSITION, position), (BODY, body)):
            if value is not None:
                goal = goal.copy()
                goal[columns] = value
        if orientation is not None:
            rotation = arrays.reference_of(self._goal, orientation)
            y = motion.y.copy()
            y[:, ERROR] = arrays.retarget(y[0, ERROR], y[1, ERROR], state.reference, rotation)
            motion = motion._replace(y=y)
        if coupling is not None:
            push = np.zeros_like(goal)
            push[POSITION] = coupling
        return PoseStepperState(self._motion.step(motion, dt, goal, push, slowdown), rotation)
