"""Ridge regression in closed form, and its leave-one-out error."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

CONSTANT = 1e-12
"""Features that vary by less than this share of their size do not vary."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RidgeFit:
    """y = a + B (x - mean) / scale, fitted to n samples."""

    mean: Float[Tensor, "F"]
    scale: Float[Tensor, "F"]
    """Standard deviation of each feature; one where it never changes."""
    coefficients: Float[Tensor, "F_and_1 K"]
    """First row a, the others B transposed."""
    held_out: Float[Tensor, "n K"]
    """What each sample differs by from its prediction by a fit to all others."""


def fit_ridge(
    features: Float[Tensor, "n F"], targets: Float[Tensor, "n K"], regularization: float
) -> RidgeFit:
    """Minimise |Y - A X|^2 + n regularization |B|^2, A = [1, (features - mean) / scale].

    The constant is free, so that a strong penalty leads to the mean of the targets. With
    the hat matrix H = A (A'A + P)^-1 A', the residual of a fit without sample i, at the same
    penalty P, is e_i / (1 - H_ii) (PRESS; Allen 1974, "The relationship between variable
    selection and data augmentation").

    Args:
        features: n >= 2.
        targets: Fitted alike, column by column.
        regularization: Positive; 1 weighs the penalty as much as the data.

    Raises:
        ValueError: Fewer than 2 samples, or a regularization that is not positive.
    """
    n, F = features.shape
    if n < 2:
        raise ValueError(f"a regression needs at least 2 samples, got {n}")
    if not 0 < regularization < torch.inf:
        raise ValueError(f"regularization must be positive, got {regularization}")
    mean, deviation = features.mean(0), features.std(0, correction=0)
    # What is left of a constant in rounding is no deviation.
    varies = deviation > CONSTANT * features.abs().amax(0)
    scale = torch.where(varies, deviation, 1.0)
    A = torch.cat([torch.ones_like(features[:, :1]), (features - mean) / scale], dim=1)
    penalty = torch.zeros(F, F + 1).to(A)
    penalty[:, 1:].fill_diagonal_((n * regularization) ** 0.5)
    # QR of the stacked system: A'A would square its condition number.
    Q, R = torch.linalg.qr(torch.cat([A, penalty]))
    Q = Q[:n]
    coefficients = torch.linalg.solve_triangular(R, Q.mT @ targets, upper=True)
    leverage = Q.square().sum(1, keepdim=True)
    return RidgeFit(
        mean=mean,
        scale=scale,
        coefficients=coefficients,
        held_out=(targets - A @ coefficients) / (1 - leverage),
    )
