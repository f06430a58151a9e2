"""Closed-loop steps in NumPy, of one primitive each, for loops that count microseconds."""

import math
from functools import singledispatch
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from hrc_learn.dmp import numpy_orientation as arrays
from hrc_learn.dmp._system.quintic_curves import quintic
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
        forced, weights = dmp.response.forced, dmp.weights.detach().double().cpu()
        self._scaling, self._shown = dmp.forcing_scale, _demonstrated(dmp)
        weights = weights.numpy().T
        if not self._scaling.follows_ends:
            weights = self._scaled(weights, self._shown.start, self._shown.goal)
        table = forced.coefficients.cpu().numpy() @ weights
        self._table = np.ascontiguousarray(table.reshape(*table.shape[:2], -1))
        self._exponents = np.arange(table.shape[1], dtype=float)
        self._interval = forced.interval
        self._end = math.inf if forced.periodic else forced.end
        self._spring, self._approach = dmp.spring, dmp.response.approach
        self._velocity = dmp.start_velocity.detach().double().cpu().numpy()
        self._duration = dmp.duration.item()
        half = self._spring.alpha / 2
        self._stiffness = self._spring.stiffness
        self._transition = math.nan, np.eye(2), np.zeros((2, 1))
        self._shifted = np.array([[half, 1.0], [-self._spring.stiffness, -half]])

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
        powers = (2.0 * (x - piece) - 1.0) ** self._exponents
        forced = powers.dot(self._table[piece]).reshape(2, -1)
        return forced if s <= self._end else self._propagator(s - self._end).dot(forced)

    def _propagator(self, s: float) -> Float64[np.ndarray, "2 2"]:
        C, S = self._spring.modes(s, math)
        E = S * self._shifted
        E[0, 0] += C
        E[1, 1] += C
        return E


def _demonstrated(dmp: JointDMP) -> Demonstrated:
    start, goal, amplitude = (
        x.detach().double().cpu().numpy() for x in (dmp.start, dmp.goal, dmp.amplitude)
    )
    return Demonstrated(start=start, goal=goal, amplitude=amplitude)


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
        phase_stopping: float = 0.0,
    ) -> OrientationStepperState:
        """Advance by `dt` [s]; a new goal is there at once."""
        motion, reference = state
        if goal is not None:
            reference = arrays.reference_of(self._goal, goal)
            ends = arrays.retarget(motion.y[0], motion.y[1], state.reference, reference)
            motion = motion._replace(y=np.stack(ends))
        motion = self._motion.step(motion, dt, phase_stopping=phase_stopping)
        return OrientationStepperState(motion, reference)


def start_stepper(stepper: Stepper, state: Any) -> StepperState:
    """State of a stepper at the start, from that of the primitive it is of."""
    start, goal, velocity = (
        x.detach().double().cpu().numpy() for x in (state.start, state.goal, state.velocity)
    )
    return stepper.initial_state(start, goal, state.duration.item(), velocity)


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
        return PoseStepperState(
            self._motion.step(motion, dt, goal, push, phase_stopping), rotation
        )


type AnyStepper = Stepper | OrientationStepper | PoseStepper


@singledispatch
def freeze_stepper(primitive: Any) -> AnyStepper | None:
    """The NumPy stepper of one primitive; None: only its exported program steps it.

    Raises:
        ValueError: The primitive is a batch.
    """
    return None


@freeze_stepper.register(JointDMP)
def _freeze_joints(primitive: JointDMP) -> AnyStepper | None:
    return Stepper(primitive)


@freeze_stepper.register(OrientationDMP)
def _freeze_orientation(primitive: OrientationDMP) -> AnyStepper | None:
    return OrientationStepper(primitive) if primitive.formulation == "log" else None


@freeze_stepper.register(PoseDMP)
def _freeze_pose(primitive: PoseDMP) -> AnyStepper | None:
    return PoseStepper(primitive)
