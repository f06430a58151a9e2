"""Tracking of a moving pose of the end effector while the null space moves."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller.arm_loop_state import (
    ArmLoopConfig,
    ArmLoopState,
    ArmReading,
    Limitation,
)
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
from hrc_learn.kinematics import SerialChain
from hrc_learn.pytree import apply_where


class TrackedPose(NamedTuple):
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
        """Limitations of the null space, for the report."""
        return (
            Limitation("speed", self.slowdown),
            Limitation("obstacle", self.clear, distance=self.distance),
            Limitation("joint_limit", self.within, joint=self.joint),
        )


class PoseTracking:
    """Joint velocities for a pose of the end effector; the null space yields to a push.

    u = J^+ (twist + gain error) + N w, with w reduced until the arm is slow enough to keep the
    pose, clear of obstacles, and leaves the task its margin before the joint limits.
    """

    def __init__(
        self,
        chain: SerialChain,
        config: ArmLoopConfig,
        clearance: Clearance | None,
    ):
        """Put the parts together.

        Args:
            chain: Kinematics and limits of the arm.
            config: Settings of the loop.
            clearance: Distance of the arm from obstacles; None: there are none.
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
            which: Elements of the batch that track it; the others are left out.
            slows: Limit the null-space velocity by `null_space_slowdown`: a push and a path
                together may bend the null space more than the push alone, which is eased.
        """
        q, config = reading.joint_position, self.config
        zero = torch.zeros_like(q[..., 0])
        never = torch.zeros_like(zero, dtype=torch.bool)

        def track(part: tuple[Any, ...]) -> TrackedPose:
            q, velocity, here, pose, twist, null_velocity = part
            # The null space is that of the joints by the time the arm follows.
            J = self.chain.jacobian(q + config.command_delay * velocity)
            correction = config.pose_gain * here.twist_to(pose)
            task, null = resolved_rate(J, twist + correction, null_velocity)
            one, moves = torch.ones_like(q[..., 0]), (null != 0).any(-1)
            blocked, distance = torch.zeros_like(moves), torch.full_like(one, torch.inf)
            slowdown, clear = one, one
            if slows:
                slowdown = self._slowdown(q, null)
                null = slowdown.unsqueeze(-1) * null
            if self.clearance is not None and bool(moves.any()):
                kept = kept_clear(q, task, null, self.clearance, config.clearance)
                clear = fraction_kept(null, kept.null)
                distance, blocked = kept.distance, kept.blocked & moves
                null = torch.where(moves.unsqueeze(-1), kept.null, null)
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
        """Null-space velocity that leaves the task its margin before the joint limits."""
        gives_way = null_space_giving_way(J, task, null, *margin)
        gives_way = apply_where(
            (gives_way != null).any(-1),
            lambda part: self._slowdown(*part).unsqueeze(-1) * part[1],
            (q, gives_way),
            gives_way,
        )
        return scale_null_space(task, gives_way, *self.safety.velocity_bounds(q))


def twist_of(
    J: Float[Tensor, "*batch 6 n"], joint_velocity: Float[Tensor, "*batch n"]
) -> Float[Tensor, "*batch 6"]:
    """Velocity of the end effector (linear [m/s], angular [rad/s])."""
    return (J @ joint_velocity.unsqueeze(-1)).squeeze(-1)
