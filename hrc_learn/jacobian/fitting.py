"""Radial basis functions of the image Jacobian, and the regression of their weights.

The paper calls each basis function a neuron. The weights follow from Bayesian ridge regression
on pairs of key frames: each image row is dx = w . phi + noise with phi = dr (x) theta, a
Gaussian prior on w and Gaussian noise. Mean and covariance of w then have a closed form in
summed statistics.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import reduce
from operator import add
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn import distributed
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian.motion_samples import (
    ImageDemonstration,
    KeyFrameConfig,
    RegressionStatistics,
)

# Least distance of outer neurons from the middle [m, rad]: with hardly any demonstrated motion
# along a component, closer neurons could not be distinguished.
_LEAST_REACH = 0.05
# Width of the neurons relative to the largest distance from the middle: wide enough to blend
# over the whole workspace, narrow enough to distinguish its ends.
_WIDTH_OVER_REACH = 1.5


def radial_basis(
    inputs: Float[Tensor, "*batch n"],
    centers: Float[Tensor, "K n"],
    width: Float[Tensor, ""],
    *,
    normalized: bool,
) -> Float[Tensor, "*batch K"]:
    """Gaussian neurons theta_k = exp(-|x - c_k|^2 / (2 width^2)), the paper's (eq_rbf).

    Args:
        inputs: Points of evaluation.
        centers: Centre of each neuron.
        width: Standard deviation of the Gaussians, in the unit of `inputs`.
        normalized: Divide by the sum over neurons. The neurons then sum to one everywhere:
            equal weights give a constant function, and far from all centres the nearest neuron
            dominates.
    """
    square = (inputs.unsqueeze(-2) - centers).square().sum(-1)
    exponent = -square / (2 * width.square())
    return torch.softmax(exponent, dim=-1) if normalized else torch.exp(exponent)


def grid(*axes: tuple[float, float, int]) -> Float[Tensor, "K n"]:
    """Centres on a regular grid.

    Args:
        axes: First value, last value and number of centres along each input.
    """
    lines = [torch.linspace(*axis, dtype=torch.float64) for axis in axes]
    return torch.cartesian_prod(*lines).reshape(-1, len(axes))


def paper_grid() -> Float[Tensor, "9 2"]:
    """Table I: (0.05, 0.35) + (0.15 i, 0.15 j) for i, j = 0, 1, 2, in x and y [m]."""
    return grid((0.05, 0.35, 3), (0.35, 0.65, 3))


@dataclass(frozen=True, kw_only=True, eq=False)
class RBFCenters:
    """Normalised Gaussians of selected components of the tool pose."""

    centers: Float[Tensor, "K n"]
    """Centre of each neuron (row), one column an input [m, rad]."""
    width: float | Float[Tensor, ""]
    """Standard deviation of the Gaussians, one number in the same units."""
    input_indices: tuple[int, ...] = (0, 1)
    """Components of (x, y, z, rotation vector) that are inputs of the neurons."""
    reference: Float[Tensor, "4"] | None = None
    """Orientation to which the rotation vector is relative; None: that of the base."""

    @staticmethod
    def paper() -> RBFCenters:
        """Nine over the paper's table, which see x and y (Table I)."""
        return RBFCenters(centers=paper_grid(), width=0.1)

    @staticmethod
    def around(demonstrations: Sequence[ImageDemonstration]) -> RBFCenters:
        """Thirteen neurons about the demonstrated poses: the middle, and both ends of all axes.

        The image Jacobian of a small workspace is nearly linear in position and rotation, which
        these represent; a grid over six inputs would need hundreds.

        Args:
            demonstrations: Demonstrations, read one by one, twice. Each of several processes
                reads a part of them.
        """
        reference = _mean_orientation(demonstrations)
        low, high = _range(demonstrations, reference)
        middle, reach = (low + high) / 2, ((high - low) / 2).clamp_min(_LEAST_REACH)
        return RBFCenters(
            centers=torch.cat([middle[None], middle + reach.diag(), middle - reach.diag()]),
            width=_WIDTH_OVER_REACH * float(reach.max()),
            input_indices=tuple(range(6)),
            reference=reference,
        )

    def basis(self) -> Callable[[Pose], Tensor]:
        """Function from poses (time,) to activations (time, K); differentiable in the centres
        and the width.
        """

        def activation(pose: Pose) -> Tensor:
            inputs = pose_inputs(pose, self.reference)[..., self.input_indices]
            width = torch.as_tensor(self.width, dtype=inputs.dtype)
            return radial_basis(inputs, self.centers.to(inputs), width, normalized=True)

        return activation


def pose_inputs(pose: Pose, reference: Float[Tensor, "4"] | None) -> Float[Tensor, "*batch 6"]:
    """Position [m] and rotation vector from the reference to the orientation [rad].

    A rotation vector jumps at half turns: choose the reference in the middle of the tool's
    orientations.
    """
    if reference is None:
        return pose.vector()
    back = quaternion.conjugate(reference)
    turn = quaternion.log(quaternion.multiply(pose.orientation, back))
    return torch.cat([pose.position, turn], dim=-1)


def _mean_orientation(demonstrations: Sequence[ImageDemonstration]) -> Float[Tensor, "4"]:
    """Largest eigenvector of the summed outer products (Markley et al. 2007); either sign."""
    total = torch.zeros(4, 4, dtype=torch.float64)
    for _, demonstration in distributed.local_items(demonstrations):
        orientation = demonstration.pose.orientation.double()
        total += orientation.mT @ orientation
    return torch.linalg.eigh(distributed.sum_over_processes(total)).eigenvectors[:, -1]


def _range(
    demonstrations: Sequence[ImageDemonstration], reference: Float[Tensor, "4"]
) -> tuple[Float[Tensor, "6"], Float[Tensor, "6"]]:
    """Smallest and largest value of every input."""
    low = torch.full((6,), torch.inf, dtype=torch.float64)
    high = -low
    for _, demonstration in distributed.local_items(demonstrations):
        pose = demonstration.pose
        pose = Pose(pose.position.double(), pose.orientation.double())
        inputs = pose_inputs(pose, reference)
        low = torch.minimum(low, inputs.amin(dim=0))
        high = torch.maximum(high, inputs.amax(dim=0))
    lows, highs = (torch.stack(distributed.gather(end)) for end in (low, high))
    return lows.amin(dim=0), highs.amax(dim=0)


@dataclass(frozen=True, kw_only=True)
class ImageJacobianFitConfig(KeyFrameConfig):
    """Choice of key frames, noise and prior of a fit."""

    pixel_noise: float = 0.5
    """Standard deviation of the measured feature [px]; enters twice into each difference. A
    larger held-out error, from a network that is too coarse, replaces it."""
    bias_std: float = 1500.0
    """Prior standard deviation of the mean Jacobian of the workspace [px/m]."""
    weight_std: float = 500.0
    """Prior standard deviation of each neuron's deviation from the mean [px/m]."""


@dataclass(frozen=True, kw_only=True)
class ImageJacobianFitReport:
    """Prediction errors of a fitted image Jacobian for feature motion between key frames.

    Errors are root mean squares of the error's length [px].
    """

    pairs: int
    """Number of pairs of key frames."""
    motion: float
    """Motion of the feature, the error of predicting no motion [px]."""
    error: float
    """Error over the fitted pairs [px]."""
    held_out_error: float
    """Cross-validation error by demonstrations, or by fifths of a single one [px]. NaN if all
    pairs belong to one part."""
    noise: float
    """Standard deviation of each coordinate of dx that the posterior assumes [px]."""

    def summary(self) -> dict[str, Any]:
        """The report as plain numbers."""
        return asdict(self)


@dataclass(frozen=True, kw_only=True, eq=False)
class Posterior:
    """Distribution of the weights after the fit."""

    mean: Float[Tensor, "P 2"]
    """Mean of the weights [px/m], one column an image row."""
    covariance: Float[Tensor, "P P"]
    """Covariance of the weights of either image row [(px/m)^2]."""


def weight_covariance(
    centers: Float[Tensor, "K _"],
    bias_std: float | Float[Tensor, ""],
    weight_std: float | Float[Tensor, ""],
) -> Float[Tensor, "K K"]:
    """Prior covariance between neurons for a single entry of the Jacobian.

    The entry is a bias, common to all neurons, plus a deviation of each. With normalised
    neurons, which sum to one, that is a constant Jacobian plus a network: an observation at one
    place applies everywhere until other places are observed.

    Args:
        centers: Centres of the neurons; give their number, dtype and device.
        bias_std: Standard deviation of the bias [px/m].
        weight_std: Standard deviation of the deviations [px/m].
    """
    K = len(centers)
    eye = torch.eye(K, dtype=centers.dtype, device=centers.device)
    return bias_std**2 * torch.ones_like(eye) + weight_std**2 * eye


def prior_precision(
    centers: Float[Tensor, "K _"], config: ImageJacobianFitConfig
) -> Float[Tensor, "P P"]:
    """Inverse prior covariance of the weights."""
    prior = weight_covariance(centers, config.bias_std, config.weight_std)
    return torch.block_diag(*[torch.linalg.inv(prior)] * 6)


def fit_weights(
    folds: Sequence[RegressionStatistics],
    precision: Float[Tensor, "P P"],
    config: ImageJacobianFitConfig,
) -> tuple[Posterior, ImageJacobianFitReport]:
    """Fit to all folds; each in turn is held out to measure the error on unseen data.

    Args:
        folds: Statistics of separately recorded parts of the data.
        precision: Prior precision (see `prior_precision`).
        config: Noise of the feature.

    Raises:
        ValueError: There is no pair of key frames.
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
    # A network that is too coarse for the data has an error that acts as noise on the weights.
    # Half of it, as the square sums two coordinates. (NaN, with one fold, keeps the noise.)
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
        statistics: Statistics of the data.
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
    without = weights_without_each(folds, precision, noise)
    error = sum(fold.squared_error(W) for fold, W in zip(folds, without, strict=True))
    return error / sum(fold.count for fold in folds)


def weights_without_each(
    folds: Sequence[RegressionStatistics], precision: Float[Tensor, "P P"], noise: float
) -> list[Float[Tensor, "P 2"]]:
    """Posterior means of all folds but one, for each fold left out."""
    rests = (reduce(add, [*folds[:i], *folds[i + 1 :]]) for i in range(len(folds)))
    return [solve(rest, precision, noise).mean for rest in rests]
