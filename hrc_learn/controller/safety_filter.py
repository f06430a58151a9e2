"""Safety filter: the last word on every joint velocity that is sent to the arm.

It needs no model but the joint limits, and works for any source of commands: the adaptive
controller, the playback of a learned motion, a person's joystick.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from hrc_learn.controller.constraint_layer import (
    ConstrainedVelocity,
    ConstraintConfig,
    Distances,
    constrained_velocity,
)
from hrc_learn.controller.motion_barriers import LimitBarrier, SeparationConfig
from hrc_learn.geometry.numerics import is_number
from hrc_learn.kinematics import JointLimits
from hrc_learn.pytree import pytree

INTERVENTIONS = (
    "velocity",
    "position",
    "acceleration",
    "jerk",
    "tcp_speed",
    "separation",
    "invalid",
    "stopped",
)
"""Kinds of interventions, in the order of the last axis of their flags and counts."""

# Fraction of a limit, or joint velocity [rad/s], beyond which an intervention is reported.
# Below is rounding, in float32 too: a command led along a limit would be flagged by chance.
_REPORTED = 1e-6
# Fraction of the limits of acceleration and jerk left unused: who checks what was sent divides
# differences of rounded numbers by powers of a step, for the jerk of positions at 1 kHz by
# 1e-9 s^3. Roundings of 4e-16 rad count for 2e-6 rad/s^3 then, of thousands.
_ROUNDING = 1e-9
# Joint velocities below are rounding of rest [rad/s].
_REST = 1e-15
# Step [s] to brake by while none has been valid: that of the fastest arms, so the gentlest.
_SHORTEST_STEP = 1e-3


@dataclass(frozen=True, kw_only=True)
class SafetyConfig:
    """Margins and caps besides the joint limits themselves."""

    margin: float = 0.02
    """Distance kept from every joint position limit [rad]."""
    velocity_margin: float = 0.02
    """Fraction of every joint velocity limit that is not used. The arm's own servo overshoots
    what it is told by up to 1.2 % of the limit (in MuJoCo)."""
    rate: float = 5.0
    """Fastest decay of the remaining distance to a limit [1/s]; at most 1/dt."""
    jerk_limited: bool = True
    """Whether the jerk of each joint is limited, which starts to matter below 4 ms a step."""
    braking: float = 1.0
    """Fraction of the limits of acceleration and jerk that the arm's driver uses, above 0 to
    1. franky plans with the `dynamics` that it is given, 0.3 by default in our adapter."""
    delay: float = 0.0
    """Longest time from a joint position read to the arm doing what was made of it [s]."""
    jitter: float = 0.0
    """Largest fraction by which steps are longer or shorter than their `dt`, 0 to below 1. Zero
    where dt is the time measured since the last step: all limits then hold as they are."""
    tcp_speed: float = 1.0
    """Cap on the speed of the tool centre point [m/s]; acts where a Jacobian is given."""
    separation: SeparationConfig = field(default_factory=SeparationConfig)
    """How near to a person, by the speeds of both: lowers that cap where the distance of the
    tool is given, and is kept by all of the arm where those of its links are."""
    constraints: ConstraintConfig | None = None
    """Keeps limits and distances by one program, in which the null space yields to the task;
    None: joints brake before their limits each by itself, and no distance is kept."""

    def __post_init__(self):
        for name in ("rate", "tcp_speed"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, but is {getattr(self, name)}")
        if self.margin < 0:
            raise ValueError(f"margin must not be negative, but is {self.margin}")
        if self.delay < 0:
            raise ValueError(f"delay must not be negative, but is {self.delay}")
        if not 0 < self.braking <= 1:
            raise ValueError(f"braking must be in (0, 1], but is {self.braking}")
        for name in ("velocity_margin", "jitter"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} must be in [0, 1), but is {getattr(self, name)}")

    @property
    def longest_step(self) -> float:
        """For which the limits can be guaranteed [s]."""
        return 1 / (self.rate * (1 + self.jitter))


@pytree
@dataclass(frozen=True, kw_only=True)
class SafetyState:
    """What the filter remembers from one step to the next."""

    velocity: Float[Tensor, "*batch n"]
    """Velocity of the last step [rad/s]."""
    acceleration: Float[Tensor, "*batch n"]
    """By which it came about [rad/s^2]; zero where jerk is not limited."""
    position: Float[Tensor, "*batch n"]
    """Where the joints should be now [rad]: used while their measurement is invalid."""
    dt: Float[Tensor, "*batch"]
    """Last step of a valid length [s]: used while that is invalid."""
    counts: Int[Tensor, "*batch kinds"]
    """Steps in which each of `INTERVENTIONS` was needed."""

    def count(self, kind: str) -> Int[Tensor, "*batch"]:
        """Steps in which one kind of intervention was needed."""
        return self.counts[..., _index(kind)]


@pytree
@dataclass(frozen=True, kw_only=True)
class ConstraintReport:
    """What it took to keep all limits at once (`ConstrainedVelocity`)."""

    slowed: Float[Tensor, "*batch"]
    """Part of the task that was given up in this step, 0 to 1."""
    violation: Float[Tensor, "*batch"]
    """By how much distances shrink faster than they may [m/s]."""
    solved: Bool[Tensor, "*batch"]
    """False: the arm brakes, for the solver was not given steps enough."""


@pytree
@dataclass(frozen=True, kw_only=True)
class SafetyReport:
    """What the filter did in this step."""

    flags: Bool[Tensor, "*batch kinds"]
    """Whether each of `INTERVENTIONS` was needed, by more than rounding."""
    constraints: ConstraintReport | None = None
    """What keeping distances took, where the filter does that."""

    def acted(self, kind: str) -> Bool[Tensor, "*batch"]:
        """Whether one kind of intervention was needed."""
        return self.flags[..., _index(kind)]


def _index(kind: str) -> int:
    if kind not in INTERVENTIONS:
        raise ValueError(f"no intervention {kind!r}; there are {', '.join(INTERVENTIONS)}")
    return INTERVENTIONS.index(kind)


@final
class SafetyFilter(nn.Module):
    """Joint velocities that keep the limits of position, velocity, acceleration and jerk.

    They hold for *any* sequence of commands, by a control barrier (`LimitBarrier`), as long as
    the arm moves as it is told, or errs by less than the margins. Where it does not, the
    limits of acceleration and jerk hold, and the others as soon as those let them. A joint
    outside its limits, or within their margin, does not move further out. It may rest there,
    and returns when the command asks it to: no stop becomes a motion.

    Whatever is not a number, in any argument or in the state, brakes the arm to rest and is
    forgotten: neither a command nor a state is ever NaN or infinite.

    Velocity, tool speed, acceleration and jerk are limited by scaling the whole vector, which
    keeps its direction; only the barrier cuts single joints. Where the others would then move
    the tool faster than its cap, all brake as for a stop, as far as it takes. The acceleration
    fades in time for the velocity to arrive without overshoot, so stops and resumes are smooth.
    """

    def __init__(self, limits: JointLimits, config: SafetyConfig | None = None):
        super().__init__()
        self.config = config = config or SafetyConfig()
        # What a shorter step makes of a change of velocity must be in the driver's power.
        usable = (1 - _ROUNDING) * config.braking * (1 - config.jitter)
        self.barrier = LimitBarrier(
            replace(
                limits.slowed(1 - config.velocity_margin),
                acceleration=usable * limits.acceleration,
                jerk=usable * limits.jerk,
            ),
            margin=config.margin,
            rate=config.rate,
            delay=config.delay,
            jitter=config.jitter,
            jerk_limited=config.jerk_limited,
            rests_outside=True,
        )

    def initial_state(
        self,
        joint_position: Float[Tensor, "*batch n"],
        joint_velocity: Float[Tensor, "*batch n"] | None = None,
    ) -> SafetyState:
        """State of an arm at rest, or moving steadily with `joint_velocity` [rad/s]."""
        counts = joint_position.new_zeros(
            *joint_position.shape[:-1], len(INTERVENTIONS), dtype=torch.int64
        )
        still = torch.zeros_like(joint_position)
        return SafetyState(
            velocity=still.clone() if joint_velocity is None else still + joint_velocity,
            acceleration=still,
            position=joint_position,
            dt=torch.full_like(still[..., 0], _SHORTEST_STEP),
            counts=counts,
        )

    def restored(self, state: SafetyState) -> SafetyState:
        """The state, at rest in mid-range where it is not of numbers."""
        lower, upper = self.barrier.walls.unbind(-2)
        fallback = (
            (state.velocity, torch.zeros_like(state.velocity)),
            (state.acceleration, torch.zeros_like(state.acceleration)),
            (state.position, (upper - lower) / 2),
        )
        v, a, q = (torch.where(is_number(x), x, instead) for x, instead in fallback)
        valid = (state.dt > 0) & (state.dt <= self.config.longest_step)
        return SafetyState(
            velocity=v,
            acceleration=a,
            position=q,
            dt=torch.where(valid, state.dt, _SHORTEST_STEP),
            counts=state.counts,
        )

    def velocity_bounds(
        self, joint_position: Float[Tensor, "*batch n"]
    ) -> tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"]]:
        """Lowest and highest velocity [rad/s] that position and velocity limits allow."""
        return self.barrier.velocity_bounds(joint_position)

    def step(
        self,
        state: SafetyState,
        joint_position: Float[Tensor, "*batch n"],
        joint_velocity_command: Float[Tensor, "*batch n"],
        dt: float | Float[Tensor, ""],
        *,
        jacobian: Float[Tensor, "*batch rows n"] | None = None,
        human_distance: Float[Tensor, "*batch"] | None = None,
        stop: Bool[Tensor, "*batch"] | None = None,
        stale: Bool[Tensor, "*batch"] | None = None,
        bounds: tuple[Tensor, Tensor] | None = None,
        distances: Distances | None = None,
    ) -> tuple[Float[Tensor, "*batch n"], SafetyState, SafetyReport]:
        """Velocity to send for the next `dt` seconds.

        Args:
            state: Of the step before.
            joint_position: Measured [rad]. Not finite: brake to rest.
            joint_velocity_command: Wanted [rad/s]. Not finite: brake to rest.
            dt: Time until the next step [s], or since the last where steps are irregular. A
                tensor outside (0, longest_step]: brake to rest, by the last that was within.
            jacobian: Of the tool centre point, linear rows first: enables its speed cap. Not
                finite: brake to rest.
            human_distance: Of the nearest person [m], who slows the tool down and stops it;
                NaN, not known: stop. None: nobody is watched for.
            stop: Brake to rest for another reason.
            stale: The joint position is too old to be used: brake to rest.
            bounds: `velocity_bounds` of a trusted joint position, where they are known.
                Not finite: brake to rest, as hard as the arm can.
            distances: To keep, by `SafetyConfig.constraints`. Not finite: brake to rest.

        Returns:
            The velocity (*batch, n) [rad/s], the next state, and what was done.

        Raises:
            ValueError: A number dt is not in (0, longest_step], or a distance comes without a
                Jacobian or without the constraints that would keep it.
        """
        layer = self.config.constraints
        if layer is None and distances is not None:
            raise ValueError(
                "distances are kept by SafetyConfig.constraints, which is None: give it a "
                "ConstraintConfig"
            )
        if layer is not None and jacobian is None:
            raise ValueError(
                "constraints tell the null space by the Jacobian of the tool: pass jacobian"
            )
        state, dt, invalid = self._validated_state(state, dt)
        given = [joint_position, joint_velocity_command]
        if jacobian is not None:
            given.append(jacobian.flatten(-2))
        invalid = invalid | ~is_number(torch.cat(given, dim=-1)).all(-1, keepdim=True)
        if distances is not None:
            invalid = invalid | ~distances.known().unsqueeze(-1)
        if bounds is not None:
            unknown = ~is_number(torch.cat(bounds, dim=-1)).all(-1, keepdim=True)
            invalid = invalid | unknown
            bounds = bounds[0].masked_fill(unknown, 0), bounds[1].masked_fill(unknown, 0)
        if stale is not None:
            invalid = invalid | stale.unsqueeze(-1)
        stopped = torch.zeros_like(invalid) if stop is None else stop.unsqueeze(-1)
        q = torch.where(invalid, state.position, joint_position)
        u = joint_velocity_command.masked_fill(invalid | stopped, 0)
        if jacobian is not None:
            jacobian = jacobian.masked_fill(invalid.unsqueeze(-1), 0)
        bounds = bounds or self.velocity_bounds(q)

        excess = _excess(u, self.barrier.velocity)
        if layer is None:
            u = u / excess.clamp(min=1)
        inside = u.clamp(*bounds)
        cut = torch.linalg.vector_norm(inside - u, math.inf, dim=-1, keepdim=True) > _REPORTED
        # Constraints cut no joint by itself: the null space may make way for all of the task.
        target, cap, speeding, near = self._cap_tcp_speed(
            inside if layer is None else u, jacobian, human_distance
        )
        limit = self._limit_jerk if self.config.jerk_limited else self._limit_acceleration
        v, acceleration, excess_a, excess_j = limit(
            state, target, bounds if layer is None else None, dt
        )
        report = None
        if jacobian is not None:
            stopping, braking = None, invalid | stopped
            if layer is not None:
                kept = self._constrained(state, v, u, jacobian, bounds, distances, dt)
                v = kept.joint_velocity
                # What a solver leaves of rest is a motion where a velocity limit is zero.
                v = torch.where(v.abs() < _REST, 0, v)
                if not layer.early_exit or bool(braking.any()):
                    stopping = limit(state, torch.zeros_like(v), bounds, dt)
                    v = torch.where(braking, stopping[0], v)
                if self.config.jerk_limited:
                    acceleration = (v - state.velocity) / dt
                idle = braking.squeeze(-1)
                report = ConstraintReport(
                    slowed=kept.slowed.masked_fill(idle, 0),
                    violation=kept.violation.masked_fill(idle, 0),
                    solved=kept.solved | idle,
                )
            tool = _linear(jacobian, v)
            early = layer is not None and layer.early_exit
            if not early or _too_fast(tool, cap):
                if stopping is None:
                    stopping = limit(state, torch.zeros_like(v), bounds, dt)
                fraction = _blend_to_cap(tool, _linear(jacobian, stopping[0]), cap)
                # Between two that are within the limits, so within them as well.
                v = torch.lerp(v, stopping[0], fraction)
                acceleration = torch.lerp(acceleration, stopping[1], fraction)

        a_acts, j_acts = _acts(excess_a), _acts(excess_j)
        flags = [_acts(excess), cut, a_acts, j_acts, speeding, near, invalid, stopped]
        flags = torch.cat(flags, dim=-1)
        return (
            v,
            SafetyState(
                velocity=v,
                acceleration=acceleration,
                position=q + v * dt,
                dt=state.dt,
                counts=state.counts + flags,
            ),
            SafetyReport(flags=flags, constraints=report),
        )

    def _validated_state(
        self, state: SafetyState, dt: float | Tensor
    ) -> tuple[SafetyState, float | Tensor, Tensor]:
        """A state of numbers, the step to compute with, and where either was invalid."""
        known = is_number(torch.cat([state.velocity, state.acceleration], dim=-1))
        invalid, longest = ~known.all(-1, keepdim=True), self.config.longest_step
        state = self.restored(state)
        if isinstance(dt, Tensor):
            valid = (dt > 0) & (dt <= longest)
            length = torch.where(valid, dt.to(state.dt), state.dt)
            return replace(state, dt=length), length.unsqueeze(-1), invalid | ~valid
        if not 0 < dt <= longest:
            raise ValueError(
                f"the safety filter needs a step dt in (0, {longest:g}] s to "
                f"guarantee the limits, but got {dt:g} s; step faster or lower its rate"
            )
        return replace(state, dt=torch.full_like(state.dt, dt)), dt, invalid

    def _constrained(
        self,
        state: SafetyState,
        wanted: Tensor,
        command: Tensor,
        jacobian: Tensor,
        bounds: tuple[Tensor, Tensor],
        distances: Distances | None,
        dt: float | Tensor,
    ) -> ConstrainedVelocity:
        """The velocity nearest to the wanted one with which limits and distances are kept."""
        # A wanted velocity has the part of the command that the arm has picked up.
        square = torch.linalg.vecdot(command, command)
        along = torch.linalg.vecdot(command, wanted)
        share = torch.where(square > 0, along / torch.where(square > 0, square, 1.0), 0.0)
        return constrained_velocity(
            wanted,
            command,
            jacobian,
            *self.barrier.reachable_velocity(state.velocity, state.acceleration, bounds, dt),
            distances,
            self.config.constraints,
            share.clamp(0, 1),
            self.config.separation,
        )

    def _cap_tcp_speed(
        self, u: Tensor, jacobian: Tensor | None, human_distance: Tensor | None
    ) -> tuple[Tensor, Tensor | float, Tensor, Tensor]:
        """The command slowed down, the cap, and the flags `tcp_speed` and `separation`."""
        never = torch.zeros_like(u[..., :1], dtype=torch.bool)
        if jacobian is None:
            if human_distance is not None:
                raise ValueError(
                    "human_distance limits the speed of the tool, which needs its Jacobian: "
                    "pass jacobian as well"
                )
            return u, math.inf, never, never
        speed = torch.linalg.vector_norm(_linear(jacobian, u), dim=-1, keepdim=True)
        excess = speed / self.config.tcp_speed
        speeding = _acts(excess)
        if human_distance is None:
            return u / excess.clamp(min=1), self.config.tcp_speed, speeding, never
        safe = self.config.separation.highest_speed(human_distance).unsqueeze(-1)
        cap = safe.clamp(max=self.config.tcp_speed)
        # At a cap of zero everything rests, also what does not move the tool.
        factor = cap / torch.maximum(speed, cap).clamp(min=torch.finfo(u.dtype).tiny)
        return factor * u, cap, speeding, (speed > (1 + _REPORTED) * safe) | (safe == 0)

    def _limit_acceleration(
        self,
        state: SafetyState,
        target: Tensor,
        bounds: tuple[Tensor, Tensor] | None,
        dt: float | Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Velocity as near to the target as the acceleration limit lets it come.

        Without `bounds` those of position and velocity are left to whoever keeps them.

        Returns:
            Velocity, acceleration, and by how much acceleration and jerk were too large.
        """
        reach = self.barrier.acceleration * dt
        change = target - state.velocity
        excess_a = _excess(change, reach)
        v = torch.addcdiv(state.velocity, change, excess_a.clamp(min=1))
        if bounds is None:
            return v, state.acceleration, excess_a, torch.zeros_like(excess_a)
        # Last the bounds that no scaling may loosen. Should both exclude each other, the arm
        # could not brake harder anyway.
        v = v.clamp(*bounds).clamp(state.velocity - reach, state.velocity + reach)
        return v, state.acceleration, excess_a, torch.zeros_like(excess_a)

    def _limit_jerk(
        self,
        state: SafetyState,
        target: Tensor,
        bounds: tuple[Tensor, Tensor] | None,
        dt: float | Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The same under a jerk limit.

        The acceleration wanted is the largest fraction of change/dt, alike for all joints, with
        which they keep their acceleration limits and can still fade it out in time:
        a dt + a^2/(2 j) <= change.
        """
        barrier = self.barrier
        reach = barrier.jerk * dt  # largest change of the acceleration in this step
        change = (target - state.velocity) / dt
        excess_a = _excess(change, barrier.acceleration)
        # a = change/s with the root s of a dt + a^2/(2 j) = change dt, which fades out in time.
        fading = (1 + torch.sqrt(1 + 2 * _excess(change, reach))) / 2
        wanted = change / torch.maximum(excess_a, fading)
        step = wanted - state.acceleration
        excess_j = _excess(step, reach)
        acceleration = torch.addcdiv(state.acceleration, step, excess_j.clamp(min=1))
        if bounds is not None:
            acceleration = barrier.nearest_acceleration(
                acceleration, state.acceleration, state.velocity, bounds, dt
            )
        return state.velocity + acceleration * dt, acceleration, excess_a, excess_j


def _linear(jacobian: Tensor, joint_velocity: Tensor) -> Tensor:
    """Linear velocity of the tool [m/s]."""
    return torch.linalg.vecdot(jacobian[..., :3, :], joint_velocity.unsqueeze(-2))


def _blend_to_cap(wanted: Tensor, stopping: Tensor, cap: Tensor | float) -> Tensor:
    """Fraction of the way from one tool velocity to another at which the speed is the cap.

    Zero where the first keeps it; where the whole way does not reach it, that of least speed.
    """
    change = stopping - wanted
    # |wanted + s change|^2 = cap^2, a quadratic in s. Changes that count for nothing are no
    # divisor, and a root of zero has no derivative.
    a = torch.linalg.vecdot(change, change).clamp(min=_REPORTED**2)
    b = torch.linalg.vecdot(wanted, change)
    c = torch.linalg.vecdot(wanted, wanted).unsqueeze(-1) - cap**2
    a, b = a.unsqueeze(-1), b.unsqueeze(-1)
    root = (b * b - a * c).clamp(min=torch.finfo(a.dtype).tiny).sqrt()
    return torch.where(c > 0, (-b - root) / a, 0.0).clamp(0, 1)


def _too_fast(velocity: Tensor, cap: Tensor | float) -> bool:
    """Whether any tool is faster than its cap."""
    return bool((torch.linalg.vecdot(velocity, velocity).unsqueeze(-1) > cap**2).any())


def _excess(vector: Tensor, limit: Tensor) -> Tensor:
    """Largest ratio of a component to its limit; at most 1 where all keep them."""
    return (vector / limit).abs().amax(-1, keepdim=True)


def _acts(excess: Tensor) -> Bool[Tensor, "..."]:
    """Whether what is divided by a ratio of at least 1 changes by more than rounding."""
    return excess > 1 + _REPORTED
