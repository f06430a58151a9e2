"""Independent monitor of motion limits, for trials of the controller."""

from typing import final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.kinematics import JointLimits

# Relative excess tolerated: differences of rounded numbers exceed limits by it.
_MONITOR_TOLERANCE = 1 + 1e-9


@final
class LimitMonitor:
    """Monitor of the motion limits of commanded joint velocities, from step to step.

    It shares no code with the safety filter that has to keep them.
    """

    def __init__(self, limits: JointLimits, velocity: Float[Tensor, "*batch n"], dt: float):
        """Start monitoring.

        Args:
            limits: Limits of the joints.
            velocity: Steady velocity at the start [rad/s].
            dt: Step [s].
        """
        self._limits, self._velocity, self._dt = limits, velocity, dt
        self._acceleration = torch.zeros_like(velocity)

    def violations(
        self, q: Float[Tensor, "*batch n"], velocity: Float[Tensor, "*batch n"]
    ) -> Bool[Tensor, "*batch 4"]:
        """Flags of exceeded limits in one step: position, velocity, acceleration, jerk.

        Args:
            q: Joint positions, on which velocity limits may depend [rad].
            velocity: Velocity commanded for the step [rad/s].
        """
        limits = self._limits
        slowest, fastest = limits.velocity_bounds(q)
        acceleration = (velocity - self._velocity) / self._dt
        jerk = (acceleration - self._acceleration) / self._dt
        self._velocity, self._acceleration = velocity, acceleration
        broken = [
            (q > limits.upper) | (q < limits.lower),
            (velocity > fastest) | (velocity < slowest),
            acceleration.abs() > limits.acceleration * _MONITOR_TOLERANCE,
            jerk.abs() > limits.jerk * _MONITOR_TOLERANCE,
        ]
        return torch.stack([flags.any(-1) for flags in broken], dim=-1)
