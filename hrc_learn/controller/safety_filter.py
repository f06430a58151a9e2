"""Safety filter: the last stage before a joint velocity is sent to the arm.

It needs only the joint limits, and serves any source of commands: the adaptive controller, the
playback of a learned motion, a joystick.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol, final, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from hrc_learn.controller.constraint_layer import (
    ConstraintConfig,
    Distances,
    SeparationConfig,
    constrained_velocity,
)
from hrc_learn.controller.limit_barrier import LimitBarrier
from hrc_learn.geometry.numerics import ArrayLike, as_tensor, is_number
from hrc_learn.kinematics import JointLimits, MotionLimits
from hrc_learn.pytree import pytree


@runtime_checkable
class HasLimits(Protocol):
    """An arm or a kinematic chain with joint limits."""

    @property
    def limits(self) -> JointLimits:
        """Joint limits."""
        ...


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

# Smallest relative excess, or change of a joint velocity [rad/s], reported as an intervention.
# Smaller ones are rounding, also in float32: a command along a limit would be flagged at
# random.
_REPORTED = 1e-6
# Fraction of the acceleration and jerk limits left unused. A check of the sent positions
# divides differences of rounded numbers by powers of the step: for the jerk at 1 kHz by 1e-9
# s^3, which turns rounding of 4e-16 rad into 2e-6 rad/s^3, of thousands.
_ROUNDING = 1e-9
# Smaller joint velocities are rounded to rest [rad/s].
_REST = 1e-15
# Step assumed for braking before the first valid one [s]: that of the fastest arms, so the
# gentlest.
_SHORTEST_STEP = 1e-3


@dataclass(frozen=True, kw_only=True)
class SafetyConfig:
    """Margins and caps in addition to the joint limits."""

    margin: float = 0.02
    """Distance kept from every joint position limit [rad]."""
    velocity_margin: float = 0.02
    """Unused fraction of every joint velocity limit. The arm's own servo overshoots its command
    by up to 1.2 % of the limit (in MuJoCo)."""
    rate: float = 5.0
    """Fastest decay of the remaining distance to a limit [1/s]; at most 1/dt."""
    jerk_limited: bool = True
    """True if joint jerk is limited, which starts to matter below 4 ms a step."""
    braking: float = 1.0
    """Fraction of the acceleration and jerk limits that the arm's driver uses, in (0, 1].
    franky plans with its `dynamics` factor, 0.3 by default in our adapter."""
    delay: float = 0.0
    """Longest time from a joint position reading to the motion that results from it [s]."""
    jitter: float = 0.0
    """Largest relative deviation of a step from its `dt`, in [0, 1). Zero where dt is the
    measured time since the last step: then all limits hold exactly."""
    tcp_speed: float = 1.0
    """Highest speed of the tool centre point [m/s]; applied where a Jacobian is given."""
    separation: SeparationConfig = field(default_factory=SeparationConfig)
    """Protective distance from people. It lowers the tool-speed cap where `human_distance` is
    given, and limits all links where `distances` to a person are given."""
    constraints: ConstraintConfig | None = None
    """Keeps limits and distances by one quadratic program, in which the null space yields to
    the task; None: each joint brakes by itself before its limits, and no distance is kept."""

    def __post_init__(self):
        for name in ("rate", "tcp_speed"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, but is {getattr(self, name)}")
        for name in ("margin", "delay"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, but is {getattr(self, name)}")
        if not 0 < self.braking <= 1:
            raise ValueError(f"braking must be in (0, 1], but is {self.braking}")
        for name in ("velocity_margin", "jitter"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} must be in [0, 1), but is {getattr(self, name)}")

    @property
    def longest_step(self) -> float:
        """Longest step for which the limits are guaranteed [s]."""
        return 1 / (self.rate * (1 + self.jitter))


@pytree
@dataclass(frozen=True, kw_only=True)
class SafetyState:
    """State of the filter between two steps."""

    velocity: Float[Tensor, "*batch n"]
    """Velocity of the last step [rad/s]."""
    acceleration: Float[Tensor, "*batch n"]
    """Acceleration of the last step [rad/s^2]; zero where jerk is not limited."""
    position: Float[Tensor, "*batch n"]
    """Predicted joint positions [rad], used while the measurement is invalid."""
    dt: Float[Tensor, "*batch"]
    """Last valid step [s], used while the given one is invalid."""
    counts: Int[Tensor, "*batch kinds"]
    """Number of steps with each of `INTERVENTIONS`."""

    def count(self, kind: str) -> Int[Tensor, "*batch"]:
        """Number of steps with one kind of intervention."""
        return self.counts[..., _index(kind)]


@pytree
@dataclass(frozen=True, kw_only=True)
class ConstraintReport:
    """Effect of the quadratic program in one step (`ConstrainedVelocity`)."""

    slowed: Float[Tensor, "*batch"]
    """Fraction of the task velocity given up, 0 to 1."""
    violation: Float[Tensor, "*batch"]
    """Excess of the fastest closing speed over the allowed one [m/s]."""
    solved: Bool[Tensor, "*batch"]
    """False: the arm brakes, because the solver needed more steps."""


@pytree
@dataclass(frozen=True, kw_only=True)
class SafetyReport:
    """Interventions of the filter in one step."""

    flags: Bool[Tensor, "*batch kinds"]
    """True for each of `INTERVENTIONS` that changed the command by more than rounding."""
    constraints: ConstraintReport | None = None
    """Effect of the constraints, where the filter has them."""

    def acted(self, kind: str) -> Bool[Tensor, "*batch"]:
        """True where one kind of intervention changed the command."""
        return self.flags[..., _index(kind)]


def _index(kind: str) -> int:
    if kind not in INTERVENTIONS:
        raise ValueError(f"no intervention {kind!r}; there are {', '.join(INTERVENTIONS)}")
    return INTERVENTIONS.index(kind)


class _Inputs(NamedTuple):
    """Arguments of a step, with invalid values replaced."""

    state: SafetyState
    joint_position: Tensor
    command: Tensor
    """Wanted joint velocity [rad/s], zero where the arm has to brake."""
    jacobian: Tensor | None
    bounds: tuple[Tensor, Tensor]
    """Lowest and highest velocity allowed by position and velocity limits [rad/s]."""
    dt: float | Tensor
    invalid: Tensor
    stopped: Tensor


class _Motion(NamedTuple):
    """Motion of one step."""

    velocity: Tensor
    acceleration: Tensor


@final
class SafetyFilter(nn.Module):
    """Joint velocities that keep the limits of position, velocity, acceleration and jerk.

    A step is a chain of stages, each of which takes the velocity of the one before:

        limit_velocity -> cap_tool_speed -> limit_acceleration -> keep_constraints
        -> brake_to_cap

    The limits hold for *any* sequence of commands, by a control barrier (`LimitBarrier`), if
    the arm follows its commands with an error below the margins. Otherwise the limits of
    acceleration and jerk hold, and the others as soon as those allow. A joint outside its
    limits, or within their margin, does not move further out. It may rest there, and returns
    when the command asks for it: a stop never causes a motion.

    Any NaN or infinity, in an argument or in the state, brakes the arm to rest and is
    forgotten: neither a command nor a state is ever NaN or infinite.

    Velocity, tool speed, acceleration and jerk are limited by scaling the whole vector, which
    keeps its direction; only the barrier cuts single joints. Where such a cut makes the tool
    faster than its cap, all joints brake as for a stop, as far as necessary. The acceleration
    fades in time for the velocity to arrive without overshoot, so stops and resumes are smooth.
    """

    def __init__(self, limits: MotionLimits | HasLimits, config: SafetyConfig | None = None):
        """Prepare the filter.

        Args:
            limits: Joint limits, or the arm or chain that has them.
            config: Margins and caps; default: the recommended ones.
        """
        super().__init__()
        if not isinstance(limits, MotionLimits):
            limits = limits.limits
        self.config = config = config or SafetyConfig()
        # A step shorter than dt needs a larger acceleration for the same change of velocity.
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

    def joint_vector(self, values: ArrayLike, name: str) -> Float[Tensor, "*batch n"]:
        """Joint values as a tensor (*batch, n); tensors are returned as they are.

        Args:
            values: Tensor, array or nested lists.
            name: Name of the argument, for the error message.

        Raises:
            ValueError: The last axis does not have one value for each joint.
        """
        vector = values
        if not isinstance(vector, Tensor):
            vector = as_tensor(vector, self.barrier.velocity)
        n = self.barrier.velocity.shape[-1]
        if vector.dim() == 0 or vector.shape[-1] != n:
            raise ValueError(
                f"{name} needs {n} values, one for each joint, but has the shape "
                f"{tuple(vector.shape)}"
            )
        return vector

    def initial_state(
        self, joint_position: ArrayLike, joint_velocity: ArrayLike | None = None
    ) -> SafetyState:
        """State of an arm at rest, or moving steadily.

        Args:
            joint_position: Measured joint positions (*batch, n) [rad].
            joint_velocity: Steady joint velocities (*batch, n) [rad/s]; None: at rest.

        Raises:
            ValueError: A vector does not have one value for each joint.
        """
        q = self.joint_vector(joint_position, "joint_position")
        counts = q.new_zeros(*q.shape[:-1], len(INTERVENTIONS), dtype=torch.int64)
        still = torch.zeros_like(q)
        if joint_velocity is None:
            velocity = still.clone()
        else:
            velocity = still + self.joint_vector(joint_velocity, "joint_velocity")
        return SafetyState(
            velocity=velocity,
            acceleration=still,
            position=q,
            dt=torch.full_like(still[..., 0], _SHORTEST_STEP),
            counts=counts,
        )

    def restored(self, state: SafetyState) -> SafetyState:
        """The state with invalid values replaced: at rest, in the middle of the joint range."""
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
        self, joint_position: ArrayLike
    ) -> tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"]]:
        """Lowest and highest velocity [rad/s] that position and velocity limits allow."""
        return self.barrier.velocity_bounds(self.joint_vector(joint_position, "joint_position"))

    def step(
        self,
        state: SafetyState,
        joint_position: ArrayLike,
        joint_velocity_command: ArrayLike,
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
            state: State after the last step.
            joint_position: Measured joint positions (*batch, n) [rad]. Not finite: brake to
                rest.
            joint_velocity_command: Wanted joint velocities (*batch, n) [rad/s]. Not finite:
                brake to rest.
            dt: Time until the next step [s], or since the last where steps are irregular. A
                tensor outside (0, longest_step]: brake to rest, with the last valid step.
            jacobian: Jacobian of the tool centre point, linear rows first; enables the cap on
                its speed. Not finite: brake to rest.
            human_distance: Distance of the tool from the nearest person [m], which slows and
                stops it; NaN (unknown): stop. None: no person is monitored.
            stop: True where the arm has to brake to rest for another reason.
            stale: True where the joint position is too old to be used: brake to rest.
            bounds: `velocity_bounds` of a trusted joint position, if already computed. Not
                finite: brake to rest, as hard as the arm can.
            distances: Distances to keep, by `SafetyConfig.constraints`. Not finite: brake to
                rest.

        Returns:
            The velocity (*batch, n) [rad/s], the next state, and the interventions.

        Raises:
            ValueError: A vector does not have one value for each joint; a number dt is not in
                (0, longest_step]; or a distance is given without a Jacobian or without the
                constraints that would keep it.
        """
        self._check_arguments(jacobian, human_distance, distances)
        q = self.joint_vector(joint_position, "joint_position")
        u = self.joint_vector(joint_velocity_command, "joint_velocity_command")
        given = self._validated(state, q, u, dt, jacobian, bounds, distances, stop, stale)
        target, fast, cut = self._limit_velocity(given)
        target, cap, speeding, near = self._cap_tool_speed(given, target, human_distance)
        # Constraints keep the bounds on the velocity themselves.
        own = given.bounds if self.config.constraints is None else None
        motion, hard, jerky = self._limit_acceleration(given, target, own)
        report = None
        if given.jacobian is not None:
            stopping = self._stopping(given)
            if self.config.constraints is not None:
                motion, report = self._keep_constraints(given, motion, distances, stopping)
            motion = self._brake_to_cap(given, motion, cap, stopping)

        # In the order of INTERVENTIONS.
        flags = (fast, cut, hard, jerky, speeding, near, given.invalid, given.stopped)
        flags = torch.cat(flags, dim=-1)
        v = motion.velocity
        state = SafetyState(
            velocity=v,
            acceleration=motion.acceleration,
            position=given.joint_position + v * given.dt,
            dt=given.state.dt,
            counts=given.state.counts + flags,
        )
        return v, state, SafetyReport(flags=flags, constraints=report)

    def _check_arguments(
        self,
        jacobian: Tensor | None,
        human_distance: Tensor | None,
        distances: Distances | None,
    ) -> None:
        if distances is not None and self.config.constraints is None:
            raise ValueError(
                "distances are kept by SafetyConfig.constraints, which is None: set it to a "
                "ConstraintConfig"
            )
        if jacobian is None and self.config.constraints is not None:
            raise ValueError(
                "constraints find the null space by the Jacobian of the tool: pass jacobian"
            )
        if jacobian is None and human_distance is not None:
            raise ValueError(
                "human_distance limits the speed of the tool, which needs its Jacobian: pass "
                "jacobian as well"
            )

    def _validated(
        self,
        state: SafetyState,
        q: Tensor,
        u: Tensor,
        dt: float | Tensor,
        jacobian: Tensor | None,
        bounds: tuple[Tensor, Tensor] | None,
        distances: Distances | None,
        stop: Tensor | None,
        stale: Tensor | None,
    ) -> _Inputs:
        """Arguments of a step, with invalid values replaced and flagged."""
        state, dt, invalid = self._validated_state(state, dt)
        numbers = [q, u]
        if jacobian is not None:
            numbers.append(jacobian.flatten(-2))
        invalid = invalid | ~is_number(torch.cat(numbers, dim=-1)).all(-1, keepdim=True)
        if distances is not None:
            invalid = invalid | ~distances.known().unsqueeze(-1)
        if bounds is not None:
            unknown = ~is_number(torch.cat(bounds, dim=-1)).all(-1, keepdim=True)
            invalid = invalid | unknown
            bounds = bounds[0].masked_fill(unknown, 0), bounds[1].masked_fill(unknown, 0)
        if stale is not None:
            invalid = invalid | stale.unsqueeze(-1)
        stopped = torch.zeros_like(invalid) if stop is None else stop.unsqueeze(-1)
        q = torch.where(invalid, state.position, q)
        if jacobian is not None:
            jacobian = jacobian.masked_fill(invalid.unsqueeze(-1), 0)
        return _Inputs(
            state=state,
            joint_position=q,
            command=u.masked_fill(invalid | stopped, 0),
            jacobian=jacobian,
            bounds=bounds or self.velocity_bounds(q),
            dt=dt,
            invalid=invalid,
            stopped=stopped,
        )

    def _validated_state(
        self, state: SafetyState, dt: float | Tensor
    ) -> tuple[SafetyState, float | Tensor, Tensor]:
        """A finite state, the step to compute with, and a flag where either was invalid."""
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

    def _limit_velocity(self, given: _Inputs) -> tuple[Tensor, Tensor, Tensor]:
        """Limits of velocity and position.

        Returns:
            The velocity, and the flags `velocity` and `position`.
        """
        u = given.command
        excess = _excess(u, self.barrier.velocity)
        if self.config.constraints is None:
            u = u / excess.clamp(min=1)
        inside = u.clamp(*given.bounds)
        cut = torch.linalg.vector_norm(inside - u, math.inf, dim=-1, keepdim=True) > _REPORTED
        # Constraints cut no single joint: the null space may give way to all of the task.
        return inside if self.config.constraints is None else u, _acts(excess), cut

    def _cap_tool_speed(
        self, given: _Inputs, u: Tensor, human_distance: Tensor | None
    ) -> tuple[Tensor, Tensor | float, Tensor, Tensor]:
        """The velocity slowed down, the cap, and the flags `tcp_speed` and `separation`."""
        never = torch.zeros_like(u[..., :1], dtype=torch.bool)
        if given.jacobian is None:
            return u, math.inf, never, never
        speed = torch.linalg.vector_norm(_linear(given.jacobian, u), dim=-1, keepdim=True)
        excess = speed / self.config.tcp_speed
        speeding = _acts(excess)
        if human_distance is None:
            return u / excess.clamp(min=1), self.config.tcp_speed, speeding, never
        safe = self.config.separation.highest_speed(human_distance).unsqueeze(-1)
        cap = safe.clamp(max=self.config.tcp_speed)
        # At a cap of zero all joints rest, also those that do not move the tool.
        factor = cap / torch.maximum(speed, cap).clamp(min=torch.finfo(u.dtype).tiny)
        return factor * u, cap, speeding, (speed > (1 + _REPORTED) * safe) | (safe == 0)

    def _limit_acceleration(
        self, given: _Inputs, target: Tensor, bounds: tuple[Tensor, Tensor] | None
    ) -> tuple[_Motion, Tensor, Tensor]:
        """The motion nearest to a target velocity within limits of acceleration and jerk.

        With a jerk limit, the wanted acceleration is the largest fraction of change/dt, alike
        for all joints, with which they keep their acceleration limits and can still fade it out
        in time:  a dt + a^2/(2 j) <= change.

        Args:
            given: Arguments of the step.
            target: Velocity to go to [rad/s].
            bounds: Limits of the velocity; None: the constraints keep them.

        Returns:
            The motion, and the flags `acceleration` and `jerk`.
        """
        barrier, state, dt = self.barrier, given.state, given.dt
        if not self.config.jerk_limited:
            reach = barrier.acceleration * dt
            change = target - state.velocity
            excess_a = _excess(change, reach)
            v = torch.addcdiv(state.velocity, change, excess_a.clamp(min=1))
            if bounds is not None:
                # The acceleration limit comes last: the arm could not brake harder anyway.
                v = v.clamp(*bounds).clamp(state.velocity - reach, state.velocity + reach)
            acts = _acts(excess_a)
            return _Motion(v, state.acceleration), acts, torch.zeros_like(acts)
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
        motion = _Motion(state.velocity + acceleration * dt, acceleration)
        return motion, _acts(excess_a), _acts(excess_j)

    @property
    def _exits_early(self) -> bool:
        """True if steps skip work by branches on the data, where they run one by one."""
        constraints = self.config.constraints
        return constraints is not None and constraints.early_exit

    def _stopping(self, given: _Inputs) -> _Motion | None:
        """The motion that brakes to rest; None: not needed so far."""
        if self._exits_early and not bool((given.invalid | given.stopped).any()):
            return None
        still = torch.zeros_like(given.command)
        return self._limit_acceleration(given, still, given.bounds)[0]

    def _keep_constraints(
        self,
        given: _Inputs,
        motion: _Motion,
        distances: Distances | None,
        stopping: _Motion | None,
    ) -> tuple[_Motion, ConstraintReport]:
        """The motion nearest to a given one with which limits and distances are kept."""
        state, dt, command = given.state, given.dt, given.command
        assert given.jacobian is not None
        # The arm has picked up this fraction of the command so far.
        square = torch.linalg.vecdot(command, command)
        along = torch.linalg.vecdot(command, motion.velocity)
        fraction = torch.where(square > 0, along / torch.where(square > 0, square, 1.0), 0.0)
        kept = constrained_velocity(
            motion.velocity,
            command,
            given.jacobian,
            *self.barrier.reachable_velocity(
                state.velocity, state.acceleration, given.bounds, dt
            ),
            distances,
            self.config.constraints,
            fraction.clamp(0, 1),
            self.config.separation,
        )
        # The solver's rounding is a motion where a velocity limit is zero.
        v = kept.joint_velocity
        v = torch.where(v.abs() < _REST, 0, v)
        braking = given.invalid | given.stopped
        if stopping is not None:
            v = torch.where(braking, stopping.velocity, v)
        acceleration = motion.acceleration
        if self.config.jerk_limited:
            acceleration = (v - state.velocity) / dt
        idle = braking.squeeze(-1)
        report = ConstraintReport(
            slowed=kept.slowed.masked_fill(idle, 0),
            violation=kept.violation.masked_fill(idle, 0),
            solved=kept.solved | idle,
        )
        return _Motion(v, acceleration), report

    def _brake_to_cap(
        self, given: _Inputs, motion: _Motion, cap: Tensor | float, stopping: _Motion | None
    ) -> _Motion:
        """The motion braked as far as the cap on the tool speed requires."""
        assert given.jacobian is not None
        tool = _linear(given.jacobian, motion.velocity)
        if stopping is None:
            square = torch.linalg.vecdot(tool, tool).unsqueeze(-1)
            if not bool((square > cap**2).any()):
                return motion
            still = torch.zeros_like(given.command)
            stopping = self._limit_acceleration(given, still, given.bounds)[0]
        fraction = _blend_to_cap(tool, _linear(given.jacobian, stopping.velocity), cap)
        # Between two motions within the limits, so within them as well.
        return _Motion(
            torch.lerp(motion.velocity, stopping.velocity, fraction),
            torch.lerp(motion.acceleration, stopping.acceleration, fraction),
        )


def _linear(jacobian: Tensor, joint_velocity: Tensor) -> Tensor:
    """Linear velocity of the tool [m/s]."""
    return torch.linalg.vecdot(jacobian[..., :3, :], joint_velocity.unsqueeze(-2))


def _blend_to_cap(wanted: Tensor, stopping: Tensor, cap: Tensor | float) -> Tensor:
    """Interpolation weight from one tool velocity to another at which the speed is the cap.

    Zero where the first keeps the cap; where none reaches it, the weight of least speed.
    """
    change = stopping - wanted
    # |wanted + s change|^2 = cap^2, a quadratic in s. Negligible changes must not become a
    # divisor, and a root of zero has no derivative.
    a = torch.linalg.vecdot(change, change).clamp(min=_REPORTED**2)
    b = torch.linalg.vecdot(wanted, change)
    c = torch.linalg.vecdot(wanted, wanted).unsqueeze(-1) - cap**2
    a, b = a.unsqueeze(-1), b.unsqueeze(-1)
    root = (b * b - a * c).clamp(min=torch.finfo(a.dtype).tiny).sqrt()
    return torch.where(c > 0, (-b - root) / a, 0.0).clamp(0, 1)


def _excess(vector: Tensor, limit: Tensor) -> Tensor:
    """Largest ratio of a component to its limit; at most 1 where all keep them."""
    return (vector / limit).abs().amax(-1, keepdim=True)


def _acts(excess: Tensor) -> Bool[Tensor, "..."]:
    """True where scaling by an excess above 1 changes a vector by more than rounding."""
    return excess > 1 + _REPORTED
