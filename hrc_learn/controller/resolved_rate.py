"""Terms of the control law: regional feedback, and the joint velocity that realises its twist.

*Feedback.* Two levels between 0 and 1 blend the sources of feedback. The *vision level* fades
vision feedback in, on top of Cartesian feedback, while the camera sees the feature. The *task
level* replaces a joint-space approach to a posture by task-space feedback. Invalid measurements
are replaced before any feedback is computed.

*Resolved rate.* A tool twist and a null-space velocity become one joint velocity. The
null-space projector is exact only to first order in the step, so the pose drift that null-space
motion causes is measured and corrected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple, final

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from hrc_learn.controller.interface import Goals, Observation
from hrc_learn.geometry import Pose
from hrc_learn.geometry.numerics import (
    Constant,
    check_settings,
    everywhere,
    inverse_norm,
    is_number,
    matmul,
    null_projection,
    solve_positive,
)
from hrc_learn.kinematics.inverse import SINGULAR_BELOW, position_first
from hrc_learn.pytree import pytree, zero_where
from hrc_learn.regions import PostureRegion

# Addition to the diagonal that keeps the Cholesky factorisation possible at a singularity. The
# addition affects only the estimated distance from a singularity, never a solution.
_FLOOR = 1e-9
_EYE = {rows: Constant(torch.eye(rows, dtype=torch.float64)) for rows in range(1, 7)}


def excess_speed(
    twist: Float[Tensor, "*batch 6"], caps: Float[Tensor, "2"]
) -> Float[Tensor, "*batch 1"]:
    """Factor by which a twist exceeds the speed caps; at least 1.

    Args:
        twist: Twist of the tool (linear [m/s], angular [rad/s]).
        caps: Highest linear and angular speed [m/s, rad/s].
    """
    speeds = torch.linalg.vector_norm(twist.view(*twist.shape[:-1], 2, 3), dim=-1)
    return (speeds / caps).amax(-1, keepdim=True).clamp(min=1)


def task_descent(
    J: Float[Tensor, "*batch 6 n"],
    basis: Float[Tensor, "*batch rows 6"],
    gradient: Float[Tensor, "*batch 6"],
) -> Float[Tensor, "*batch 6"]:
    """Twist along which a task of fewer than six dimensions descends the potentials.

    With J_t = B J and a motion y of the task, the joints move by J_t^+ y, and the tool moves by
    J J_t^+ y, which includes rotations outside the task. So the gradient of the potentials with
    respect to y is g = (J J_t^+)^T s. A motion along -g lowers the potentials at the rate
    |g|^2. If s lies in the task, g = B s.

    Args:
        J: Geometric Jacobian.
        basis: B, orthonormal twists of the task (`task_basis`).
        gradient: s, gradient of the potentials with respect to small motions of the tool.

    Returns:
        The twist B^T g.
    """
    J_t = matmul(basis, J)
    pushed = matmul(J_t, matmul(J.mT, gradient.unsqueeze(-1)))
    return matmul(basis.mT, solve_positive(_damped_gram(J_t), pushed)).squeeze(-1)


def resolved_rate(
    J: Float[Tensor, "*batch rows n"],
    twist: Float[Tensor, "*batch rows"],
    null_velocity: Float[Tensor, "*batch n"],
) -> tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"]]:
    """Joint velocities J^+ twist of the task and N w of the null space.

        J^+ v = J^T (J J^T + lambda^2 I)^-1 v,   N w = w - Q Q^T w,   J^T = Q R

    The damping lambda is exactly zero unless J is near a singularity. The distance from a
    singularity is estimated as |(J J^T)^-1|_F^(-1/2), which is at most the smallest singular
    value, and close to this value where the value is small.

    N is never damped: |J N w| <= 1e-12 |w| in float64 for every J. At a singularity, the null
    space has more dimensions than elsewhere. N keeps only as many as elsewhere, and may keep
    other dimensions in the next step. The safety filter limits the resulting acceleration.

    An arm with fewer joints than rows has no null space. The position of its tool follows the
    twist, and the rotation follows as closely as possible (`position_first`).

    Args:
        J: Geometric Jacobian, or its rows in the task: at most 6.
        twist: Twist of the tool (linear [m/s], angular [rad/s]), or its part in the task.
        null_velocity: Wanted joint velocity w [rad/s]; N keeps only the part of it that does
            not move the tool.

    Returns:
        Joint velocity of the task, and joint velocity of the null space [rad/s].
    """
    if J.shape[-1] < J.shape[-2]:
        return task_rate(J, twist), torch.zeros_like(null_velocity)
    return task_rate(J, twist), null_projection(J, null_velocity)


def task_rate(
    J: Float[Tensor, "*batch rows n"], twist: Float[Tensor, "*batch rows"]
) -> Float[Tensor, "*batch n"]:
    """Smallest joint velocity for a twist, J^+ twist, damped near singularities [rad/s].

    Arguments are those of `resolved_rate`.
    """
    if J.shape[-1] < J.shape[-2]:
        basis = position_first(J)
        J, twist = matmul(basis, J), matmul(basis, twist.unsqueeze(-1)).squeeze(-1)
    return matmul(J.mT, solve_positive(_damped_gram(J), twist.unsqueeze(-1))).squeeze(-1)


def _damped_gram(J: Float[Tensor, "*batch rows n"]) -> Float[Tensor, "*batch rows rows"]:
    """J J^T + lambda^2 I, with the damping lambda of `resolved_rate`."""
    gram = matmul(J, J.mT)
    eye = _EYE[J.shape[-2]].like(J)
    sigma_square = 1 / inverse_norm(torch.add(gram, eye, alpha=_FLOOR))
    damping_square = (SINGULAR_BELOW**2 - sigma_square).clamp(min=0)
    return torch.addcmul(gram, eye, damping_square[..., None, None])


def saturate_in_null_space(
    task: Float[Tensor, "*batch n"],
    J: Float[Tensor, "*batch rows n"],
    twist: Float[Tensor, "*batch rows"],
    lower: Float[Tensor, "*#batch n"],
    upper: Float[Tensor, "*#batch n"],
) -> Float[Tensor, "*batch n"]:
    """Shift the motion of joints at a limit to the other joints.

    Joints that would exceed a limit move at the limit, and the other joints make up for the
    rest of the twist. This is one iteration of the saturation in the null space (Flacco, De
    Luca and Khatib, "Control of redundant robots under hard joint constraints", T-RO 2015).
    Without saturation, an arm may stop short of its goal: this happens where the smallest joint
    velocity for the twist would move only a joint that is at its limit.

    Args:
        task: Joint velocity of the task, by `resolved_rate` [rad/s].
        J: Jacobian given to `resolved_rate`.
        twist: Twist given to `resolved_rate`.
        lower: Lowest allowed velocity [rad/s].
        upper: Highest allowed velocity [rad/s].

    Returns:
        The shifted velocity [rad/s]; it may exceed bounds that `task` keeps. If the twist of
        `task`, after clamping, is at least as near to `twist`, `task` is returned instead.
    """
    cut = task.clamp(lower, upper)
    free = cut == task
    if everywhere(free):
        return task
    left = twist - torch.linalg.vecdot(J, cut.masked_fill(free, 0).unsqueeze(-2))
    J_free = J * free.unsqueeze(-2)
    others = matmul(J_free.mT, solve_positive(_damped_gram(J_free), left.unsqueeze(-1)))
    shared = torch.where(free, others.squeeze(-1), cut)

    def off(velocity: Tensor) -> Tensor:
        missing = twist - torch.linalg.vecdot(J, velocity.clamp(lower, upper).unsqueeze(-2))
        return torch.linalg.vecdot(missing, missing).unsqueeze(-1)

    # Where no limit acts, both velocities are equal up to rounding.
    better = (off(shared) < off(task)) & ~free.all(-1, keepdim=True)
    return torch.where(better, shared, task)


def scale_task(
    task: Float[Tensor, "*batch n"],
    J: Float[Tensor, "*batch 6 n"],
    lower: Float[Tensor, "*#batch n"],
    upper: Float[Tensor, "*#batch n"],
    caps: Float[Tensor, "2"],
) -> Float[Tensor, "*batch n"]:
    """Slow the task down where limits of single joints would make the tool faster.

    If one of two joints that nearly cancel each other's motion is limited, the other swings the
    tool off its path, faster than requested. Slowing down the task as a whole avoids this.
    Where the limit makes the tool slower, the task goes on and slides along the limit.

    Args:
        task: Joint velocity of the task [rad/s].
        J: Geometric Jacobian of the tool.
        lower: Lowest allowed velocity [rad/s].
        upper: Highest allowed velocity [rad/s].
        caps: Highest linear and angular speed [m/s, rad/s], used to weight both speeds.

    Returns:
        The velocity, scaled down at most until no limit acts [rad/s].
    """
    cut = task.clamp(lower, upper)
    if everywhere(cut == task):
        return task
    twists = torch.linalg.vecdot(J, torch.stack((task, cut)).unsqueeze(-2))
    speeds = twists.unflatten(-1, (2, 3)) / caps[:, None]
    asked, done = torch.linalg.vector_norm(speeds, dim=(-2, -1)).unsqueeze(-1)
    moving = torch.where(task == 0, torch.finfo(task.dtype).tiny, task)
    fits = torch.maximum(lower / moving, upper / moving).amin(-1, keepdim=True)
    slowed = torch.maximum(asked / done, fits).clamp(0, 1)
    return torch.where(done > asked, slowed, 1.0) * task


def scale_null_space(
    task: Float[Tensor, "*batch n"],
    null: Float[Tensor, "*batch n"],
    lower: Float[Tensor, "*#batch n"],
    upper: Float[Tensor, "*#batch n"],
) -> Float[Tensor, "*batch n"]:
    """Scale the null-space velocity as a whole to keep the limits of single joints.

    Limiting single joints would move the tool. The factor is the largest from 0 to 1 that keeps
    the limits. If no factor keeps them, because the task alone is too fast, we use the factor
    with the smallest excess.
    (Factors outside this range would let the redundant joints give way to the task, but in
    measurements they drove the elbow fast into the limits near singularities.)

    Args:
        task: Joint velocity of the task [rad/s].
        null: Joint velocity of the null space [rad/s].
        lower: Lowest allowed velocity [rad/s].
        upper: Highest allowed velocity [rad/s].

    Returns:
        The scaled null-space velocity [rad/s].
    """
    both = task + null
    if everywhere(both.clamp(lower, upper) == both):
        return null
    # A joint without null-space motion does not bound the factor: its bounds, divided by the
    # smallest number, become infinite, or get the wrong sign where the task alone is too fast.
    null_or_tiny = torch.where(null == 0, torch.finfo(null.dtype).tiny, null)
    at_lower, at_upper = (lower - task) / null_or_tiny, (upper - task) / null_or_tiny
    least = torch.minimum(at_lower, at_upper).amax(-1, keepdim=True)
    most = torch.maximum(at_lower, at_upper).amin(-1, keepdim=True)
    wanted = (least <= most).to(null.dtype)
    low, high = torch.minimum(least, most), torch.maximum(least, most)
    factor = torch.minimum(torch.maximum(wanted, low), high).clamp(0, 1)
    return factor * null


# Bound on each component of the accumulated drift [m, rad]; prevents windup while a person
# blocks the arm.
_MAX_DRIFT = 0.005


@pytree
class PoseDrift:
    """Deviation of the tool from the motion of its task, and the data of the last step."""

    drift: Float[Tensor, "*batch 6"]
    """Motion that remains to be corrected (linear [m], angular [rad])."""
    joint_position: Float[Tensor, "*batch n"]
    """Joint positions of the last step [rad]."""
    jacobian: Float[Tensor, "*batch 6 n"]
    """Jacobian of the last step."""
    planned: Float[Tensor, "*batch 6"]
    """Motion that the task had planned for the last step (linear [m], angular [rad])."""
    active: Bool[Tensor, "*batch"]
    """True if the drift was measured in the last step; otherwise the other fields may be
    outdated."""


def restored_drift(drift: PoseDrift) -> PoseDrift:
    """The drift, reset where a field is not a number."""
    numbers = (drift.drift, drift.joint_position, drift.planned, drift.jacobian.flatten(-2))
    known = is_number(torch.cat(numbers, dim=-1)).all(-1)
    return zero_where(~known, drift)


def measure_drift(
    before: PoseDrift,
    joint_position: Float[Tensor, "*batch n"],
    jacobian: Float[Tensor, "*batch 6 n"],
    active: Bool[Tensor, "*batch"],
) -> PoseDrift:
    """Add the drift of the last step: planned motion minus measured motion of the tool.

    With the Jacobians J_0 before and J_1 after the step dq of the joints, the tool moves by
    (J_0 + J_1)/2 dq, up to an error of third order in the step. The motion was planned as
    J_0 dq, with an error of second order: the difference is the drift.

    Args:
        before: Drift after the last step.
        joint_position: Joint positions now [rad].
        jacobian: Jacobian now.
        active: True where drift is compensated. Elsewhere, and in the first step of a
            null-space input, the drift is zero.
    """
    step = (joint_position - before.joint_position).unsqueeze(-2)
    moved = torch.linalg.vecdot(before.jacobian + jacobian, step)  # twice the motion
    drift = torch.add(before.drift + before.planned, moved, alpha=-0.5)
    drift = drift.clamp(-_MAX_DRIFT, _MAX_DRIFT)
    drift = torch.where((active & before.active).unsqueeze(-1), drift, 0.0)
    return replace(
        before, drift=drift, joint_position=joint_position, jacobian=jacobian, active=active
    )


# Speed below which the executed fraction of a twist counts as 1 [m/s, rad/s].
_NO_SPEED = 1e-6


def planned_motion(
    task_twist: Float[Tensor, "*batch 6"],
    twist: Float[Tensor, "*batch 6"],
    done: Float[Tensor, "*batch 6"],
    dt: float | Float[Tensor, ""],
) -> Float[Tensor, "*batch 6"]:
    """Motion of the tool that the task plans for the coming step (linear [m], angular [rad]).

    Limits may slow the motion down, and slowing down is not drift. Therefore only the fraction
    of the motion that the filtered joint velocity executes counts as planned. This fraction is
    measured on the whole twist: for a slow task, the correction of measurement noise is as
    large as the task's own twist, and would distort a fraction measured on the task's twist
    alone.

    Args:
        task_twist: Twist of the task alone.
        twist: Twist of the task and of the drift correction.
        done: Twist of the tool at the filtered joint velocity.
        dt: Step [s].
    """
    along = torch.linalg.vecdot(done, twist) + _NO_SPEED**2
    square = torch.linalg.vecdot(twist, twist) + _NO_SPEED**2
    fraction = (along / square).clamp(0, 1)
    return (fraction * dt).unsqueeze(-1) * task_twist


# Value of the posture's region function above which a joint-space approach starts again. With
# the default tolerance of 0.5 rad, this value is reached at a distance of 1.5 rad. People do
# not pull the elbow that far.
_FAR_FROM_POSTURE = 2.0


@dataclass(frozen=True, kw_only=True)
class BlendingConfig:
    """Conditions for vision feedback, and its fading time."""

    image_size: tuple[int, int] = (1440, 1080)
    """Width and height of the image [px]; default: the paper's camera."""
    hysteresis: float = 40.0
    """Distance from the image border at which a new feature is first used [px]; from then on it
    is used up to the border. Without hysteresis, the blending would chatter at the border."""
    blend_time: float = 0.3
    """Time in which vision feedback fades in and out [s]; 0: it switches without fading."""
    max_feature_age: float = 0.25
    """Age above which a feature is not used; an arm that follows the feature then stops [s]."""

    def __post_init__(self) -> None:
        check_settings(self, not_negative=("hysteresis", "blend_time", "max_feature_age"))


@pytree
class BlendingState:
    """State of the blending between Cartesian and vision feedback."""

    active: Bool[Tensor, "*batch"]
    """True while the feature is followed."""
    level: Float[Tensor, "*batch"]
    """Fraction of vision feedback in the command, 0 to 1."""
    feature: Float[Tensor, "*batch rows"]
    """Last measured feature [px]; its feedback fades out when the feature is lost."""


@final
class VisionBlending(nn.Module):
    """Level of vision feedback, from the measured feature."""

    def __init__(self, config: BlendingConfig | None = None):
        super().__init__()
        self.config = config = config or BlendingConfig()
        size = torch.tensor(config.image_size, dtype=torch.float64)
        self.centre = nn.Buffer((size - 1) / 2)
        """Middle of the image [px]. Pixels count from 0, so this is also half of the size."""

    def initial_state(self, like: Float[Tensor, "*batch n"], points: int = 1) -> BlendingState:
        """State before the first image.

        Args:
            like: Joint positions with the batch shape, dtype and device of the state.
            points: Number of points of the feature.
        """
        level = like.new_zeros(like.shape[:-1])
        return BlendingState(
            active=torch.zeros_like(level, dtype=torch.bool),
            level=level,
            feature=self.centre.repeat(points).expand(*level.shape, -1).clone(),
        )

    def restored(self, state: BlendingState) -> BlendingState:
        """The state, reset where it is not finite."""
        known = is_number(state.level) & is_number(state.feature).all(-1)
        fresh = self.initial_state(state.level.unsqueeze(-1), state.feature.shape[-1] // 2)
        feature = torch.where(known.unsqueeze(-1), state.feature, fresh.feature)
        return replace(zero_where(~known, state), feature=feature)

    def late(self, age: Float[Tensor, "*batch"]) -> Bool[Tensor, "*batch"]:
        """True where the age of a measurement [s] is too high or unknown."""
        # NaN is an unknown age; an age far below zero means that the clocks differ.
        return ~(age.abs() <= self.config.max_feature_age)

    def inside(self, feature: Float[Tensor, "*batch rows"]) -> Float[Tensor, "*batch"]:
        """Distance to the nearest image border [px], negative outside; NaN if unknown."""
        points = feature.shape[-1] // 2
        centre = self.centre if points == 1 else self.centre.repeat(points)
        return (centre - (feature - centre).abs()).amin(-1)

    def step(
        self,
        state: BlendingState,
        feature: Float[Tensor, "*batch rows"],
        usable: Bool[Tensor, "*batch"],
        dt: float | Float[Tensor, ""],
        *,
        age: Float[Tensor, "*batch"] | None = None,
    ) -> tuple[BlendingState, Bool[Tensor, "*batch"], Bool[Tensor, "*batch"] | None]:
        """One step of the blending.

        Args:
            state: State after the last step.
            feature: Measured position [px]; any value, also NaN, where it is not usable.
            usable: True where vision is enabled and the feature was found.
            dt: Step [s].
            age: Age of the measurement [s]; None: zero.

        Returns:
            The next state; True where the feature was seen within the image; and True where
            the arm must stop because its feature is too old (None without an age).
        """
        stop = None
        if age is not None:
            stop = usable & self.late(age) & state.active
            usable = usable & ~self.late(age)
        inside = self.inside(feature)
        seen = usable & (inside >= 0)
        active = seen & (state.active | (inside >= self.config.hysteresis))
        level = fade(state.level, active, dt, self.config.blend_time)
        if stop is not None:
            # Wait for the camera: neither fade out nor stop following.
            active = active | stop
            level = torch.where(stop, state.level, level)
        feature = torch.where(seen.unsqueeze(-1), feature, state.feature)
        return BlendingState(active=active, level=level, feature=feature), seen, stop


def fade(
    level: Float[Tensor, "*batch"],
    rising: Bool[Tensor, "*batch"],
    dt: float | Float[Tensor, ""],
    time: float,
) -> Float[Tensor, "*batch"]:
    """Move a level towards 1 where `rising`, else towards 0, within `time` seconds."""
    wanted = rising.to(level.dtype)
    if time == 0:
        return wanted
    change = dt / time
    return (level + (2 * change) * wanted - change).clamp(0, 1)


def approach_velocity(
    posture: PostureRegion,
    joint_position: Float[Tensor, "*batch n"],
    jacobian: Float[Tensor, "*batch 6 n"],
    caps: Float[Tensor, "2"],
) -> Float[Tensor, "*batch n"]:
    """Joint velocity towards a posture, within the caps on the tool speed [rad/s].

    Args:
        posture: Region of the goal posture.
        joint_position: Measured joint positions [rad].
        jacobian: Geometric Jacobian of the tool.
        caps: Highest linear and angular speed of the tool [m/s, rad/s].
    """
    velocity = -posture.gradient(joint_position)
    twist = torch.linalg.vecdot(jacobian, velocity.unsqueeze(-2))
    return velocity / excess_speed(twist, caps)


def next_task_level(
    task_level: Float[Tensor, "*batch"],
    posture: PostureRegion | None,
    joint_position: Float[Tensor, "*batch n"],
    vision_active: Bool[Tensor, "*batch"],
    dt: float | Float[Tensor, ""],
    blend_time: float,
) -> Float[Tensor, "*batch"]:
    """Level of task-space feedback after a joint-space approach, 0 to 1.

    The level rises inside the posture region: task-space feedback from an arbitrary posture
    often ends at a joint limit. Afterwards the level does not fall if a person or the task
    moves the joints out of the region. It falls only while no feature is followed and the
    posture is far away, for example at the start of a new phase.

    Args:
        task_level: Level after the last step.
        posture: Region of the approach; None: no approach.
        joint_position: Measured joint positions [rad].
        vision_active: True while the feature is followed: then the approach does not restart.
        dt: Step [s].
        blend_time: Time of the transition [s].
    """
    if posture is None:
        return torch.zeros_like(task_level)
    f = posture.value(joint_position)
    stays = (task_level > 0) & ((f <= _FAR_FROM_POSTURE) | vision_active)
    return fade(task_level, stays | (f <= 0), dt, blend_time)


# Pixel rate that is always allowed [px/s]; it keeps the cap above zero at the target.
_LEAST_PIXEL_RATE = 1.0


class Feedback(NamedTuple):
    """Feedback vectors of the regions and their combination."""

    xi_x: Float[Tensor, "*batch rows"]
    """Feedback of the vision region, scaled by the vision level and limited by
    `vision_rate`."""
    xi_r: Float[Tensor, "*batch 6"]
    """Feedback of the Cartesian regions, position then orientation."""
    s: Float[Tensor, "*batch 6"]
    """J_s_hat^T xi_x + xi_r."""
    potential: Float[Tensor, "*batch"]
    """Sum of the potentials, with the potential of vision scaled by the vision level."""


def regional_feedback(
    goals: Goals,
    pose: Pose,
    blending: BlendingState,
    image_jacobian: Float[Tensor, "*batch rows 6"],
    vision_rate: float,
) -> Feedback:
    """Feedback of the position, orientation and vision regions.

    Args:
        goals: The regions.
        pose: Pose of the tool.
        blending: Vision level and feature.
        image_jacobian: J_s_hat at the pose [px/m, px/rad].
        vision_rate: Fastest decay of the pixel error to request [1/s].
    """
    P_t, xi_position = goals.position.feedback(pose.position)
    if goals.orientation is None:
        P_o, xi_orientation = 0.0, torch.zeros_like(xi_position)
    else:
        P_o, xi_orientation = goals.orientation.feedback(pose.orientation)
    P_v, xi_x = goals.vision.feedback(blending.feature)
    xi_r = torch.cat([xi_position, xi_orientation], dim=-1)
    error = blending.feature - goals.vision.target
    gain = blending.level.unsqueeze(-1)
    descent = torch.linalg.vecdot(image_jacobian, xi_x.unsqueeze(-1), dim=-2)
    if vision_rate < math.inf:
        gain = gain / _excess_rate(image_jacobian, descent, error, vision_rate)
    s = torch.addcmul(xi_r, gain, descent)
    return Feedback(gain * xi_x, xi_r, s, P_t + P_o + blending.level * P_v)


def _excess_rate(
    J_s: Tensor, descent: Tensor, error: Tensor, vision_rate: float
) -> Float[Tensor, "*batch 1"]:
    """Divisor of the vision feedback, at least 1, that caps the decay of the pixel error."""
    # The feature moves with J_s descent = J_s J_s^T xi_x, if the estimate is right.
    speed = torch.linalg.vecdot(J_s, descent.unsqueeze(-2))
    speed = torch.linalg.vector_norm(speed, dim=-1, keepdim=True)
    distance = torch.linalg.vector_norm(error, dim=-1, keepdim=True)
    allowed = vision_rate * distance + _LEAST_PIXEL_RATE
    return (speed / allowed).clamp(min=1)


def validated_position(
    observation: Observation, expected: Float[Tensor, "*batch n"]
) -> tuple[Float[Tensor, "*batch n"], Bool[Tensor, "*batch"]]:
    """Joint positions [rad]: measured, or expected where the measurement is NaN or stale.

    Returns:
        The positions, and True where the expected positions are used.
    """
    q = observation.joint_position
    stale = ~is_number(q).all(-1)
    if observation.joint_state_stale is not None:
        stale = stale | observation.joint_state_stale
    return torch.where(stale.unsqueeze(-1), expected, q), stale


def validated_step(
    dt: float | Float[Tensor, ""], longest: float
) -> tuple[float | Tensor, Bool[Tensor, ""] | bool]:
    """Time until the next step [s], zero where invalid, and True where it is valid.

    A number is always valid here: the safety filter raises if it is outside (0, longest].
    """
    if not isinstance(dt, Tensor):
        return dt, True
    known = (dt > 0) & (dt <= longest)
    return torch.where(known, dt, 0.0), known
