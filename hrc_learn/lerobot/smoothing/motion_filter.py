"""A jerk-limited filter of positions, and the curve through actions for the motors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float

from .action_limits import ActionLimits

LIMIT_KINDS = ("position", "velocity", "acceleration", "jerk")
"""Limits that positions may break, in the order of the last axis of a report's flags."""

# Fraction of the limits that a correction counts on; the motion followed needs the rest.
_USABLE = 0.8
# Fastest decay of errors, as fractions of the sampling rate: of those tried, the fastest with
# which steps of 0.03 to 1 rad settle without overshoot at 20 and 50 samples a second.
_POSITION_RATE, _VELOCITY_RATE = 0.35, 0.7
# Differences of rounded numbers, float32 too, may exceed a limit in the last digits.
_ROUNDING = 1 + 1e-6
# Fraction of a limit of velocity left unused, as sums of rounded numbers must not exceed it.
_UNUSED = 1e-12
# Larger numbers are taken for invalid: squares of much larger ones overflow.
_LARGEST_VALID = 1e50


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionState:
    """State of the motion, carried from one position to the next."""

    position: Float[np.ndarray, "*batch D"]
    """Handed out last."""
    velocity: Float[np.ndarray, "*batch D"]
    """Difference quotient of the last step [1/s]."""
    acceleration: Float[np.ndarray, "*batch D"]
    """Difference quotient of the velocity at the last step [1/s^2]."""
    reference: Float[np.ndarray, "*batch D"]
    """Asked for last."""
    reference_velocity: Float[np.ndarray, "*batch D"]
    """Velocity of the motion, zero after a jump [1/s]."""
    reference_acceleration: Float[np.ndarray, "*batch D"]
    """Acceleration of the motion, zero after a jump [1/s^2]."""

    @classmethod
    def moving(
        cls,
        position: Float[np.ndarray, "*batch D"],
        velocity: Float[np.ndarray, "*batch D"] | float = 0.0,
        acceleration: Float[np.ndarray, "*batch D"] | float = 0.0,
    ) -> MotionState:
        """State of a motion at a position, at rest by default.

        Raises:
            ValueError: The position is not finite, from which no motion could recover.
        """
        position = np.asarray(position, dtype=np.float64)
        if not np.isfinite(position).all():
            raise ValueError(f"a motion must start at a finite position, but is at {position}")
        still = np.zeros_like(position)
        return cls(
            position=position,
            velocity=still + velocity,
            acceleration=still + acceleration,
            reference=position,
            reference_velocity=still + velocity,
            reference_acceleration=still,
        )


@final
class MotionFilter:
    """Follows positions within limits of position, velocity, acceleration and jerk.

    Positions that keep the limits and go on where the last ones ended come out as they went
    in. Otherwise the motion leaves them and comes back: with e the distance to what is asked
    for, e' its rate and a_r the acceleration of what is asked for,

        a = a_r - h'(e; A, lambda) e' - h(e' + h(e; A, lambda); j, mu)
        h(x; b, k) = sign(x) (sqrt((b/k)^2 + 2 b |x|) - b/k)

    so that e' follows -h(e), along which e brakes with A while it is large and decays at the
    rate lambda once it is small. A step counts as error, not as motion.

    The limits hold for *any* input, as they are for differences of what is handed out:
    v_k = (p_k - p_{k-1})/dt, a_k = (v_k - v_{k-1})/dt, j_k = (a_k - a_{k-1})/dt. With d the
    distance to a limit of position and v the speed towards it, the next acceleration is clamped
    so that

        v + (a + A)^2/(2 j) <= min(h(d; A, 1/dt), v_max + A^2/(2 j))

    remains true, which is a set that braking with A, reached with j, never leaves. It takes a
    start in it: at rest, A^3/(8 j^2) + A^2 dt/(2 j) away from the limits of position. A is
    lowered where that would be more than a tenth of their range.

    `hrc_learn.controller.ActionChunkFilter` is the same in PyTorch, for batches and gradients,
    at three times the time for one position.
    """

    def __init__(self, limits: ActionLimits, dt: float):
        """Prepare for one sampling rate.

        Args:
            limits: Limits of every value.
            dt: Time from one position to the next [s].

        Raises:
            ValueError: dt is not positive and finite.
        """
        if not 0 < dt < float("inf"):
            raise ValueError(f"dt must be positive and finite, but is {dt}")
        lower, upper = limits.positions()
        self.dt = dt
        self.velocity = np.asarray(limits.velocity, dtype=np.float64)
        self.jerk = np.asarray(limits.jerk, dtype=np.float64)
        A = np.asarray(limits.acceleration, dtype=np.float64)
        j, margin = self.jerk, 0.05 * (upper - lower)
        # The larger of both terms of the way that braking needs at rest stays below the margin,
        # so that together they take at most a tenth of the range.
        ramped = np.minimum(np.cbrt(8 * j**2 * margin), np.sqrt(2 * j * margin / dt))
        self.acceleration = np.minimum(A, ramped)
        A = self.acceleration
        self._lower, self._upper = lower, upper
        self._walls = np.stack([-lower, upper])
        self._sides = np.array([[1.0], [-1.0]])
        self._knee, self._reserve = A * dt, A**2 / (2 * j)
        self._fastest = self.velocity * (1 - _UNUSED)
        self._braking, self._braking_jerk = _USABLE * A, _USABLE * j
        self._rate = np.minimum(self._braking_jerk / self._braking, _POSITION_RATE / dt)
        self._rate_of_velocity = _VELOCITY_RATE / dt

    def step(self, state: MotionState, asked: Float[np.ndarray, "*batch D"]) -> MotionState:
        """Go towards a position, dt after the state.

        Args:
            state: After the position before.
            asked: Requested values. NaN and absurdly large ones are replaced by the previous
                value.
        """
        dt = self.dt
        asked = np.where(np.abs(asked) < _LARGEST_VALID, asked, state.reference)
        velocity, acceleration = self._reference_motion(state, asked)
        error = state.position - (asked - velocity * dt)
        rate = state.velocity - (velocity - acceleration * dt)
        approach, slope = _braking_rate(error, self._braking, self._rate)
        fade, _ = _braking_rate(rate + approach, self._braking_jerk, self._rate_of_velocity)
        a = self._allowed(acceleration - slope * rate - fade, state)
        v = state.velocity + a * dt
        return MotionState(
            position=state.position + v * dt,
            velocity=v,
            acceleration=a,
            reference=asked,
            reference_velocity=velocity,
            reference_acceleration=(velocity - state.reference_velocity) / dt,
        )

    def broken(
        self, state: MotionState, asked: Float[np.ndarray, "*batch T D"]
    ) -> Bool[np.ndarray, "*batch T 4"]:
        """True for each of `LIMIT_KINDS` that exact positions would violate."""
        values = asked = np.asarray(asked, dtype=np.float64)
        flags = [((asked > self._upper) | (asked < self._lower)).any(-1)]
        for start, limit in (
            (state.position, self.velocity),
            (state.velocity, self.acceleration),
            (state.acceleration, self.jerk),
        ):
            values = np.diff(np.concatenate([start[..., None, :], values], -2), axis=-2)
            values = values / self.dt
            flags.append((np.abs(values) > limit * _ROUNDING).any(-1))
        return np.stack(flags, axis=-1)

    def _reference_motion(
        self, state: MotionState, asked: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Velocity and acceleration of what is asked for, as far as it is a motion.

        Where it breaks a limit, the velocity goes after it with the limit of acceleration,
        which passes steps by and still learns a new slope, and there is no acceleration to be
        followed.
        """
        dt, A = self.dt, self.acceleration
        change = ((asked - state.reference) / dt - state.reference_velocity) / dt
        limited = np.minimum(np.maximum(change, -A), A)
        jerk = (limited - state.reference_acceleration) / dt
        motion = (np.abs(jerk) <= self.jerk * _ROUNDING) & (limited == change)
        return state.reference_velocity + limited * dt, np.where(motion, limited, 0.0)

    def _allowed(self, wanted: np.ndarray, state: MotionState) -> np.ndarray:
        """The nearest acceleration with which the limits are kept, now and later [1/s^2]."""
        A, j, dt = self.acceleration, self.jerk, self.dt
        margin = self._walls + self._sides * state.position[..., None, :]
        # Past a limit the motion returns as fast as from the same distance inside it.
        speed = np.sqrt(self._knee**2 + 2 * A * np.abs(margin)) - self._knee
        speed = np.copysign(speed, margin) - self._reserve
        speed = np.minimum(np.maximum(speed, -self._fastest), self._fastest)
        slack = speed + self._sides * state.velocity[..., None, :]
        offset = A + j * dt
        # Negative far outside the set, where no acceleration is enough: brake hard.
        most = np.sqrt(np.maximum(offset**2 + 2 * j * slack, 0.0)) - offset
        a = np.minimum(np.maximum(wanted, -most[..., 0, :]), most[..., 1, :])
        # Last what the motors cannot exceed: outside the set the rest may ask for more.
        least = np.maximum(state.acceleration - j * dt, -A)
        greatest = np.minimum(state.acceleration + j * dt, A)
        return np.minimum(np.maximum(a, least), greatest)


def _braking_rate(
    x: np.ndarray, strength: np.ndarray, rate: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """The function h and its slope: how fast x may change if it is to come to rest at zero.

    Square root far from zero (constant deceleration), a line of slope `rate` close to it.
    """
    knee = strength / rate
    root = np.sqrt(knee**2 + 2 * strength * np.abs(x))
    return np.copysign(root - knee, x), strength / root


LARGEST_DEGREE = 3
_LATEST = 1.5
"""Frames for which the curve is continued when no action comes; then it comes to rest."""


class ActionUpsampler:
    """Setpoints between actions, on a B-spline, within limits.

    The last d + 1 actions are the control points of a uniform B-spline of degree d: 0 holds the
    newest, 1 is a line from the one before it, 2 and 3 have continuous velocity and
    acceleration. The derivatives of such a curve lie between the differences of its control
    points, so actions that keep the limits at their own rate lead to setpoints that keep them
    at any. A `MotionFilter` at the rate of the setpoints keeps them whatever the actions are.

    A curve of degree d is (d + 1)/2 actions late. A smaller latency puts each control point
    ahead, along the difference of the last two actions, which makes their noise larger.

    Attributes:
        latency: Latency of the curve behind the actions [s].
        position: Setpoint handed out last.
    """

    def __init__(
        self,
        limits: ActionLimits,
        rate: float,
        *,
        degree: int = LARGEST_DEGREE,
        latency: float | None = None,
    ):
        """Begin with `reset`.

        Args:
            limits: Limits of the actions, with their rate.
            rate: Setpoints a second; at least as many as actions.
            degree: Degree of the curve, 0 to 3.
            latency: Latency of the curve, in actions; None: (degree + 1)/2, the largest.

        Raises:
            ValueError: An argument is out of its range.
        """
        if not 0 <= degree <= LARGEST_DEGREE:
            raise ValueError(f"degree must be 0 to {LARGEST_DEGREE}, got {degree}")
        if not limits.fps <= rate < float("inf"):
            raise ValueError(
                f"rate must be at least the {limits.fps:g} actions a second, got {rate:g}"
            )
        own = (degree + 1) / 2
        latency = own if latency is None else latency
        if not 0 <= latency <= own:
            raise ValueError(
                f"latency must be 0 to {own:g} actions for a curve of degree {degree}, got "
                f"{latency:g}"
            )
        self.limits, self.rate, self.degree = limits, rate, degree
        self.latency = latency / limits.fps
        self._lead = own - latency
        self._filter = MotionFilter(limits, 1 / rate)
        self._points: np.ndarray | None = None
        self._phase = 0.0

    @property
    def position(self) -> Float[np.ndarray, "*batch D"]:
        return self._state.position

    def reset(self, position: Float[np.ndarray, "*batch D"]) -> None:
        """Start at rest at the present position; several robots move at once if there are.

        Raises:
            ValueError: It has another number of values than the limits.
        """
        position = self._checked(position)
        self._state = MotionState.moving(position)
        self._points = np.repeat(position[None], self.degree + 1, axis=0)
        self._newest, self._phase = position, 0.0

    def push(self, action: Float[np.ndarray, "*batch D"]) -> None:
        """Take the next action; the phase of `setpoint` counts from now on.

        Values that are not finite are taken for those before.

        Raises:
            ValueError: It has another number of values than the limits.
            RuntimeError: There was no `reset`.
        """
        if self._points is None:
            raise RuntimeError("reset() says where the robot is: call it first")
        action = self._checked(action)
        action = np.where(np.isfinite(action), action, self._newest)
        ahead = action + self._lead * (action - self._newest)
        self._points = np.concatenate([self._points[1:], ahead[None]])
        self._newest = action

    def repeat(self) -> None:
        """Take the newest action once more: with no other ones, the motion comes to rest."""
        self.push(self._newest)

    def setpoint(self, phase: float) -> Float[np.ndarray, "*batch D"]:
        """The next setpoint, 1/rate after the last.

        Args:
            phase: Time since the newest action, in actions. Beyond one, where the next action
                is late, the curve goes on for half an action.
        """
        assert self._points is not None  # reset() comes before push()
        weights = _weights(self.degree, min(phase, _LATEST))
        self._state = self._filter.step(self._state, np.tensordot(weights, self._points, 1))
        return self._state.position

    def frame(self, action: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "n *batch D"]:
        """All setpoints until the next action is due.

        Where the rates do not divide, their number changes from one action to the next.

        Raises:
            ValueError: Same as `push`.
        """
        self.push(action)
        made, step = [], self.limits.fps / self.rate
        # Rounding must not make one more of them, just before the next action.
        while self._phase < 1 - 1e-9:
            made.append(self.setpoint(self._phase))
            self._phase += step
        self._phase -= 1
        return np.stack(made)

    def _checked(self, values: np.ndarray) -> np.ndarray:
        values = np.asarray(values, dtype=np.float64)
        if values.shape[-1:] != (len(self.limits.names),):
            raise ValueError(
                f"limits are given for {', '.join(self.limits.names)}, but there are values "
                f"of shape {values.shape}"
            )
        return values


def _weights(degree: int, u: float) -> Float[np.ndarray, " points"]:
    """Weights of the control points, oldest first, by the recursion of Cox and de Boor."""
    weights = np.array([1.0])
    for d in range(1, degree + 1):
        k = np.arange(d)
        rising = (u + d - 1 - k) / d
        weights = np.append(weights * (1 - rising), 0.0) + np.append(0.0, weights * rising)
    return weights
