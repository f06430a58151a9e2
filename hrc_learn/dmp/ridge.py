"""Ridge regression with its held-out residuals in closed form."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

CONSTANT = 1e-12
"""Standard deviation relative to the size below which a feature counts as constant: what is
left after the mean is subtracted is rounding."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RidgeFit:
    """Linear map y = a + B (x - mean) / scale, fitted to n samples."""

    mean: Float[Tensor, "F"]
    scale: Float[Tensor, "F"]
    """Standard deviation of each feature; one if it is constant or not standardised."""
    coefficients: Float[Tensor, "F_and_1 K"]
    """a in the first row, B transposed in the others."""
    held_out: Float[Tensor, "n K"]
    """Difference of each sample to its prediction from all others."""


def fit_ridge(
    features: Float[Tensor, "n F"],
    targets: Float[Tensor, "n K"],
    regularization: float,
    *,
    standardize: bool = True,
) -> RidgeFit:
    """Minimise |Y - A X|^2 + n regularization |B|^2, A = [1, (features - mean) / scale].

    The constant is not penalised, so that a strong penalty leads to the mean of the targets.
    With the hat matrix H = A (A'A + P)^-1 A', the residual of sample i in a fit without it, at
    the same penalty P, is e_i / (1 - H_ii) (PRESS; Allen 1974, "The relationship between
    variable selection and data augmentation").

    Args:
        features: Features of n >= 2 samples.
        targets: Targets of the samples.
        regularization: Positive; 1 gives penalty and data equal weight.
        standardize: True to divide features by their standard deviation. False suits
            features on one scale, where those that hardly vary should have little effect.

    Raises:
        ValueError: Fewer than 2 samples, or a regularization that is not positive.
    """
    n, F = features.shape
    if n < 2:
        raise ValueError(f"a regression needs at least 2 samples, got {n}")
    if not 0 < regularization < torch.inf:
        raise ValueError(f"regularization must be positive, got {regularization}")
    mean, deviation = features.mean(0), features.std(0, correction=0)
    # A constant feature has a deviation by rounding only.
    varies = standardize & (deviation > CONSTANT * features.abs().amax(0))
    scale = torch.where(varies, deviation, 1.0)
    A = torch.cat([torch.ones_like(features[:, :1]), (features - mean) / scale], dim=1)
    penalty = torch.zeros(F, F + 1).to(A)
    # The constant is not penalised.
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
