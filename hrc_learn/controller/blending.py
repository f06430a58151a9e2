"""Smooth blending between joint-space approach, Cartesian feedback and vision feedback.

Two levels between 0 and 1 decide what leads the arm. The *vision level* fades vision feedback
in on top of Cartesian feedback while the camera sees the feature. The *task level* takes the
lead from a joint-space approach to a posture, and gives it to both of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from hrc_learn.controller.resolved_rate import excess_speed
from hrc_learn.pytree import pytree
from hrc_learn.regions import PostureRegion

# Region function of the posture beyond which a joint-space approach begins anew: at the default
# tolerance of 0.5 rad, a distance of 1.5 rad, more than a person pulls the elbow away.
_FAR_FROM_POSTURE = 2.0


@dataclass(frozen=True, kw_only=True)
class BlendingConfig:
    """When the camera takes part, and how fast."""

    image_size: tuple[int, int] = (1440, 1080)
    """Width and height of the image [px]."""
    hysteresis: float = 40.0
    """How far inside the image a feature must be found before it is used [px]; once used, it
    is used up to the edge. Without this the blending chatters at the border."""
    blend_time: float = 0.3
    """Time in which vision feedback fades in and out [s]; 0: at once."""
    max_feature_age: float = 0.25
    """Older measurements of the feature are not used, and stop an arm that needs them [s]."""


@pytree
@dataclass(frozen=True, kw_only=True)
class BlendingState:
    """State of the blending between Cartesian and vision feedback."""

    active: Bool[Tensor, "*batch"]
    """Whether the feature is being followed."""
    level: Float[Tensor, "*batch"]
    """Fraction of vision feedback in the command, 0 to 1."""
    feature: Float[Tensor, "*batch rows"]
    """Where the feature was last seen [px]: what fades out when it is lost."""


@final
class VisionBlending(nn.Module):
    """Decides from the measured feature how much vision feedback takes part."""

    centre: Tensor
    """Middle of the image [px]; pixels count from 0, so it is also the half size."""

    def __init__(self, config: BlendingConfig | None = None):
        super().__init__()
        self.config = config = config or BlendingConfig()
        size = torch.tensor(config.image_size, dtype=torch.float64)
        self.register_buffer("centre", (size - 1) / 2)

    def initial_state(self, like: Float[Tensor, "*batch n"], points: int = 1) -> BlendingState:
        """Nothing seen yet, for the batch of `like` and a feature of so many points."""
        level = torch.zeros_like(like[..., 0])
        return BlendingState(
            active=torch.zeros_like(level, dtype=torch.bool),
            level=level,
            feature=self.centre.repeat(points).expand(*level.shape, -1).clone(),
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
            state: Of the step before.
            feature: Measured position [px]; anything, also NaN, where it is not usable.
            usable: Whether the camera takes part and found the feature.
            dt: Step [s].
            age: Of the measurement [s]; None: none.

        Returns:
            The next state; whether the feature was seen within the image; and whether the arm
            must stop because the camera it follows has fallen silent (None without an age).
        """
        stop = None
        if age is not None:
            late = age > self.config.max_feature_age
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
            # Wait for the camera: neither fade out nor forget that it was in charge.
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
    """Move a level towards 1 or 0, all the way in `time` seconds."""
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
    """Joint velocity towards a posture, as slow as the caps of the tool ask [rad/s].

    Args:
        posture: Where to go.
        joint_position: Now [rad].
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
    """Fraction to which task-space feedback has taken over from the approach, 0 to 1.

    It does so inside the posture region: earlier it would lead an arm from whatever posture it
    is in, and many of those end at a joint limit. Once it has, it keeps the lead, also where a
    person or the task moves the joints out of the region, unless the posture lies far away, as
    when a new phase begins.

    Args:
        task_level: The fraction after the step before.
        posture: Of the approach; None: there is none.
        joint_position: Now [rad].
        vision_active: Whether the camera leads the arm, which then is not called back.
        dt: Step [s].
        blend_time: Time in which to take over [s].
    """
    if posture is None:
        return torch.zeros_like(task_level)
    f = posture.value(joint_position)
    leads = (task_level > 0) & ((f <= _FAR_FROM_POSTURE) | vision_active)
    return fade(task_level, leads | (f <= 0), dt, blend_time)
