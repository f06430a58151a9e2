"""Regional feedback, and the smooth blending of joint-space, Cartesian and vision feedback.

Two levels between 0 and 1 set the blend. The *vision level* fades vision feedback in, on top of
Cartesian feedback, while the camera sees the feature. The *task level* fades from a joint-space
approach towards a posture to task-space feedback. Invalid measurements are replaced before any
feedback is computed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, final

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from hrc_learn.controller.interface import Goals, Observation
from hrc_learn.controller.resolved_rate import excess_speed
from hrc_learn.geometry import Pose
from hrc_learn.geometry.numerics import is_number
from hrc_learn.pytree import pytree
from hrc_learn.regions import PostureRegion

# Region function of the posture beyond which a joint-space approach starts again: at the
# default tolerance of 0.5 rad a distance of 1.5 rad, more than a person pulls the elbow away.
_FAR_FROM_POSTURE = 2.0


@dataclass(frozen=True, kw_only=True)
class BlendingConfig:
    """Conditions for vision feedback, and its fading time."""

    image_size: tuple[int, int] = (1440, 1080)
    """Width and height of the image [px]; default: the paper's camera."""
    hysteresis: float = 40.0
    """Distance from the image border at which a new feature is first used [px]; from then on it
    is used up to the border. Without hysteresis the blending chatters there."""
    blend_time: float = 0.3
    """Time in which vision feedback fades in and out [s]; 0: at once."""
    max_feature_age: float = 0.25
    """Age above which a feature is not used, and stops an arm that needs it [s]."""


@pytree
@dataclass(frozen=True, kw_only=True)
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

    centre: Tensor
    """Middle of the image [px]; pixels count from 0, so it is also the half size."""

    def __init__(self, config: BlendingConfig | None = None):
        super().__init__()
        self.config = config = config or BlendingConfig()
        size = torch.tensor(config.image_size, dtype=torch.float64)
        self.register_buffer("centre", (size - 1) / 2)

    def initial_state(self, like: Float[Tensor, "*batch n"], points: int = 1) -> BlendingState:
        """State before the first image.

        Args:
            like: Joint positions, of which batch shape, dtype and device are taken.
            points: Number of points of the feature.
        """
        level = torch.zeros_like(like[..., 0])
        return BlendingState(
            active=torch.zeros_like(level, dtype=torch.bool),
            level=level,
            feature=self.centre.repeat(points).expand(*level.shape, -1).clone(),
        )

    def restored(self, state: BlendingState) -> BlendingState:
        """The state, reset where it is not finite."""
        known = is_number(state.level) & is_number(state.feature).all(-1)
        fresh = self.initial_state(state.level.unsqueeze(-1), state.feature.shape[-1] // 2)
        return BlendingState(
            active=state.active & known,
            level=torch.where(known, state.level, fresh.level),
            feature=torch.where(known.unsqueeze(-1), state.feature, fresh.feature),
        )

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
            # NaN is an unknown age; an age far below zero means that the clocks differ.
            late = ~(age.abs() <= self.config.max_feature_age)
            stop = usable & late & state.active
            usable = usable & ~late
        # Distance to the nearest edge of the image; NaN compares as not seen.
        points = feature.shape[-1] // 2
        centre = self.centre if points == 1 else self.centre.repeat(points)
        inside = (centre - (feature - centre).abs()).amin(-1)
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

    It rises inside the posture region: task-space feedback from an arbitrary posture often ends
    at a joint limit. Then it stays up, also where a person or the task moves the joints out of
    the region, unless the posture is far away, as at the start of a new phase.

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


# Pixel rate that is always allowed [px/s]: keeps the cap above zero at the target.
_LEAST_PIXEL_RATE = 1.0


class Feedback(NamedTuple):
    """Feedback vectors of the regions and their combination."""

    xi_x: Float[Tensor, "*batch rows"]
    """Feedback of the vision region, scaled by the vision level."""
    xi_r: Float[Tensor, "*batch 6"]
    """Feedback of the Cartesian regions, position then orientation."""
    s: Float[Tensor, "*batch 6"]
    """J_s_hat^T xi_x + xi_r."""
    potential: Float[Tensor, "*batch"]
    """Sum of the potentials."""


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
    if vision_rate < math.inf:
        gain = gain / _excess_rate(image_jacobian, xi_x, error, vision_rate)
    xi_x = gain * xi_x
    s = torch.linalg.vecdot(image_jacobian, xi_x.unsqueeze(-1), dim=-2) + xi_r
    return Feedback(xi_x, xi_r, s, P_t + P_o + blending.level * P_v)


def _excess_rate(
    J_s: Tensor, xi_x: Tensor, error: Tensor, vision_rate: float
) -> Float[Tensor, "*batch 1"]:
    """Divisor of vision feedback that caps the rate of the pixel error; at least 1."""
    # The feature moves with J_s J_s^T xi_x, if the estimate is right.
    descent = torch.linalg.vecdot(J_s, xi_x.unsqueeze(-1), dim=-2)
    speed = torch.linalg.vecdot(J_s, descent.unsqueeze(-2))
    speed = torch.linalg.vector_norm(speed, dim=-1, keepdim=True)
    distance = torch.linalg.vector_norm(error, dim=-1, keepdim=True)
    allowed = vision_rate * distance + _LEAST_PIXEL_RATE
    return (speed / allowed).clamp(min=1)


def potential_rate(
    s: Float[Tensor, "*batch 6"],
    jacobian: Float[Tensor, "*batch 6 n"],
    joint_velocity: Float[Tensor, "*batch n"],
) -> Float[Tensor, "*batch"]:
    """Rate of the potential P_v + P_c predicted by the estimated image Jacobian [1/s].

    A measured potential that falls more slowly shows an error of the image Jacobian. A positive
    rate shows a motion that a limit or a person has turned against the task.
    """
    twist = torch.linalg.vecdot(jacobian, joint_velocity.unsqueeze(-2))
    return torch.linalg.vecdot(s, twist)


def validated_position(
    observation: Observation, expected: Float[Tensor, "*batch n"]
) -> tuple[Float[Tensor, "*batch n"], Bool[Tensor, "*batch"]]:
    """Joint positions [rad]: measured, or the expected ones where those are NaN or stale.

    Returns:
        The positions, and True where they are the expected ones.
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


def effective_goals(
    observation: Observation, default: Goals
) -> tuple[Goals, Bool[Tensor, "*batch"] | bool]:
    """Goals of this step, and True where the target is known (not NaN)."""
    goals = default if observation.goals is None else observation.goals
    target = observation.target
    if target is None:
        return goals, True
    known = is_number(target).all(-1)
    target = torch.where(known.unsqueeze(-1), target, goals.vision.target)
    return goals.aimed_at(target), known
