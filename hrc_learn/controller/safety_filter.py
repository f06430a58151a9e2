"""Safety filter: the last stage before a joint velocity is sent to the arm.

The filter needs only the joint limits, and serves any source of commands: the adaptive
controller, the playback of a learned motion, a joystick.
"""

import math
from dataclasses import replace
from typing import NamedTuple, final

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from hrc_learn.controller.constraint_layer import (
    ConstraintReport,
    Distances,
    constrained_velocity,
)
from hrc_learn.controller.interface import (
    INTERVENTIONS,
    SafetyConfig,
    SafetyReport,
    SafetyState,
)
from hrc_learn.controller.limit_barrier import LimitBarrier, SpeedBarrier
from hrc_learn.geometry.numerics import ArrayLike, as_tensor, everywhere, has_numbers, is_number
from hrc_learn.kinematics import MotionLimits, SerialChain
from hrc_learn.pytree import zero_where

# Smallest relative excess over a limit, or change of a joint velocity [rad/s], that is reported
# as an intervention. Smaller values are rounding, also in float32: if they were reported, a
# command along a limit would be flagged at random.
_REPORTED = 1e-6
# Fraction of the acceleration and jerk limits left unused, because finite differences of the
# sent positions amplify rounding. At 1 kHz, rounding of 4e-16 rad changes the measured jerk by
# 2e-6 rad/s^3; the limits are thousands of rad/s^3.
_ROUNDING = 1e-9
# Smaller joint velocities are rounded to rest [rad/s].
_REST = 1e-15
# Step dt assumed for braking before the first valid dt [s]: the shortest step that arms use,
# because it brakes most gently.
_SHORTEST_STEP = 1e-3
# Fraction of the velocity limits by which measured velocities may differ from the velocities of
# the initial state: encoders at 1 kHz err by some hundredths of a radian per second.
_START_ERROR = 0.03


class _Inputs(NamedTuple):
    """Arguments of a step, with invalid values replaced."""

    state: SafetyState
    joint_position: Tensor
    command: Tensor
    """Wanted joint velocity [rad/s], zero where the arm has to brake."""
    jacobian: Tensor | None
    points: Tensor | None
    """Linear Jacobians of the capped points (points, 3, n); None: no cap acts."""
    distances: Distances | None
    bounds: tuple[Tensor, Tensor]
    """Lowest and highest velocity allowed by position and velocity limits [rad/s]."""
    dt: float | Tensor
    invalid: Tensor
    stopped: Tensor


@final
class SafetyFilter(nn.Module):
    """Joint velocities that keep the limits of position, velocity, acceleration and jerk.

    A step is a chain of stages. Each stage changes the velocity that the previous one returns:

        limit_velocity -> cap_speed -> limit_acceleration -> keep_constraints -> keep_speed

    A control barrier (`LimitBarrier`) keeps the limits for *any* sequence of commands, if the
    arm follows its commands with an error below the margins. Otherwise the limits of
    acceleration and jerk hold, and the other limits hold again as soon as these two limits
    allow it. A joint outside its limits, or within their margin, does not move further out. It
    may rest there, and returns when the command asks for it: a stop never causes a motion.

    A second barrier (`SpeedBarrier`) keeps the cap on the speed of tool, elbow and load. The
    cap may fall faster than the arm can brake, or the arm may be too fast at the start. If
    no admissible motion then keeps the cap, the arm brakes as hard as it can, and the
    report says by how much and for how long the cap is exceeded.

    Any NaN or infinity, in an argument or in the state, brakes the arm to rest and is not
    stored: neither a command nor a state is ever NaN or infinite.

    Velocity, speed, acceleration and jerk are limited by scaling the whole vector, which keeps
    its direction; only the barrier of the joint limits clips single joints. The acceleration
    fades out early enough for the velocity to reach its target without overshoot, so the arm
    stops and starts smoothly.
    """

    def __init__(self, limits: MotionLimits | SerialChain, config: SafetyConfig | None = None):
        """Prepare the filter.

        Args:
            limits: The arm or its chain, so that the speed of the elbow is capped as well; or
                the joint limits alone.
            config: Margins and caps; default: the recommended settings.
        """
        super().__init__()
        self._arm = None
        if not isinstance(limits, MotionLimits):
            self._arm, limits = limits, limits.limits
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
        )
        self.speed_barrier = SpeedBarrier(
            self.barrier, config.tcp_speed, delay=config.delay, jitter=config.jitter
        )

    def joint_vector(self, values: ArrayLike, name: str) -> Float[Tensor, "*batch n"]:
        """Joint values as a tensor (*batch, n) in the dtype of the filter.

        Args:
            values: Tensor, array or nested lists.
            name: Name of the argument, for the error message.

        Raises:
            ValueError: The last axis does not have one value for each joint.
        """
        like = self.barrier.velocity
        if not isinstance(values, Tensor) or values.dtype != like.dtype:
            values = as_tensor(values, like)
        if values.shape[-1:] != like.shape[-1:]:
            raise ValueError(
                f"{name} needs {like.shape[-1]} values, one for each joint, but has the shape "
                f"{tuple(values.shape)}"
            )
        return values

    def initial_state(
        self,
        joint_position: ArrayLike,
        joint_velocity: ArrayLike | None = None,
        joint_acceleration: ArrayLike | None = None,
    ) -> SafetyState:
        """State of an arm at rest or in motion.

        Args:
            joint_position: Measured joint positions (*batch, n) [rad].
            joint_velocity: Measured joint velocities (*batch, n) [rad/s]; None: at rest.
            joint_acceleration: Joint accelerations (*batch, n) [rad/s^2]; None: zero.

        Raises:
            ValueError: A vector does not have one value for each joint.
        """
        q = self.joint_vector(joint_position, "joint_position")
        still = torch.zeros_like(q)

        def motion(values: ArrayLike | None, name: str) -> Tensor:
            return still.clone() if values is None else still + self.joint_vector(values, name)

        zero = q.new_zeros(q.shape[:-1])
        return SafetyState(
            velocity=motion(joint_velocity, "joint_velocity"),
            acceleration=motion(joint_acceleration, "joint_acceleration"),
            position=q,
            dt=torch.full_like(zero, _SHORTEST_STEP),
            fresh=torch.ones_like(zero, dtype=torch.bool),
            too_fast=zero,
            counts=q.new_zeros(*q.shape[:-1], len(INTERVENTIONS), dtype=torch.int64),
        )

    def restored(self, state: SafetyState) -> SafetyState:
        """The state with invalid values replaced: zero velocity and acceleration, and the
        middle of the joint range as position. Outside of traced code, a valid state is returned
        unchanged.
        """
        valid = (state.dt > 0) & (state.dt <= self.config.longest_step)
        if everywhere(valid) and has_numbers(state):
            return state
        lower, upper = self.barrier.walls.unbind(-2)
        zero = torch.zeros_like(state.velocity)
        fallback = (
            (state.velocity, zero),
            (state.acceleration, zero),
            (state.position, (upper - lower) / 2),
            (state.too_fast, torch.zeros_like(state.too_fast)),
        )
        v, a, q, time = (torch.where(is_number(x), x, instead) for x, instead in fallback)
        dt = torch.where(valid, state.dt, _SHORTEST_STEP)
        return replace(state, velocity=v, acceleration=a, position=q, dt=dt, too_fast=time)

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
        jacobian: ArrayLike | None = None,
        load: Float[Tensor, "*batch 3"] | None = None,
        joint_velocity: ArrayLike | None = None,
        human_distance: ArrayLike | None = None,
        stop: Bool[Tensor, "*batch"] | bool | None = None,
        distances: Distances | None = None,
    ) -> tuple[Float[Tensor, "*batch n"], SafetyState, SafetyReport]:
        """Velocity to send for the next `dt` seconds.

        Args:
            state: State after the last step.
            joint_position: Measured joint positions (*batch, n) [rad]. Not finite: brake to
                rest.
            joint_velocity_command: Wanted joint velocities (*batch, n) [rad/s]. Not finite:
                brake to rest.
            dt: Time until the next step [s], or since the last step where steps are irregular.
                A tensor outside (0, longest_step]: brake to rest, using the last valid step.
            jacobian: Jacobian of the tool centre point (*batch, rows, n), linear rows first;
                enables the cap on the speed of tool, elbow and load. Not finite: brake to rest.
            load: Vector from the tool centre point to the far end of a load, in the base frame
                [m]; needs all six rows of the Jacobian. Not finite: brake to rest.
            joint_velocity: Measured joint velocities (*batch, n) [rad/s]. If they differ from
                the initial state in the first step, the filter continues from the measured
                velocities.
            human_distance: Distance of the tool from the nearest person (*batch) [m]; a short
                distance slows down or stops the arm. NaN (unknown): stop. None: no person is
                monitored.
            stop: True where the arm has to brake to rest for another reason.
            distances: Distances that `SafetyConfig.constraints` keep. Not finite: brake to
                rest.

        Returns:
            The velocity (*batch, n) [rad/s], the next state, and the interventions.

        Raises:
            ValueError: A vector, or a row of the Jacobian, does not have one value for each
                joint; `dt` is a number outside (0, longest_step]; a distance is given without a
                Jacobian or without the constraints that would keep it; or constraints are set
                without a Jacobian.
        """
        self._check_arguments(jacobian, human_distance, distances)
        if jacobian is not None:
            jacobian = self.joint_vector(jacobian, "each row of jacobian")
        q = self.joint_vector(joint_position, "joint_position")
        u = self.joint_vector(joint_velocity_command, "joint_velocity_command")
        given = self._validated(state, q, u, dt, jacobian, distances, stop)
        given, wrong_start = self._from_measured_start(given, joint_velocity)
        if human_distance is not None or self.config.tcp_speed < math.inf:
            given = self._with_capped_points(given, load)
        target, fast, cut = self._limit_velocity(given)
        target, cap, speeding, near = self._cap_speed(given, target, human_distance)
        # With constraints, the quadratic program keeps the bounds on the velocity.
        own = given.bounds if self.config.constraints is None else None
        v, hard, jerky = self._limit_acceleration(given, target, own)
        report, excess = None, torch.zeros_like(given.state.dt)
        if self.config.constraints is not None:
            v, report = self._keep_constraints(given, v)
        if given.points is not None:
            v, braked = self._keep_speed(given, v, cap)
            if braked is not None:
                speeding = speeding | braked
                excess = (_speed(given.points, v) - cap).clamp(min=0).squeeze(-1)
        # In the order of INTERVENTIONS.
        flags = (fast, cut, hard, jerky, speeding, near)
        flags = torch.cat((*flags, given.invalid, given.stopped, wrong_start), dim=-1)
        return v, *self._results(given, v, flags, excess, report)

    def _check_arguments(
        self,
        jacobian: ArrayLike | None,
        human_distance: ArrayLike | None,
        distances: Distances | None,
    ) -> None:
        if distances is not None and self.config.constraints is None:
            raise ValueError(
                "distances are kept by SafetyConfig.constraints, which is None: set it to a "
                "ConstraintConfig"
            )
        constrained = self.config.constraints is not None
        if jacobian is None and (constrained or human_distance is not None):
            raise ValueError(
                "constraints and human_distance need the Jacobian of the tool: set jacobian"
            )

    def _validated(
        self,
        state: SafetyState,
        q: Tensor,
        u: Tensor,
        dt: float | Tensor,
        jacobian: Tensor | None,
        distances: Distances | None,
        stop: Tensor | bool | None,
    ) -> _Inputs:
        """Arguments of a step, with invalid values replaced and flagged."""
        state, dt, invalid = self._validated_state(state, dt)
        numbers = [q, u] if jacobian is None else [q, u, jacobian.flatten(-2)]
        invalid = invalid | ~is_number(torch.cat(numbers, dim=-1)).all(-1, keepdim=True)
        if distances is not None:
            self.joint_vector(distances.gradient, "each row of distances.gradient")
            known = distances.known()
            invalid, distances = invalid | ~known.unsqueeze(-1), distances.where(known)
        stop = None if stop is None else torch.as_tensor(stop, device=q.device)
        stopped = torch.zeros_like(invalid) if stop is None else stop.unsqueeze(-1)
        q = torch.where(invalid, state.position, q)
        if jacobian is not None:
            jacobian = jacobian.masked_fill(invalid.unsqueeze(-1), 0)
        return _Inputs(
            state=state,
            joint_position=q,
            command=u.masked_fill(invalid | stopped, 0),
            jacobian=jacobian,
            points=None,
            distances=distances,
            bounds=self.velocity_bounds(q),
            dt=dt,
            invalid=invalid,
            stopped=stopped,
        )

    def _validated_state(
        self, state: SafetyState, dt: float | Tensor
    ) -> tuple[SafetyState, float | Tensor, Tensor]:
        """A finite state, the step to compute with, and True where the state or the step was
        invalid.
        """
        given, longest = state, self.config.longest_step
        state, invalid = self.restored(state), torch.zeros_like(state.fresh).unsqueeze(-1)
        if state is not given:
            motion = torch.cat([given.velocity, given.acceleration], dim=-1)
            invalid = ~is_number(motion).all(-1, keepdim=True)
        if isinstance(dt, Tensor):
            valid = (dt > 0) & (dt <= longest)
            length = torch.where(valid, dt.to(state.dt), state.dt)
            return replace(state, dt=length), length.unsqueeze(-1), invalid | ~valid
        if not 0 < dt <= longest:
            raise ValueError(
                f"the safety filter needs a step dt in (0, {longest:g}] s to guarantee the "
                f"limits, but got {dt:g} s; step faster or lower the filter's rate"
            )
        return replace(state, dt=torch.full_like(state.dt, dt)), dt, invalid

    def _from_measured_start(
        self, given: _Inputs, joint_velocity: ArrayLike | None
    ) -> tuple[_Inputs, Tensor]:
        """The arguments, and the flag `start`: True where the state takes the measured velocity
        because the initial velocity differed from it.
        """
        state = given.state
        if joint_velocity is None:
            return given, torch.zeros_like(given.invalid)
        measured = self.joint_vector(joint_velocity, "joint_velocity")
        error = (measured - state.velocity).abs() > _START_ERROR * self.barrier.velocity
        known = is_number(measured).all(-1, keepdim=True)
        wrong = state.fresh.unsqueeze(-1) & known & error.any(-1, keepdim=True)
        velocity = torch.where(wrong, measured, state.velocity)
        acceleration = state.acceleration.masked_fill(wrong, 0)
        state = replace(state, velocity=velocity, acceleration=acceleration)
        return given._replace(state=state), wrong

    def _with_capped_points(self, given: _Inputs, load: Tensor | None) -> _Inputs:
        """The arguments, with the Jacobians of tool, elbow and far end of a load."""
        J, invalid = given.jacobian, given.invalid
        if J is None:
            return given
        points = [J[..., :3, :]]
        if self._arm is not None:
            q, elbow = given.joint_position, self._arm.elbow
            points.append(self._arm.joint_jacobian(q, elbow)[..., :3, :])
        if load is not None:
            unknown = ~is_number(load).all(-1, keepdim=True)
            invalid, end = invalid | unknown, load.masked_fill(unknown, 0).unsqueeze(-1)
            turning = J[..., 3:, :]
            points.append(J[..., :3, :] + torch.linalg.cross(turning, end, dim=-2))
        return given._replace(
            points=torch.stack(points, dim=-3),
            command=given.command.masked_fill(invalid, 0),
            invalid=invalid,
        )

    def _limit_velocity(self, given: _Inputs) -> tuple[Tensor, Tensor, Tensor]:
        """Apply the limits of velocity and position.

        Returns:
            The velocity, and the flags `velocity` and `position`.
        """
        u = given.command
        excess = _excess(u, self.barrier.velocity)
        if self.config.constraints is None:
            u = u / excess.clamp(min=1)
        inside = u.clamp(*given.bounds)
        cut = (inside - u).abs().amax(-1, keepdim=True) > _REPORTED
        # With constraints, no single joint is limited here: the null space can give way to the
        # whole task.
        return inside if self.config.constraints is None else u, _acts(excess), cut

    def _cap_speed(
        self, given: _Inputs, u: Tensor, human_distance: ArrayLike | None
    ) -> tuple[Tensor, Tensor | float, Tensor, Tensor]:
        """The slowed velocity, the cap, and the flags `tcp_speed` and `separation`."""
        never = torch.zeros_like(given.invalid)
        if given.points is None:
            return u, math.inf, never, never
        speed = _speed(given.points, u)
        excess = speed / self.config.tcp_speed
        speeding = _acts(excess)
        if human_distance is None:
            return u / excess.clamp(min=1), self.config.tcp_speed, speeding, never
        distance = as_tensor(human_distance, u)
        safe = self.config.separation.highest_speed(distance).unsqueeze(-1)
        cap = safe.clamp(max=self.config.tcp_speed)
        # At a cap of zero, all joints rest, also joints that do not move the tool.
        factor = cap / torch.maximum(speed, cap).clamp(min=torch.finfo(u.dtype).tiny)
        return factor * u, cap, speeding, (speed > (1 + _REPORTED) * safe) | (safe == 0)

    def _limit_acceleration(
        self, given: _Inputs, target: Tensor, bounds: tuple[Tensor, Tensor] | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The velocity nearest to a target within limits of acceleration and jerk.

        The wanted acceleration is a fraction of change/dt, the same fraction for all joints. It
        is as large as possible while every joint keeps its acceleration limit and can still
        fade its acceleration out in time: a dt + a^2/(2 j) <= change.

        Args:
            given: Arguments of the step.
            target: Velocity to go to [rad/s].
            bounds: Limits of the velocity; None: the constraints keep them.

        Returns:
            The velocity, and the flags `acceleration` and `jerk`.
        """
        barrier, state, dt = self.barrier, given.state, given.dt
        usable = acceleration, jerk = barrier.usable(dt)
        change, reach = (target - state.velocity) / dt, jerk * dt
        excess = _excess(change, acceleration)
        # a = change/s with the root s of a dt + a^2/(2 j) = change dt, which fades out in time.
        fading = (1 + torch.sqrt(1 + 2 * _excess(change, reach))) / 2
        jump = change / torch.maximum(excess, fading) - state.acceleration
        jerky = _excess(jump, reach)
        wanted = torch.addcdiv(state.acceleration, jump, jerky.clamp(min=1))
        if bounds is not None:
            wanted = barrier.nearest_acceleration(
                wanted, state.acceleration, state.velocity, bounds, dt, usable
            )
        return state.velocity + wanted * dt, _acts(excess), _acts(jerky)

    def _stopping(self, given: _Inputs) -> Tensor:
        """The velocity after one step of the hardest possible braking to rest [rad/s]."""
        return self._limit_acceleration(given, torch.zeros_like(given.command), given.bounds)[0]

    def _easing(self, given: _Inputs) -> Tensor:
        """The velocity after one step of gentle braking, as in the speed barrier [rad/s]."""
        v, dt = given.state.velocity, given.dt
        T = self.speed_barrier.braking_time(v).clamp(min=dt)
        # Each joint ramps as fast as it can: a common ramp would last as long as the longest
        # ramp.
        acceleration = self.barrier.nearest_acceleration(
            -v / T, given.state.acceleration, v, given.bounds, dt
        )
        return v + acceleration * dt

    def _keep_constraints(self, given: _Inputs, v: Tensor) -> tuple[Tensor, ConstraintReport]:
        """The velocity that keeps limits and distances and is nearest to a given one, and a
        report.
        """
        state, J = given.state, given.jacobian
        assert J is not None
        v, report = constrained_velocity(
            v,
            J,
            *self.barrier.reachable_velocity(
                state.velocity, state.acceleration, given.bounds, given.dt
            ),
            given.distances,
            self.config.constraints,
            self.config.separation,
        )
        # Rounding of the solver would move joints that have a velocity limit of zero.
        v = torch.where(v.abs() < _REST, 0, v)
        braking = given.invalid | given.stopped
        if not everywhere(~braking):
            v = torch.where(braking, self._stopping(given), v)
        idle = braking.squeeze(-1)
        return v, replace(zero_where(idle, report), solved=report.solved | idle)

    def _keep_speed(
        self, given: _Inputs, v: Tensor, cap: Tensor | float
    ) -> tuple[Tensor, Bool[Tensor, "*batch 1"] | None]:
        """The velocity, reduced as far as the cap on the speed of points requires, and a flag
        for the reduction; None instead of the flag if all arms keep the cap.

        The result lies inside the barrier, on the line from the wanted velocity to gentle
        braking (`_easing`), as near to the wanted velocity as possible. Where gentle braking is
        not enough, the result lies on the line from gentle to hardest braking (`_stopping`).
        A stop always brakes as hard as possible.
        """
        cap = cap * (1 - 8 * torch.finfo(v.dtype).eps)
        speed = self._highest_speed(given, v)
        keeps = speed <= cap
        passes = keeps | given.invalid | given.stopped
        if everywhere(passes):
            return v, None if everywhere(keeps) else ~passes
        stopping, easing = self._stopping(given), self._easing(given)
        hard, gentle = self._highest_speed(given, stopping), self._highest_speed(given, easing)
        eases = gentle <= cap
        low, high = torch.where(eases, easing, stopping), torch.where(eases, v, easing)
        at_low, at_high = torch.where(eases, gentle, hard), torch.where(eases, speed, gentle)
        fraction = _secant(at_low, at_high, cap)
        # The bound is almost linear along this short line; a second step corrects for its
        # curvature.
        at = self._highest_speed(given, torch.lerp(low, high, fraction))
        fraction = fraction * _secant(at_low, at, cap)
        kept = torch.where(passes, v, torch.lerp(low, high, fraction))
        return kept, ~passes & ~(eases & (fraction > 1 - _REPORTED))

    def _highest_speed(self, given: _Inputs, v: Tensor) -> Tensor:
        """Bound on the speed of the capped points at a joint velocity and in the braking after
        it [m/s].
        """
        assert given.points is not None
        acceleration = (v - given.state.velocity) / given.dt
        return self.speed_barrier.highest_speed(given.points, v, acceleration, given.dt)

    def _results(
        self,
        given: _Inputs,
        v: Tensor,
        flags: Tensor,
        excess: Tensor,
        constraints: ConstraintReport | None,
    ) -> tuple[SafetyState, SafetyReport]:
        """The next state, and the report."""
        before = given.state
        too_fast = torch.where(excess > _REPORTED, before.too_fast + before.dt, 0.0)
        state = replace(
            before,
            velocity=v,
            # Computed from the rounded velocities, so that errors do not add up, and a check of
            # the sent velocities finds the same value.
            acceleration=(v - before.velocity) / given.dt,
            position=given.joint_position + v * given.dt,
            fresh=torch.zeros_like(before.fresh),
            too_fast=too_fast,
            counts=before.counts + flags,
        )
        return state, SafetyReport(
            flags=flags,
            speed_excess=excess,
            speed_excess_time=too_fast,
            constraints=constraints,
        )


def _speed(points: Tensor, joint_velocity: Tensor) -> Float[Tensor, "*batch 1"]:
    """Speed of the fastest point [m/s]."""
    velocity = torch.linalg.vecdot(points, joint_velocity.unsqueeze(-2).unsqueeze(-2))
    return torch.linalg.vector_norm(velocity, dim=-1).amax(-1, keepdim=True)


def _secant(low: Tensor, high: Tensor, cap: Tensor | float) -> Tensor:
    """Largest fraction of the way from the value `low` to `high` at which the cap is kept."""
    rise = (high - low).clamp(min=_REPORTED)
    return torch.where(high > cap, ((cap - low) / rise).clamp(0, 1), 1.0)


def _excess(vector: Tensor, limit: Tensor) -> Tensor:
    """Largest ratio of a component to its limit; at most 1 where all limits are kept."""
    return (vector / limit).abs().amax(-1, keepdim=True)


def _acts(excess: Tensor) -> Bool[Tensor, "..."]:
    """True where scaling by an excess above 1 changes a vector by more than rounding."""
    return excess > 1 + _REPORTED
