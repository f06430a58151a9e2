"""Arm angle: one number for the body shape of a seven-joint arm with its hand held still.

The angle by which the plane of shoulder, elbow and wrist is turned out of the vertical about
the line from shoulder to wrist (Kreutz-Delgado et al. 1992). Unlike the position of joint 7 it
changes steadily as the elbow circles, and keeps its meaning when the hand goes elsewhere.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.kinematics.chain import SerialChain
from hrc_learn.kinematics.pseudo_inverse import null_space_projector

_SHOULDER, _ELBOW, _WRIST = 1, 3, 5  # frames of joints 2, 4 and 6
_STEP = 1e-5  # rad; of the central difference


def arm_angle(chain: SerialChain, q: Float[Tensor, "*batch 7"]) -> Float[Tensor, "*batch"]:
    """Angle of the elbow about the line from shoulder to wrist [rad], in (-pi, pi].

    Zero with the elbow straight above that line, positive turning right-handed about it. Not
    defined where the wrist is straight above the shoulder, or the arm is stretched.

    Args:
        chain: A seven-joint arm with shoulder, elbow and wrist at joints 2, 4 and 6.
        q: Joint positions [rad].
    """
    points = chain.joint_origins(q)
    axis = points[..., _WRIST, :] - points[..., _SHOULDER, :]
    axis = torch.nn.functional.normalize(axis, dim=-1)
    upper_arm = points[..., _ELBOW, :] - points[..., _SHOULDER, :]
    up = torch.zeros_like(axis)
    up[..., 2] = 1.0
    side = torch.linalg.cross(axis, up)
    above = torch.linalg.cross(side, axis)
    return torch.atan2((upper_arm * side).sum(-1), (upper_arm * above).sum(-1))


def arm_angle_and_motion(
    chain: SerialChain,
    q: Float[Tensor, "*batch 7"],
    jacobian: Float[Tensor, "*batch 6 7"],
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 7"]]:
    """`arm_angle`, and the joint motion that turns it at 1 rad/s and leaves the hand alone.

    Args:
        chain: The arm.
        q: Joint positions [rad].
        jacobian: Of the hand, at q.

    Returns:
        The angle [rad], and joint velocities [rad/s]; these are bounded near configurations
        in which the null space does not move the elbow.
    """
    N = null_space_projector(jacobian)
    # The projector has rank one: its longest column spans the null space.
    longest = N.norm(dim=-2).argmax(dim=-1)
    column = N.gather(-1, longest[..., None, None].expand(*N.shape[:-1], 1)).squeeze(-1)
    direction = torch.nn.functional.normalize(column, dim=-1)
    step = _STEP * direction
    angle, after, before = arm_angle(chain, torch.stack([q, q + step, q - step]))
    difference = torch.remainder(after - before + torch.pi, 2 * torch.pi) - torch.pi
    rate = (difference / (2 * _STEP)).unsqueeze(-1)
    return angle, direction * rate / (rate * rate + 1e-2)
