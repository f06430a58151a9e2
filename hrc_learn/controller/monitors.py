"""What watches a run from outside: the Lyapunov function and its rate, and motion limits.

V = P_v(x) + P_c(r) + 1/2 tr(W~ L^-1 W~^T),  W~ = W - W_hat                          (vt)

`docs/controller.md` states under which assumptions V_dot = -|s|^2. `Command.potential` and
`Command.potential_rate` hold the part that needs no true weights, at every step.
"""

from __future__ import annotations

from typing import final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.kinematics import JointLimits

# Differences of rounded numbers may exceed a limit in the last digits.
_ROUNDING = 1 + 1e-9


def lyapunov_function(
    potential: Float[Tensor, "*batch"],
    weight_error: Float[Tensor, "*batch rows K"],
    gain: float,
) -> Float[Tensor, "*batch"]:
    """V of (vt), with the factor 1/2 that its trace lacks in print.

    Args:
        potential: P_v + P_c.
        weight_error: W~, which only a simulation knows.
        gain: Of the paper's update, L = gain I.
    """
    return potential + weight_error.square().sum((-2, -1)) / (2 * gain)


def lyapunov_rate(s: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch"]:
    """V_dot = -|s|^2 where the assumptions hold."""
    return -torch.linalg.vecdot(s, s)


def potential_rate(
    s: Float[Tensor, "*batch 6"],
    jacobian: Float[Tensor, "*batch 6 n"],
    joint_velocity: Float[Tensor, "*batch n"],
) -> Float[Tensor, "*batch"]:
    """Rate of P_v + P_c that a joint velocity brings if the image Jacobian is right [1/s].

    Its fall behind the measured change of the potential shows an image Jacobian that is wrong,
    its rise above zero a motion that a limit or a person has turned against the task.
    """
    twist = torch.linalg.vecdot(jacobian, joint_velocity.unsqueeze(-2))
    return torch.linalg.vecdot(s, twist)


@final
class LimitMonitor:
    """Checks the motion limits of commanded joint velocities, from step to step.

    Independent of the safety filter that ought to keep them.
    """

    def __init__(self, limits: JointLimits, velocity: Float[Tensor, "*batch n"], dt: float):
        """Begin.

        Args:
            limits: Of the joints.
            velocity: At the start, steady [rad/s].
            dt: Step [s].
        """
        self._limits, self._velocity, self._dt = limits, velocity, dt
        self._acceleration = torch.zeros_like(velocity)

    def violations(
        self, q: Float[Tensor, "*batch n"], velocity: Float[Tensor, "*batch n"]
    ) -> Bool[Tensor, "*batch 4"]:
        """Whether limits of position, velocity, acceleration and jerk are broken in a step.

        Args:
            q: Joint position, which limits of velocity may depend on [rad].
            velocity: Commanded for the step [rad/s].
        """
        limits = self._limits
        slowest, fastest = limits.velocity_bounds(q)
        acceleration = (velocity - self._velocity) / self._dt
        jerk = (acceleration - self._acceleration) / self._dt
        self._velocity, self._acceleration = velocity, acceleration
        broken = [
            (q > limits.upper) | (q < limits.lower),
            (velocity > fastest) | (velocity < slowest),
            acceleration.abs() > limits.acceleration * _ROUNDING,
            jerk.abs() > limits.jerk * _ROUNDING,
        ]
        return torch.stack([flags.any(-1) for flags in broken], dim=-1)
