"""Regions of joint space: repulsion from the joint limits, attraction to a posture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.pytree import pytree, static
from hrc_learn.regions.region import Region


@pytree
@dataclass(frozen=True, kw_only=True)
class JointRegion(Region):
    """Range of the joints; repels each joint from the nearer of its limits.

    With the distance delta_i to the limit, negative past it:

        f_i = delta_i - margin,   f_ri = delta_i - reference_margin
        P   = sum_i k_q/2 min(0, f_i)^2 + k_r/2 min(0, f_ri)^2           (jointxp)

    `formulation="paper"` is Table I's f_i = delta_i^2 - margin^2. Its push vanishes at the
    limit and points outwards past it, because the square loses the sign.
    """

    centre: Float[Tensor, "*#batch n"]
    """Middle of the joint range [rad]."""
    half_range: Float[Tensor, "*#batch n"]
    """Half of the joint range [rad]."""
    margin: float = static(0.1)
    """Distance from the limit at which the steep repulsion starts [rad]."""
    reference_margin: float = static(0.3)
    """Distance at which the weak repulsion of the reference region starts [rad]."""
    stiffness: float = static(10.0)
    """k_q."""
    reference_stiffness: float = static(1.0)
    """k_r."""
    formulation: Literal["one_sided", "paper"] = static("one_sided")

    @classmethod
    def from_limits(
        cls, lower: Float[Tensor, "*batch n"], upper: Float[Tensor, "*batch n"], **options
    ) -> JointRegion:
        """Region of the joint limits [rad]; `options` are the remaining fields."""
        return cls(centre=(lower + upper) / 2, half_range=(upper - lower) / 2, **options)

    def value(self, x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*both n"]:
        """f_i of every joint at the nearer limit [rad] ("paper": [rad^2])."""
        return self._depths(self.half_range - (x - self.centre).abs())[0]

    def feedback(
        self, x: Float[Tensor, "*batch n"]
    ) -> tuple[Float[Tensor, "*both"], Float[Tensor, "*both m"]]:
        """Potential and its gradient over the joint positions."""
        offset = x - self.centre
        distance = self.half_range - offset.abs()
        f, f_reference = (depth.clamp(max=0) for depth in self._depths(distance))
        pull, pull_reference = self.stiffness * f, self.reference_stiffness * f_reference
        P = 0.5 * (pull * f + pull_reference * f_reference).sum(-1)
        slope = pull + pull_reference  # dP/d delta, at most zero
        if self.formulation == "paper":
            slope = slope * (2 * distance)
        # The distance to the nearer limit falls on both sides of the centre.
        return P, -torch.sign(offset) * slope

    def _depths(self, distance: Tensor) -> tuple[Tensor, Tensor]:
        """Region functions f and f_r from the distance to the limit."""
        if self.formulation == "paper":
            square = distance * distance
            return square - self.margin**2, square - self.reference_margin**2
        return distance - self.margin, distance - self.reference_margin


@pytree
@dataclass(frozen=True, kw_only=True)
class PostureRegion(Region):
    """Ball about a posture; attracts the joints, with a pull that saturates with the distance.

    f = |q - q_g| / tolerance - 1
    P = k s^2 (sqrt(1 + |q - q_g|^2/s^2) - 1)

    Between two admissible postures, a joint-space approach meets neither singularities nor
    joint limits; a straight line of the tool may meet both.
    """

    goal: Float[Tensor, "*#batch n"]
    """Goal posture within the joint limits [rad]."""
    tolerance: float = static(0.5)
    """Radius of the region [rad], inside which task-space feedback may take over."""
    stiffness: float = static(2.0)
    """k, convergence rate close to the goal [1/s]."""
    saturation: float = static(0.75)
    """s, distance at which the pull saturates [rad]; its limit is k s [rad/s]."""

    def value(self, x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*both"]:
        """Region function f at the joint position x [rad]."""
        return torch.linalg.vector_norm(x - self.goal, dim=-1) / self.tolerance - 1

    def feedback(
        self, x: Float[Tensor, "*batch n"]
    ) -> tuple[Float[Tensor, "*both"], Float[Tensor, "*both m"]]:
        """Potential and its gradient over the joint positions."""
        offset = x - self.goal
        square = torch.linalg.vecdot(offset, offset).unsqueeze(-1)
        root = torch.sqrt(1 + square / self.saturation**2)
        P = (self.stiffness * self.saturation**2) * (root.squeeze(-1) - 1)
        return P, self.stiffness / root * offset
