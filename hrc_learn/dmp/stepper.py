"""Closed-loop steps of one joint primitive in NumPy, which take microseconds."""

import math
from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from hrc_learn.dmp._arguments import check_not_negative
from hrc_learn.dmp.closed_loop_step import numpy_approach, numpy_step
from hrc_learn.dmp.forcing_scale import Demonstrated
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.response import PiecewisePolynomial

Vector = Float64[np.ndarray, "D"]
Pair = Float64[np.ndarray, "2 D"]


class StepperState(NamedTuple):
    """State of a joint primitive in a `Stepper`; every step returns a new one."""

    s: float
    """Normalised time, 1 at the end of the motion."""
    y: Pair
    """Columns, and their derivative dy/ds."""
    forced: Pair
    """State (y, dy/ds) caused so far by the unscaled forcing term alone."""
    scale: Float64[np.ndarray, "D D"] | None
    """Scaling of `forced`, multiplied from the right; None: independent of start and goal."""
    start: Vector
    goal: Vector
    displacement: Vector
    """Goal minus start at the beginning of the motion."""
    duration: float
    """Duration of the motion if nothing slows it [s]."""
    pace: float
    """Relative speed of the clock in the last step: 1 if undisturbed."""

    @property
    def position(self) -> Vector:
        """Position in the units of the demonstration."""
        return self.y[0]

    @property
    def velocity(self) -> Vector:
        """Velocity, position units per second."""
        return self.y[1] * (self.pace / self.duration)


class Stepper:
    """One frozen joint primitive, stepped in float64 without PyTorch.

    `step` returns the same state as `step` of the primitive. The table of the forced motion is
    multiplied by the weights beforehand, so that a step is a table look-up and a 2x2 product.
    """

    def __init__(self, dmp: JointDMP):
        """Freeze a primitive; later changes of the primitive have no effect.

        Raises:
            ValueError: The primitive is a batch or of another kind.
        """
        if type(dmp) is not JointDMP:  # a subclass may move differently
            raise ValueError(
                f"a stepper takes a JointDMP, got {type(dmp).__name__}: use the program that "
                "export_dmp makes"
            )
        if dmp.duration.ndim:
            raise ValueError(
                f"a stepper takes one primitive, got a batch {tuple(dmp.duration.shape)}"
            )
        self._dmp = motion = deepcopy(dmp).requires_grad_(False).double()
        self._spring, self._approach = motion.spring, motion.response.approach
        self._scaling, weights = motion.forcing_scale, _array(motion.weights).T
        start, goal, amplitude = map(_array, (motion.start, motion.goal, motion.amplitude))
        self._shown = Demonstrated(start=start, goal=goal, amplitude=amplitude)
        if not self._scaling.depends_on_boundary:
            weights = self._scaling.scale(weights, start, goal, self._shown, np)
        # Tabulate the one forced motion instead of one for each basis function.
        forced = motion.response.forced
        table = forced.coefficients.cpu() @ torch.from_numpy(weights.copy())
        self._table = PiecewisePolynomial(table, forced.interval, forced.periodic)
        self._end = math.inf if forced.periodic else forced.end
        # NaN differs from every step length, so the first step computes its matrix.
        self._transition = math.nan, np.eye(2)

    def initial_state(self, **arguments: Any) -> StepperState:
        """State at the start of a motion; arguments as in `initial_state` of the primitive."""
        state = self._dmp.initial_state(**arguments)
        start, goal = _array(state.start), _array(state.goal)
        return StepperState(
            s=0.0,
            y=np.stack([start, _array(state.rate)]),
            forced=self._forced(0.0),
            scale=self._scale(start, goal),
            start=start,
            goal=goal,
            displacement=goal - start,
            duration=state.duration.item(),
            pace=1.0,
        )

    def step(
        self,
        state: StepperState,
        dt: float,
        goal: Vector | None = None,
        coupling: Vector | None = None,
        phase_stopping: float = 0.0,
    ) -> StepperState:
        """Advance by `dt` [s].

        Args:
            state: From `initial_state` or the last step.
            dt: Time step [s].
            goal: New goal, which replaces the goal at once.
            coupling: External acceleration [1/s^2].
            phase_stopping: Number p >= 0; the clock runs slower by the factor 1 + p.
        """
        check_not_negative("dt", dt)
        check_not_negative("phase_stopping", phase_stopping)
        s, y, before, scale, start, target, displacement, duration, _ = state
        if goal is not None:
            target = _checked("goal", goal, start)
            scale = self._scale(start, target)
        pace = 1.0 / (1.0 + phase_stopping)
        ds = dt * pace / duration
        now = s + ds
        known, E = self._transition
        if ds != known:
            # Loops repeat one step length, so keep its matrix. Another thread may replace it.
            E = self._spring.propagator(ds).numpy()
            self._transition = ds, E
        # After the end of the forcing, only the spring changes the state that the forcing
        # caused.
        forced = after = self._forced(now) if s < self._end else E.dot(before)
        if scale is not None:
            before, after = before.dot(scale), after.dot(scale)
        if self._approach:
            before = before + numpy_approach(s, self._approach, displacement)
            after = after + numpy_approach(now, self._approach, displacement)
        rest = target
        if coupling is not None:
            # At the equilibrium the spring balances the push.
            push = _checked("coupling", coupling, start)
            rest = target + push * (duration**2 / self._spring.stiffness)
        y = numpy_step(E, y, before, after, rest)
        return StepperState(now, y, forced, scale, start, target, displacement, duration, pace)

    def _scale(self, start: Vector, goal: Vector) -> Float64[np.ndarray, "D D"] | None:
        if not self._scaling.depends_on_boundary:
            return None
        return self._scaling.scale(np.eye(len(start)), start, goal, self._shown, np)

    def _forced(self, s: float) -> Pair:
        """State (y, dy/ds) caused by the forcing: from the table, then by the spring alone."""
        forced = self._table.at(s)
        if s <= self._end:
            return forced
        return self._spring.propagator(s - self._end).numpy().dot(forced)


def _array(x: Tensor) -> Float64[np.ndarray, "..."]:
    return x.detach().cpu().to(torch.float64, copy=True).numpy()


def _checked(name: str, values: Any, like: Vector) -> np.ndarray:
    values = np.asarray(values)
    if values.dtype.kind not in "fiu" or values.shape != like.shape:
        raise ValueError(f"{name} must hold {len(like)} real numbers, got {values}")
    # For so few numbers, Python's sum takes a third of the time of NumPy's.
    if not math.isfinite(sum(values.tolist())):
        raise ValueError(f"{name} must be finite, got {values}")
    return values
