"""Closed-loop steps in NumPy, of one primitive each, for loops that count microseconds.

Those of joints first; then errors of orientations, one at a time, and the steppers of what has
one.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64
from torch import Tensor

from hrc_learn.dmp._system.closed_forms import quintic
from hrc_learn.dmp.forcing_scale import Demonstrated
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.orientation_dmp import OrientationDMP
from hrc_learn.dmp.pose_dmp import BODY, ERROR, POSITION, PoseDMP

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
    scale: Float64[np.ndarray, "D D"] | None
    """What start and goal make of the forcing term, from the right; None: nothing."""
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
        forced, weights = dmp.response.forced, _array(dmp.weights).T
        start, goal, amplitude = (_array(x) for x in (dmp.start, dmp.goal, dmp.amplitude))
        self._shown = Demonstrated(start=start, goal=goal, amplitude=amplitude)
        self._scaling = dmp.forcing_scale
        if not self._scaling.follows_ends:
            weights = self._scaled(weights, self._shown.start, self._shown.goal)
        # One motion instead of one for each basis function.
        table = forced.coefficients.cpu().numpy() @ weights
        self._table = np.ascontiguousarray(table.reshape(*table.shape[:2], -1))
        self._exponents = np.arange(table.shape[1], dtype=float)
        self._interval = forced.interval
        self._end = math.inf if forced.periodic else forced.end
        self._spring, self._approach = dmp.spring, dmp.response.approach
        self._velocity = _array(dmp.start_velocity)
        self._duration = dmp.duration.item()
        half, self._stiffness = self._spring.alpha / 2, self._spring.stiffness
        # A + alpha / 2 I, see `SpringDamper.propagator`.
        self._shifted = np.array([[half, 1.0], [-self._stiffness, -half]])
        # NaN differs from every step length: none is known yet.
        self._transition = math.nan, np.eye(2), np.zeros((2, 1))

    def initial_state(
        self,
        start: Vector | None = None,
        goal: Vector | None = None,
        duration: float | None = None,
        start_velocity: Vector | None = None,
    ) -> StepperState:
        """State at the start of a motion; arguments as in `JointDMP.rollout`."""
        y_0 = self._shown.start if start is None else start
        g = self._shown.goal if goal is None else goal
        tau = self._duration if duration is None else duration
        if start_velocity is not None:
            rate = start_velocity * tau
        else:
            rate = self._velocity * self._duration
            if self._scaling.turns:
                rate = self._scaled(rate[None], y_0, g)[0]
        return StepperState(
            s=0.0,
            y=np.stack([y_0, rate]),
            forced=self._forced(0.0),
            scale=self._scale(y_0, g),
            start=y_0,
            goal=g,
            way=g - y_0,
            duration=tau,
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
        """Advance by `dt` [s]; arguments as in `JointDMP.step`."""
        s, y, before, scale, start, at, way, duration, _ = state
        if goal is None:
            goal = at
        else:
            scale = self._scale(start, goal)
        pace = 1.0 / (1.0 + phase_stopping)
        ds = dt * pace / duration
        s += ds
        if ds != self._transition[0]:
            # Loops repeat their step length: kept, it serves again.
            E = self._propagator(ds)
            self._transition = ds, E, np.array([[1.0 - E[0, 0]], [-E[1, 0]]])
        _, E, attraction = self._transition
        # Past its end the spring alone moves on what the forcing caused.
        forced = after = self._forced(s) if state.s < self._end else E.dot(before)
        if scale is not None:
            before, after = before.dot(scale), after.dot(scale)
        if self._approach:
            before = before + self._approaching(state.s, way)
            after = after + self._approaching(s, way)
        # At rest the spring balances a push.
        rest = goal if coupling is None else goal + coupling * (duration**2 / self._stiffness)
        y = E.dot(y - before)
        y += after
        y += attraction * rest
        return StepperState(s, y, forced, scale, start, goal, way, duration, pace)

    def _scale(self, start: Vector, goal: Vector) -> Float64[np.ndarray, "D D"] | None:
        if not self._scaling.follows_ends:
            return None
        return self._scaled(np.eye(len(start)), start, goal)

    def _scaled(
        self, values: Float64[np.ndarray, "K D"], start: Vector, goal: Vector
    ) -> Float64[np.ndarray, "K D"]:
        return self._scaling.scale(values, start, goal, self._shown, np)

    def _approaching(self, s: float, way: Vector) -> Pair:
        m, slope = quintic(min(s / self._approach, 1.0))
        return np.stack([(m - 1.0) * way, slope / self._approach * way])

    def _forced(self, s: float) -> Pair:
        """(y, dy/ds) that the forcing term has caused, by a table that ends where it does."""
        x = (s % 1.0 if self._end == math.inf else min(s, self._end)) / self._interval
        piece = min(int(x), len(self._table) - 1)
        # From -1 to 1 along a piece, as in `PiecewisePolynomial`.
        powers = (2.0 * (x - piece) - 1.0) ** self._exponents
        forced = powers.dot(self._table[piece]).reshape(2, -1)
        return forced if s <= self._end else self._propagator(s - self._end).dot(forced)

    def _propagator(self, s: float) -> Float64[np.ndarray, "2 2"]:
        C, S = self._spring.modes(s, math)
        E = S * self._shifted
        E[0, 0] += C
        E[1, 1] += C
        return E


def _array(x: Tensor) -> Float64[np.ndarray, "..."]:
    return x.detach().double().cpu().numpy()


# Errors of orientations

Vector3 = Float64[np.ndarray, "3"]
Quaternion = Float64[np.ndarray, "4"]

SMALL = 2e-2
"""Angles [rad] below which closed forms cancel; two terms of their series are exact to 1e-11
there."""
SINGULAR = 1e-3
"""Share of an angular velocity that still counts as rate of the error: below it, one whole turn
away, the inverse would blow the rest up a thousand times."""
NO_AXIS = 1e-9
"""Rotation vectors shorter than this [rad] have no direction of their own."""


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
    """sin(x) / x, which cancels nowhere."""
    return math.sin(x) / x if x else 1.0


def _log(q: Quaternion) -> Vector3:
    """Rotation vector of the shortest rotation [rad]; at half a turn as `quaternion.log`."""
    sign = np.sign(q) @ [8.0, 4.0, 2.0, 1.0]
    w, v = np.sign(sign) * q[0], np.sign(sign) * q[1:]
    sine = math.sqrt(v @ v)
    return (2 * math.atan2(sine, w) / sine if sine else 2.0) * v


def _to_orientation(error: Vector3, goal: Quaternion) -> Quaternion:
    """Orientation that differs from the goal by this error."""
    return _multiply(_exp(-error), goal)


def _to_error(q: Quaternion, goal: Quaternion) -> Vector3:
    """Shortest error of an orientation to the goal [rad]."""
    return _log(_multiply(goal, q * [1.0, -1.0, -1.0, -1.0]))


def _reference_of(error: Vector3, orientation: Quaternion) -> Quaternion:
    """The reference to which an orientation, of any length, has this error."""
    return _multiply(_exp(error), orientation / np.sqrt(orientation @ orientation))


def _velocity_map(error: Vector3) -> Float64[np.ndarray, "3 3"]:
    """Maps the rate of an error to the angular velocity of the orientation.

    omega = -J(-e) e', J the left Jacobian of the rotation group, J(v) = I + (1 - cos t) / t^2
    [v] + (t - sin t) / t^3 [v]^2, t = |v| (Sola et al. 2018, "A micro Lie theory", eq. 145).
    """
    square = float(error @ error)
    angle = square**0.5
    if angle < SMALL:
        first = 0.5 - square / 24 + square**2 / 720
        second = 1 / 6 - square / 120 + square**2 / 5040
    else:
        # Half angles: 1 - cos cancels for small ones.
        first = 2 * (math.sin(angle / 2) / angle) ** 2
        second = (angle - math.sin(angle)) / (angle * square)
    cross = _skew(error)
    return first * cross - second * (cross @ cross) - np.eye(3)


def _angular_velocity(error: Vector3, rate: Vector3) -> Vector3:
    """Angular velocity in the base frame, of an error and its rate."""
    return _velocity_map(error) @ rate


def _error_rate(error: Vector3, velocity: Vector3) -> Vector3:
    """Rate of an error, of an angular velocity: the inverse of `_angular_velocity`.

    Whole turns away the error has a rate about its own axis only.
    """
    square = float(error @ error)
    half = square**0.5 / 2
    sinc = _sinc(half)
    if abs(sinc) < SINGULAR:
        return -(error @ velocity) / square * error
    near = 2 * half < SMALL
    share = 1 / 12 + square / 720 if near else (1 - math.cos(half) / sinc) / square
    cross = _skew(error)
    across = cross @ velocity
    return -velocity - 0.5 * across - share * (cross @ across)


def _skew(v: Vector3) -> Float64[np.ndarray, "3 3"]:
    """The matrix [v] with [v] u = v x u."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _retarget(
    error: Vector3, rate: Vector3, old_goal: Quaternion, goal: Quaternion
) -> tuple[Vector3, Vector3]:
    """Error to a new goal and its rate, for the same orientation and angular velocity."""
    new = _nearest_turn(_to_error(_to_orientation(error, old_goal), goal), error)
    return new, _error_rate(new, _angular_velocity(error, rate))


def _nearest_turn(error: Vector3, reference: Vector3) -> Vector3:
    """The same rotation as `error`, with the whole turns that bring it closest to another."""
    axis = error if np.sqrt(error @ error) > NO_AXIS else reference
    axis = axis / max(np.sqrt(axis @ axis), NO_AXIS)
    turns = np.round((reference - error) @ axis / (2 * np.pi))
    return error + 2 * np.pi * turns * axis


# Steppers of what has an orientation


class OrientationStepperState(NamedTuple):
    """Where a primitive is while it is stepped; every step makes a new one."""

    motion: StepperState
    """Of the error to the goal [rad]."""
    reference: Quaternion
    """The goal, unless the primitive says otherwise."""

    @property
    def orientation(self) -> Quaternion:
        """Unit quaternion (w, x, y, z)."""
        return _to_orientation(self.motion.position, self.reference)

    @property
    def angular_velocity(self) -> Vector3:
        """In the base frame [rad/s]."""
        return _angular_velocity(self.motion.position, self.motion.velocity)


class PoseStepperState(NamedTuple):
    """Where a primitive is while it is stepped; every step makes a new one."""

    motion: StepperState
    """Of position, error to the goal, and body."""
    reference: Quaternion
    """The goal's orientation, unless the primitive says otherwise."""

    @property
    def position(self) -> Vector3:
        """[m]."""
        return self.motion.position[POSITION]

    @property
    def orientation(self) -> Quaternion:
        """Unit quaternion (w, x, y, z)."""
        return _to_orientation(self.motion.position[ERROR], self.reference)

    @property
    def body(self) -> Float64[np.ndarray, "K"]:
        """Coordinates learned along."""
        return self.motion.position[BODY]

    @property
    def twist(self) -> Float64[np.ndarray, "6"]:
        """(linear [m/s], angular [rad/s]) in the base frame."""
        position, velocity = self.motion.position, self.motion.velocity
        angular = _angular_velocity(position[ERROR], velocity[ERROR])
        return np.concatenate([velocity[POSITION], angular])


class _ErrorStepper:
    """A stepper of columns some of which are the error of an orientation."""

    def __init__(self, dmp: OrientationDMP | PoseDMP):
        """Freeze a primitive.

        Raises:
            ValueError: The primitive is a batch, or of the formulation of Ude et al.
        """
        if getattr(dmp, "formulation", "log") != "log":
            raise ValueError(
                f"a stepper takes the formulation 'log', got {dmp.formulation!r}, whose steps "
                f"are integrated: use the exported program"
            )
        self._motion, self._columns = Stepper(dmp.motion), dmp.adapter.error_columns
        self._goal = _array(dmp.motion.goal[self._columns])
        self._dmp = dmp

    def _begin(self, arguments: dict[str, Any]) -> tuple[StepperState, Quaternion]:
        state = self._dmp.initial_state(**arguments)
        motion = state.motion
        start, goal, velocity = (
            _array(x) for x in (motion.start, motion.goal, motion.velocity)
        )
        begun = self._motion.initial_state(start, goal, motion.duration.item(), velocity)
        return begun, _array(state.reference)

    def _retarget(
        self, motion: StepperState, reference: Quaternion, orientation: Quaternion
    ) -> tuple[StepperState, Quaternion]:
        """The same orientation and angular velocity, on the way to a new goal."""
        new = _reference_of(self._goal, orientation)
        y = motion.y.copy()
        y[:, self._columns] = _retarget(
            y[0, self._columns], y[1, self._columns], reference, new
        )
        return motion._replace(y=y), new


class OrientationStepper(_ErrorStepper):
    """One unbatched primitive, frozen; `step` does what `OrientationDMP.step` does."""

    def initial_state(self, **arguments: Any) -> OrientationStepperState:
        """State at the start of a motion; arguments as in `OrientationDMP.rollout`."""
        return OrientationStepperState(*self._begin(arguments))

    def step(
        self,
        state: OrientationStepperState,
        dt: float,
        goal: Quaternion | None = None,
        phase_stopping: float = 0.0,
    ) -> OrientationStepperState:
        """Advance by `dt` [s]; a new goal is there at once."""
        motion, reference = state
        if goal is not None:
            motion, reference = self._retarget(motion, reference, goal)
        motion = self._motion.step(motion, dt, phase_stopping=phase_stopping)
        return OrientationStepperState(motion, reference)


class PoseStepper(_ErrorStepper):
    """One unbatched primitive, frozen; `step` does what `PoseDMP.step` does."""

    def initial_state(self, **arguments: Any) -> PoseStepperState:
        """State at the start of a motion; arguments as in `PoseDMP.rollout`."""
        return PoseStepperState(*self._begin(arguments))

    def step(
        self,
        state: PoseStepperState,
        dt: float,
        position: Vector3 | None = None,
        orientation: Quaternion | None = None,
        body: Float64[np.ndarray, "K"] | None = None,
        coupling: Vector3 | None = None,
        phase_stopping: float = 0.0,
    ) -> PoseStepperState:
        """Advance by `dt` [s].

        Args:
            state: From `initial_state` or the last step.
            dt: [s].
            position: Of the goal from here on [m].
            orientation: Of the goal, likewise.
            body: Goal of the body, likewise.
            coupling: Acceleration added to the position [m/s^2].
            phase_stopping: The clock runs 1 + this times slower.
        """
        motion, reference = state
        goal, push = motion.goal.copy(), None
        for columns, value in ((POSITION, position), (BODY, body)):
            if value is not None:
                goal[columns] = value
        if orientation is not None:
            motion, reference = self._retarget(motion, reference, orientation)
        if coupling is not None:
            push = np.zeros_like(goal)
            push[POSITION] = coupling
        motion = self._motion.step(motion, dt, goal, push, phase_stopping)
        return PoseStepperState(motion, reference)


type AnyStepper = Stepper | OrientationStepper | PoseStepper
STEPPERS: dict[type, Any] = {
    JointDMP: Stepper,
    OrientationDMP: OrientationStepper,
    PoseDMP: PoseStepper,
}
"""By the primitives that they step."""


def freeze_stepper(primitive: Any) -> AnyStepper | None:
    """The NumPy stepper of one primitive; None: only its exported program steps it.

    Raises:
        ValueError: The primitive is a batch.
    """
    integrated = getattr(primitive, "formulation", "log") != "log"
    kinds = (kind for kind in STEPPERS if isinstance(primitive, kind) and not integrated)
    return next((STEPPERS[kind](primitive) for kind in kinds), None)
