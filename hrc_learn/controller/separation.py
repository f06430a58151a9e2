"""Speed and separation monitoring: how fast the tool may move when a person is near."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class SeparationConfig:
    """The terms of the protective separation distance (ISO/TS 15066:2016, 5.5.4.2.3)."""

    human_speed: float = 1.6
    """v_h, at which the person may come closer [m/s]; 1.6 where it is not measured."""
    reaction_time: float = 0.1
    """T_r, from the person's motion to the arm's response [s]: sensing, transport, and some
    20 ms for a control step and the ramp of the acceleration."""
    deceleration: float = 2.0
    """Of the tool while the arm stops [m/s^2]: T_s = v/a and S_s = v^2/(2 a)."""
    clearance: float = 0.2
    """C + Z_d + Z_r, intrusion and the uncertainty of both positions [m]: the distance that is
    left when everything has come to rest."""

    def __post_init__(self):
        for name in ("human_speed", "reaction_time", "clearance"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, but is {getattr(self, name)}")
        if not self.deceleration > 0:
            raise ValueError(f"deceleration must be positive, but is {self.deceleration}")

    def highest_speed(self, distance: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Tool speed that keeps the protective separation distance [m/s].

        The root v of  d = v_h (T_r + v/a) + v T_r + v^2/(2 a) + C + Z_d + Z_r,  zero where the
        person is too close for any motion. A distance of NaN is not known and counts as zero.

        Args:
            distance: Between the person and the arm [m]; infinite: nobody is there.
        """
        a = self.deceleration
        spare = distance - self.human_speed * self.reaction_time - self.clearance
        spare = torch.where(spare > 0, spare, 0.0)  # NaN too
        delay = self.reaction_time + self.human_speed / a
        return a * (torch.sqrt(delay**2 + (2 / a) * spare) - delay)
