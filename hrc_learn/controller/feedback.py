"""Regional feedback in image and Cartesian space, and the validation of the measurements
behind it: what cannot be trusted is replaced before any feedback is computed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.controller.blending import BlendingState
from hrc_learn.controller.interface import Goals, Observation
from hrc_learn.geometry import Pose, quaternion

# Pixel rate that is always allowed [px/s]: keeps the cap above zero at the target itself.
_LEAST_PIXEL_RATE = 1.0


class Feedback(NamedTuple):
    """Feedback vectors of the regions and their combination."""

    xi_x: Float[Tensor, "*batch rows"]
    """Of the vision region, faded by the blending."""
    xi_r: Float[Tensor, "*batch 6"]
    """Of the Cartesian regions, position then orientation."""
    s: Float[Tensor, "*batch 6"]
    """J_s_hat^T xi_x + xi_r."""
    potential: Float[Tensor, "*batch"]
    """Sum of the potentials."""


def regional_feedback(
    goals: Goals,
    pose: Pose,
    blending: BlendingState,
    image_jacobian: Float[Tensor, "*batch rows 6"],
    vision_rate: float,
) -> Feedback:
    """Feedback of the position, orientation and vision regions.

    Args:
        goals: The regions.
        pose: Of the tool.
        blending: How much of vision feedback takes part, and where the feature is.
        image_jacobian: J_s_hat at the pose [px/m, px/rad].
        vision_rate: Fastest decay of the pixel error to ask for [1/s].
    """
    P_t, xi_position = goals.position.feedback(pose.position)
    P_o, xi_orientation = goals.orientation.feedback(pose.orientation)
    P_v, xi_x = goals.vision.feedback(blending.feature)
    xi_r = torch.cat([xi_position, xi_orientation], dim=-1)
    error = blending.feature - goals.vision.target
    gain = blending.level.unsqueeze(-1)
    if vision_rate < math.inf:
        gain = gain / _excess_rate(image_jacobian, xi_x, error, vision_rate)
    xi_x = gain * xi_x
    s = torch.linalg.vecdot(image_jacobian, xi_x.unsqueeze(-1), dim=-2) + xi_r
    return Feedback(xi_x, xi_r, s, P_t + P_o + blending.level * P_v)


def _excess_rate(
    J_s: Tensor, xi_x: Tensor, error: Tensor, vision_rate: float
) -> Float[Tensor, "*batch 1"]:
    """What to divide vision feedback by to keep the rate of the pixel error; at least 1."""
    # The feature moves with J_s J_s^T xi_x, as far as the estimate is right.
    descent = torch.linalg.vecdot(J_s, xi_x.unsqueeze(-1), dim=-2)
    speed = torch.linalg.vecdot(J_s, descent.unsqueeze(-2))
    speed = torch.linalg.vector_norm(speed, dim=-1, keepdim=True)
    distance = torch.linalg.vector_norm(error, dim=-1, keepdim=True)
    allowed = vision_rate * distance + _LEAST_PIXEL_RATE
    return (speed / allowed).clamp(min=1)


def analytic_descent(
    s: Float[Tensor, "*batch 6"], orientation: Float[Tensor, "*batch 4"]
) -> Float[Tensor, "*batch 6"]:
    """Twist B B^T s, to which -J_A^+ (J_sA^T xi_x + xi_rA) amounts (but for the sign).

    With r_dot = B^-1 twist, B = diag(I, J_l(phi)) for the rotation vector phi of the tool, the
    analytic Jacobian is J_A = B^-1 J, so J_A^+ = J^+ B, and a gradient over r is B^T times one
    over small motions of the tool. So s of the geometric form serves both laws; they differ in
    the metric by which a gradient becomes a motion.

    Args:
        s: J_s_hat^T xi_x + xi_r of the geometric form.
        orientation: Of the tool.
    """
    phi = quaternion.log(orientation)
    turn = quaternion.left_jacobian(phi, quaternion.left_jacobian_transposed(phi, s[..., 3:]))
    return torch.cat([s[..., :3], turn], dim=-1)


def validated_position(
    observation: Observation, expected: Float[Tensor, "*batch n"]
) -> tuple[Float[Tensor, "*batch n"], Bool[Tensor, "*batch"]]:
    """Joint position [rad]: measured, or the expected one where that is NaN or stale.

    Returns:
        The position, and where it is the expected one.
    """
    q = observation.joint_position
    stale = ~q.isfinite().all(-1)
    if observation.joint_state_stale is not None:
        stale = stale | observation.joint_state_stale
    return torch.where(stale.unsqueeze(-1), expected, q), stale


def effective_goals(
    observation: Observation, default: Goals
) -> tuple[Goals, Bool[Tensor, "*batch"] | bool]:
    """Goals of this step, and whether the target is known: one that is NaN is not."""
    goals = default if observation.goals is None else observation.goals
    target = observation.target
    if target is None:
        return goals, True
    known = target.isfinite().all(-1)
    target = torch.where(known.unsqueeze(-1), target, goals.vision.target)
    return goals.aimed_at(target), known
