"""Values of the arm loop: settings, readings, requests, state and report.

Readings, requests and states have any number of leading batch dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hrc_learn.controller.constraint_layer import Distances
from hrc_learn.controller.interface import Command, SafetyConfig, SafetyReport, SafetyState
from hrc_learn.controller.joint_path import DirectReturn, JointPaths
from hrc_learn.controller.null_space_motion import YieldingConfig
from hrc_learn.controller.task_pace import TaskPace, WayMakingConfig
from hrc_learn.geometry import Pose
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.protocols import Hindrance
from hrc_learn.pytree import pytree, static

# Joints count as stuck unless they come nearer to their path by this distance [rad]. The
# slowest returns need 1 s for this distance.
_NEARER = 0.05


@dataclass(frozen=True, kw_only=True)
class ArmLoopConfig(YieldingConfig):
    """Settings of the loop."""

    dt: float = 0.01
    """Control step [s]."""
    command_delay: float = 0.01
    """Time from a command until the arm follows it, including servo lag [s]. The default is the
    lag of the simulated servos; on real arms, networks and schedulers add to it."""
    limit_margin: float = 0.1
    """Range next to each joint limit into which the task may move a joint, but a push may not
    [rad]. It adds to the margin of the safety filter. A joint that crosses this range moves the
    end effector by a few centimetres."""
    speed: float = 1.0
    """Speed of the task relative to its planned speed, in (0, 1]. Use a low value for the first
    run on a real arm. Null-space motion is not slowed down
    while the joints are off their path."""
    longest_wait: float = 300.0
    """Longest time for which people may block or displace the arm before the task fails [s]."""
    back_after: float = 2.0
    """Time after which the path runs backwards if the joints come no nearer to it [s]."""
    direct_return_after: float = 20.0
    """Time without progress after which the joints return to their path directly [s]."""
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    """Settings of the safety filter, including those that describe the arm's driver."""
    way_making: WayMakingConfig | None = None
    """Source of null-space motion: a person's push, the repulsion from people near the arm, or
    both; None: a person's push."""

    unbounded = "longest_wait", "back_after", "direct_return_after"

    def __post_init__(self) -> None:
        super().__post_init__()
        positive = "dt", "longest_wait", "back_after", "direct_return_after"
        not_negative = "command_delay", "limit_margin"
        check_settings(self, positive=positive, not_negative=not_negative, fraction=["speed"])


@pytree
class WatchedPeople:
    """Distances of the arm from people near it, and the speed limits that result."""

    distances: Distances
    """Distances of the most urgent pairs; each pair is a capsule of the arm and a capsule of a
    body. The distances are reduced by the distance that people may have moved since the
    observation. They are NaN, and the arm brakes, if there is no observation or if people are
    close enough for a contact that is not allowed."""
    nearest: Float[Tensor, "*batch"]
    """Smallest distance between the observed people and the arm at its present joints [m]."""
    age: Float[Tensor, "*batch"]
    """Age of the observation [s]."""
    speed_scale: Float[Tensor, "*batch"]
    """Speed scale of the arm in every direction, 0 to 1."""
    speed_cap: Float[Tensor, "*batch"]
    """Cap on the speed of all parts of the arm [m/s]; infinite: no cap."""


@pytree
class ArmReading:
    """One reading of the arm and of the people near it.

    An arm whose joint positions or push are not finite brakes to rest.
    """

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
    load: Float[Tensor, "*batch 3"] | None = None
    """Far end of a load in the frame of the end effector [m]. The cap on the tool's speed also
    applies to this point. None: no load."""
    people: WatchedPeople | None = None
    """People near the arm: they slow the arm down, and the safety filter keeps the arm at a
    distance. None: people are not tracked."""
    stop: Bool[Tensor, "*batch"] | None = None
    """True where the arm must come to rest because of people; None: nowhere."""
    explain: bool = static(False)
    """True to report what limits the push."""


@pytree
class PathState:
    """Progress along a joint path, and how the last step tracked it."""

    progress: Float[Tensor, "*batch"]
    """Index of the path sample to track; a fractional index lies between two samples."""
    rate: Float[Tensor, "*batch"]
    """Speed along the path, relative to the path's own speed, -1 (backwards) to 1."""
    last: Float[Tensor, "*batch"]
    """Index of the last sample."""
    followed: Bool[Tensor, "*batch"]
    """True if the last step followed the path."""
    goal: Float[Tensor, "*batch n"]
    """Joint positions on the path that the last step tracked [rad]."""
    pose: Pose
    """Pose of the end effector at `goal`."""
    twist: Float[Tensor, "*batch 6"]
    """Velocity of `pose` along the path (linear [m/s], angular [rad/s])."""
    blocked: Bool[Tensor, "*batch"]
    """True if the arm is off its path and would collide if the path advanced. It stays true for
    joints on the path until a push ends: the path was planned past the obstacle."""
    narrow_ahead: Bool[Tensor, "*batch"]
    """True if the path comes near a singularity within its stopping distance. Near a
    singularity, the joints cannot leave the path."""
    waited: Float[Tensor, "*batch"]
    """Waiting time in which the joints came no nearer to the path [s]."""
    nearest: Float[Tensor, "*batch"]
    """Distance of the joints from the path when they last came nearer [rad]."""
    held: Float[Tensor, "*batch"]
    """Time for which the path has waited while the arm was pushed [s]."""
    direct_return: DirectReturn

    @classmethod
    def none(cls, joint_position: Float[Tensor, "*batch n"], pose: Pose) -> PathState:
        """State of an arm that follows no path.

        Args:
            joint_position: Joint positions [rad].
            pose: Pose of the end effector.
        """
        zero = joint_position.new_zeros(joint_position.shape[:-1])
        never = torch.zeros_like(zero, dtype=torch.bool)
        return cls(
            progress=zero,
            rate=zero + 1,
            last=zero - 1,
            followed=never,
            goal=joint_position,
            pose=pose,
            twist=zero.new_zeros(*zero.shape, 6),
            blocked=never,
            narrow_ahead=never,
            waited=zero,
            nearest=zero + torch.inf,
            held=zero,
            direct_return=DirectReturn.none(joint_position),
        )

    def longer(self, time: Float[Tensor, "*batch"], dt: float) -> Float[Tensor, "*batch"]:
        """A waiting time of the path, one step later [s].

        Time in which the path advances is subtracted: a path that stops and starts is stuck
        only if it rests for more than half of the time.
        """
        return (time + (1.0 - 2.0 * self.rate.clamp(min=0)) * dt).clamp(min=0)

    def waiting(
        self, off: Tensor, counts: Tensor, stuck_after: float, dt: float
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        """`waited` and `nearest`, one step later.

        Args:
            off: Distance of the joints from the path now [rad].
            counts: False for steps in which the arm is pushed or slowed down by people.
            stuck_after: Waiting time [s] after which joints stay stuck even if they come
                nearer.
            dt: Control step [s].
        """
        nearer = counts & (off < self.nearest - _NEARER) & (self.waited <= stuck_after)
        longer = torch.where(counts, self.longer(self.waited, dt), self.waited)
        waited = torch.where(nearer, 0.0, longer)
        return waited, torch.where(nearer | ~counts, off, self.nearest)

    @property
    def finished(self) -> Bool[Tensor, "*batch"]:
        """True once the last sample has been tracked."""
        return self.progress > self.last


@pytree
class ArmLoopState:
    """State of the loop between two steps."""

    safety: SafetyState
    pace: TaskPace
    null_velocity: Float[Tensor, "*batch n"]
    """Null-space velocity requested by a push, smoothed [rad/s]."""
    return_velocity: Float[Tensor, "*batch n"]
    """Null-space velocity back to the path, smoothed [rad/s]."""
    aside: Bool[Tensor, "*batch"]
    """True while the joints are off their path."""
    lost: Bool[Tensor, "*batch"]
    """True while null-space motion might take the joints to a posture other than the path's."""
    path: PathState

    @property
    def pushed(self) -> Bool[Tensor, "*batch"]:
        """True while the null space is pushed."""
        return self.null_velocity.norm(dim=-1) > 0


@pytree
class FollowPath:
    """Request to follow joint paths; the null space yields to a push and returns afterwards."""

    paths: JointPaths
    path: Int[Tensor, "*batch"]
    """Index of the path of each arm."""


@pytree
class TrackPose:
    """Request to track a moving pose of the end effector; the null space yields to a push."""

    pose: Pose
    twist: Float[Tensor, "*batch 6"]
    """Velocity of the pose (linear [m/s], angular [rad/s])."""


@pytree
class MoveJoints:
    """Request for a joint velocity."""

    joint_velocity: Float[Tensor, "*batch n"]
    """Joint velocity [rad/s]."""


type ArmRequest = FollowPath | TrackPose | MoveJoints | Command
"""Request of a task; a `Command` of the adaptive controller has passed a safety filter."""


class Limitation(NamedTuple):
    """Reduction of a push by one cause."""

    cause: Hindrance
    kept: Float[Tensor, "*batch"]
    """Fraction of the motion that remains, 0 to 1."""
    joint: Int[Tensor, "*batch"] | None = None
    """Index of the joint at its limit, from 0."""
    distance: Float[Tensor, "*batch"] | None = None
    """Distance from an obstacle [m]."""
    mentioned: Bool[Tensor, "*batch"] | None = None
    """True where the cause is reported although it reduces nothing."""


class ArmReport(NamedTuple):
    """Report of one step."""

    safety: SafetyReport
    limitations: tuple[Limitation, ...] = ()
    """Limitations of the push; empty unless the reading asks for an explanation."""
    goal: Pose | None = None
    """Pose that the end effector tracks."""
    path_joints: Float[Tensor, "*batch n"] | None = None
    """Joint positions on the path [rad]."""
    slowed_by_people: Bool[Tensor, "*batch"] | None = None
    """True where people near the arm slow it down; None: not explained."""
    null_motion: tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"]] | None = None
    """Null-space velocity before and after the safety filter [rad/s]; None: not explained."""


class WantedMotion(NamedTuple):
    """Joint velocity before the safety filter, with the parts of the report known so far."""

    joint_velocity: Tensor
    limitations: tuple[Limitation, ...] = ()
    goal: Pose | None = None
    path_joints: Tensor | None = None
