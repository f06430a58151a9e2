"""Jerk-limited filter of positions, fast enough for a loop at the rate of the motors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

# Fraction of the limits that corrections of errors use; the requested motion needs the rest.
_USABLE = 0.8
# Decay rates of position and velocity errors, as fractions of the sampling rate. Of the rates
# that we tried, these are the fastest at which steps of 0.03 to 1 rad settle without overshoot
# at 20 and 50 samples a second.
_POSITION_RATE, _VELOCITY_RATE = 0.35, 0.7
# Factor by which differences of rounded numbers may exceed a limit, also in float32.
_ROUNDING = 1 + 1e-6
# Fraction of a velocity limit left unused, so that rounded sums do not exceed it.
_UNUSED = 1e-12
# Larger numbers count as invalid: squares of much larger numbers overflow.
_LARGEST_VALID = 1e50


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionState:
    """State of the motion, passed from one step to the next."""

    position: Float[np.ndarray, "*batch D"]
    """Last position returned."""
    velocity: Float[np.ndarray, "*batch D"]
    """Difference quotient of the last step [1/s]."""
    acceleration: Float[np.ndarray, "*batch D"]
    """Difference quotient of the velocity at the last step [1/s^2]."""
    reference: Float[np.ndarray, "*batch D"]
    """Last position requested."""
    reference_velocity: Float[np.ndarray, "*batch D"]
    """Velocity of the requested motion without its jumps [1/s]."""
    reference_acceleration: Float[np.ndarray, "*batch D"]
    """Difference quotient of `reference_velocity` at the last step [1/s^2]."""

    @classmethod
    def moving(
        cls,
        position: Float[np.ndarray, "*batch D"],
        velocity: Float[np.ndarray, "*batch D"] | float = 0.0,
        acceleration: Float[np.ndarray, "*batch D"] | float = 0.0,
    ) -> MotionState:
        """State of a motion at a position, at rest by default.

        Raises:
            ValueError: A value is not finite: no motion could recover from it.
        """
        position = np.asarray(position, dtype=np.float64)
        still = np.zeros_like(position)
        velocity, acceleration = still + velocity, still + acceleration
        if not np.isfinite([position, velocity, acceleration]).all():
            raise ValueError(
                "a motion must start at a finite position, velocity and acceleration, but "
                f"starts at {position}, {velocity} and {acceleration}"
            )
        return cls(
            position=position,
            velocity=velocity,
            acceleration=acceleration,
            reference=position,
            reference_velocity=velocity,
            reference_acceleration=still,
        )


@final
class MotionFilter:
    """Filter that follows positions within limits of position, velocity, acceleration and jerk.

    Positions that keep the limits and continue the previous motion are returned unchanged.
    Otherwise the motion departs from the positions and returns to them later. With the position
    error e, its rate e' and the requested acceleration a_r,

        a = a_r - h'(e; A, lambda) e' - h(e' + h(e; A, lambda); j, mu)
        h(x; b, k) = sign(x) (sqrt((b/k)^2 + 2 b |x|) - b/k)

    with the slope h' of h. So e' follows -h(e): a large e shrinks with the deceleration A, a
    small e decays at the rate lambda. Deviations of e' from -h(e) decay in the same way, with
    the jerk j and the rate mu. A step in the requested positions counts as an error, not as a
    motion.

    The limits hold for *any* input, because they apply to differences of the returned
    positions: v_k = (p_k - p_{k-1})/dt, a_k = (v_k - v_{k-1})/dt, j_k = (a_k - a_{k-1})/dt.
    With d the distance to a limit of position and v the speed towards it, the next acceleration
    is clamped so that

        v + (a + A)^2/(2 j) <= min(h(d; A, 1/dt), v_max + A^2/(2 j))

    remains true. Braking with A, ramped up with j, never leaves this set. The motion must start
    in the set: at rest, at least A^3/(8 j^2) + A^2 dt/(2 j) away from the position limits. A is
    lowered where this distance would exceed a tenth of the range between these limits.
    """

    def __init__(
        self,
        dt: float,
        *,
        velocity: Float[np.ndarray, " D"],
        acceleration: Float[np.ndarray, " D"],
        jerk: Float[np.ndarray, " D"],
        lower: Float[np.ndarray, " D"],
        upper: Float[np.ndarray, " D"],
    ):
        """Prepare for one sampling rate.

        Args:
            dt: Time from one position to the next [s].
            velocity: Velocity limit of each value [1/s].
            acceleration: Acceleration limit of each value [1/s^2].
            jerk: Jerk limit of each value [1/s^3].
            lower: Lowest position, may be infinite.
            upper: Highest position, may be infinite.

        Raises:
            ValueError: dt is not positive and finite.
        """
        if not 0 < dt < float("inf"):
            raise ValueError(f"dt must be positive and finite, but is {dt}")
        self.dt, self.velocity, self.jerk = dt, velocity, jerk
        j, margin = jerk, 0.05 * (upper - lower)
        # Each of the two terms of the distance needed at rest stays below the margin, so
        # together they take at most a tenth of the range.
        ramped = np.minimum(np.cbrt(8 * j**2 * margin), np.sqrt(2 * j * margin / dt))
        self.acceleration = A = np.minimum(acceleration, ramped)
        self._walls = np.stack([-lower, upper])
        self._sides = np.array([[1.0], [-1.0]])
        self._knee, self._reserve = A * dt, A**2 / (2 * j)
        self._fastest = velocity * (1 - _UNUSED)
        self._braking, self._braking_jerk = _USABLE * A, _USABLE * j
        self._rate = np.minimum(self._braking_jerk / self._braking, _POSITION_RATE / dt)
        self._rate_of_velocity = _VELOCITY_RATE / dt

    def step(self, state: MotionState, asked: Float[np.ndarray, "*batch D"]) -> MotionState:
        """Move towards a position for one step dt.

        Args:
            state: State after the previous step.
            asked: Requested position. NaN and values from 1e50 on are replaced by the previous
                request.
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

    def _reference_motion(
        self, state: MotionState, asked: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Velocity and acceleration of the requested motion, without its jumps. Where the
        request breaks a limit, the velocity approaches the slope of the request within the
        acceleration limit: it nearly ignores single jumps, but follows a new slope. The
        returned acceleration is then zero.
        """
        dt, A = self.dt, self.acceleration
        change = ((asked - state.reference) / dt - state.reference_velocity) / dt
        limited = np.minimum(np.maximum(change, -A), A)
        jerk = (limited - state.reference_acceleration) / dt
        motion = (np.abs(jerk) <= self.jerk * _ROUNDING) & (limited == change)
        return state.reference_velocity + limited * dt, np.where(motion, limited, 0.0)

    def _allowed(self, wanted: np.ndarray, state: MotionState) -> np.ndarray:
        """Nearest acceleration that keeps the limits now and later [1/s^2]."""
        A, j, dt = self.acceleration, self.jerk, self.dt
        margin = self._walls + self._sides * state.position[..., None, :]
        # Beyond a limit, the speed of the return equals the speed at which the motion may
        # approach the limit from the same distance on the inner side.
        speed = np.sqrt(self._knee**2 + 2 * A * np.abs(margin)) - self._knee
        speed = np.copysign(speed, margin) - self._reserve
        speed = np.minimum(np.maximum(speed, -self._fastest), self._fastest)
        slack = speed + self._sides * state.velocity[..., None, :]
        offset = A + j * dt
        # Far outside the set no acceleration is enough, and the square is negative: brake hard.
        most = np.sqrt(np.maximum(offset**2 + 2 * j * slack, 0.0)) - offset
        a = np.minimum(np.maximum(wanted, -most[..., 0, :]), most[..., 1, :])
        # Clamp to jerk and acceleration last: outside the set, the bounds above may exceed
        # them.
        least = np.maximum(state.acceleration - j * dt, -A)
        greatest = np.minimum(state.acceleration + j * dt, A)
        return np.minimum(np.maximum(a, least), greatest)


def _braking_rate(
    x: np.ndarray, strength: np.ndarray, rate: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """The function h and its slope: the fastest rate at which x can still come to rest at zero.

    Far from zero, h is a square root (constant deceleration); near zero, a line of slope
    `rate`.
    """
    knee = strength / rate
    root = np.sqrt(knee**2 + 2 * strength * np.abs(x))
    return np.copysign(root - knee, x), strength / root
