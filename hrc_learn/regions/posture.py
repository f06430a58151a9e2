"""Posture region: a ball in joint space that attracts, for large approaches."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.pytree import pytree, static
from hrc_learn.regions.region import Region


@pytree
@dataclass(frozen=True, kw_only=True)
class PostureRegion(Region):
    """Attracts the joints to a posture, at a speed that does not grow with the distance.

    f = |q - q_g| / tolerance - 1
    P = k s^2 (sqrt(1 + |q - q_g|^2/s^2) - 1)

    Far away a joint-space approach meets neither singularities nor joint limits between two
    admissible postures, where a straight line of the tool meets both.
    """

    goal: Float[Tensor, "*#batch n"]
    """Posture to go to [rad], within the joint limits."""
    tolerance: float = static(0.5)
    """Radius of the region [rad]; inside it other feedback may take over."""
    stiffness: float = static(2.0)
    """k, the rate of convergence close to the goal [1/s]."""
    saturation: float = static(0.75)
    """s, the distance from which on the pull hardly grows [rad]; its limit is k s [rad/s]."""

    def value(self, x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*both"]:
        """F at the joint position x [rad]."""
        return torch.linalg.vector_norm(x - self.goal, dim=-1) / self.tolerance - 1

    def feedback(self, x: Float[Tensor, "*batch n"]) -> tuple[Tensor, Tensor]:
        """Potential and its gradient over the joint positions."""
        offset = x - self.goal
        square = torch.linalg.vecdot(offset, offset).unsqueeze(-1)
        root = torch.sqrt(1 + square / self.saturation**2)
        P = (self.stiffness * self.saturation**2) * (root.squeeze(-1) - 1)
        return P, self.stiffness / root * offset
