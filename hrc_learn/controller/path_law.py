"""Joint velocities that track poses and joint paths while a push may move the null space.

A path advances, waits or is retraced, depending on how well an arm off the path can follow.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import joint_path
from hrc_learn.controller.arm_loop_state import (
    ArmLoopConfig,
    ArmLoopState,
    ArmReading,
    FollowPath,
    Limitation,
    PathState,
    WantedMotion,
)
from hrc_learn.controller.joint_path import DirectReturn
from hrc_learn.controller.null_space_motion import (
    Clearance,
    fraction_kept,
    kept_clear,
    limiting_joint,
    null_space_giving_way,
    null_space_slowdown,
)
from hrc_learn.controller.resolved_rate import resolved_rate, scale_null_space
from hrc_learn.controller.safety_filter import SafetyFilter
from hrc_learn.geometry import Pose
from hrc_learn.geometry.numerics import null_projection
from hrc_learn.kinematics import SerialChain
from hrc_learn.pytree import apply_where

# `_ASIDE`: when a path begins, joints farther than this from its start are off the path [rad].
# `_MOVED`: near people, joints farther than this from their path in the null space are off the
# path [rad]. Where a person stopped a turn of the base at 0.8 rad/s, the null space came to
# rest between 0.1 and 0.2 rad.
# `_BACK`: joints that were off the path are back on it within this distance [rad]. Servos lag
# by 0.03 rad at the speed of transfers.
_ASIDE, _MOVED, _BACK = 0.1, 0.2, 0.03


class TrackedPose(NamedTuple):
    """Joint velocity that tracks a pose while the null space yields."""

    joint_velocity: Tensor
    blocked: Tensor
    slowdown: Tensor
    clear: Tensor
    """Fraction of the null-space velocity that obstacles permit."""
    distance: Tensor
    within: Tensor
    """Fraction of the remaining null-space velocity that joint limits permit."""
    joint: Tensor
    """Index of the joint that limits the velocity most."""

    def limitations(self) -> tuple[Limitation, ...]:
        """Limitations of the null space, for the report."""
        return (
            Limitation("speed", self.slowdown),
            Limitation("obstacle", self.clear, distance=self.distance),
            Limitation("joint_limit", self.within, joint=self.joint),
        )


class PathTarget(NamedTuple):
    """Point of a joint path."""

    goal: Tensor
    """Joint positions [rad]."""
    velocity: Tensor
    """Joint velocity along the path [rad/s]."""
    narrow: Tensor
    """True where the joints cannot leave the path."""
    narrow_ahead: Tensor
    """True where the path becomes narrow within its stopping distance."""


class OffPath(NamedTuple):
    """State of joints off their path, and the parts of their null-space velocity."""

    aside: Tensor
    lost: Tensor
    fraction: Tensor
    """Fraction of the push that is followed."""
    push: Tensor
    """Part of the push that is followed [rad/s]."""
    back: Tensor
    """Velocity of the return [rad/s]."""


class PathLaw:
    """Joint velocities for poses of the end effector and along joint paths.

    Where the null space yields to a push, the joint velocity is

        u = J^+ (twist + gain error) + N w

    with the pose error `error` and the joint velocity w of the push. The law reduces w until
    the arm keeps the pose, stays clear of obstacles, and leaves the task a margin before the
    joint limits. In this way, joints off their path track its poses.
    """

    def __init__(self, chain: SerialChain, config: ArmLoopConfig, clearance: Clearance | None):
        """Put the parts together.

        Args:
            chain: Kinematics and limits of the arm.
            config: Settings of the loop.
            clearance: Distance of the arm from obstacles; None: there are no obstacles.
        """
        self.chain, self.config, self.clearance = chain, config, clearance
        self.safety = SafetyFilter(chain, config.safety)
        margin = config.safety.margin + config.limit_margin
        self.task_margin = SafetyFilter(chain, replace(config.safety, margin=margin))

    def track(
        self,
        state: ArmLoopState,
        reading: ArmReading,
        pose: Pose,
        twist: Tensor,
        null_velocity: Tensor,
        which: Tensor,
        *,
        slows: bool,
    ) -> TrackedPose:
        """Track a moving pose while the null space moves.

        Args:
            state: State of the loop.
            reading: Newest reading.
            pose: Pose that the end effector should have.
            twist: Velocity of that pose.
            null_velocity: Joint velocity whose null-space part is wanted [rad/s].
            which: Elements of the batch that track the pose; the others get a velocity of zero.
            slows: True to limit the null-space velocity by `null_space_slowdown`: the velocity
                of a push alone is already limited, but its sum with the velocity of a path is
                not.
        """
        q, config = reading.joint_position, self.config
        zero = q.new_zeros(q.shape[:-1])
        never = torch.zeros_like(zero, dtype=torch.bool)

        def track(part: tuple[Any, ...]) -> TrackedPose:
            q, velocity, here, pose, twist, null_velocity = part
            # Jacobian at the joint positions predicted for the time when the arm follows the
            # command.
            J = self.chain.jacobian(q + config.command_delay * velocity)
            correction = config.pose_gain * here.twist_to(pose)
            task, null = resolved_rate(J, twist + correction, null_velocity)
            one, moves = q.new_ones(q.shape[:-1]), null.norm(dim=-1) > 0
            blocked, distance = torch.zeros_like(moves), torch.full_like(one, torch.inf)
            slowdown, clear = one, one
            if slows:
                slowdown = self._slowdown(q, null)
                null = slowdown.unsqueeze(-1) * null
            if self.clearance is not None and bool(moves.any()):
                kept = kept_clear(q, task, null, self.clearance, config.clearance)
                clear = fraction_kept(null, kept.null)
                distance, blocked = kept.distance, kept.blocked & moves
                null = kept.null
            margin = self.task_margin.velocity_bounds(q)
            within = self._within_limits(q, J, task, null, margin)
            return TrackedPose(
                joint_velocity=task + within,
                blocked=blocked,
                slowdown=slowdown,
                clear=clear,
                distance=distance,
                within=fraction_kept(null, within),
                joint=limiting_joint(task + null, *margin),
            )

        return apply_where(
            which,
            track,
            (q, state.safety.velocity, reading.pose, pose, twist, null_velocity),
            TrackedPose(
                joint_velocity=torch.zeros_like(q),
                blocked=never,
                slowdown=zero + 1,
                clear=zero + 1,
                distance=zero + torch.inf,
                within=zero + 1,
                joint=never.to(torch.int64),
            ),
        )

    def _slowdown(self, q: Tensor, null: Tensor) -> Tensor:
        return null_space_slowdown(self.chain, q, null, self.config.elbow_speed)

    def _within_limits(
        self, q: Tensor, J: Tensor, task: Tensor, null: Tensor, margin: tuple[Tensor, Tensor]
    ) -> Tensor:
        """Null-space velocity reduced so that the task keeps its margin before joint limits."""
        gives_way = null_space_giving_way(J, task, null, *margin)
        gives_way = apply_where(
            (gives_way - null).norm(dim=-1) > 0,
            lambda part: self._slowdown(*part).unsqueeze(-1) * part[1],
            (q, gives_way),
            gives_way,
        )
        return scale_null_space(task, gives_way, *self.safety.velocity_bounds(q))

    def begin(
        self,
        state: ArmLoopState,
        joint_position: Float[Tensor, "*batch n"],
        request: FollowPath,
    ) -> ArmLoopState:
        """State at the start of joint paths.

        Args:
            state: State of the last step.
            joint_position: Joint positions now [rad].
            request: The paths.
        """
        paths, which = request.paths, request.path
        path = PathState.none(joint_position, state.path.pose)
        goal, last = paths.position[which, 0], paths.last[which].to(path.last)
        path = replace(path, goal=goal, last=last)
        aside = (goal - joint_position).norm(dim=-1) > _ASIDE
        return replace(state, aside=aside, lost=torch.zeros_like(aside), path=path)

    def go_on(self, state: ArmLoopState, reading: ArmReading) -> PathState:
        """Progress along the path, one step later."""
        path, q, dt = state.path, reading.joint_position, self.config.dt
        moves = path.followed & ~path.finished
        if not bool(moves.any()):
            return path
        pushed, zero = state.pushed, torch.zeros_like(path.rate)
        off, counts = (path.goal - q).norm(dim=-1), ~pushed & state.pace.at_full_speed
        waited, nearest = path.waiting(off, counts, self.config.back_after, dt)
        waited = torch.where(state.aside, waited, 0.0)
        held = torch.where(pushed, path.longer(path.held, dt), 0.0)
        # Joints that cannot return to this sample may be able to return to an earlier one, near
        # which they left the path.
        backs = (waited > self.config.back_after) & (path.progress > 0)

        def astray(part: tuple[Any, ...]) -> tuple[Tensor, Tensor]:
            here, there, twist, *motion = part
            ratio = joint_path.deviation_ratio(here.twist_to(there), twist)
            return ratio, joint_path.nears_singularity(self.chain, *motion)

        ratio, singular = apply_where(
            state.aside,
            astray,
            (reading.pose, path.pose, path.twist, q, state.safety.velocity),
            (zero, torch.zeros_like(state.aside)),
        )
        stops = ~backs & state.aside & (state.lost | path.narrow_ahead | singular)
        ratio = torch.where((path.blocked & state.aside) | stops, torch.inf, ratio)
        rate = joint_path.changed_rate(path.rate, 2.0 - ratio, dt, torch.where(backs, -1, 1))
        progress = (path.progress + rate * state.pace.scale).clamp(min=0)
        then = {"progress": progress, "rate": rate, "waited": waited, "nearest": nearest}
        return _changed_where(moves, path, **then, held=held)

    def follow(
        self, state: ArmLoopState, reading: ArmReading, request: FollowPath
    ) -> tuple[WantedMotion, ArmLoopState]:
        """Joint velocity on a joint path, off the path, or directly back to it."""
        q, config = reading.joint_position, self.config
        path = self._returning(state.path, q, request)
        direct = path.direct_return
        target = self._target(path, state.pace.speed_override, request)
        off = self._off_path(state, reading, path, target)
        pose, twist = self._target_motion(target, off.aside)

        along = target.velocity + config.pose_gain * (target.goal - q)
        null = target.velocity + off.back + off.push
        tracked = self.track(state, reading, pose, twist, null, off.aside, slows=True)
        velocity = torch.where(off.aside.unsqueeze(-1), tracked.joint_velocity, along)
        straight = config.pose_gain * (direct.joint_position() - q)
        velocity = torch.where(direct.active.unsqueeze(-1), straight, velocity)

        limitations = ()
        if reading.explain:
            limitations = self._path_limitations(state, reading, path, target, off)
            limitations += tracked.limitations()
        passed = torch.where(direct.active, config.dt * state.pace.speed_override, 0.0)
        path = replace(
            path,
            followed=~direct.active,
            goal=target.goal,
            pose=pose,
            twist=twist,
            blocked=tracked.blocked | (path.blocked & state.pushed & ~off.aside),
            narrow_ahead=target.narrow_ahead,
            direct_return=replace(direct, time=direct.time + passed),
        )
        state = replace(
            state, return_velocity=off.back, aside=off.aside, lost=off.lost, path=path
        )
        return WantedMotion(velocity, limitations, pose, target.goal), state

    def _target(
        self, path: PathState, speed_override: Tensor, request: FollowPath
    ) -> PathTarget:
        """Points of the paths to track now."""
        paths, which, config = request.paths, request.path, self.config
        rate = path.rate * speed_override
        # Velocity of the path at the time when the arm follows the command.
        later = (path.progress + rate * config.command_delay / config.dt).clamp(min=0)
        velocity = rate.unsqueeze(-1) * paths.interpolated(paths.velocity, which, later)
        sample = torch.minimum(path.progress.long(), paths.last[which])
        return PathTarget(
            goal=paths.interpolated(paths.position, which, path.progress),
            velocity=velocity.masked_fill(path.finished.unsqueeze(-1), 0.0),
            narrow=paths.narrow[which, sample],
            narrow_ahead=paths.narrow_ahead[which, sample],
        )

    def _target_motion(self, target: PathTarget, aside: Tensor) -> tuple[Pose, Tensor]:
        """Pose of the end effector on the path, and its twist along the path. The twist is zero
        for arms on their path.
        """
        ahead = target.goal + self.config.command_delay * target.velocity
        twist = apply_where(
            aside,
            lambda part: twist_of(self.chain.jacobian(part[0]), part[1]),
            (ahead, target.velocity),
            target.goal.new_zeros(*aside.shape, 6),
        )
        return self.chain.forward(target.goal), twist

    def _off_path(
        self, state: ArmLoopState, reading: ArmReading, path: PathState, target: PathTarget
    ) -> OffPath:
        """State of joints off their path, with the push to follow and the return velocity."""
        config, error = self.config, target.goal - reading.joint_position
        direct = path.direct_return.active
        pushed, aside = state.pushed & ~direct, state.aside & ~direct
        null_error = null_projection(reading.jacobian, error)
        # Near people, the constraint layer moves joints off their path. Joints that lag for
        # another reason are in contact with an object: they do not count as off the path.
        moved = _MOVED if reading.people is not None else torch.inf
        leaves = pushed | aside | (null_error.norm(dim=-1) > moved)
        stays = (pushed & ~path.blocked) | (leaves & (error.norm(dim=-1) > _BACK))
        aside = (~target.narrow | aside) & stays
        lost, fraction = torch.zeros_like(aside), torch.ones_like(path.rate)
        # Joints return while the path waits for them and, if `after_push` is "return", also
        # after the push.
        returns = path.rate <= 0
        if config.after_push == "return":
            alignment = joint_path.return_alignment(null_error, error)
            lost = aside & joint_path.may_not_return(error, alignment, state.lost & ~pushed)
            fraction = joint_path.push_fraction(state.null_velocity, null_error, alignment)
            returns = returns | ~pushed
        null_error = null_error.masked_fill(~returns.unsqueeze(-1), 0.0)
        fastest = config.return_speed / null_error.norm(dim=-1, keepdim=True)
        back, last = fastest.clamp(max=config.pose_gain) * null_error, state.return_velocity
        back = last + min(config.dt / config.nullspace_rise, 1.0) * (back - last)
        return OffPath(
            aside=aside,
            lost=lost,
            fraction=fraction,
            push=fraction.unsqueeze(-1) * state.null_velocity,
            back=back.masked_fill(~aside.unsqueeze(-1), 0.0),
        )

    def _path_limitations(
        self,
        state: ArmLoopState,
        reading: ArmReading,
        path: PathState,
        target: PathTarget,
        off: OffPath,
    ) -> tuple[Limitation, ...]:
        """Limitations that the path imposes on a push."""
        J, direct, one = reading.jacobian, path.direct_return.active, torch.ones_like(path.rate)
        push = null_projection(J, state.null_velocity)
        kept = fraction_kept(push, null_projection(J, off.push) + off.back)
        kept = torch.where(off.aside, kept, 1.0)
        far = off.lost | (off.fraction < 1)
        bound = target.narrow & ~off.aside & ~direct
        return (
            Limitation("narrow_path", torch.where(bound, 0.0, one)),
            Limitation("too_far", torch.where(direct, 0.0, one)),
            Limitation("too_far", torch.where(far, kept, one)),
            Limitation("task_waits", torch.where(far, one, kept), mentioned=path.rate <= 0),
        )

    def _returning(
        self, path: PathState, joint_position: Tensor, request: FollowPath
    ) -> PathState:
        """State of the path, with direct returns started after a long wait and ended on
        arrival.
        """
        direct, dt = path.direct_return, self.config.dt
        arrived = direct.active & (direct.time > direct.duration + dt)
        if bool(arrived.any()):
            there = {"progress": direct.progress, "waited": 0.0, "nearest": torch.inf}
            path = _changed_where(arrived, path, **there, held=0.0)
            direct = replace(direct, active=direct.active & ~arrived)
        begins = path.waited > self.config.direct_return_after
        begins = begins & ~direct.active & ~direct.blocked
        if bool(begins.any()):
            direct = apply_where(
                begins,
                lambda part: DirectReturn.planned(
                    request.paths, *part, config=self.config, clearance=self.clearance
                ),
                (request.path, path.progress, joint_position),
                direct,
            )
        return replace(path, direct_return=direct)


def _changed_where(mask: Tensor, path: PathState, **values: Tensor | float) -> PathState:
    """The path, with other values of some fields where a mask is true."""
    changed = {
        name: torch.where(mask, value, getattr(path, name)) for name, value in values.items()
    }
    return replace(path, **changed)


def twist_of(
    J: Float[Tensor, "*batch 6 n"], joint_velocity: Float[Tensor, "*batch n"]
) -> Float[Tensor, "*batch 6"]:
    """Velocity of the end effector (linear [m/s], angular [rad/s])."""
    return (J @ joint_velocity.unsqueeze(-1)).squeeze(-1)
