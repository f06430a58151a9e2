"""The redundancy of a seven-joint arm: inverting its Jacobian, its arm angle, and the choice of
posture for a pose.

The arm angle is one number for the posture of the arm with its end effector at rest: the
angle by which the plane of shoulder, elbow and wrist is turned out of the vertical about the
line from shoulder to wrist (Kreutz-Delgado et al. 1992). Unlike the position of joint 7 it
changes steadily as the elbow circles, and keeps its meaning when the end effector moves on.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.kinematics.chain import SerialChain

# Smallest singular value of the 6 x n Jacobian (metres and radians mixed, as it stands) below
# which inverting it exactly asks for joint speeds an arm does not have.
SINGULAR_BELOW = 0.05


def pseudo_inverse(
    J: Float[Tensor, "*batch rows joints"], damping: Float[Tensor, "*#batch"] | float = 0.0
) -> Float[Tensor, "*batch joints rows"]:
    """Right pseudo-inverse J^T (J J^T + damping^2 I)^-1.

    Without damping it inverts exactly wherever J has full rank, and fails or overflows where
    it has not.

    Args:
        J: Jacobian with at least as many joints as rows.
        damping: Not negative; bounds the gain by 1 / (2 damping).
    """
    gram = J @ J.mT
    if isinstance(damping, Tensor):
        damping = damping[..., None, None]
    if isinstance(damping, Tensor) or damping != 0:
        gram = gram + damping**2 * torch.eye(J.shape[-2], dtype=J.dtype, device=J.device)
    return torch.linalg.solve(gram, J).mT


def null_space_projector(
    J: Float[Tensor, "*batch 6 joints"], damping: Float[Tensor, "*#batch"] | float = 0.0
) -> Float[Tensor, "*batch joints joints"]:
    """N = I - J^+ J: what is left of a joint velocity when its motion of the tip is removed.

    Args:
        J: Jacobian with at least as many joints as rows.
        damping: As in `pseudo_inverse`. With damping N is no longer a projector: near a
            singularity it lets some motion of the tip through.
    """
    eye = torch.eye(J.shape[-1], dtype=J.dtype, device=J.device)
    return eye - pseudo_inverse(J, damping) @ J


_SHOULDER, _ELBOW, _WRIST = 1, 3, 5  # frames of joints 2, 4 and 6
# Step of the central difference [rad]: rounding and truncation are both near 1e-10 then.
_STEP = 1e-5
# Square of the rate [1] below which the motion that turns the arm angle is damped: near
# configurations in which the null space does not move the elbow it would have no bound.
_DAMPING = 1e-2
# Singular value [1] and distance to a limit [rad] beyond which a posture is as good as any.
_GOOD_SINGULAR_VALUE = 0.2
_GOOD_DISTANCE = 0.5
# Postures nearer to each other lead along the same path [rad].
_ALIKE = 0.5


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
    """`arm_angle`, and the joint motion that turns it at 1 rad/s with the tool at rest.

    Args:
        chain: The arm.
        q: Joint positions [rad].
        jacobian: Jacobian of the tool at q.

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
    # The shorter difference, should the angle wrap around between both ends.
    difference = torch.remainder(after - before + torch.pi, 2 * torch.pi) - torch.pi
    rate = (difference / (2 * _STEP)).unsqueeze(-1)
    return angle, direction * rate / (rate * rate + _DAMPING)


def best_postures(
    chain: SerialChain, solutions: Float[Tensor, "solutions n"]
) -> Float[Tensor, "postures n"]:
    """Those of several joint positions that differ, the most comfortable one first.

    Args:
        chain: The arm.
        solutions: One or more joint positions [rad].
    """
    lower, upper = chain.limits.lower, chain.limits.upper
    distance = torch.minimum(solutions - lower, upper - solutions).amin(-1)
    smallest = torch.linalg.svdvals(chain.jacobian(solutions))[:, -1]
    margin = (distance / _GOOD_DISTANCE).clamp(max=1)
    score = margin + (smallest / _GOOD_SINGULAR_VALUE).clamp(max=1)
    chosen: list[Tensor] = []
    for posture in solutions[score.argsort(descending=True, stable=True)]:
        if all(torch.linalg.vector_norm(posture - other) > _ALIKE for other in chosen):
            chosen.append(posture)
    return torch.stack(chosen)
