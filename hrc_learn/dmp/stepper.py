"""A joint primitive's closed-loop step in NumPy, for control loops that count microseconds."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from hrc_learn.dmp.joint import JointDMP
from hrc_learn.dmp.system.approach import quintic

Vector = Float64[np.ndarray, "D"]
Pair = Float64[np.ndarray, "2 D"]


class StepperState(NamedTuple):
    """Where a primitive is while it is stepped; every step makes a new one."""

    s: float
    """Normalised time, 1 at the end of the motion."""
    y: Pair
    """Position, and its derivative dy/ds."""
    forced: Pair
    """(y, dy/ds) that the unscaled forcing term alone has caused by `s`."""
    start: Vector
    goal: Vector
    way: Vector
    """Goal minus start, as the motion began."""
    duration: float
    """[s] that the motion takes when nothing slows it."""
    pace: float
    """Speed of the last step, 1 undisturbed."""

    @property
    def position(self) -> Vector:
        """In the units of the demonstration."""
        return self.y[0]

    @property
    def velocity(self) -> Vector:
        """Per second."""
        return self.y[1] * (self.pace / self.duration)


class Stepper:
    """One unbatched primitive, frozen; `step` does what `JointDMP.step` does, in float64.

    The weights are multiplied into the table of the forced motion beforehand, so a step is a
    table look-up and a 2x2 product. PyTorch takes no part in it.
    """

    def __init__(self, dmp: JointDMP):
        """Freeze a primitive.

        Raises:
            ValueError: The primitive is a batch.
        """
        if dmp.weights.ndim != 2:
            raise ValueError(
                f"a stepper takes one primitive, got a batch {tuple(dmp.weights.shape[:-2])}"
            )
        forced, weights = dmp.response.forced, dmp.weights.detach().double().cpu()
        if dmp.scaling == "amplitude":
            weights = weights * dmp.amplitude.double().cpu()[:, None]
        table = (forced.coefficients @ weights.T).numpy()
        self._table = np.ascontiguousarray(table.reshape(*table.shape[:2], -1))
        self._exponents = np.arange(table.shape[1])
        self._interval = forced.interval
        self._end = math.inf if forced.periodic else forced.end
        self._spring, self._approach = dmp.spring, dmp.response.approach
        self._by_distance = dmp.scaling == "paper"
        self._start, self._goal, self._velocity = (
            x.double().cpu().numpy() for x in (dmp.start, dmp.goal, dmp.start_velocity)
        )
        self._duration = dmp.duration.item()
        half = self._spring.alpha / 2
        self._transition = math.nan, np.eye(2)
        self._shifted = np.array([[half, 1.0], [-self._spring.stiffness, -half]])

    def initial_state(
        self,
        start: Vector | None = None,
        goal: Vector | None = None,
        duration: float | None = None,
        start_velocity: Vector | None = None,
    ) -> StepperState:
        """State at the start of a motion; arguments as in `JointDMP.rollout`."""
        start = self._start if start is None else start
        rate = self._velocity * self._duration
        duration = self._duration if duration is None else duration
        if start_velocity is not None:
            rate = start_velocity * duration
        y = np.stack([start, rate])
        goal = self._goal if goal is None else goal
        forced = self._forced(0.0)
        return StepperState(0.0, y, forced, start, goal, goal - start, duration, 1.0)

    def step(
        self,
        state: StepperState,
        dt: float,
        goal: Vector | None = None,
        coupling: Vector | None = None,
        slowdown: float = 0.0,
    ) -> StepperState:
        """Advance by `dt` [s]; arguments as in `JointDMP.step`."""
        s, y, before, start, _, way, duration, _ = state
        goal = state.goal if goal is None else goal
        pace = 1.0 / (1.0 + slowdown)
        ds = dt * pace / duration
        s += ds
        rest = np.zeros(y.shape)
        rest[0] = goal
        if coupling is not None:
            rest[0] += coupling * (duration**2 / self._spring.stiffness)
        if ds != self._transition[0]:
            # Loops repeat their step length: kept, it serves again.
            self._transition = ds, self._propagator(ds)
        E = self._transition[1]
        forced = after = self._forced(s) if state.s < self._end else E @ before
        if self._by_distance:
            scale = goal - start
            before, after = before * scale, after * scale
        if self._approach:
            before = before + self._approaching(state.s, way)
            after = after + self._approaching(s, way)
        y = E @ (y - rest - before)
        y += after
        y += rest
        return StepperState(s, y, forced, start, goal, way, duration, pace)

    def _approaching(self, s: float, way: Vector) -> Pair:
        m, slope = quintic(min(s / self._approach, 1.0))
        return np.stack([(m - 1.0) * way, slope / self._approach * way])

    def _forced(self, s: float) -> Pair:
        """(y, dy/ds) that the forcing term has caused, by a table that ends where it does."""
        x = (s % 1.0 if self._end == math.inf else min(s, self._end)) / self._interval
        piece = min(int(x), len(self._table) - 1)
        powers = (2.0 * (x - piece) - 1.0) ** self._exponents
        forced = (powers @ self._table[piece]).reshape(2, -1)
        return forced if s <= self._end else self._propagator(s - self._end) @ forced

    def _propagator(self, s: float) -> Float64[np.ndarray, "2 2"]:
        C, S = self._spring.modes(s, math)
        E = S * self._shifted
        E[0, 0] += C
        E[1, 1] += C
        return E
