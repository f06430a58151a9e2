"""Safety filter: the last word on every joint velocity that is sent to the arm.

It needs no model but the joint limits, and works for any source of commands: the adaptive
controller, the playback of a learned motion, a person's joystick.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from hrc_learn.kinematics import JointLimits
from hrc_learn.pytree import pytree

INTERVENTIONS = ("velocity", "position", "acceleration", "tcp_speed", "invalid", "stopped")
"""Kinds of interventions, in the order of the last axis of their flags and counts."""


@dataclass(frozen=True, kw_only=True)
class SafetyConfig:
    margin: float = 0.02
    """Distance kept from every joint position limit [rad]."""
    rate: float = 5.0
    """Fastest decay of the remaining distance to a limit [1/s]; at most 1/dt."""
    tcp_speed: float = 1.0
    """Cap on the speed of the tool centre point [m/s]; acts where a Jacobian is given."""


@pytree
@dataclass(frozen=True, kw_only=True)
class SafetyState:
    """What the filter remembers from one step to the next."""

    velocity: Float[Tensor, "*batch n"]
    """Velocity of the last step [rad/s]."""
    position: Float[Tensor, "*batch n"]
    """Where the joints should be now [rad]: used while their measurement is invalid."""
    counts: Int[Tensor, "*batch kinds"]
    """Steps in which each of `INTERVENTIONS` was needed."""

    def count(self, kind: str) -> Int[Tensor, "*batch"]:
        """Steps in which one kind of intervention was needed."""
        return self.counts[..., _index(kind)]


@pytree
@dataclass(frozen=True, kw_only=True)
class SafetyReport:
    """What the filter did in this step."""

    flags: Bool[Tensor, "*batch kinds"]
    """Whether each of `INTERVENTIONS` was needed."""

    def acted(self, kind: str) -> Bool[Tensor, "*batch"]:
        """Whether one kind of intervention was needed."""
        return self.flags[..., _index(kind)]


def _index(kind: str) -> int:
    if kind not in INTERVENTIONS:
        raise ValueError(f"no intervention {kind!r}; there are {', '.join(INTERVENTIONS)}")
    return INTERVENTIONS.index(kind)


@final
class SafetyFilter(nn.Module):
    """Joint velocities that keep the limits of position, velocity and acceleration.

    Position limits hold for *any* command, by a control barrier. With the distance delta to
    the limit less its margin, a joint may approach at most with

        h(delta) = sqrt(c^2 + 2 a delta) - c,   c = a / rate,   v <= min(h, v_max)

    that is v^2/(2a) + v/rate <= delta: enough room to brake with the acceleration limit a,
    and near the limit (where h = rate delta) an exponential approach. If it holds now it
    can be made to hold one step later without braking harder than a, for every step
    dt <= 1/rate, because with Q(v) = v^2/(2a) + v/rate

        Q(v - a dt) = Q(v) - v dt - a dt (1/rate - dt/2) <= delta - v dt.

    So the three limits never contradict each other while the arm moves as it is told. Where
    it does not, the acceleration limit holds and the others as soon as it lets them. Past a
    margin -h(-delta) drives the joint back inside.

    Velocity, tool speed and acceleration are limited by scaling the whole vector, which
    keeps its direction; only a position limit cuts single joints.
    """

    velocity: Tensor
    """v_max [rad/s]."""
    acceleration: Tensor
    """a [rad/s^2]."""
    knee: Tensor
    """c = a / rate [rad/s]."""
    walls: Tensor
    """Lower and upper limits, less the margin, with the signs of `sides` [rad]."""
    sides: Tensor
    knee_square: Tensor
    twice_acceleration: Tensor

    def __init__(self, limits: JointLimits, config: SafetyConfig | None = None):
        super().__init__()
        self.config = config = config or SafetyConfig()
        self.register_buffer("velocity", limits.velocity.clone())
        self.register_buffer("acceleration", limits.acceleration.clone())
        walls = torch.stack([-limits.lower - config.margin, limits.upper - config.margin])
        self.register_buffer("walls", walls)
        self.register_buffer("sides", torch.tensor([[1.0], [-1.0]]).to(walls))
        knee = limits.acceleration / config.rate
        self.register_buffer("knee", knee)
        self.register_buffer("knee_square", knee * knee)
        self.register_buffer("twice_acceleration", 2 * limits.acceleration)

    def initial_state(
        self,
        joint_position: Float[Tensor, "*batch n"],
        joint_velocity: Float[Tensor, "*batch n"] | None = None,
    ) -> SafetyState:
        """State of an arm at rest, or moving with `joint_velocity` [rad/s]."""
        counts = joint_position.new_zeros(
            *joint_position.shape[:-1], len(INTERVENTIONS), dtype=torch.int64
        )
        velocity = torch.zeros_like(joint_position)
        if joint_velocity is not None:
            velocity = velocity + joint_velocity
        return SafetyState(velocity=velocity, position=joint_position, counts=counts)

    def velocity_bounds(
        self, joint_position: Float[Tensor, "*batch n"]
    ) -> tuple[Tensor, Tensor]:
        """Lowest and highest velocity [rad/s] that position and velocity limits allow."""
        room = torch.addcmul(self.walls, self.sides, joint_position.unsqueeze(-2))
        square = torch.addcmul(self.knee_square, self.twice_acceleration, room.abs())
        h = torch.minimum(square.sqrt() - self.knee, self.velocity)
        bounds = torch.copysign(h, room) * -self.sides
        lower, upper = bounds.unbind(-2)
        return lower, upper

    def step(
        self,
        state: SafetyState,
        joint_position: Float[Tensor, "*batch n"],
        joint_velocity_command: Float[Tensor, "*batch n"],
        dt: float | Float[Tensor, ""],
        *,
        jacobian: Float[Tensor, "*batch rows n"] | None = None,
        stop: Bool[Tensor, "*batch"] | None = None,
        stale: Bool[Tensor, "*batch"] | None = None,
        bounds: tuple[Tensor, Tensor] | None = None,
    ) -> tuple[Tensor, SafetyState, SafetyReport]:
        """Velocity to send for the next `dt` seconds.

        Args:
            state: Of the step before.
            joint_position: Measured [rad]. Not finite: brake to rest.
            joint_velocity_command: Wanted [rad/s]. Not finite: brake to rest.
            dt: Time until the next step [s].
            jacobian: Of the tool centre point, linear rows first: enables its speed cap.
            stop: Brake to rest for another reason.
            stale: The joint position is too old to be used: brake to rest.
            bounds: `velocity_bounds` of a trusted joint position, where they are known.

        Returns:
            The velocity (*batch, n) [rad/s], the next state, and what was done.

        Raises:
            ValueError: dt is not in (0, 1/rate].
        """
        self._check_step(dt)
        q, u, invalid, stopped = self._trusted(
            state, joint_position, joint_velocity_command, stop, stale
        )
        lower, upper = bounds or self.velocity_bounds(q)

        excess = _excess(u, self.velocity)
        u = u / excess.clamp(min=1)
        inside = u.clamp(lower, upper)
        target, speeding = self._cap_tcp_speed(inside, jacobian)

        reach = self.acceleration * dt
        change = target - state.velocity
        jerky = _excess(change, reach)
        v = torch.addcdiv(state.velocity, change, jerky.clamp(min=1))
        # Last the bounds that no scaling may loosen. Should both exclude each other, the arm
        # could not brake harder anyway.
        v = v.clamp(lower, upper).clamp(state.velocity - reach, state.velocity + reach)

        cut = (inside != u).any(-1, keepdim=True)
        flags = torch.cat([excess > 1, cut, jerky > 1, speeding, invalid, stopped], dim=-1)
        position = q + v * dt
        next_state = SafetyState(velocity=v, position=position, counts=state.counts + flags)
        return v, next_state, SafetyReport(flags=flags)

    def _check_step(self, dt: float | Tensor) -> None:
        if not isinstance(dt, Tensor) and not 0 < dt <= 1 / self.config.rate:
            raise ValueError(
                f"the safety filter needs a step dt in (0, {1 / self.config.rate:g}] s to "
                f"guarantee the limits, but got {dt:g} s; step faster or lower its rate"
            )

    def _trusted(
        self,
        state: SafetyState,
        q: Tensor,
        u: Tensor,
        stop: Tensor | None,
        stale: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Position and command to work with, and the flags `invalid` and `stopped`."""
        invalid = ~torch.cat([q, u], dim=-1).isfinite().all(-1, keepdim=True)
        if stale is not None:
            invalid = invalid | stale.unsqueeze(-1)
        stopped = torch.zeros_like(invalid) if stop is None else stop.unsqueeze(-1)
        q = torch.where(invalid, state.position, q)
        u = u.masked_fill(invalid | stopped, 0)
        return q, u, invalid, stopped

    def _cap_tcp_speed(self, u: Tensor, jacobian: Tensor | None) -> tuple[Tensor, Tensor]:
        if jacobian is None:
            return u, torch.zeros_like(u[..., :1], dtype=torch.bool)
        linear = torch.linalg.vecdot(jacobian[..., :3, :], u.unsqueeze(-2))
        ratio = torch.linalg.vector_norm(linear, dim=-1, keepdim=True) / self.config.tcp_speed
        return u / ratio.clamp(min=1), ratio > 1


def _excess(vector: Tensor, limit: Tensor) -> Tensor:
    """Largest ratio of a component to its limit; at most 1 where all keep them."""
    return (vector / limit).abs().amax(-1, keepdim=True)
