"""The paper's rule that turns the gripper as the hand moves sideways (eq. coarse_orientation).

A three-axis haptic device moves the end effector but cannot turn it. So the tilt follows from
the sideways position: straight down in front of the robot, level at the end of its reach.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import quaternion


def gripper_down() -> Float[Tensor, "4"]:
    """Orientation of a gripper that points down and closes along the base's x axis (wxyz)."""
    return torch.tensor([0.0, math.sqrt(0.5), math.sqrt(0.5), 0.0], dtype=torch.float64)


def coarse_orientation(
    position: Float[Tensor, "*batch 3"], reach: float = 0.6, tilt: float = math.pi / 2
) -> Float[Tensor, "*batch 4"]:
    """Orientation of the end effector that goes with its position.

    The paper gives r_5 = beta_0 r_2 / Y_0, limited to +-beta_0, without saying about which
    axis. We tilt the gripper-down frame by that angle about the base's x axis: a hand that
    moves to the right (-y) points to the right.

    Args:
        position: Of the end effector [m].
        reach: Y_0 [m].
        tilt: beta_0 [rad].

    Returns:
        Unit quaternions (wxyz).
    """
    angle = tilt * (position[..., 1] / reach).clamp(-1.0, 1.0)
    zero = torch.zeros_like(angle)
    turn = quaternion.exp(torch.stack([angle, zero, zero], dim=-1))
    return quaternion.multiply(turn, gripper_down().to(position))
