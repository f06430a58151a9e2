"""Way-making: the null space moves the elbow away from approaching people."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller.constraint_layer import Distances
from hrc_learn.geometry.numerics import safe_norm


@dataclass(frozen=True, kw_only=True)
class WayMakingConfig:
    """Source of null-space motion, and the repulsion from what is near."""

    mode: Literal["none", "expert", "automatic", "both"] = "both"
    """Source of null-space motion: none, the null-space input of a person, the repulsion from
    what is near, or the sum of both."""
    far: float = 0.3
    """Distance at which the repulsion begins [m]: well before the 0.13 m at which
    `ConstraintConfig` begins to slow down an approach at 0.5 m/s."""
    near: float = 0.08
    """Distance at which the repulsion is largest [m], before the constraints bind."""
    speed: float = 0.5
    """Joint velocity at the largest repulsion, of which the null-space part acts [rad/s]."""
    smoothing: float = 0.02
    """Difference of distances below which pairs count alike [m]. Without it the direction
    would jump where another pair becomes the nearest."""

    def __post_init__(self):
        if self.mode not in ("none", "expert", "automatic", "both"):
            raise ValueError(
                f"mode must be 'none', 'expert', 'automatic' or 'both', but is {self.mode!r}"
            )
        if not self.near < self.far:
            raise ValueError(f"near must be below far, but they are {self.near} and {self.far}")
        for name in ("speed", "smoothing"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, but is {getattr(self, name)}")

    @property
    def automatic(self) -> bool:
        """True if the repulsion moves the null space."""
        return self.mode in ("automatic", "both")

    @property
    def expert(self) -> bool:
        """True if the null-space input of a person moves it."""
        return self.mode in ("expert", "both")


def way_making_velocity(
    distances: Distances, config: WayMakingConfig | None = None
) -> Float[Tensor, "*batch n"]:
    """Joint velocity away from what is near, whose null-space part acts [rad/s].

    It follows the gradient of the smoothed least distance d = -k log sum exp(-d_i/k), as down
    the potential of a repulsion (Khatib 1986). Its speed rises smoothly from zero at `far` to
    `speed` at `near`. Zero where a distance is not a number: the arm brakes there.

    Args:
        distances: Distances from what the arm should keep away from.
        config: Default: the recommended settings.
    """
    config = config or WayMakingConfig()
    distances = distances.where(distances.known())
    ratio = -distances.distance / config.smoothing
    least = -config.smoothing * torch.logsumexp(ratio, -1)
    gradient = (torch.softmax(ratio, -1).unsqueeze(-1) * distances.gradient).sum(-2)
    level = ((config.far - least) / (config.far - config.near)).clamp(0, 1)
    speed = config.speed * level * level * (3 - 2 * level)
    length = safe_norm(gradient)
    direction = gradient / torch.where(length > 0, length, 1.0).unsqueeze(-1)
    return speed.unsqueeze(-1) * direction
