"""Regional feedback in image and Cartesian space."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller.activation import Activation
from hrc_learn.controller.goals import Goals
from hrc_learn.geometry import Pose

# Keeps the cap on the pixel rate finite at the target.
_ONE_PIXEL_PER_SECOND = 1.0


class Feedback(NamedTuple):
    """Feedback vectors of the regions and their combination."""

    xi_x: Float[Tensor, "*batch rows"]
    """Of the vision region, faded by the activation."""
    xi_r: Float[Tensor, "*batch 6"]
    """Of the Cartesian regions, position then orientation."""
    s: Float[Tensor, "*batch 6"]
    """J_s_hat^T xi_x + xi_r."""
    potential: Float[Tensor, "*batch"]
    """Sum of the potentials."""


def regional_feedback(
    goals: Goals,
    pose: Pose,
    activation: Activation,
    image_jacobian: Float[Tensor, "*batch rows 6"],
    vision_rate: float,
) -> Feedback:
    """Feedback of the position, orientation and vision regions.

    Args:
        goals: The regions.
        pose: Of the tool.
        activation: How much of vision feedback takes part, and where the feature is.
        image_jacobian: J_s_hat at the pose [px/m, px/rad].
        vision_rate: Fastest decay of the pixel error to ask for [1/s].
    """
    P_t, xi_position = goals.position.feedback(pose.position)
    P_o, xi_orientation = goals.orientation.feedback(pose.orientation)
    P_v, xi_x = goals.vision.feedback(activation.feature)
    xi_r = torch.cat([xi_position, xi_orientation], dim=-1)
    error = activation.feature - goals.vision.target
    share = activation.level.unsqueeze(-1)
    if vision_rate < math.inf:
        share = share / _excess_rate(image_jacobian, xi_x, error, vision_rate)
    xi_x = share * xi_x
    s = torch.linalg.vecdot(image_jacobian, xi_x.unsqueeze(-1), dim=-2) + xi_r
    return Feedback(xi_x, xi_r, s, P_t + P_o + activation.level * P_v)


def _excess_rate(
    J_s: Tensor, xi_x: Tensor, error: Tensor, vision_rate: float
) -> Float[Tensor, "*batch 1"]:
    """What to divide vision feedback by to keep the rate of the pixel error; at least 1."""
    push = torch.linalg.vecdot(J_s, xi_x.unsqueeze(-1), dim=-2)
    speed = torch.linalg.vecdot(J_s, push.unsqueeze(-2))
    speed = torch.linalg.vector_norm(speed, dim=-1, keepdim=True)
    distance = torch.linalg.vector_norm(error, dim=-1, keepdim=True)
    allowed = vision_rate * distance + _ONE_PIXEL_PER_SECOND
    return (speed / allowed).clamp(min=1)
