"""Jerk-limited filter of the action chunks of a policy.

Its output follows the requested positions as closely as the limits of position, velocity,
acceleration and jerk allow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from hrc_learn.controller.limit_barrier import LimitBarrier
from hrc_learn.kinematics import MotionLimits
from hrc_learn.pytree import pytree

LIMIT_KINDS = ("position", "velocity", "acceleration", "jerk")
"""Kinds of limits that a chunk may exceed, in the order of the last axis of `broken`."""

# Fraction of the limits used by corrections; the motion that is followed needs the rest.
_USABLE = 0.8
# Fastest decay of errors, as fractions of the sampling rate: of those tried, the fastest with
# which steps of 0.03 to 1 rad settle without overshoot at 20 and 50 samples a second.
_POSITION_RATE, _VELOCITY_RATE = 0.35, 0.7
# Differences of rounded numbers may exceed a limit by this ratio, also in float32.
_ROUNDING = 1 + 1e-6
# Larger numbers count as invalid: their squares could overflow.
_LARGEST_VALID = 1e50


@pytree
@dataclass(frozen=True, kw_only=True)
class ActionChunkState:
    """State of the motion between two chunks."""

    position: Float[Tensor, "*batch D"]
    """Last output position."""
    velocity: Float[Tensor, "*batch D"]
    """Difference quotient of the last two output positions [1/s]."""
    acceleration: Float[Tensor, "*batch D"]
    """Difference quotient of the last two velocities [1/s^2]."""
    reference: Float[Tensor, "*batch D"]
    """Last requested position."""
    reference_velocity: Float[Tensor, "*batch D"]
    """Velocity of the requested positions, within the limits [1/s]."""
    reference_acceleration: Float[Tensor, "*batch D"]
    """Acceleration of the requested positions, within the limits [1/s^2]."""


@pytree
@dataclass(frozen=True, kw_only=True)
class ActionChunkReport:
    """Limits exceeded by a chunk, and the corrections."""

    broken: Bool[Tensor, "*batch T 4"]
    """True for each of `LIMIT_KINDS` that the requested positions would exceed."""
    change: Float[Tensor, "*batch T D"]
    """Output position less the requested one."""


@final
class ActionChunkFilter(nn.Module):
    """Follows chunks of positions within limits of position, velocity, acceleration and jerk.

    A chunk that keeps the limits and continues the last one passes unchanged. Otherwise the
    motion leaves it and returns: with e the distance to the chunk, e' its rate and a_r the
    acceleration of the chunk,

        a = a_r - h'(e; A, lambda) e' - h(e' + h(e; A, lambda); j, mu)
        h(x; b, k) = sign(x) (sqrt((b/k)^2 + 2 b |x|) - b/k)

    so that e' follows -h(e), along which e brakes with A while it is large and decays at the
    rate lambda once it is small. The gap between two chunks counts as error, not as motion, so
    position, velocity and acceleration continue without a jump.

    The limits hold for *any* chunks, by `LimitBarrier`. They are limits of differences of the
    output: v_k = (p_k - p_{k-1})/dt, a_k = (v_k - v_{k-1})/dt, j_k = (a_k - a_{k-1})/dt.
    The start must be within the barrier's set: at rest, A^3/(8 j^2) + A^2 dt/(2 j) away from
    the position limits. A is lowered where that would exceed a tenth of their range. Each
    coordinate is filtered separately, in the unit of its limits.
    """

    braking_acceleration: Tensor
    """A of the corrections [1/s^2]."""
    braking_jerk: Tensor
    """j of the corrections [1/s^3]."""
    position_rate: Tensor
    """lambda [1/s]."""

    def __init__(self, limits: MotionLimits, dt: float):
        """Prepare for chunks of one sampling rate.

        Args:
            limits: Limits of each coordinate; those of position may be infinite.
            dt: Time from one sample of a chunk to the next [s].

        Raises:
            ValueError: dt or a limit is not positive and finite, or an upper limit of position
                is not above the lower one.
        """
        super().__init__()
        _check(limits, dt)
        self.dt = dt
        limits = replace(limits, acceleration=_reduced_acceleration(limits, dt))
        self.barrier = LimitBarrier(limits, margin=0.0, rate=1 / dt)
        A, j = _USABLE * limits.acceleration, _USABLE * limits.jerk
        self.register_buffer("braking_acceleration", A)
        self.register_buffer("braking_jerk", j)
        self.register_buffer("position_rate", (j / A).clamp(max=_POSITION_RATE / dt))
        self.velocity_rate = _VELOCITY_RATE / dt

    def initial_state(
        self,
        position: Float[Tensor, "*batch D"],
        velocity: Float[Tensor, "*batch D"] | None = None,
        acceleration: Float[Tensor, "*batch D"] | None = None,
    ) -> ActionChunkState:
        """State at rest, or in motion, in the dtype of the limits."""
        position = position.to(self.braking_acceleration)
        still = torch.zeros_like(position)
        velocity = still if velocity is None else still + velocity
        acceleration = still if acceleration is None else still + acceleration
        return ActionChunkState(
            position=position,
            velocity=velocity,
            acceleration=acceleration,
            reference=position,
            reference_velocity=velocity,
            reference_acceleration=still,
        )

    def forward(
        self, chunk: Float[Tensor, "*batch T D"], state: ActionChunkState
    ) -> tuple[Float[Tensor, "*batch T D"], ActionChunkState, ActionChunkReport]:
        """Follow one chunk, of one sample or many.

        Args:
            chunk: Requested positions, dt apart, the first dt after the state's. Invalid
                values (NaN, infinite, above 1e50) are replaced by the value before them.
            state: State after the last chunk.

        Returns:
            Positions (*batch, T, D) to go to instead, in the dtype of the chunk; the state
            after the last of them; the report.
        """
        asked = _replace_invalid(chunk.to(self.braking_acceleration), state.reference)
        broken = self._broken_limits(asked, state)
        positions = []
        for k in range(asked.shape[-2]):
            state = self._step(state, asked[..., k, :])
            positions.append(state.position)
        smooth = torch.stack(positions, dim=-2)
        report = ActionChunkReport(broken=broken, change=smooth - asked)
        return smooth.to(chunk), state, report

    def _step(self, state: ActionChunkState, asked: Tensor) -> ActionChunkState:
        """One step towards one requested position."""
        dt = self.dt
        velocity, acceleration = self._reference_motion(state, asked)
        error = state.position - (asked - velocity * dt)
        rate = state.velocity - (velocity - acceleration * dt)
        approach, slope = _braking_rate(error, self.braking_acceleration, self.position_rate)
        fade, _ = _braking_rate(rate + approach, self.braking_jerk, self.velocity_rate)
        a = self.barrier.nearest_acceleration(
            acceleration - slope * rate - fade,
            state.acceleration,
            state.velocity,
            self.barrier.velocity_bounds(state.position),
            dt,
        )
        v = state.velocity + a * dt
        return ActionChunkState(
            position=state.position + v * dt,
            velocity=v,
            acceleration=a,
            reference=asked,
            reference_velocity=velocity,
            reference_acceleration=(velocity - state.reference_velocity) / dt,
        )

    def _reference_motion(
        self, state: ActionChunkState, asked: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Velocity and acceleration of the requested positions, within the limits.

        Where the requested positions exceed the limits, the velocity follows theirs with the
        highest acceleration, which ignores steps and still adapts to a new slope, and the
        acceleration is zero.
        """
        barrier, dt = self.barrier, self.dt
        change = ((asked - state.reference) / dt - state.reference_velocity) / dt
        limited = change.clamp(-barrier.acceleration, barrier.acceleration)
        jerk = (limited - state.reference_acceleration) / dt
        motion = (jerk.abs() <= barrier.jerk * _ROUNDING) & (limited == change)
        return state.reference_velocity + limited * dt, limited.masked_fill(~motion, 0)

    def _broken_limits(self, asked: Tensor, state: ActionChunkState) -> Tensor:
        """Flags of `LIMIT_KINDS` that the requested positions would exceed."""
        barrier, dt = self.barrier, self.dt
        upper_wall, lower_wall = barrier.walls[1], -barrier.walls[0]
        outside = (asked > upper_wall) | (asked < lower_wall)
        flags, values = [outside.any(-1)], asked
        for start, limit in (
            (state.position, barrier.velocity),
            (state.velocity, barrier.acceleration),
            (state.acceleration, barrier.jerk),
        ):
            values = torch.cat([start.unsqueeze(-2), values], dim=-2).diff(dim=-2) / dt
            flags.append((values.abs() > limit * _ROUNDING).any(-1))
        return torch.stack(flags, dim=-1)


def _braking_rate(x: Tensor, strength: Tensor, rate: Tensor | float) -> tuple[Tensor, Tensor]:
    """The function h(x) and its slope: the rate of x with which it comes to rest at zero.

    Square root far from zero (constant deceleration), a line of slope `rate` close to it.
    """
    knee = strength / rate
    root = torch.sqrt(knee**2 + 2 * strength * x.abs())
    return torch.sign(x) * (root - knee), strength / root


def _replace_invalid(chunk: Tensor, before: Tensor) -> Tensor:
    """The chunk with each invalid value replaced by the value before it."""
    if (chunk.abs() < _LARGEST_VALID).all():
        return chunk
    rows = []
    for row in chunk.unbind(-2):
        before = torch.where(row.abs() < _LARGEST_VALID, row, before)
        rows.append(before)
    return torch.stack(rows, dim=-2)


def _reduced_acceleration(limits: MotionLimits, dt: float) -> Tensor:
    """Acceleration limit with which a stop needs at most a tenth of the position range.

    Each of the two terms of the distance that `LimitBarrier` needs at rest stays below a
    twentieth of the range.
    """
    distance, j = 0.05 * (limits.upper - limits.lower), limits.jerk
    ramped = torch.minimum((8 * j**2 * distance) ** (1 / 3), (2 * j * distance / dt).sqrt())
    return torch.minimum(limits.acceleration, ramped)


def _check(limits: MotionLimits, dt: float) -> None:
    if not 0 < dt < float("inf"):
        raise ValueError(f"dt must be positive and finite, but is {dt}")
    for name in ("velocity", "acceleration", "jerk"):
        limit = getattr(limits, name)
        if not ((limit > 0) & limit.isfinite()).all():
            raise ValueError(
                f"limits of {name} must be positive and finite, got {limit.tolist()}"
            )
    if not (limits.lower < limits.upper).all():
        raise ValueError(
            f"lower limits must be below the upper ones, got {limits.lower.tolist()} and "
            f"{limits.upper.tolist()}"
        )
