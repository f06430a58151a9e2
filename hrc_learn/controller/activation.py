"""When the camera takes part: smooth hand-over between Cartesian and vision feedback."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.regions.pytree import pytree


@dataclass(frozen=True, kw_only=True)
class ActivationConfig:
    image_size: tuple[int, int] = (1440, 1080)
    """Width and height of the image [px]."""
    hysteresis: float = 40.0
    """How far inside the image a feature must be found before it is used [px]; once used, it
    is used up to the edge. Without this the hand-over chatters at the border."""
    blend_time: float = 0.3
    """Time in which vision feedback fades in and out [s]; 0: at once."""
    max_feature_age: float = 0.25
    """Older measurements of the feature are not used, and stop an arm that needs them [s]."""


@pytree
@dataclass(frozen=True, kw_only=True)
class Activation:
    """State of the hand-over."""

    active: Bool[Tensor, "*batch"]
    """Whether the feature is being followed."""
    level: Float[Tensor, "*batch"]
    """Share of vision feedback in the command, 0 to 1."""
    feature: Float[Tensor, "*batch 2"]
    """Where the feature was last seen [px]: what fades out when it is lost."""

    @classmethod
    def initial(
        cls, like: Float[Tensor, "*batch n"], image_size: tuple[int, int]
    ) -> Activation:
        """Nothing seen yet."""
        level = torch.zeros_like(like[..., 0])
        centre = (like.new_tensor(image_size) - 1) / 2
        return cls(
            active=torch.zeros_like(level, dtype=torch.bool),
            level=level,
            feature=centre.expand(*level.shape, 2).clone(),
        )


def advance(
    activation: Activation,
    feature: Float[Tensor, "*batch 2"],
    usable: Bool[Tensor, "*batch"],
    dt: float | Tensor,
    config: ActivationConfig,
) -> tuple[Activation, Bool[Tensor, "*batch"]]:
    """One step of the hand-over.

    Args:
        activation: Of the step before.
        feature: Measured position [px]; anything, also NaN, where it is not usable.
        usable: Whether the camera takes part and found the feature.
        dt: Step [s].
        config: Hysteresis, blend time and image size.

    Returns:
        The next state, and whether the feature was seen within the image.
    """
    width, height = config.image_size
    edge = feature.new_tensor((width - 1, height - 1))
    # Distance to the nearest edge; NaN compares as not seen.
    depth = torch.minimum(feature, edge - feature).amin(-1)
    seen = usable & (depth >= 0)
    active = seen & (activation.active | (depth >= config.hysteresis))
    if config.blend_time > 0:
        change = torch.where(active, 1.0, -1.0) * (dt / config.blend_time)
        level = (activation.level + change).clamp(0, 1)
    else:
        level = active.to(activation.level.dtype)
    feature = torch.where(seen.unsqueeze(-1), feature, activation.feature)
    return Activation(active=active, level=level, feature=feature), seen
