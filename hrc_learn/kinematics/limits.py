"""What the joints of an arm can do."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class MotionLimits:
    """Limits of each joint's motion, float64; velocities and up are symmetric.

    Of whatever else is moved as well, in its own unit in place of radians.
    """

    lower: Float[Tensor, " joints"]
    """Smallest position [rad]."""
    upper: Float[Tensor, " joints"]
    """Largest position [rad]."""
    velocity: Float[Tensor, " joints"]
    """[rad/s]"""
    acceleration: Float[Tensor, " joints"]
    """[rad/s^2]"""
    jerk: Float[Tensor, " joints"]
    """[rad/s^3]"""


@dataclass(frozen=True, kw_only=True)
class JointLimits(MotionLimits):
    """Limits of each joint of an arm."""

    torque: Float[Tensor, " joints"]
    """[N m]"""
    vintage: str
    """Who published these numbers, and when: manufacturers revise them."""

    @property
    def middle(self) -> Float[Tensor, " joints"]:
        """Centre of the range of each joint [rad]."""
        return (self.lower + self.upper) / 2

    def contain(self, q: Float[Tensor, "*batch joints"]) -> Bool[Tensor, "*batch"]:
        """Whether all joints are within their range, limits included."""
        lower, upper = self.lower.to(q), self.upper.to(q)
        return torch.all((q >= lower) & (q <= upper), dim=-1)
