"""Bayesian ridge regression of the weights on pairs of key frames.

Each image row is dx = w . phi + noise with phi = dr (x) theta, a Gaussian prior on w and
Gaussian noise: mean and covariance of w are in closed form, from summed statistics alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import reduce
from operator import add
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.jacobian.samples import KeyFrameConfig, RegressionStatistics


@dataclass(frozen=True, kw_only=True)
class ImageJacobianFitConfig(KeyFrameConfig):
    """Which frames are compared, and what is believed before they are."""

    pixel_noise: float = 0.5
    """Standard deviation of the measured feature [px]; enters twice into each difference.
    Where the held-out error shows more, because the network is too coarse, that is used."""
    bias_std: float = 1500.0
    """Prior standard deviation of the Jacobian's mean over the workspace [px/m]."""
    weight_std: float = 500.0
    """Prior standard deviation of each neuron's departure from that mean [px/m]."""


@dataclass(frozen=True, kw_only=True)
class ImageJacobianFitReport:
    """How well a fitted image Jacobian predicts the motion of the feature between key frames.

    Errors are root mean squares of the error's length [px].
    """

    pairs: int
    """Pairs of key frames used."""
    motion: float
    """Motion of the feature itself: the error of predicting none [px]."""
    error: float
    """Over the pairs that were fitted [px]."""
    held_out_error: float
    """Over pairs that were not: cross-validation by demonstration, or by fifths of a single
    one [px]. NaN where all pairs fall into one part."""
    noise: float
    """Standard deviation of dx in each coordinate that the posterior assumes [px]."""

    def summary(self) -> dict[str, Any]:
        """As plain numbers."""
        return asdict(self)


@dataclass(frozen=True, kw_only=True, eq=False)
class Posterior:
    """Distribution of the weights after the fit."""

    mean: Float[Tensor, "P 2"]
    """[px/m], one column an image row."""
    covariance: Float[Tensor, "P P"]
    """Of either image row [(px/m)^2]."""


def weight_covariance(
    centers: Float[Tensor, "K _"],
    bias_std: float | Float[Tensor, ""],
    weight_std: float | Float[Tensor, ""],
) -> Float[Tensor, "K K"]:
    """Prior covariance between neurons, for each entry of the Jacobian alone.

    The entry is a bias, common to all neurons, plus a departure of each. With normalised
    neurons, which sum to one, that is a constant Jacobian plus a network: what is learned in
    one place holds everywhere until a place says otherwise.

    Args:
        centers: Of the neurons; gives their number, dtype and device.
        bias_std: Standard deviation of the bias [px/m].
        weight_std: Standard deviation of the departures [px/m].
    """
    K = len(centers)
    eye = torch.eye(K, dtype=centers.dtype, device=centers.device)
    return bias_std**2 * torch.ones_like(eye) + weight_std**2 * eye


def prior_precision(
    centers: Float[Tensor, "K _"], config: ImageJacobianFitConfig
) -> Float[Tensor, "P P"]:
    """Inverse covariance of the weights before anything was seen."""
    prior = weight_covariance(centers, config.bias_std, config.weight_std)
    return torch.block_diag(*[torch.linalg.inv(prior)] * 6)


def fit_weights(
    folds: Sequence[RegressionStatistics],
    precision: Float[Tensor, "P P"],
    config: ImageJacobianFitConfig,
) -> tuple[Posterior, ImageJacobianFitReport]:
    """Fit to all folds; each in turn is held out to measure the error on unseen data.

    Args:
        folds: Statistics of parts of the data that were recorded apart.
        precision: Of the prior (see `prior_precision`).
        config: Noise of the feature.

    Raises:
        ValueError: There is no pair at all.
    """
    folds = [fold for fold in folds if fold.count]
    if not folds:
        raise ValueError(
            "no two visible key frames are within reach of each other: the feature was not "
            "seen, or the tool moved less than min_step or more than max_step at a time."
        )
    total = reduce(add, folds)
    noise = 2 * config.pixel_noise**2  # of a difference of two measurements
    held_out = _held_out_square(folds, precision, noise)
    # The network may be too coarse for the data: then its error is noise to the weights. Half
    # of it, as the square sums two coordinates. (NaN, with one fold, leaves the noise.)
    noise = max(noise, held_out / 2)
    posterior = solve(total, precision, noise)
    report = ImageJacobianFitReport(
        pairs=total.count,
        motion=float(total.energy / total.count) ** 0.5,
        error=(total.squared_error(posterior.mean) / total.count) ** 0.5,
        held_out_error=held_out**0.5,
        noise=noise**0.5,
    )
    return posterior, report


def solve(
    statistics: RegressionStatistics, precision: Float[Tensor, "P P"], noise: float
) -> Posterior:
    """Posterior of the weights for a zero-mean prior.

    Args:
        statistics: Of the data.
        precision: Inverse covariance of the prior.
        noise: Variance of each coordinate of dx [px^2].
    """
    factor = torch.linalg.cholesky(statistics.gram / noise + precision)
    mean = torch.cholesky_solve(statistics.cross / noise, factor)
    return Posterior(mean=mean, covariance=torch.cholesky_inverse(factor))


def _held_out_square(
    folds: Sequence[RegressionStatistics], precision: Tensor, noise: float
) -> float:
    """Mean squared error over all pairs, each predicted without its own fold."""
    if len(folds) == 1:
        return float("nan")
    error = 0.0
    for i, held_out in enumerate(folds):
        rest = reduce(add, [*folds[:i], *folds[i + 1 :]])
        error += held_out.squared_error(solve(rest, precision, noise).mean)
    return error / sum(fold.count for fold in folds)
