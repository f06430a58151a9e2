"""The law of the arm near people, one control step at a time.

A step is a pure function `(state, reading, request) -> (command, state, report)`:

1. *Observe* a reading: the null-space push is smoothed, and the joint path goes on, waits or
   goes back, as the arm follows and people allow.
2. *Act* on a request: a joint path, a pose of the end effector, a joint velocity, or a command
   of the adaptive controller becomes a joint velocity; the null space yields to the push; the
   safety filter has the last word; and the pace of the task drops by what people took from it.

States, readings and requests have any number of leading batch dimensions. Drivers, clocks, logs
and messages to people belong to the caller.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.utils import _pytree

from hrc_learn.controller.constraint_layer import Distances
from hrc_learn.controller.interface import Command
from hrc_learn.controller.joint_path import (
    DirectReturn,
    JointPaths,
    begins_aside,
    changed_rate,
    deviation_ratio,
    eased_return,
    may_not_return,
    nears_singularity,
    push_fraction,
    return_alignment,
    stays_aside,
    waiting_time,
)
from hrc_learn.controller.null_space_motion import (
    Clearance,
    YieldingConfig,
    eased_null_velocity,
    fraction_in_null_space,
    fraction_kept,
    kept_clear,
    limiting_joint,
    null_space_giving_way,
    null_space_slowdown,
)
from hrc_learn.controller.resolved_rate import resolved_rate, scale_null_space
from hrc_learn.controller.safety_filter import (
    SafetyConfig,
    SafetyFilter,
    SafetyReport,
    SafetyState,
)
from hrc_learn.controller.task_pace import TaskPace, closes_in, fraction_of_motion, people_bind
from hrc_learn.controller.way_making import WayMakingConfig, way_making_velocity
from hrc_learn.geometry import Pose
from hrc_learn.geometry.numerics import null_projection
from hrc_learn.kinematics import MotionLimits, SerialChain
from hrc_learn.pytree import pytree, static

# Null-space input below which one that has ended is over [N m].
_LEAST_INPUT = 0.05


@dataclass(frozen=True, kw_only=True)
class ArmLoopConfig(YieldingConfig):
    """Settings of the loop."""

    dt: float = 0.01
    """Control step [s]."""
    command_delay: float = 0.01
    """Time from a command until the arm follows it, with the lag of its servos [s]. By default
    that of the simulated servos; networks and schedulers add to it on real arms."""
    limit_margin: float = 0.1
    """Distance from the joint limits that a push leaves to the task, beyond the margin of the
    safety filter [rad]: some centimetres of the end effector."""
    speed: float = 1.0
    """Speed of the task relative to its planned speed, above 0 to 1, as for a first run on a
    real arm. Motions of the null space off a path are not slowed down."""
    longest_wait: float = 300.0
    """Time after which a task fails that people block or hold aside [s]."""
    back_after: float = 2.0
    """Time after which a path goes back whose joints come no nearer [s]."""
    direct_return_after: float = 20.0
    """Time after which joints that come no nearer to their path return to it directly [s]."""
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    """Safety filter, with what the arm's driver can do."""
    way_making: WayMakingConfig | None = None
    """Source of null-space motion: the person who pushes, the repulsion from people near the
    arm, or both; None: the person who pushes."""

    def __post_init__(self) -> None:
        if not 0 < self.speed <= 1:
            raise ValueError(f"speed must be in (0, 1], but is {self.speed}.")


@pytree
@dataclass(frozen=True, kw_only=True)
class ArmReading:
    """One reading of the arm and of the people near it."""

    joint_position: Float[Tensor, "*batch n"]
    """Measured joint positions [rad]."""
    pose: Pose
    """Pose of the end effector at these joints."""
    jacobian: Float[Tensor, "*batch 6 n"]
    """Geometric Jacobian of the end effector at these joints."""
    nullspace_input: Float[Tensor, "*batch n"]
    """Push of a person on the null space [N m]."""
    pause: Bool[Tensor, "*batch"]
    """True while a person pauses the task."""
    distances: Distances | None = None
    """Distances from people, which the safety filter keeps; None: people are not tracked."""
    person_speed_scale: Float[Tensor, "*batch"] | None = None
    """Speed scale imposed by approaching people, 0 to 1; None: 1."""
    stop: Bool[Tensor, "*batch"] | None = None
    """True where the arm must come to rest for the sake of people; None: nowhere."""
    explain: bool = static(False)
    """Report what limits the push."""


@pytree
@dataclass(frozen=True, kw_only=True)
class PathState:
    """Progress along a joint path, and how the last step tracked it."""

    progress: Float[Tensor, "*batch"]
    """Number of the sample to track."""
    rate: Float[Tensor, "*batch"]
    """Rate relative to the path's own speed, -1 to 1."""
    last: Float[Tensor, "*batch"]
    """Number of the last sample."""
    followed: Bool[Tensor, "*batch"]
    """True if the last step followed the path."""
    goal: Float[Tensor, "*batch n"]
    """Joint positions that were tracked [rad]."""
    pose: Pose
    """Pose of the end effector at them."""
    twist: Float[Tensor, "*batch 6"]
    """Velocity of that pose along the path (linear [m/s], angular [rad/s])."""
    blocked: Bool[Tensor, "*batch"]
    """True if the arm, off its path, would have met something had the path gone on."""
    narrow_ahead: Bool[Tensor, "*batch"]
    """True if the joints could not leave the path somewhere before it stops."""
    waited: Float[Tensor, "*batch"]
    """Time for which it has waited for joints that come no nearer [s]."""
    nearest: Float[Tensor, "*batch"]
    """Distance of the joints from the path when they last had come nearer [rad]."""
    held: Float[Tensor, "*batch"]
    """Time for which it has waited while the arm was pushed [s]."""
    direct_return: DirectReturn

    @property
    def finished(self) -> Bool[Tensor, "*batch"]:
        """True once the last sample has been tracked."""
        return self.progress > self.last


@pytree
@dataclass(frozen=True, kw_only=True)
class ArmLoopState:
    """All that the loop remembers from one step to the next."""

    safety: SafetyState
    pace: TaskPace
    null_velocity: Float[Tensor, "*batch n"]
    """Null-space velocity that a push amounts to, without jumps [rad/s]."""
    return_velocity: Float[Tensor, "*batch n"]
    """Null-space velocity back to the path, without jumps [rad/s]."""
    aside: Bool[Tensor, "*batch"]
    """True while the joints are off their path."""
    lost: Bool[Tensor, "*batch"]
    """True while the null space might lead them to another posture than that of the path."""
    path: PathState

    @property
    def pushed(self) -> Bool[Tensor, "*batch"]:
        """True while the null space is pushed."""
        return (self.null_velocity != 0).any(-1)


@pytree
@dataclass(frozen=True, kw_only=True)
class FollowPath:
    """Request to follow joint paths; the null space yields, and returns to them."""

    paths: JointPaths
    path: Int[Tensor, "*batch"]
    """Index of the path of each arm."""


@pytree
@dataclass(frozen=True, kw_only=True)
class TrackPose:
    """Request to track a moving pose of the end effector; the null space yields."""

    pose: Pose
    twist: Float[Tensor, "*batch 6"]
    """Velocity of the pose (linear [m/s], angular [rad/s])."""


@pytree
@dataclass(frozen=True, kw_only=True)
class MoveJoints:
    """Request for a joint velocity."""

    joint_velocity: Float[Tensor, "*batch n"]
    """Joint velocity [rad/s]."""


class SendCommand(NamedTuple):
    """Request to send a command of the adaptive controller, which has its own safety filter."""

    command: Command


type ArmRequest = FollowPath | TrackPose | MoveJoints | SendCommand


class Limitation(NamedTuple):
    """Part of a push that one cause takes away."""

    cause: str
    """One of `hrc_learn.protocols.HINDRANCES`."""
    kept: Float[Tensor, "*batch"]
    """Fraction of the motion that is left, 0 to 1."""
    joint: Int[Tensor, "*batch"] | None = None
    """Joint at its limit, from 0."""
    distance: Float[Tensor, "*batch"] | None = None
    """Distance from an obstacle [m]."""
    mentioned: Bool[Tensor, "*batch"] | None = None
    """True where the cause is reported although it takes nothing away."""


class ArmReport(NamedTuple):
    """What a step did, and why."""

    safety: SafetyReport
    limitations: tuple[Limitation, ...] = ()
    """What limits the push; empty unless the reading asks for an explanation."""
    goal: Pose | None = None
    """Pose that the end effector tracks."""
    path_joints: Float[Tensor, "*batch n"] | None = None
    """Joint positions on the path [rad]."""
    slowed_by_people: Bool[Tensor, "*batch"] | None = None
    """True where people near the arm hold it back; None: not explained."""
    null_motion: tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"]] | None = None
    """Null-space velocity before and after the safety filter [rad/s]; None: not explained."""


class _Wanted(NamedTuple):
    """Joint velocity before the safety filter, and the parts of the report known by then."""

    joint_velocity: Tensor
    limitations: tuple[Limitation, ...] = ()
    goal: Pose | None = None
    path_joints: Tensor | None = None


class _Tracked(NamedTuple):
    """Joint velocity that tracks a pose while the null space yields."""

    joint_velocity: Tensor
    blocked: Tensor
    slowdown: Tensor
    clear: Tensor
    """Fraction of the null-space velocity that obstacles leave."""
    distance: Tensor
    within: Tensor
    """Fraction of it that the joint limits leave."""
    joint: Tensor
    """Joint that limits it most."""

    def limitations(self) -> tuple[Limitation, ...]:
        """What limits the null space, for the report."""
        return (
            Limitation("speed", self.slowdown),
            Limitation("obstacle", self.clear, distance=self.distance),
            Limitation("joint_limit", self.within, joint=self.joint),
        )


@final
class ArmLoop:
    """The law of one arm or of a batch of equal arms; all of its state is passed in."""

    def __init__(
        self,
        chain: SerialChain,
        config: ArmLoopConfig | None = None,
        clearance: Clearance | None = None,
        limits: MotionLimits | None = None,
    ):
        """Put the parts together.

        Args:
            chain: Kinematics of the arm.
            config: Settings of the loop.
            clearance: Distance of the arm from itself and its surroundings; None: a push can
                move it anywhere within its limits.
            limits: Limits of the joints; None: those of the chain.
        """
        self.chain, self.limits = chain, limits or chain.limits
        self.config = config = config or ArmLoopConfig()
        self.clearance = clearance
        self.safety = SafetyFilter(self.limits, config.safety)
        margin = config.safety.margin + config.limit_margin
        self._task_margin = SafetyFilter(self.limits, replace(config.safety, margin=margin))

    def initial_state(
        self, joint_position: Float[Tensor, "*batch n"], time: float = 0.0
    ) -> ArmLoopState:
        """State of arms at rest that follow no path.

        Args:
            joint_position: Joint positions [rad].
            time: Reading of the clock [s].
        """
        zero = torch.zeros_like(joint_position[..., 0])
        never = torch.zeros_like(zero, dtype=torch.bool)
        still = torch.zeros_like(joint_position)
        pose, J = self.chain.forward_and_jacobian(joint_position)
        path = PathState(
            progress=zero,
            rate=zero + 1,
            last=zero - 1,
            followed=never,
            goal=joint_position,
            pose=pose,
            twist=torch.zeros_like(J[..., 0]),
            blocked=never,
            narrow_ahead=never,
            waited=zero,
            nearest=zero + torch.inf,
            held=zero,
            direct_return=DirectReturn.none(joint_position),
        )
        return ArmLoopState(
            safety=self.safety.initial_state(joint_position),
            pace=TaskPace(
                time=zero + time,
                people_scale=zero + 1,
                speed_override=zero + self.config.speed,
                blocked_for=zero,
                full_speed=self.config.speed,
            ),
            null_velocity=still,
            return_velocity=still,
            aside=never,
            lost=never,
            path=path,
        )

    def begin_path(
        self,
        state: ArmLoopState,
        joint_position: Float[Tensor, "*batch n"],
        request: FollowPath,
    ) -> ArmLoopState:
        """State at the start of joint paths.

        Args:
            state: Of the last step.
            joint_position: Joint positions now [rad].
            request: The paths.
        """
        paths, which = request.paths, request.path
        zero = torch.zeros_like(state.path.progress)
        goal = paths.position[which, 0]
        path = replace(
            state.path,
            progress=zero,
            rate=zero + 1,
            last=zero + paths.last[which],
            followed=torch.zeros_like(state.aside),
            goal=goal,
            waited=zero,
            nearest=zero + torch.inf,
            held=zero,
            direct_return=DirectReturn.none(joint_position),
        )
        return replace(state, aside=begins_aside(goal - joint_position), path=path)

    def step(
        self, state: ArmLoopState, reading: ArmReading, request: ArmRequest
    ) -> tuple[Float[Tensor, "*batch n"], ArmLoopState, ArmReport]:
        """One step of the loop.

        Args:
            state: Of the step before.
            reading: Newest reading.
            request: What the task asks for.

        Returns:
            Joint velocity to send [rad/s], the next state, and what was done.
        """
        state, limitations = self.observe(state, reading)
        command, state, report = self.act(state, reading, request)
        return command, state, report._replace(limitations=limitations + report.limitations)

    def observe(
        self, state: ArmLoopState, reading: ArmReading
    ) -> tuple[ArmLoopState, tuple[Limitation, ...]]:
        """First half of a step: take in a reading.

        Args:
            state: Of the step before.
            reading: Newest reading.

        Returns:
            The state, and what limits the push.
        """
        null_velocity, limitations = self._eased_push(state, reading)
        pace = state.pace.overridden(reading.pause, self.config.dt)
        state = replace(state, null_velocity=null_velocity, pace=pace)
        return replace(state, path=self._path_goes_on(state, reading)), limitations

    def act(
        self, state: ArmLoopState, reading: ArmReading, request: ArmRequest
    ) -> tuple[Float[Tensor, "*batch n"], ArmLoopState, ArmReport]:
        """Second half of a step: make a request a joint velocity.

        Arguments and results are those of `step`; the state is that of `observe`.
        """
        if isinstance(request, SendCommand):
            return self._send(state, reading, request.command)
        if isinstance(request, FollowPath):
            wanted, state = self._follow(state, reading, request)
        elif isinstance(request, TrackPose):
            wanted, state = self._track(state, reading, request), _off_path(state)
        else:
            wanted, state = _Wanted(request.joint_velocity), _off_path(state)
        return self._filtered(state, reading, wanted)

    # The push on the null space.

    def _eased_push(
        self, state: ArmLoopState, reading: ArmReading
    ) -> tuple[Tensor, tuple[Limitation, ...]]:
        """Null-space velocity that the push amounts to now, and what limits it."""
        requested = self._requested_null_velocity(reading)
        asked = (requested != 0).any(-1)
        acts = asked | state.pushed
        if not bool(acts.any()):
            return requested, ()
        q, J = reading.joint_position, reading.jacobian
        config, bounds = self.config, self._task_margin.velocity_bounds(q)

        def eased(part: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            q, J, previous, requested, lower, upper = part
            return tuple(
                eased_null_velocity(
                    self.chain, q, J, previous, requested, (lower, upper), config.dt, config
                )
            )

        one = torch.ones_like(q[..., 0])
        velocity, projected, slowdown, fade, unbounded, bounded = _where(
            acts,
            eased,
            (q, J, state.null_velocity, requested, *bounds),
            (requested, requested, one, one, requested, requested),
        )
        small = config.damping * velocity.abs().amax(-1) < _LEAST_INPUT
        velocity = velocity.masked_fill((~asked & small).unsqueeze(-1), 0.0)
        if not reading.explain:
            return velocity, ()
        return velocity, (
            Limitation("task", fraction_in_null_space(requested, projected)),
            Limitation("speed", slowdown),
            Limitation("singularity", fade),
            Limitation(
                "joint_limit",
                fraction_kept(unbounded, bounded),
                joint=limiting_joint(unbounded, *bounds),
            ),
        )

    def _requested_null_velocity(self, reading: ArmReading) -> Tensor:
        """Joint velocity whose null-space part is requested, by people or the repulsion."""
        config, way = self.config, self.config.way_making
        push = reading.nullspace_input
        if way is not None and not way.expert:
            push = torch.zeros_like(push)
        if way is not None and way.automatic and reading.distances is not None:
            push = push + config.damping * way_making_velocity(reading.distances, way)
        return _scaled(push, reading.person_speed_scale) / config.damping

    # The joint path.

    def _path_goes_on(self, state: ArmLoopState, reading: ArmReading) -> PathState:
        """Progress along the path, one step later."""
        path, q, dt = state.path, reading.joint_position, self.config.dt
        moves = path.followed & ~path.finished
        if not bool(moves.any()):
            return path
        pushed, zero = state.pushed, torch.zeros_like(path.rate)
        waited, nearest = waiting_time(
            path.waited,
            path.nearest,
            (path.goal - q).norm(dim=-1),
            path.rate,
            ~pushed & state.pace.at_full_speed,
            self.config.back_after,
            dt,
        )
        waited = torch.where(state.aside, waited, 0.0)
        held = torch.where((path.rate <= 0) & pushed, path.held + dt, 0.0)
        # Joints that found no way back here do so where they left the path.
        backs = (waited > self.config.back_after) & (path.progress > 0)
        ratio = _where(
            state.aside,
            lambda part: deviation_ratio(part[0].twist_to(part[1]), part[2]),
            (reading.pose, path.pose, path.twist),
            zero,
        )
        singular = _where(
            state.aside,
            lambda part: nears_singularity(self.chain, *part),
            (q, state.safety.velocity),
            torch.zeros_like(state.aside),
        )
        stops = ~backs & state.aside & (state.lost | path.narrow_ahead | singular)
        ratio = torch.where(path.blocked | stops, torch.inf, ratio)
        rate = changed_rate(path.rate, 2.0 - ratio, dt, torch.where(backs, -1, 1))
        progress = (path.progress + rate * state.pace.scale).clamp(min=0)
        return replace(
            path,
            progress=torch.where(moves, progress, path.progress),
            rate=torch.where(moves, rate, path.rate),
            waited=torch.where(moves, waited, path.waited),
            nearest=torch.where(moves, nearest, path.nearest),
            held=torch.where(moves, held, path.held),
        )

    def _follow(
        self, state: ArmLoopState, reading: ArmReading, request: FollowPath
    ) -> tuple[_Wanted, ArmLoopState]:
        """Joint velocity along joint paths, or beside them."""
        q, J, config = reading.joint_position, reading.jacobian, self.config
        paths, which = request.paths, request.path
        path = self._returning(state.path, q, request)
        direct = path.direct_return
        aside = state.aside & ~direct.active
        rate = path.rate * state.pace.speed_override
        later = (path.progress + rate * config.command_delay / config.dt).clamp(min=0)
        goal = paths.interpolated(paths.position, which, path.progress)
        wanted = rate.unsqueeze(-1) * paths.interpolated(paths.velocity, which, later)
        wanted = wanted.masked_fill(path.finished.unsqueeze(-1), 0.0)
        sample = torch.minimum(path.progress.long(), paths.last[which])
        narrow, error = paths.narrow[which, sample], goal - q

        pushed = state.pushed & ~direct.active
        aside = (~narrow | aside) & stays_aside(pushed, aside, error)
        null_error = null_projection(J, error).masked_fill(~aside.unsqueeze(-1), 0.0)
        alignment = return_alignment(null_error, error)
        lost, fraction = torch.zeros_like(aside), torch.ones_like(alignment)
        if config.after_push == "return":
            waited = state.lost & ~pushed
            lost = aside & may_not_return(error, alignment, waited)
            followed = push_fraction(state.null_velocity, null_error, alignment)
            fraction = torch.where(aside, followed, 1.0)
        # Joints go back once they are let go, and in any case where the path waits for them.
        returns = path.rate <= 0
        if config.after_push == "return":
            returns = returns | ~pushed
        null_error = null_error.masked_fill(~returns.unsqueeze(-1), 0.0)
        back = eased_return(state.return_velocity, null_error, config.dt, config)
        back = back.masked_fill(~aside.unsqueeze(-1), 0.0)

        pose = self.chain.forward(goal)
        twist = _where(
            aside,
            lambda part: _twist(self.chain.jacobian(part[0]), part[1]),
            (goal + config.command_delay * wanted, wanted),
            torch.zeros_like(J[..., 0]),
        )
        push = fraction.unsqueeze(-1) * state.null_velocity
        null = wanted + back + push
        tracked = self._tracked(state, reading, pose, twist, null, aside, slows=True)
        along = wanted + config.pose_gain * error
        velocity = torch.where(aside.unsqueeze(-1), tracked.joint_velocity, along)
        straight = config.pose_gain * (direct.joint_position() - q)
        velocity = torch.where(direct.active.unsqueeze(-1), straight, velocity)

        limitations = ()
        if reading.explain:
            one, null_push = torch.ones_like(fraction), null_projection(J, state.null_velocity)
            kept = fraction_kept(null_push, null_projection(J, push) + back)
            kept = torch.where(aside, kept, 1.0)
            far = lost | (fraction < 1)
            bound = narrow & ~aside & ~direct.active
            limitations = (
                Limitation("narrow_path", torch.where(bound, 0.0, one)),
                Limitation("too_far", torch.where(direct.active, 0.0, one)),
                Limitation("too_far", torch.where(far, kept, one)),
                Limitation("task_waits", torch.where(far, one, kept), mentioned=path.rate <= 0),
                *tracked.limitations(),
            )
        time = direct.time + config.dt * state.pace.speed_override
        path = replace(
            path,
            followed=~direct.active,
            goal=goal,
            pose=pose,
            twist=twist,
            blocked=aside & tracked.blocked,
            narrow_ahead=paths.narrow_ahead[which, sample],
            direct_return=replace(direct, time=torch.where(direct.active, time, direct.time)),
        )
        state = replace(state, return_velocity=back, aside=aside, lost=lost, path=path)
        return _Wanted(velocity, limitations, pose, goal), state

    def _returning(
        self, path: PathState, joint_position: Tensor, request: FollowPath
    ) -> PathState:
        """The path with direct returns begun where it has waited too long, and ended."""
        direct, dt = path.direct_return, self.config.dt
        arrived = direct.active & (direct.time > direct.duration + dt)
        if bool(arrived.any()):
            path = replace(
                path,
                progress=torch.where(arrived, direct.progress, path.progress),
                waited=torch.where(arrived, 0.0, path.waited),
                nearest=torch.where(arrived, torch.inf, path.nearest),
                held=torch.where(arrived, 0.0, path.held),
                direct_return=replace(direct, active=direct.active & ~arrived),
            )
            direct = path.direct_return
        begins = path.waited > self.config.direct_return_after
        begins = begins & ~direct.active & ~direct.blocked
        if bool(begins.any()):
            direct = _where(
                begins,
                lambda part: DirectReturn.planned(
                    request.paths, part[0], part[1], part[2], self.config, self.clearance
                ),
                (request.path, path.progress, joint_position),
                direct,
            )
            path = replace(path, direct_return=direct)
        return path

    # Poses of the end effector.

    def _track(self, state: ArmLoopState, reading: ArmReading, request: TrackPose) -> _Wanted:
        """Joint velocity that tracks a pose of the end effector."""
        every, push = torch.ones_like(state.aside), state.null_velocity
        tracked = self._tracked(
            state, reading, request.pose, request.twist, push, every, slows=False
        )
        limitations = tracked.limitations() if reading.explain else ()
        return _Wanted(tracked.joint_velocity, limitations, request.pose)

    def _tracked(
        self,
        state: ArmLoopState,
        reading: ArmReading,
        pose: Pose,
        twist: Tensor,
        null_velocity: Tensor,
        which: Tensor,
        *,
        slows: bool,
    ) -> _Tracked:
        """Track a moving pose while the null space moves.

        Args:
            state: Of the loop.
            reading: Newest reading.
            pose: Pose that the end effector should have.
            twist: Velocity of that pose.
            null_velocity: Joint velocity whose null-space part is wanted [rad/s].
            which: Elements of the batch that track it; the others are left out.
            slows: Limit the null-space velocity by `null_space_slowdown`: a push and a path
                together may bend the null space more than the push alone, which is eased.
        """
        q, config = reading.joint_position, self.config
        zero = torch.zeros_like(q[..., 0])
        never = torch.zeros_like(zero, dtype=torch.bool)

        def track(part: tuple[Any, ...]) -> _Tracked:
            q, velocity, here, pose, twist, null_velocity = part
            # The null space is that of the joints by the time the arm follows.
            J = self.chain.jacobian(q + config.command_delay * velocity)
            correction = config.pose_gain * here.twist_to(pose)
            task, null = resolved_rate(J, twist + correction, null_velocity)
            one, moves = torch.ones_like(q[..., 0]), (null != 0).any(-1)
            blocked, distance = torch.zeros_like(moves), torch.full_like(one, torch.inf)
            slowdown, clear = one, one
            if slows:
                slowdown = null_space_slowdown(self.chain, q, null)
                null = slowdown.unsqueeze(-1) * null
            if self.clearance is not None and bool(moves.any()):
                kept = kept_clear(q, task, null, self.clearance, config.clearance)
                clear = fraction_kept(null, kept.null)
                distance, blocked = kept.distance, kept.blocked & moves
                null = torch.where(moves.unsqueeze(-1), kept.null, null)
            margin = self._task_margin.velocity_bounds(q)
            within = self._within_limits(q, J, task, null, margin)
            return _Tracked(
                joint_velocity=task + within,
                blocked=blocked,
                slowdown=slowdown,
                clear=clear,
                distance=distance,
                within=fraction_kept(null, within),
                joint=limiting_joint(task + null, *margin),
            )

        return _where(
            which,
            track,
            (q, state.safety.velocity, reading.pose, pose, twist, null_velocity),
            _Tracked(
                joint_velocity=torch.zeros_like(q),
                blocked=never,
                slowdown=zero + 1,
                clear=zero + 1,
                distance=zero + torch.inf,
                within=zero + 1,
                joint=never.to(torch.int64),
            ),
        )

    def _within_limits(
        self, q: Tensor, J: Tensor, task: Tensor, null: Tensor, margin: tuple[Tensor, Tensor]
    ) -> Tensor:
        """Null-space velocity that leaves the task its margin before the joint limits."""
        gives_way = null_space_giving_way(J, task, null, *margin)
        gives_way = _where(
            (gives_way != null).any(-1),
            lambda part: null_space_slowdown(self.chain, *part).unsqueeze(-1) * part[1],
            (q, gives_way),
            gives_way,
        )
        return scale_null_space(task, gives_way, *self.safety.velocity_bounds(q))

    # The safety filter, and the pace of the task.

    def _filtered(
        self, state: ArmLoopState, reading: ArmReading, wanted: _Wanted
    ) -> tuple[Tensor, ArmLoopState, ArmReport]:
        """Send a joint velocity through the safety filter."""
        velocity = wanted.joint_velocity
        J, scale = reading.jacobian, reading.person_speed_scale
        sent, safety, filtered = self.safety.step(
            state.safety,
            reading.joint_position,
            _scaled(velocity, scale),
            self.config.dt,
            jacobian=J,
            distances=reading.distances,
            stop=reading.stop,
        )
        slowed = self._slowed_by_people(reading, sent, filtered)
        left = fraction_of_motion(_twist(J, velocity), _twist(J, sent))
        pace = state.pace.limited(torch.where(slowed, left, 1.0), self.config.dt)
        report = ArmReport(filtered, *wanted[1:])
        if reading.explain:
            report = self._explained(reading, report, velocity, sent)
        return sent, replace(state, safety=safety, pace=pace), report

    def _send(
        self, state: ArmLoopState, reading: ArmReading, command: Command
    ) -> tuple[Tensor, ArmLoopState, ArmReport]:
        """Send a command of the adaptive controller, at the pace of the task."""
        J, q = reading.jacobian, reading.joint_position
        slowed = self._slowed_by_people(reading, command.joint_velocity, command.safety)
        left = fraction_of_motion(command.twist, _twist(J, command.joint_velocity))
        velocity = state.pace.speed_override.unsqueeze(-1) * command.joint_velocity
        pace = state.pace.limited(torch.where(slowed, left, 1.0), self.config.dt)
        safety = self.safety.initial_state(q, velocity)
        state = replace(_off_path(state), safety=safety, pace=pace)
        report = ArmReport(command.safety)
        if reading.explain:
            # Without the part that the controller's own joint region asks for.
            push = state.null_velocity - command.xi_q / self.config.damping
            wanted, bounds = null_projection(J, push), self.safety.velocity_bounds(q)
            kept = fraction_kept(wanted, command.null_velocity)
            limit = Limitation("joint_limit", kept, joint=limiting_joint(wanted, *bounds))
            report = self._explained(
                reading, report, command.null_velocity, command.joint_velocity
            )._replace(limitations=(limit,))
        return velocity, state, report

    def _slowed_by_people(
        self, reading: ArmReading, sent: Tensor, report: SafetyReport
    ) -> Tensor:
        """True where people near the arm hold it back."""
        slowed = torch.zeros_like(sent[..., 0], dtype=torch.bool)
        if reading.person_speed_scale is not None:
            slowed = slowed | (reading.person_speed_scale < 1)
        if reading.stop is not None:
            slowed = slowed | reading.stop
        if reading.distances is not None and report.constraints is not None:
            config = self.safety.config
            slowed = slowed | people_bind(reading.distances, sent, report.constraints, config)
        return slowed

    def _explained(
        self, reading: ArmReading, report: ArmReport, velocity: Tensor, sent: Tensor
    ) -> ArmReport:
        """The report with what the safety filter takes from a push."""
        J, scale = reading.jacobian, reading.person_speed_scale
        slowed = torch.zeros_like(sent[..., 0], dtype=torch.bool)
        if scale is not None:
            slowed = slowed | (scale < 1)
        config, distances = self.safety.config, reading.distances
        if distances is not None and config.constraints is not None:
            slowed = slowed | closes_in(distances, sent, config)
        motion = null_projection(J, velocity), null_projection(J, sent)
        return report._replace(slowed_by_people=slowed, null_motion=motion)


def _off_path(state: ArmLoopState) -> ArmLoopState:
    """The state of a loop that follows no path in this step."""
    return replace(state, path=replace(state.path, followed=torch.zeros_like(state.aside)))


def _scaled(velocity: Tensor, scale: Tensor | None) -> Tensor:
    return velocity if scale is None else scale.unsqueeze(-1) * velocity


def _twist(J: Tensor, joint_velocity: Tensor) -> Tensor:
    """Velocity of the end effector (linear [m/s], angular [rad/s])."""
    return (J @ joint_velocity.unsqueeze(-1)).squeeze(-1)


def _where(
    mask: Bool[Tensor, "*batch"], function: Callable[[Any], Any], arguments: Any, otherwise: Any
) -> Any:
    """Results of a batched function where a mask holds, elsewhere given values.

    The function sees the selected elements of the batch only, which saves its time.

    Args:
        mask: Elements for which to call the function.
        function: From a pytree of tensors to one; its batch dimensions lead.
        arguments: Pytree for the whole batch.
        otherwise: Results elsewhere, of the structure of the function's.
    """
    if not bool(mask.any()):
        return otherwise
    if bool(mask.all()):
        return function(arguments)
    rows = mask.nonzero(as_tuple=True)
    part = function(_pytree.tree_map(lambda x: x[rows], arguments))
    return _pytree.tree_map(lambda x, new: x.index_put(rows, new), otherwise, part)
