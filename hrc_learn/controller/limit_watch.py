"""Looks whether a motion keeps the limits, without help from the filter that ought to."""

from typing import final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.kinematics import JointLimits

# Differences of rounded numbers may exceed a limit in the last digits.
_ROUNDING = 1 + 1e-9


@final
class LimitWatch:
    """Follows joint velocities from step to step."""

    def __init__(self, limits: JointLimits, velocity: Float[Tensor, "*batch n"], dt: float):
        """Begin.

        Args:
            limits: Of the joints.
            velocity: At the start, steady [rad/s].
            dt: Step [s].
        """
        self._limits, self._velocity, self._dt = limits, velocity, dt
        self._acceleration = torch.zeros_like(velocity)

    def beyond(
        self, q: Float[Tensor, "*batch n"], velocity: Float[Tensor, "*batch n"]
    ) -> Bool[Tensor, "*batch 4"]:
        """Whether limits of position, velocity, acceleration and jerk are broken in a step.

        Args:
            q: Joint position [rad].
            velocity: Commanded for the step [rad/s].
        """
        limits = self._limits
        acceleration = (velocity - self._velocity) / self._dt
        jerk = (acceleration - self._acceleration) / self._dt
        self._velocity, self._acceleration = velocity, acceleration
        broken = [
            (q > limits.upper) | (q < limits.lower),
            velocity.abs() > limits.velocity,
            acceleration.abs() > limits.acceleration * _ROUNDING,
            jerk.abs() > limits.jerk * _ROUNDING,
        ]
        return torch.stack([flags.any(-1) for flags in broken], dim=-1)
