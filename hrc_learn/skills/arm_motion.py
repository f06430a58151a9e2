"""Motions of the arm: resolved rates, straight lines, inverse kinematics of a goal; and how
policies and teleoperators command positions, which are tracked by velocities.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.controller import (
    ActionChunkFilter,
    ActionChunkState,
    SafetyConfig,
    SafetyFilter,
    SafetyState,
)
from hrc_learn.geometry import Pose, minimum_jerk, quaternion
from hrc_learn.geometry.numerics import null_projection
from hrc_learn.kinematics import (
    SINGULAR_BELOW,
    SerialChain,
    panda,
    pseudo_inverse,
    singularity_damping,
)
from hrc_learn.kinematics import (
    Arm as ArmModel,
)
from hrc_learn.protocols import Arm, ArmState

# Mean speed of turning along a straight line, where that takes longer than the way [rad/s].
_TURNING_SPEED = 0.6
# Of Newton's method, which doubles the digits each time: from 1 cm to below 1e-9 m.
_ITERATIONS = 4


def resolved_rate(
    jacobian: Float[Tensor, "*batch rows joints"],
    twist: Float[Tensor, "*batch rows"],
    null_velocity: Float[Tensor, "*batch joints"],
) -> Float[Tensor, "*batch joints"]:
    """Joint velocities for a given twist, as close as possible to given joint velocities.

    u = J^+ twist + N null_velocity. J^+ is damped near singularities, N is not: nowhere does
    null-space motion move the end effector.

    Args:
        jacobian: Geometric Jacobian of the end effector, or the rows of it that are led.
        twist: Linear [m/s] and angular [rad/s] velocity of the end effector, or of those.
        null_velocity: Desired joint velocities; only their null-space part acts [rad/s].
    """
    return task_rate(jacobian, twist) + null_projection(jacobian, null_velocity)


def task_rate(
    jacobian: Float[Tensor, "*batch rows joints"], twist: Float[Tensor, "*batch rows"]
) -> Float[Tensor, "*batch joints"]:
    """`resolved_rate` of the task alone: the least joint velocity for a twist [rad/s].

    Args:
        jacobian: Geometric Jacobian of the end effector.
        twist: Linear [m/s] and angular [rad/s] velocity of the end effector.
    """
    J_pinv = pseudo_inverse(jacobian, singularity_damping(jacobian))
    return (J_pinv @ twist.unsqueeze(-1)).squeeze(-1)


# What a null-space motion may ask of the arm: acceleration of the end effector that has to be
# made up for [m/s^2], a radian counting for 0.1 m. Servos that are 10 ms later than known,
# pulled back with 4 1/s, leave 0.5 mm of it.
_BENDING, _METRES_PER_RADIAN = 0.2, 0.1
_TINY_STEP = 1e-4
# Fastest that a person moves the elbow [m/s], the reduced speed of ISO 10218-1:2011, 3.23; and
# a joint [rad/s]: it stops within 0.2 rad, by the part of its acceleration that a push may use.
_GUIDED_SPEED, _GUIDED_JOINT = 0.25, 1.0
LOOK_AHEAD = 0.15
"""How far ahead of a null-space motion to look [s]: an elbow at 1 m/s stops within 0.1 s."""
# Which parts of the motion, or of the way, are tried.
_SHARES = torch.linspace(0.0, 1.0, 6, dtype=torch.float64)


def null_space_slowdown(
    chain: SerialChain,
    joint_position: Float[Tensor, "*batch joints"],
    null_velocity: Float[Tensor, "*batch joints"],
) -> Float[Tensor, "*batch"]:
    """Fraction of a null-space motion at which the arm can keep its end effector in place.

    The null space bends: a motion along it at the speed s takes the end effector along with
    the acceleration s^2 c, with c the change of J along the motion times the motion, which the
    joints make up for, late as they are. Besides, neither the elbow nor a joint is fast: near
    singularities, where self-motions are, joints could turn far before they stop.

    Args:
        chain: The arm.
        joint_position: [rad]
        null_velocity: In the null space of the Jacobian there [rad/s].

    Returns:
        At most 1.
    """
    # Now, and where the arm will be once it could have slowed down.
    times = null_velocity.new_tensor([0.0, LOOK_AHEAD])
    times = torch.stack([times, times + _TINY_STEP])
    steps = times.reshape(2, 2, *(1 for _ in null_velocity.shape)) * null_velocity
    origins, (J, beyond) = chain.joint_origins_and_jacobian(joint_position + steps)
    bending = ((beyond - J) @ null_velocity.unsqueeze(-1)).squeeze(-1) / _TINY_STEP
    scale = bending.new_tensor([1.0] * 3 + [_METRES_PER_RADIAN] * 3)
    excess = torch.linalg.vector_norm(scale * bending, dim=-1).amax(0) / _BENDING
    moved = torch.linalg.vector_norm(origins[1, 0] - origins[0, 0], dim=-1)
    fastest = moved.amax(-1) / _TINY_STEP / _GUIDED_SPEED
    fastest = torch.maximum(fastest, null_velocity.abs().amax(-1) / _GUIDED_JOINT)
    return torch.minimum(excess.clamp(min=1.0) ** -0.5, 1 / fastest).clamp(max=1.0)


# Smallest singular values between which a null-space motion towards a singularity fades: below
# the lower one the task itself is damped.
_SINGULAR, _REGULAR = SINGULAR_BELOW, 1.6 * SINGULAR_BELOW


def singularity_fade(
    chain: SerialChain,
    joint_position: Float[Tensor, "*batch joints"],
    null_velocity: Float[Tensor, "*batch joints"],
) -> Float[Tensor, "*batch"]:
    """Fraction of a null-space motion that does not take an arm into a singularity.

    Args:
        chain: The arm.
        joint_position: [rad]
        null_velocity: In the null space of the Jacobian there [rad/s].

    Returns:
        1 away from singularities and on the way out of one, 0 on the way into one.
    """
    # On the way too: beyond a singularity it is regular again.
    ahead = joint_position + 2 * LOOK_AHEAD * _shares_of(null_velocity)
    now, *later = torch.linalg.svdvals(chain.jacobian(ahead))[..., -1]
    least = torch.stack(later).amin(0)
    fade = ((least - _SINGULAR) / (_REGULAR - _SINGULAR)).clamp(0, 1)
    return torch.where(least >= now, 1.0, fade)


def _shares_of(velocity: Float[Tensor, "*batch joints"]) -> Tensor:
    """Parts of a motion, none and all among them: (shares, *batch, joints)."""
    return _SHARES.to(velocity).reshape(-1, *(1 for _ in velocity.shape)) * velocity


# Part of a correction below which it does not lie in the null space [rad/s].
_NOTHING = 1e-6


def null_space_giving_way(
    jacobian: Float[Tensor, "*batch 6 joints"],
    task: Float[Tensor, "*batch joints"],
    null: Float[Tensor, "*batch joints"],
    lower: Float[Tensor, "*batch joints"],
    upper: Float[Tensor, "*batch joints"],
) -> Float[Tensor, "*batch joints"]:
    """The null-space velocity nearest to a given one with which no joint leaves its bounds.

    A person who pushes an arm to a limit would else leave its task no room: the null space
    gives way to the task. Along one direction of the null space, which for seven joints is all
    of it. Where none fits, what exceeds the bounds least.

    Args:
        jacobian: Of the end effector.
        task: Joint velocity of the task, which goes on in any case [rad/s].
        null: Wanted joint velocity in the null space [rad/s].
        lower: Lowest velocity [rad/s].
        upper: Highest velocity [rad/s].
    """
    velocity = task + null
    missing = velocity.clamp(lower, upper) - velocity
    if not bool(missing.any()):
        return null
    along = null_projection(jacobian, missing)
    size = along.abs()
    moving = size > _NOTHING * size.amax(-1, keepdim=True)
    slope = torch.where(moving, along, 1.0)
    at_lower, at_upper = (lower - velocity) / slope, (upper - velocity) / slope
    least = torch.where(moving, torch.minimum(at_lower, at_upper), -math.inf).amax(-1)
    most = torch.where(moving, torch.maximum(at_lower, at_upper), math.inf).amin(-1)
    share = torch.where(least <= most, least, (least + most) / 2)
    share = torch.where(along.norm(dim=-1) < _NOTHING, 0.0, share)
    return null + share.unsqueeze(-1) * along


# At which an arm at the margin may still close in [m/s], down to so far within [m]: one that
# slides along what is around it would else stop and go with every reading, its task as well.
_SLIDING, _DEEPEST = 0.002, 0.005


class ClearMotion(NamedTuple):
    """A null-space motion that keeps an arm clear of what is around it."""

    null: Float[Tensor, "*batch joints"]
    """[rad/s]"""
    waits: Bool[Tensor, "*batch"]
    """Whether the task alone takes the arm nearer than the margin: then it has to wait."""
    distance: Float[Tensor, "*batch"]
    """Of the arm as it is now from what it must not meet [m]."""


def kept_clear(
    joint_position: Float[Tensor, "*batch joints"],
    task: Float[Tensor, "*batch joints"],
    null: Float[Tensor, "*batch joints"],
    clearance: Callable[[Float[Tensor, "*batch joints"]], Float[Tensor, "*batch"]],
    margin: float,
    look_ahead: float = LOOK_AHEAD,
) -> ClearMotion:
    """As much of a null-space motion as keeps the arm clear of what is around it.

    Args:
        joint_position: Now [rad].
        task: Joint velocity of the task, which goes on in any case [rad/s].
        null: That of the null space [rad/s].
        clearance: Distance of an arm at given joint positions from what it must not meet [m].
        margin: Distance to keep [m]. Where the task alone leaves less, the null space takes
            no more of it.
        look_ahead: Time in which the motion stops before the margin, as an exponential does
            [s].
    """
    ahead = joint_position + look_ahead * (task + _shares_of(null))
    now, without, *_ = every = clearance(torch.cat([joint_position[None], ahead]))
    waits = without < torch.clamp(now, max=margin)
    if bool((every >= margin).all()):
        return ClearMotion(null, waits, now)
    closing = without - every[2:]
    room = without - margin
    allowed = room.clamp(min=0.0) + look_ahead * _SLIDING * (1.0 + room / _DEEPEST).clamp(
        0.0, 1.0
    )
    # Closing in grows with the share: where it is too fast, so much less of it.
    shares = _SHARES[1:].to(closing).reshape(-1, *(1 for _ in now.shape))
    share = torch.where(closing > allowed, shares * allowed / closing, 1.0).amin(0)
    return ClearMotion(share.unsqueeze(-1) * null, waits, now)


class StraightLine:
    """A motion of the end effector on a straight line, from rest to rest.

    Attributes:
        duration: [s]
    """

    def __init__(self, start: Pose, goal: Pose, speed: float):
        """Plan it.

        Args:
            start: First pose.
            goal: Last pose.
            speed: Mean speed of the end effector [m/s].
        """
        self._start, self._twist = start, start.twist_to(goal)
        distance, turn = float(self._twist[:3].norm()), float(self._twist[3:].norm())
        # Not below 0.3 s: a short motion would need accelerations beyond the safety filter's.
        self.duration = max(distance / speed, turn / _TURNING_SPEED, 0.3)

    def at(self, time: float) -> tuple[Pose, Float[Tensor, "6"]]:
        """Pose and twist (linear [m/s], angular [rad/s]) at a time since the start [s]."""
        s, slope = minimum_jerk(time / self.duration)
        turned = quaternion.multiply(
            quaternion.exp(s * self._twist[3:]), self._start.orientation
        )
        pose = Pose(self._start.position + s * self._twist[:3], turned)
        return pose, self._twist * (slope / self.duration)


def joint_line(
    start: Float[Tensor, " joints"], goal: Float[Tensor, " joints"], speed: float, dt: float
) -> Float[Tensor, "steps joints"]:
    """Joint positions on a straight line in joint space, from rest to rest.

    Args:
        start: First [rad].
        goal: Last [rad].
        speed: Largest speed of any joint [rad/s].
        dt: Time between samples [s].
    """
    # A minimum jerk motion peaks at 1.875 times its mean speed.
    duration = max(1.875 * float((goal - start).abs().max()) / speed, dt)
    steps = round(duration / dt) + 1
    progress = torch.tensor(
        [minimum_jerk(k * dt / duration)[0] for k in range(steps + 1)], dtype=start.dtype
    )
    return torch.lerp(start, goal, progress[:, None])


def nearest_configuration(
    goal: Pose,
    near: Float[Tensor, "*#batch joints"],
    samples: int = 57,
    robot: ArmModel = panda,
) -> Float[Tensor, "*batch joints"]:
    """Joint positions that reach poses, as near as can be to given ones.

    Args:
        goal: Poses of the tool centre point.
        near: Joint positions [rad].
        samples: Solutions sought among, where there are any number of them.
        robot: The arm.

    Raises:
        UnreachableError: No joint positions within the limits reach a pose.
    """
    return robot.inverse(goal, near=near, samples=samples)


def joints_near(
    chain: SerialChain, pose: Pose, near: Float[Tensor, " joints"]
) -> Float[Tensor, " joints"]:
    """Joint positions with the end effector at a pose, as near as can be to given ones [rad].

    Args:
        chain: Kinematics of the arm.
        pose: Of the end effector. Out of reach: positions that come closer.
        near: Joint positions, a centimetre or so away [rad].
    """
    q = near
    for _ in range(_ITERATIONS):
        now, J = chain.forward_and_jacobian(q)
        q = q + task_rate(J, now.twist_to(pose))
    return q


@dataclass(frozen=True, kw_only=True)
class PositionServoConfig:
    """How positions are tracked."""

    gain: float = 8.0
    """Decay rate of the tracking error [1/s]."""
    lag: float = 0.1
    """Largest tracking error of a joint; beyond, the motion restarts where the arm is [rad]."""
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    """The safety filter, which has the last word."""

    def __post_init__(self) -> None:
        if not (self.gain > 0 and self.lag > 0):
            raise ValueError(
                f"gain and lag must be positive, but are {self.gain} and {self.lag}."
            )


class PositionServo:
    """Tracks joint positions, or poses of the end effector, by velocities within the limits.

    Positions that keep the limits are reached when the next one is due. The others are
    tracked as `ActionChunkFilter` does, so a target that jumps makes no jump of the arm.

    Attributes:
        safety: State of the safety filter, with its counts of interventions.
        limits: Within which positions are reached when the next one is due.
    """

    def __init__(
        self, chain: SerialChain, arm: Arm, dt: float, config: PositionServoConfig | None = None
    ):
        """Connect to the arm at rest.

        Args:
            chain: Its kinematics.
            arm: Its driver.
            dt: Time between targets [s].
            config: How they are tracked.

        Raises:
            ValueError: dt is longer than the safety filter can guarantee its limits for.
        """
        self._chain, self._arm, self._dt = chain, arm, dt
        self._config = config = config or PositionServoConfig()
        self._filter = SafetyFilter(chain.limits, config.safety)
        if not 0 < dt <= config.safety.longest_step:
            raise ValueError(
                f"targets must come within {config.safety.longest_step:g} s of each other, but "
                f"dt is {dt:g} s: raise the rate of frames."
            )
        # Within the limits of the safety filter, which then has nothing to do.
        limits, margin = chain.limits, 1.5 * config.safety.margin
        self.limits = replace(
            limits,
            lower=limits.lower + margin,
            upper=limits.upper - margin,
            acceleration=self._filter.barrier.acceleration,
            jerk=self._filter.barrier.jerk,
        )
        self._smoother = ActionChunkFilter(self.limits, dt)
        self.safety: SafetyState
        self._motion: ActionChunkState
        self.restart()

    def restart(self) -> None:
        """Restart where the arm is, at rest."""
        q = torch.from_numpy(self._arm.read().joint_position)
        self.safety = self._filter.initial_state(q)
        self._motion = self._smoother.initial_state(q)

    def follow(
        self, target: Float[np.ndarray, " joints"]
    ) -> tuple[ArmState, Float[np.ndarray, " joints"]]:
        """Command the velocity with which the target is reached, or neared, within dt.

        Args:
            target: Joint positions [rad]. NaN leaves a joint to its present motion.

        Returns:
            The reading of the arm it is based on, and the commanded positions [rad]. The
            caller lets dt pass.
        """
        state = self._arm.read()
        q, before = torch.from_numpy(state.joint_position), self._motion
        _, self._motion, _ = self._smoother(
            torch.from_numpy(np.asarray(target, dtype=float))[None], before
        )
        wanted = self._motion.velocity + self._config.gain * (before.position - q)
        velocity, self.safety, _ = self._filter.step(
            self.safety, q, wanted, self._dt, jacobian=self._chain.jacobian(q)
        )
        self._arm.command(velocity.numpy())
        if float((before.position - q).abs().max()) > self._config.lag:
            self._motion = self._smoother.initial_state(q + velocity * self._dt, velocity)
        return state, self._motion.position.numpy()

    def joints_at(self, pose: Pose) -> Float[np.ndarray, " joints"]:
        """Joint positions, near the commanded ones, with the end effector at a pose [rad].

        Args:
            pose: Of the end effector. Out of reach: positions that come closer.
        """
        return joints_near(self._chain, pose, self._motion.position).numpy()
