"""Least-squares fits of weights and start velocities to samples, and ridge regression.

Demonstrations with the same normalised times are fitted by one matrix product. Demonstrations
with different times are fitted by batched normal equations.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.dmp.dynamics import balanced_units
from hrc_learn.dmp.ragged_times import LONG, blocks, motion
from hrc_learn.dmp.response import Response
from hrc_learn.dmp.samples import Samples
from hrc_learn.geometry.numerics import cached_tensors

REGULARIZATION = 1e-7
"""Default ridge of a fit: far above rounding, far below what a sensor resolves."""
BLOCK = 2**13
"""Number of samples whose columns are computed at a time: 3 MB, which fit the cache."""
METHODS = ("trajectory", "ridge", "lwr")
SAMPLES_PER_FUNCTION = 20
"""Samples per basis function on the even grid on which mixed columns are orthonormal."""
WELL_POSED = 1e-3
"""Smallest allowed ratio of the smallest to the largest diagonal entry of a Cholesky factor.
The matrix that is factored has the square of this ratio: at 1e-4, half of the digits of float64
are lost."""
CONSTANT = 1e-12
"""Standard deviation of a feature, relative to its size, below which the feature counts as
constant: only rounding is left when the mean is subtracted."""
type Fit = tuple[Float[Tensor, "*batch D N"], Float[Tensor, "*batch D"]]
"""Weights and start velocity dy/ds."""


def fit_samples(
    method: str, response: Response, samples: Samples, regularization: float
) -> tuple[Float[Tensor, "B D N"], Float[Tensor, "B D"]]:
    """Fit weights of the unscaled forcing term and the start velocity dy/ds, in float64.

    Args:
        method: `"trajectory"`, least squares on the positions; `"ridge"`, ridge regression on
            the force; `"lwr"`, locally weighted regression on the force, which fits each weight
            separately, as in the paper.
        response: Response of the primitive to be fitted.
        samples: One demonstration or many.
        regularization: Ridge, relative to the largest singular value of the design matrix.
    """
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}; choose from {', '.join(METHODS)}")
    if not 0 <= regularization < math.inf:
        raise ValueError(f"regularization must be finite, not negative: {regularization}")
    position = samples.position.double()
    rate = None
    if samples.velocity is not None:
        rate = samples.velocity.double() * samples.duration[:, None, None]
    if samples.shared_grid and samples.s.shape[1] <= LONG:
        return _fit(method, response, samples.s[0], position, rate, regularization)
    weights = position.new_empty(*position.shape[:2], response.basis.count)
    start_rate = position.new_empty(position.shape[:2])
    remaining = torch.ones(len(position), dtype=torch.bool)
    if method == "trajectory" and not response.basis.periodic:
        weights, start_rate, remaining = _fit_ragged(response, samples, rate, regularization)
    for i in remaining.nonzero()[:, 0].tolist():
        valid = samples.mask[i]
        one_rate = None if rate is None else rate[i, :, valid]
        s = samples.s[i, valid]
        weights[i], start_rate[i] = _fit(
            method, response, s, position[i, :, valid], one_rate, regularization
        )
    return weights, start_rate


def _fit_ragged(
    response: Response,
    samples: Samples,
    rate: Float[Tensor, "B D T"] | None,
    regularization: float,
) -> tuple[Float[Tensor, "B D N"], Float[Tensor, "B D"], Bool[Tensor, "B"]]:
    """Least squares on the trajectory for all demonstrations at once, on ragged times.

    Returns:
        Weights, start velocity dy/ds, and a flag for each demonstration. If the flag is true,
        the samples do not determine all weights, and the other results must not be used.
    """
    known = [samples.first.double(), samples.last.double()]
    if rate is not None:
        first = samples.mask.long().argmax(-1)[:, None, None]
        known.insert(0, torch.take_along_dim(rate, first, -1)[..., 0])
    products = normal_products(response, samples, torch.stack(known, 1))
    n = response.size - len(known)
    unknown, _, undetermined = solve_normal(response, n, products, regularization)
    if rate is None:
        return unknown[..., :-1], unknown[..., -1], undetermined
    return unknown, known[0], undetermined


def normal_products(
    response: Response, samples: Samples, known: Float[Tensor, "B k D"]
) -> Float[Tensor, "B m m"]:
    """Products for `solve_normal`; products of several demonstrations may be added.

    Args:
        response: Response of the primitive, with a basis that is not periodic.
        samples: Demonstrations.
        known: The last k coordinates: start velocity dy/ds if it is known, start, and goal.

    Returns:
        Products [A B]'[A B], summed over the valid samples. A holds n mixed columns. They are
        orthonormal on an even grid, so the products lose no digits if the samples determine all
        weights. B holds the positions without the effect of `known`.
    """
    M = response.size
    n = M - known.shape[1]
    mixing, _ = _orthonormal_columns(response, n, samples.s.device)
    D = samples.position.shape[1]
    products = known.new_zeros(len(known), n + D, n + D)
    for part, span in blocks(samples.s, BLOCK):
        s = samples.s[part, span]
        # One motion for each column, at the times of all demonstrations.
        columns = motion(response, s.reshape(1, -1), mixing.mT[None], 0).view(*s.shape, M)
        left = samples.position[part, :, span].double().mT - columns[..., n:] @ known[part]
        if not samples.complete:
            columns *= samples.mask[part, span][..., None]
            left *= samples.mask[part, span][..., None]
        columns, sums = columns[..., :n], products[part]
        sums[:, :n, :n] += columns.mT @ columns
        sums[:, :n, n:] += columns.mT @ left
        sums[:, n:, n:] += left.mT @ left
    return products


def solve_normal(
    response: Response, n: int, products: Float[Tensor, "B m m"], regularization: float
) -> tuple[Float[Tensor, "B D n"], Float[Tensor, "B D"], Bool[Tensor, "B"]]:
    """Solve normal equations for the first n coordinates.

    Args:
        response: Response of the primitive.
        n: Number of unknown coordinates.
        products: From `normal_products`.
        regularization: Ridge, relative to the largest singular value of the balanced columns.

    Returns:
        Unknown coordinates, squared residuals, and a flag for each demonstration: true if the
        samples do not determine all coordinates.
    """
    mixing, sigma = _orthonormal_columns(response, n, products.device)
    gram, right = products[:, :n, :n], products[:, :n, n:]
    # The first column has the largest singular value.
    ridge = regularization**2 * gram[:, :1, 0] * (sigma[0] / sigma) ** 2
    factor, failed = torch.linalg.cholesky_ex(gram + torch.diag_embed(ridge))
    diagonal = factor.diagonal(dim1=-2, dim2=-1)
    undetermined = (failed > 0) | ~(diagonal.amin(-1) > WELL_POSED * diagonal.amax(-1))
    z = torch.cholesky_solve(right, factor)
    square = products.diagonal(dim1=-2, dim2=-1)[:, n:] - (z * (2 * right - gram @ z)).sum(1)
    return (mixing[:n, :n] @ z).mT, square.clamp(min=0), undetermined


@cached_tensors(maxsize=16)
def _orthonormal_columns(
    response: Response, n: int, device: torch.device
) -> tuple[Float[Tensor, "M M"], Float[Tensor, "n"]]:
    """Mixtures of the first n columns of the response that are orthonormal on an even grid.

    Returns:
        Coordinates that cause each mixture, one mixture per column (columns after n are those
        of the identity), and the singular values of the balanced design matrix.
    """
    N = response.basis.count
    count = SAMPLES_PER_FUNCTION * N + 1
    even = torch.linspace(0, 1, count, dtype=torch.float64, device=device)
    H = response.evaluate(even)[:, 0]
    unit = balanced_units(response.basis, H, n - N)
    _, sigma, Vh = torch.linalg.svd(H[:, :n] * unit, full_matrices=False)
    mixing = torch.eye(H.shape[1]).to(H)
    mixing[:n, :n] = unit[:, None] * Vh.mT / sigma
    return mixing, sigma


def _fit(
    method: str,
    response: Response,
    s: Float[Tensor, "T"],
    position: Float[Tensor, "*batch D T"],
    rate: Float[Tensor, "*batch D T"] | None,
    regularization: float,
) -> Fit:
    """Fit demonstrations on one time grid."""
    # The timestamps as bytes are the key of the cached operators.
    grid = response, s.cpu().numpy().tobytes(), s.device
    if method == "trajectory":
        # Minimise the squared distance to the samples, without differentiation. Start and goal
        # are the first and last sample; the start velocity is recorded or fitted.
        K, to_weights = _trajectory_operator(*grid, rate is None, regularization)
        unknown = _apply(position, K)
        if rate is None:
            return unknown[..., :-1], unknown[..., -1]
        return unknown - rate[..., :1] * to_weights, rate[..., 0]
    if rate is None:
        rate = differentiate(s, position)
    goal = position[..., -1:]
    force = differentiate(s, rate) - response.spring.acceleration(position - goal, rate)
    if response.approach:
        force = force - (goal - position[..., :1]) * response.approach_force(s)
    return _apply(force, _force_operator(*grid, method, regularization)), rate[..., 0]


def _apply(
    y: Float[Tensor, "*batch D T"], K: Float[Tensor, "n T"]
) -> Float[Tensor, "*batch D n"]:
    """One flat product K y for all coordinates of all demonstrations."""
    return (y.reshape(-1, y.shape[-1]) @ K.T).view(*y.shape[:-1], -1)


def differentiate(
    s: Float[Tensor, "T"], y: Float[Tensor, "*batch T"]
) -> Float[Tensor, "*batch T"]:
    """Second-order accurate dy/ds on any spacing, ends included (exact for parabolas)."""
    return torch.gradient(y, spacing=(s,), dim=-1, edge_order=2)[0]


# Demonstrations on one grid use one operator, so 16 grids serve as many datasets.
@cached_tensors(maxsize=16)
def _trajectory_operator(
    response: Response,
    timestamps: bytes,
    device: torch.device,
    fit_rate: bool,
    regularization: float,
) -> tuple[Float[Tensor, "unknown T"], Float[Tensor, "unknown"]]:
    """Matrix from samples to unknowns, and the effect of a known start velocity on unknowns.

    With y_0 = y(0) and g = y(1) taken from the samples, the residual is linear in the samples,
    so one matrix maps samples to unknowns.
    """
    N = response.basis.count
    s = _timestamps(timestamps, device)
    H = response.evaluate(s)[:, 0]
    velocity, start, goal = H[:, N], H[:, N + 1], H[:, N + 2]
    unit = balanced_units(response.basis, H, int(fit_rate))
    K = unit[:, None] * ridge_inverse(H[:, : N + fit_rate] * unit, regularization)
    # Subtract the motion that start and goal cause by themselves.
    from_samples = K.clone()
    from_samples[:, 0] -= K @ start
    from_samples[:, -1] -= K @ goal
    return from_samples, K @ velocity


@cached_tensors(maxsize=16)
def _force_operator(
    response: Response,
    timestamps: bytes,
    device: torch.device,
    method: str,
    regularization: float,
) -> Float[Tensor, "N T"]:
    """Matrix that maps a force to the weights that fit the force best."""
    s, basis = _timestamps(timestamps, device), response.basis
    if method == "ridge":
        return ridge_inverse(basis.forcing(s), regularization)
    # w_i = (z' Gamma_i f) / (z' Gamma_i z) minimises the paper's cost (Cost_i). It needs no
    # ridge: each weight is a weighted mean of samples, which is always well-posed.
    z = basis.phase(s)
    weighted = (basis.kernels(s) * z[:, None]).T
    # A Gaussian narrower than the sampling may cover no sample: its weight is zero then.
    return weighted / (weighted @ z).clamp_min(torch.finfo(s.dtype).tiny)[:, None]


def _timestamps(key: bytes, device: torch.device) -> Float[Tensor, "T"]:
    return torch.frombuffer(bytearray(key), dtype=torch.float64).to(device)


def ridge_inverse(A: Float[Tensor, "T n"], regularization: float) -> Float[Tensor, "n T"]:
    """(A'A + (r sigma_max)^2 I)^-1 A' by singular values; A'A is never formed."""
    U, sigma, Vh = torch.linalg.svd(A, full_matrices=False)
    damping = regularization * sigma[0]
    return (Vh.T * (sigma / (sigma**2 + damping**2))) @ U.T


@dataclass(frozen=True, kw_only=True, eq=False)
class RidgeFit:
    """Linear map y = a + B (x - mean) / scale, fitted to n samples."""

    mean: Float[Tensor, "F"]
    scale: Float[Tensor, "F"]
    """Standard deviation of each feature; one if it is constant or not standardised."""
    coefficients: Float[Tensor, "F_and_1 K"]
    """a in the first row, B transposed in the others."""
    held_out: Float[Tensor, "n K"]
    """Difference between each sample and its prediction from all other samples."""


def fit_ridge(
    features: Float[Tensor, "n F"],
    targets: Float[Tensor, "n K"],
    regularization: float,
    *,
    standardize: bool = True,
) -> RidgeFit:
    """Minimise |Y - A [a B]'|^2 + n regularization |B|^2, A = [1, (features - mean) / scale].

    The constant a is not penalised, so that a strong penalty leads to the mean of the targets.
    Fits without one sample, at the same penalty P, follow from the fit to all samples. If
    sample i is omitted, its residual is e_i / (1 - H_ii), where e_i is its residual in the fit
    to all samples and H = A (A'A + P)^-1 A' is the hat matrix (PRESS; Allen 1974, "The
    relationship between variable selection and data augmentation").

    Args:
        features: Features of n >= 2 samples.
        targets: Targets of the samples.
        regularization: Strength of the penalty, positive; at 1 it weighs as much as the data.
        standardize: True to divide features by their standard deviation. False suits
            features in one unit; features that hardly vary then have little effect.

    Raises:
        ValueError: Fewer than 2 samples, or a regularization that is not positive.
    """
    n, F = features.shape
    if n < 2:
        raise ValueError(f"a regression needs at least 2 samples, got {n}")
    if not 0 < regularization < torch.inf:
        raise ValueError(f"regularization must be positive, got {regularization}")
    mean, deviation = features.mean(0), features.std(0, correction=0)
    # A constant feature deviates from its mean by rounding only.
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
