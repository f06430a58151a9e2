"""Closed-loop steps of one primitive in NumPy, for loops that count microseconds."""

import math
from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from hrc_learn.dmp.closed_loop_step import numpy_approach, numpy_step
from hrc_learn.dmp.forcing_scale import Demonstrated
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.orientation_dmp import OrientationDMP
from hrc_learn.dmp.pose_dmp import BODY, ERROR, POSITION, PoseDMP
from hrc_learn.dmp.response import PiecewisePolynomial
from hrc_learn.geometry import Pose

Vector = Float64[np.ndarray, "D"]
Pair = Float64[np.ndarray, "2 D"]
Vector3 = Float64[np.ndarray, "3"]
Quaternion = Float64[np.ndarray, "4"]

SMALL = 2e-2
"""Angle [rad] below which closed forms cancel; two terms of their series are exact to 1e-11."""
SINGULAR = 1e-3
"""Ratio of the rate of an error to the angular velocity below which the rate is not inverted.
One whole turn away the ratio is zero, and the inverse would magnify a thousand times."""
NO_AXIS = 1e-9
"""Length [rad] below which a rotation vector has no direction."""


class StepperState(NamedTuple):
    """State of a joint primitive in a `Stepper`; every step returns a new one."""

    s: float
    """Normalised time, 1 at the end of the motion."""
    y: Pair
    """Columns, and their derivative dy/ds."""
    forced: Pair
    """State (y, dy/ds) caused so far by the unscaled forcing term alone."""
    scale: Float64[np.ndarray, "D D"] | None
    """Scaling of the forcing term, to multiply from the right; None: no scaling."""
    start: Vector
    goal: Vector
    displacement: Vector
    """Goal minus start at the beginning of the motion."""
    duration: float
    """Duration of the motion if nothing slows it [s]."""
    pace: float
    """Speed of the clock in the last step, 1 undisturbed."""
    reference: Quaternion | None
    """Reference of the orientation error; None for joints."""

    @property
    def rate(self) -> Vector:
        """Velocity of the columns, per second."""
        return self.y[1] * (self.pace / self.duration)

    @property
    def position(self) -> Vector:
        """Position in the units of the demonstration."""
        return self.y[0]

    @property
    def velocity(self) -> Vector:
        """Velocity, position units per second."""
        return self.rate


class OrientationStepperState(StepperState):
    """State of an orientation primitive in a `Stepper`."""

    errors = slice(0, 3)

    @property
    def orientation(self) -> Quaternion:
        """Unit quaternion (w, x, y, z)."""
        return _to_orientation(self.y[0, self.errors], self.reference)

    @property
    def angular_velocity(self) -> Vector3:
        """Angular velocity in the base frame [rad/s]."""
        return _angular_velocity(self.y[0, self.errors], self.rate[self.errors])


class PoseStepperState(OrientationStepperState):
    """State of a pose primitive in a `Stepper`."""

    errors = ERROR

    @property
    def position(self) -> Vector3:
        """Position [m]."""
        return self.y[0, POSITION]

    @property
    def velocity(self) -> Vector3:
        """Linear velocity [m/s]."""
        return self.rate[POSITION]

    @property
    def body(self) -> Float64[np.ndarray, "K"]:
        """Body coordinates."""
        return self.y[0, BODY]

    @property
    def twist(self) -> Float64[np.ndarray, "6"]:
        """Twist (linear [m/s], angular [rad/s]) in the base frame."""
        return np.concatenate([self.velocity, self.angular_velocity])


STATES: dict[type, type[StepperState]] = {
    JointDMP: StepperState,
    OrientationDMP: OrientationStepperState,
    PoseDMP: PoseStepperState,
}
"""State of each kind of primitive that a `Stepper` steps."""


class Stepper:
    """One frozen joint, orientation or pose primitive, stepped in float64 without PyTorch.

    `step` computes what `step` of the primitive does. The weights are multiplied into the table
    of the forced motion beforehand, so that a step is a table look-up and a 2x2 product.
    """

    def __init__(self, dmp: JointDMP | OrientationDMP | PoseDMP):
        """Freeze a primitive; later changes of it have no effect.

        Raises:
            ValueError: The primitive is a batch, of another kind, or of the formulation of Ude
                et al.
        """
        if not can_step(dmp):
            raise ValueError(
                f"a stepper takes {', '.join(kind.__name__ for kind in STATES)} of the "
                f"formulation 'log', got {type(dmp).__name__}: use the exported program"
            )
        if dmp.duration.ndim:
            raise ValueError(
                f"a stepper takes one primitive, got a batch {tuple(dmp.duration.shape)}"
            )
        self._dmp = deepcopy(dmp).requires_grad_(False).double()
        self._state = next(STATES[kind] for kind in STATES if isinstance(dmp, kind))
        motion = self._dmp.motion
        self._spring, self._approach = motion.spring, motion.response.approach
        self._scaling, weights = motion.forcing_scale, _array(motion.weights).T
        start, goal, amplitude = map(_array, (motion.start, motion.goal, motion.amplitude))
        self._shown = Demonstrated(start=start, goal=goal, amplitude=amplitude)
        if not self._scaling.depends_on_boundary:
            weights = self._scaling.scale(weights, start, goal, self._shown, np)
        # One motion instead of one for each basis function.
        forced = motion.response.forced
        table = forced.coefficients.cpu() @ torch.from_numpy(weights.copy())
        self._table = PiecewisePolynomial(table, forced.interval, forced.periodic)
        self._end = math.inf if forced.periodic else forced.end
        half, stiffness = self._spring.alpha / 2, self._spring.stiffness
        # A + alpha / 2 I, see `SpringDamper.propagator`.
        self._shifted = np.array([[half, 1.0], [-stiffness, -half]])
        # The first step length differs from NaN, so that its matrix is computed.
        self._transition = math.nan, np.eye(2)

    def initial_state(self, **arguments: Any) -> StepperState:
        """State at the start of a motion; arguments as in `initial_state` of the primitive."""
        state: Any = self._dmp.initial_state(**arguments)
        motion = state if isinstance(self._dmp, JointDMP) else state.motion
        start, goal = _array(motion.start), _array(motion.goal)
        return self._state(
            s=0.0,
            y=np.stack([start, _array(motion.rate)]),
            forced=self._forced(0.0),
            scale=self._scale(start, goal),
            start=start,
            goal=goal,
            displacement=goal - start,
            duration=motion.duration.item(),
            pace=1.0,
            reference=None if state is motion else _array(state.reference),
        )

    def step(
        self,
        state: StepperState,
        dt: float,
        goal: Vector | Quaternion | Pose | None = None,
        coupling: Vector | None = None,
        phase_stopping: float = 0.0,
        *,
        goal_body: Float64[np.ndarray, "K"] | None = None,
    ) -> StepperState:
        """Advance by `dt` [s].

        Args:
            state: From `initial_state` or the last step.
            dt: [s].
            goal: New goal from now on: joints, a unit quaternion or a `Pose`; it jumps.
            coupling: External acceleration of joints or position [1/s^2].
            phase_stopping: The clock runs slower by the factor 1 + this.
            goal_body: New goal of the body of a pose.
        """
        if not (0 <= dt < math.inf and 0 <= phase_stopping < math.inf):
            raise ValueError(
                f"dt and phase_stopping must be finite and not negative, got {dt} and "
                f"{phase_stopping}"
            )
        if goal is not None or goal_body is not None:
            state = self._retargeted(state, goal, goal_body)
        s, y, before, scale, start, goal_columns, displacement, duration, _, reference = state
        pace = 1.0 / (1.0 + phase_stopping)
        ds = dt * pace / duration
        now = s + ds
        if ds != self._transition[0]:
            # Loops repeat their step length, so its matrix is kept.
            self._transition = ds, self._propagator(ds)
        E = self._transition[1]
        # Past its end, the spring alone moves what the forcing caused.
        forced = after = self._forced(now) if s < self._end else E.dot(before)
        if scale is not None:
            before, after = before.dot(scale), after.dot(scale)
        if self._approach:
            before = before + numpy_approach(s, self._approach, displacement)
            after = after + numpy_approach(now, self._approach, displacement)
        rest = goal_columns
        if coupling is not None:
            # At the equilibrium the spring balances the push.
            push = _finite("coupling", coupling) * (duration**2 / self._spring.stiffness)
            rest = goal_columns.copy()
            rest[: len(push)] += push
        y = numpy_step(E, y, before, after, rest)
        return self._state(
            *(now, y, forced, scale, start, goal_columns, displacement, duration, pace),
            reference,
        )

    def _retargeted(
        self, state: StepperState, goal: Any, goal_body: Vector | None
    ) -> StepperState:
        """State on the way to a new goal; value and velocity stay."""
        if state.reference is None:
            goal = _finite("goal", goal)
            return state._replace(goal=goal, scale=self._scale(state.start, goal))
        columns = state.goal.copy()
        if goal_body is not None:
            columns[BODY] = _finite("goal_body", goal_body)
        state = state._replace(goal=columns)
        if goal is None:
            return state
        if isinstance(goal, Pose):
            columns[POSITION] = _finite("goal", np.asarray(goal.position))
            goal = np.asarray(goal.orientation)
        _finite("goal", goal)
        errors = self._dmp.error_columns
        new = _reference_of(self._shown.goal[errors], goal)
        y = state.y.copy()
        y[:, errors] = _retarget(y[0, errors], y[1, errors], state.reference, new)
        scale = self._scale(state.start, columns)
        return state._replace(y=y, scale=scale, reference=new)

    def _scale(self, start: Vector, goal: Vector) -> Float64[np.ndarray, "D D"] | None:
        if not self._scaling.depends_on_boundary:
            return None
        return self._scaling.scale(np.eye(len(start)), start, goal, self._shown, np)

    def _forced(self, s: float) -> Pair:
        """State (y, dy/ds) caused by the forcing term, by the table and the spring after it."""
        forced = self._table.at(s)
        return forced if s <= self._end else self._propagator(s - self._end).dot(forced)

    def _propagator(self, s: float) -> Float64[np.ndarray, "2 2"]:
        C, S = self._spring.modes(s, math)
        E = S * self._shifted
        E[0, 0] += C
        E[1, 1] += C
        return E


def can_step(dmp: Any) -> bool:
    """True if a `Stepper` steps this kind; other kinds need the exported program."""
    return isinstance(dmp, tuple(STATES)) and getattr(dmp, "formulation", "log") == "log"


def _array(x: Tensor) -> Float64[np.ndarray, "..."]:
    return x.detach().cpu().to(torch.float64, copy=True).numpy()


def _finite(name: str, values: np.ndarray) -> np.ndarray:
    if values.dtype.kind not in "fiu":
        raise ValueError(f"{name} must hold real numbers, got {values.dtype}")
    # For so few numbers Python's sum takes a third of the time.
    if not math.isfinite(sum(values.tolist())):
        raise ValueError(f"{name} must be finite, got {values}")
    return values


# Orientation errors in NumPy: `orientation_error.py` for one orientation at a time.


def _multiply(p: Quaternion, q: Quaternion) -> Quaternion:
    """Hamilton product."""
    a, b, c, d = p
    w, x, y, z = q
    return np.array(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ]
    )


def _exp(v: Vector3) -> Quaternion:
    """Unit quaternion of a rotation vector [rad]."""
    half = 0.5 * math.sqrt(v @ v)
    return np.array([math.cos(half), *(0.5 * _sinc(half) * v)])


def _sinc(x: float) -> float:
    """sin(x) / x; it does not cancel for small x."""
    return math.sin(x) / x if x else 1.0


def _log(q: Quaternion) -> Vector3:
    """Rotation vector of the shortest rotation [rad]; at half a turn as `quaternion.log`."""
    sign = np.sign(q) @ [8.0, 4.0, 2.0, 1.0]
    w, v = np.sign(sign) * q[0], np.sign(sign) * q[1:]
    sine = math.sqrt(v @ v)
    return (2 * math.atan2(sine, w) / sine if sine else 2.0) * v


def _to_orientation(error: Vector3, goal: Quaternion | None) -> Quaternion:
    """Orientation with this error to the goal."""
    assert goal is not None  # every orientation has a reference
    return _multiply(_exp(-error), goal)


def _reference_of(error: Vector3, orientation: Quaternion) -> Quaternion:
    """Reference to which an orientation, of any norm, has this error."""
    return _multiply(_exp(error), orientation / np.sqrt(orientation @ orientation))


def _angular_velocity(error: Vector3, rate: Vector3) -> Vector3:
    """Angular velocity in the base frame, from an error and its rate.

    omega = -J(-e) e', J the left Jacobian of the rotation group, J(v) = I + (1 - cos t) / t^2
    [v] + (t - sin t) / t^3 [v]^2, t = |v| (Sola et al. 2018, "A micro Lie theory", eq. 145).
    """
    square = float(error @ error)
    angle = square**0.5
    if angle < SMALL:
        first = 0.5 - square / 24 + square**2 / 720
        second = 1 / 6 - square / 120 + square**2 / 5040
    else:
        # Half angles, because 1 - cos cancels for small ones.
        first = 2 * (math.sin(angle / 2) / angle) ** 2
        second = (angle - math.sin(angle)) / (angle * square)
    cross = _skew(error)
    across = cross @ rate
    return first * across - second * (cross @ across) - rate


def _error_rate(error: Vector3, velocity: Vector3) -> Vector3:
    """Rate of an error for an angular velocity: the inverse of `_angular_velocity`.

    Whole turns away, the error can only change along its own axis.
    """
    square = float(error @ error)
    half = square**0.5 / 2
    sinc = _sinc(half)
    if abs(sinc) < SINGULAR:
        return -(error @ velocity) / square * error
    near = 2 * half < SMALL
    factor = 1 / 12 + square / 720 if near else (1 - math.cos(half) / sinc) / square
    cross = _skew(error)
    across = cross @ velocity
    return -velocity - 0.5 * across - factor * (cross @ across)


def _skew(v: Vector3) -> Float64[np.ndarray, "3 3"]:
    """Matrix [v] with [v] u = v x u."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _retarget(
    error: Vector3, rate: Vector3, old_goal: Quaternion | None, goal: Quaternion
) -> tuple[Vector3, Vector3]:
    """Error to a new goal and its rate, for the same orientation and angular velocity.

    Of all errors of that orientation it is the one nearest to the old error.
    """
    q = _to_orientation(error, old_goal)
    new = _log(_multiply(goal, q * [1.0, -1.0, -1.0, -1.0]))
    axis = new if np.sqrt(new @ new) > NO_AXIS else error
    axis = axis / max(np.sqrt(axis @ axis), NO_AXIS)
    turns = np.round((error - new) @ axis / (2 * np.pi))
    new = new + 2 * np.pi * turns * axis
    return new, _error_rate(new, _angular_velocity(error, rate))
