"""Inverting the Jacobian of a redundant arm."""

import torch
from jaxtyping import Float
from torch import Tensor

# Smallest singular value of the 6 x n Jacobian (metres and radians mixed, as it stands) below
# which inverting it exactly asks for joint speeds an arm does not have.
SINGULAR_BELOW = 0.05


def pseudo_inverse(
    J: Float[Tensor, "*batch 6 joints"], damping: Float[Tensor, "*#batch"] | float = 0.0
) -> Float[Tensor, "*batch joints 6"]:
    """Right pseudo-inverse J^T (J J^T + damping^2 I)^-1.

    Without damping it inverts exactly wherever J has full rank, and fails or overflows where
    it has not: pass `singularity_damping(J)` to be safe everywhere.

    Args:
        J: Jacobian with at least as many joints as rows.
        damping: Not negative; bounds the gain by 1 / (2 damping).
    """
    return torch.linalg.solve(_gram(J, damping), J).mT


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


def singularity_damping(
    J: Float[Tensor, "*batch 6 joints"], strength: float = SINGULAR_BELOW
) -> Float[Tensor, "*batch"]:
    """Damping that is exactly zero away from singularities and grows smoothly towards them.

    damping^2 = strength^2 (1 - (sigma_min / 0.05)^2) below sigma_min = 0.05, else 0
    (Maciejewski and Klein 1988, numerical filtering of the smallest singular value).

    Args:
        J: Jacobian.
        strength: Damping at the singularity itself. With the default the gain of the
            pseudo-inverse grows to 1 / 0.05 = 20 and from there falls in proportion to
            sigma_min, to zero at the singularity.
    """
    smallest = torch.linalg.svdvals(J)[..., -1]
    depth = torch.clamp_min(1 - torch.square(smallest / SINGULAR_BELOW), 0.0)
    # The derivative of sqrt at zero is infinite: leave it out of the branch not chosen.
    outside = depth == 0
    return torch.where(outside, 0.0, strength * torch.sqrt(torch.where(outside, 1.0, depth)))


def _gram(J: Tensor, damping: Tensor | float) -> Tensor:
    gram = J @ J.mT
    if isinstance(damping, Tensor):
        damping = damping[..., None, None]
    elif damping == 0:
        return gram
    return gram + damping**2 * torch.eye(J.shape[-2], dtype=J.dtype, device=J.device)
