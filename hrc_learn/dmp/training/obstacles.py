"""Solid obstacles by their signed distance, whose gradient leads out of them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry.numerics import safe_norm


@dataclass(frozen=True, kw_only=True)
class Sphere:
    """A ball."""

    centre: tuple[float, float, float]
    """[m]."""
    radius: float
    """[m]."""

    def distance(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """From its surface [m], negative inside."""
        centre = torch.tensor(self.centre, dtype=points.dtype, device=points.device)
        return safe_norm(points - centre) - self.radius


@dataclass(frozen=True, kw_only=True)
class Box:
    """A box along the axes."""

    centre: tuple[float, float, float]
    """[m]."""
    half_size: tuple[float, float, float]
    """[m]."""

    def distance(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """From its surface [m], negative inside."""
        centre, half = (
            torch.tensor(x, dtype=points.dtype, device=points.device)
            for x in (self.centre, self.half_size)
        )
        beyond = (points - centre).abs() - half
        # Outside, to the nearest corner, edge or face; inside, to the nearest face.
        return safe_norm(beyond.clamp_min(0)) + beyond.amax(-1).clamp_max(0)


type Obstacle = Sphere | Box
