"""Null-space motions that an arm can follow without moving its end effector.

A person, or the repulsion from nearby bodies, requests a motion of the null space. The
functions here reduce this motion until the arm can follow it: slow enough to keep the end
effector in place, away from singularities, within the joint limits, clear of obstacles, and
without jumps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hrc_learn.controller.resolved_rate import scale_null_space
from hrc_learn.geometry.numerics import check_settings, null_projection
from hrc_learn.kinematics import SINGULAR_BELOW, SerialChain

LOOK_AHEAD = 0.15
"""Time ahead over which a null-space motion is checked [s]: about its stopping time."""

# `_BENDING`: largest acceleration of the end effector that a null-space motion may cause
# [m/s^2]. If servos lag 10 ms more than assumed, this acceleration moves the end effector by
# 0.5 mm at a pose gain of 4 1/s. `_METRES_PER_RADIAN`: length that counts as much as 1 rad.
_BENDING, _METRES_PER_RADIAN = 0.2, 0.1
_DIFFERENCE_STEP = 1e-4  # [s]
# `_GUIDED_SPEED`: highest speed of an elbow that a person guides [m/s], the reduced speed of
# ISO 10218-1:2025. `_GUIDED_FRACTION`: fraction of a speed cap that a guided elbow may use.
# Above this fraction the speed barrier, which allows for braking and delay, would slow the
# elbow down (on a Panda with a cap of 0.25 m/s, above 0.15 m/s).
_GUIDED_SPEED, _GUIDED_FRACTION = 0.25, 0.6
# Highest speed of a guided joint [rad/s]. With `_STOP_EFFORT`, every joint of a Panda stops
# within 0.11 rad.
_GUIDED_JOINT_SPEED = 1.0
# Fractions of a motion at which it is checked.
_FRACTIONS = torch.linspace(0.0, 1.0, 6, dtype=torch.float64)
# A motion towards a singularity fades out while the smallest singular value falls from
# `_REGULAR` to `_SINGULAR`. Below `_SINGULAR`, the task itself is damped.
_SINGULAR, _REGULAR = SINGULAR_BELOW, 1.6 * SINGULAR_BELOW
# Fractions of the acceleration limits with which null-space motions may speed up
# (`_PUSH_EFFORT`) and slow down (`_STOP_EFFORT`). The task needs the rest; if task and
# null-space motion together exceed the limits, the task slows down as well.
_PUSH_EFFORT, _STOP_EFFORT = 0.3, 0.6
# Lower bound on the null-space speed with which the arm looks ahead for singularities [rad/s].
_SLOW = 0.2
# The null-space part of a correction counts as zero if it is shorter than this [rad/s]. A joint
# takes no part in a correction if its entry is smaller than this, relative to the largest
# entry.
_NEGLIGIBLE = 1e-6
# `_SLIDING_SPEED`: closing speed allowed at the clearance margin [m/s].
# `_DEEPEST`: depth inside the margin at which this allowed speed has fallen to zero [m].
# Without these tolerances, an arm that slides along a surface would stop and start with every
# reading, and so would its task.
_SLIDING_SPEED, _DEEPEST = 0.002, 0.005
# Null-space fraction of a push below which the push counts as a push on the end effector.
_ACROSS = 0.1

type Clearance = Callable[[Float[Tensor, "*batch n"]], Float[Tensor, "*batch"]]
"""Function from joint positions to the arm's distance from itself and its surroundings [m]."""


@dataclass(frozen=True, kw_only=True)
class YieldingConfig:
    """Null-space response to a push, and the return of the joints afterwards."""

    damping: float = 3.0
    """c_d: null-space input per unit of joint velocity (paper, Table I) [N m s/rad]."""
    nullspace_rise: float = 0.15
    """Time constant of the null-space velocity when a push begins or grows, and when the joints
    return [s]."""
    pose_gain: float = 4.0
    """Decay rate of the pose error while a pose or a joint path is tracked [1/s]."""
    after_push: Literal["return", "stay"] = "return"
    """Behaviour after a push. "return": the joints return to their planned path, or under
    visual servoing to their posture. "stay": they stay off the path until the path waits for
    them."""
    elbow_speed: float = _GUIDED_SPEED
    """Highest speed of the elbow in null-space motions [m/s], at most `guided_elbow_speed` for
    the cap on the arm's speed."""
    return_speed: float = 0.4
    """Highest speed of the return, norm over all joints [rad/s]."""
    clearance: float = 0.03
    """Distance from obstacles that the arm keeps when it is pushed [m]: three times the
    calibration errors of base and table. The distance may be up to 5 mm less while the arm
    slides along an obstacle."""

    def __post_init__(self) -> None:
        positive = "damping", "nullspace_rise", "pose_gain", "elbow_speed", "return_speed"
        check_settings(self, positive=positive, not_negative=["clearance"])


def guided_elbow_speed(cap: float) -> float:
    """Highest speed of a guided elbow that the arm follows without lag under a speed cap [m/s].

    An arm that lags behind a curved null-space motion moves its end effector.

    Args:
        cap: Cap on the speed of the arm's points [m/s]; infinity: no cap.
    """
    return min(_GUIDED_SPEED, _GUIDED_FRACTION * cap)


def smallest_singular_value(
    chain: SerialChain, joint_position: Float[Tensor, "*batch n"]
) -> Float[Tensor, "*batch"]:
    """Smallest singular value of the end effector's Jacobian, metres and radians mixed.

    Args:
        chain: Kinematics of the arm.
        joint_position: Joint positions [rad].
    """
    return torch.linalg.svdvals(chain.jacobian(joint_position))[..., -1]


def null_space_slowdown(
    chain: SerialChain,
    joint_position: Float[Tensor, "*batch n"],
    null_velocity: Float[Tensor, "*batch n"],
    elbow_speed: float,
) -> Float[Tensor, "*batch"]:
    """Fraction of a null-space velocity with which the end effector can be kept in place.

    The null space is curved. A motion in it at the speed s along a unit vector w accelerates
    the end effector by s^2 c. Here c is the derivative of J along w, times w. Late servos
    compensate for this acceleration only in part. The speeds of elbow and joints are limited as
    well: near a singularity, a joint could turn far before it stops.

    Args:
        chain: Kinematics of the arm.
        joint_position: Joint positions [rad].
        null_velocity: Velocity in the null space at these joints [rad/s].
        elbow_speed: Highest speed of any joint's origin [m/s].

    Returns:
        Factor of at most 1.
    """
    # Check the joints now and after the look-ahead time, in which the arm can slow down.
    times = null_velocity.new_tensor([0.0, LOOK_AHEAD])
    times = torch.stack([times, times + _DIFFERENCE_STEP])
    steps = times.reshape(2, 2, *(1 for _ in null_velocity.shape)) * null_velocity
    origins, (J, beyond) = chain.joint_origins_and_jacobian(joint_position + steps)
    bending = ((beyond - J) @ null_velocity.unsqueeze(-1)).squeeze(-1) / _DIFFERENCE_STEP
    scale = bending.new_tensor([1.0] * 3 + [_METRES_PER_RADIAN] * 3)
    excess = torch.linalg.vector_norm(scale * bending, dim=-1).amax(0) / _BENDING
    moved = torch.linalg.vector_norm(origins[1, 0] - origins[0, 0], dim=-1)
    fastest = moved.amax(-1) / _DIFFERENCE_STEP / elbow_speed
    fastest = torch.maximum(fastest, null_velocity.abs().amax(-1) / _GUIDED_JOINT_SPEED)
    return torch.minimum(excess.clamp(min=1.0) ** -0.5, 1 / fastest).clamp(max=1.0)


def singularity_fade(
    chain: SerialChain,
    joint_position: Float[Tensor, "*batch n"],
    null_velocity: Float[Tensor, "*batch n"],
) -> Float[Tensor, "*batch"]:
    """Fraction of a null-space velocity that does not lead into a singularity.

    Args:
        chain: Kinematics of the arm.
        joint_position: Joint positions [rad].
        null_velocity: Velocity in the null space at these joints [rad/s].

    Returns:
        1 away from singularities and for motions out of a singularity; it fades to 0 for
        motions into a singularity.
    """
    # Intermediate postures count too: beyond a singularity the arm is regular again.
    ahead = joint_position + 2 * LOOK_AHEAD * _fractions_of(null_velocity)
    now, *later = torch.linalg.svdvals(chain.jacobian(ahead))[..., -1]
    least = torch.stack(later).amin(0)
    fade = ((least - _SINGULAR) / (_REGULAR - _SINGULAR)).clamp(0, 1)
    return torch.where(least >= now, 1.0, fade)


def _fractions_of(velocity: Float[Tensor, "*batch n"]) -> Tensor:
    """A velocity times each of `_FRACTIONS`, from zero to one, shape (fractions, *batch, n)."""
    return _FRACTIONS.to(velocity).reshape(-1, *(1 for _ in velocity.shape)) * velocity


class EasedVelocity(NamedTuple):
    """Null-space velocity of one step, and what limited it."""

    velocity: Float[Tensor, "*batch n"]
    """Velocity to command [rad/s]."""
    projected: Float[Tensor, "*batch n"]
    """Null-space part of the requested velocity [rad/s]."""
    slowdown: Float[Tensor, "*batch"]
    """Fraction that `null_space_slowdown` allows."""
    fade: Float[Tensor, "*batch"]
    """Fraction that `singularity_fade` allows."""
    unbounded: Float[Tensor, "*batch n"]
    """Velocity after both fractions [rad/s]."""
    bounded: Float[Tensor, "*batch n"]
    """The same velocity within the joint bounds [rad/s]."""


def eased_null_velocity(
    chain: SerialChain,
    joint_position: Float[Tensor, "*batch n"],
    jacobian: Float[Tensor, "*batch 6 n"],
    previous: Float[Tensor, "*batch n"],
    requested: Float[Tensor, "*batch n"],
    bounds: tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"]],
    dt: float,
    config: YieldingConfig,
) -> EasedVelocity:
    """Null-space velocity of the next step, which approaches a requested one.

    Arms follow late and with limited acceleration, so a velocity that jumps or is too fast
    would move the end effector.

    Args:
        chain: Kinematics of the arm.
        joint_position: Joint positions [rad].
        jacobian: Jacobian of the end effector at these joints.
        previous: Null-space velocity of the last step [rad/s].
        requested: Joint velocity whose null-space part is requested [rad/s].
        bounds: Lowest and highest joint velocities that keep the limit margin reserved for the
            task [rad/s].
        dt: Control step [s].
        config: Response to pushes.
    """
    previous = null_projection(jacobian, previous)
    projected = null_projection(jacobian, requested)
    slowdown = null_space_slowdown(chain, joint_position, projected, config.elbow_speed)
    unbounded = projected * slowdown.unsqueeze(-1)
    # Look for singularities as far ahead as the arm may move while it slows down.
    last, size = previous.norm(dim=-1, keepdim=True), unbounded.norm(dim=-1, keepdim=True)
    speed = last.clamp(min=_SLOW) / size.clamp(min=1e-9)
    fade = singularity_fade(chain, joint_position, speed * unbounded)
    unbounded = unbounded * fade.unsqueeze(-1)
    bounded = scale_null_space(torch.zeros_like(unbounded), unbounded, *bounds)
    slows = bounded.norm(dim=-1, keepdim=True) < last
    rise = torch.where(slows, 1.0, min(dt / config.nullspace_rise, 1.0))
    change = rise * (bounded - previous)
    effort = torch.where(slows, _STOP_EFFORT, _PUSH_EFFORT)
    reach = effort * dt * chain.limits.acceleration
    velocity = previous + change / (change.abs() / reach).amax(-1, keepdim=True).clamp(min=1.0)
    return EasedVelocity(velocity, projected, slowdown, fade, unbounded, bounded)


def null_space_giving_way(
    jacobian: Float[Tensor, "*batch 6 n"],
    task: Float[Tensor, "*batch n"],
    null: Float[Tensor, "*batch n"],
    lower: Float[Tensor, "*batch n"],
    upper: Float[Tensor, "*batch n"],
) -> Float[Tensor, "*batch n"]:
    """Null-space velocity that keeps task plus null space in bounds and is nearest to a given
    one.

    At a limit to which a person has pushed the arm, the null space thus gives way to the task.
    The correction has a single direction, which spans the whole null space of an arm with seven
    joints. If no correction is sufficient, the bounds are exceeded as little as possible.

    Args:
        jacobian: Jacobian of the end effector.
        task: Joint velocity of the task, which is not changed [rad/s].
        null: Requested null-space velocity [rad/s].
        lower: Lowest joint velocity [rad/s].
        upper: Highest joint velocity [rad/s].
    """
    velocity = task + null
    missing = velocity.clamp(lower, upper) - velocity
    if not bool(missing.any()):
        return null
    along = null_projection(jacobian, missing)
    size = along.abs()
    moving = size > _NEGLIGIBLE * size.amax(-1, keepdim=True)
    slope = torch.where(moving, along, 1.0)
    at_lower, at_upper = (lower - velocity) / slope, (upper - velocity) / slope
    least = torch.where(moving, torch.minimum(at_lower, at_upper), -math.inf).amax(-1)
    most = torch.where(moving, torch.maximum(at_lower, at_upper), math.inf).amin(-1)
    factor = torch.where(least <= most, least, (least + most) / 2)
    factor = torch.where(along.norm(dim=-1) < _NEGLIGIBLE, 0.0, factor)
    return null + factor.unsqueeze(-1) * along


class ClearMotion(NamedTuple):
    """A null-space velocity that keeps the arm clear of its surroundings."""

    null: Float[Tensor, "*batch n"]
    """Null-space velocity [rad/s]."""
    blocked: Bool[Tensor, "*batch"]
    """True where the task has to wait: the task alone would bring the arm inside the margin, or
    nearer to an obstacle if the arm is already inside."""
    distance: Float[Tensor, "*batch"]
    """Clearance of the arm now [m]."""


def kept_clear(
    joint_position: Float[Tensor, "*batch n"],
    task: Float[Tensor, "*batch n"],
    null: Float[Tensor, "*batch n"],
    clearance: Clearance,
    margin: float,
) -> ClearMotion:
    """Reduce a null-space velocity until the arm keeps its clearance.

    Args:
        joint_position: Joint positions [rad].
        task: Joint velocity of the task, which is not changed [rad/s].
        null: Null-space velocity [rad/s].
        clearance: Function for the distance from obstacles. It is called once, with all
            postures to compare along a new first axis.
        margin: Clearance to keep [m]. Where the task alone results in less, null-space motion
            reduces the clearance further by at most 2 mm/s, and not at all if it is 5 mm or
            more below the margin.
    """
    ahead = joint_position + LOOK_AHEAD * (task + _fractions_of(null))
    now, without, *_ = every = clearance(torch.cat([joint_position[None], ahead]))
    blocked = without < torch.clamp(now, max=margin)
    if bool((every >= margin).all()):
        return ClearMotion(null, blocked, now)
    closing = without - every[2:]
    spare = without - margin
    sliding = LOOK_AHEAD * _SLIDING_SPEED * (1.0 + spare / _DEEPEST).clamp(0.0, 1.0)
    allowed = spare.clamp(min=0.0) + sliding
    # The distance falls with the fraction of the motion: scale the motion down in proportion.
    fractions = _FRACTIONS[1:].to(closing).reshape(-1, *(1 for _ in now.shape))
    factor = torch.where(closing > allowed, fractions * allowed / closing, 1.0).amin(0)
    return ClearMotion(factor.unsqueeze(-1) * null, blocked, now)


def fraction_kept(
    before: Float[Tensor, "*batch n"], after: Float[Tensor, "*batch n"], rest: float = 1e-6
) -> Float[Tensor, "*batch"]:
    """Fraction of a velocity that remains along its direction, 0 to 1; 1 at rest.

    Args:
        before: Velocity of the joints [rad/s], or a twist.
        after: Velocity, or twist, that remains.
        rest: Length below which a velocity counts as rest.
    """
    square = torch.linalg.vecdot(before, before)
    along = torch.linalg.vecdot(before, after) / square
    return torch.where(square >= rest**2, along, 1.0).clamp(0.0, 1.0)


def fraction_in_null_space(
    requested: Float[Tensor, "*batch n"], projected: Float[Tensor, "*batch n"]
) -> Float[Tensor, "*batch"]:
    """Null-space fraction of a push if it is below a tenth; otherwise 1.

    Args:
        requested: Joint velocity requested by the push [rad/s].
        projected: Null-space part of `requested` [rad/s].
    """
    square = torch.linalg.vecdot(requested, requested)
    # For an orthogonal projection N, |N w|^2 = w^T N w.
    inside = torch.linalg.vecdot(requested, projected).clamp(min=0)
    fraction = (inside / square).sqrt()  # NaN at rest, which counts as 1
    return torch.where(fraction < _ACROSS, fraction, 1.0)


def limiting_joint(
    velocity: Float[Tensor, "*batch n"],
    lower: Float[Tensor, "*batch n"],
    upper: Float[Tensor, "*batch n"],
) -> Int[Tensor, "*batch"]:
    """Index, from 0, of the joint whose bounds reduce a velocity most.

    Args:
        velocity: Joint velocity [rad/s].
        lower: Lowest velocity [rad/s].
        upper: Highest velocity [rad/s].
    """
    bound = torch.where(velocity > 0, upper, lower)
    return torch.where(velocity == 0, math.inf, bound / velocity).argmin(-1)
