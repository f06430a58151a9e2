"""Independent monitor of motion limits, for trials of the controller."""

import math
from typing import final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.kinematics import JointLimits

# Tolerated relative excess: differences of rounded numbers exceed limits by this much.
_MONITOR_TOLERANCE = 1 + 1e-9


@final
class LimitMonitor:
    """Monitor of the motion limits of commanded joint velocities, from step to step.

    It shares no code with the safety filter, which has to keep these limits.
    """

    def __init__(
        self,
        limits: JointLimits,
        velocity: Float[Tensor, "*batch n"],
        dt: float,
        cap: float = math.inf,
    ):
        """Start monitoring.

        Args:
            limits: Limits of the joints.
            velocity: Steady velocity at the start [rad/s].
            dt: Step [s].
            cap: Highest speed of the points [m/s].
        """
        self._limits, self._velocity, self._dt = limits, velocity, dt
        self._cap = cap
        self._acceleration = torch.zeros_like(velocity)

    def violations(
        self,
        q: Float[Tensor, "*batch n"],
        velocity: Float[Tensor, "*batch n"],
        points: Float[Tensor, "*batch points 3 n"] | None = None,
        dt: float | None = None,
    ) -> Bool[Tensor, "*batch 5"]:
        """Flags of exceeded limits in a step: position, velocity, acceleration, jerk, speed.

        Args:
            q: Joint positions, on which velocity limits may depend [rad].
            velocity: Velocity commanded for the step [rad/s].
            points: Linear Jacobians of the points whose speed is capped; None: none.
            dt: The step [s], where it differs from the usual one.
        """
        limits, dt = self._limits, dt or self._dt
        slowest, fastest = limits.velocity_bounds(q)
        acceleration = (velocity - self._velocity) / dt
        jerk = (acceleration - self._acceleration) / dt
        self._velocity, self._acceleration = velocity, acceleration
        broken = [
            (q > limits.upper) | (q < limits.lower),
            (velocity > fastest) | (velocity < slowest),
            acceleration.abs() > limits.acceleration * _MONITOR_TOLERANCE,
            jerk.abs() > limits.jerk * _MONITOR_TOLERANCE,
        ]
        if points is None:
            points = velocity.new_zeros(*velocity.shape[:-1], 1, 3, velocity.shape[-1])
        speed = torch.einsum("...pin,...n->...pi", points, velocity).norm(dim=-1)
        broken.append(speed > self._cap)
        return torch.stack([flags.any(-1) for flags in broken], dim=-1)
