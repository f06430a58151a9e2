"""The model that demonstrations are fitted to: radial basis functions and their weights.

The paper calls each of the functions a neuron, and so do we. Weights come from Bayesian ridge
regression on pairs of key frames: each image row is dx = w . phi + noise with phi = dr (x)
theta, a Gaussian prior on w and Gaussian noise, so that mean and covariance of w are in closed
form, from summed statistics alone.
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
from hrc_learn.jacobian.samples import (
    ImageDemonstration,
    KeyFrameConfig,
    RegressionStatistics,
)

# Least distance of outer neurons from the middle [m, rad]: where hardly any motion was
# demonstrated along a component, closer ones could not be told apart.
_LEAST_REACH = 0.05
# Width of the neurons over the largest distance from the middle: wide enough to blend from one
# end of the workspace to the other, narrow enough to tell them apart.
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
        inputs: Where to evaluate.
        centers: One row a neuron.
        width: Standard deviation of the Gaussians, in the unit of `inputs`.
        normalized: Divide by the sum over neurons. The neurons then sum to one everywhere: a
            weight that is the same for all of them is reproduced everywhere, and far from all
            centres the nearest neuron speaks instead of none.
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
    """Normalised Gaussians of some components of the tool's pose."""

    centers: Float[Tensor, "K n"]
    """One row a neuron, one column an input [m, rad]."""
    width: float | Float[Tensor, ""]
    """Standard deviation of the Gaussians, one number in the same units."""
    input_indices: tuple[int, ...] = (0, 1)
    """Components of (x, y, z, three of a rotation vector) that the neurons see."""
    reference: Float[Tensor, "4"] | None = None
    """Orientation that the rotation vector starts from; None: that of the base."""

    @staticmethod
    def paper() -> RBFCenters:
        """Nine over the paper's table, which see x and y (Table I)."""
        return RBFCenters(centers=paper_grid(), width=0.1)

    @staticmethod
    def around(demonstrations: Sequence[ImageDemonstration]) -> RBFCenters:
        """Thirteen about the demonstrated poses: the middle, and both ways along all six.

        The image Jacobian of a small workspace is nearly linear in position and rotation,
        which takes these; a grid over six inputs would take hundreds.

        Args:
            demonstrations: Read one by one, twice; of several processes, each its share.
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
        """Activation (time, K) of the neurons at poses (time,).

        Gradients reach centres and width.
        """

        def activation(pose: Pose) -> Tensor:
            inputs = pose_inputs(pose, self.reference)[..., self.input_indices]
            width = torch.as_tensor(self.width, dtype=inputs.dtype)
            return radial_basis(inputs, self.centers.to(inputs), width, normalized=True)

        return activation


def pose_inputs(pose: Pose, reference: Float[Tensor, "4"] | None) -> Float[Tensor, "*batch 6"]:
    """Position [m] and rotation vector from the reference to the orientation [rad].

    A rotation vector jumps at half turns: choose the reference in the middle of what the
    tool does.
    """
    if reference is None:
        return pose.vector()
    back = quaternion.conjugate(reference)
    turn = quaternion.log(quaternion.multiply(pose.orientation, back))
    return torch.cat([pose.position, turn], dim=-1)


def _mean_orientation(demonstrations: Sequence[ImageDemonstration]) -> Float[Tensor, "4"]:
    """Largest eigenvector of the summed outer products (Markley et al. 2007); either sign."""
    total = torch.zeros(4, 4, dtype=torch.float64)
    for _, demonstration in distributed.share(demonstrations):
        orientation = demonstration.pose.orientation.double()
        total += orientation.mT @ orientation
    return torch.linalg.eigh(distributed.sum_over_processes(total)).eigenvectors[:, -1]


def _range(
    demonstrations: Sequence[ImageDemonstration], reference: Float[Tensor, "4"]
) -> tuple[Float[Tensor, "6"], Float[Tensor, "6"]]:
    """Smallest and largest value of every input."""
    low = torch.full((6,), torch.inf, dtype=torch.float64)
    high = -low
    for _, demonstration in distributed.share(demonstrations):
        pose = demonstration.pose
        pose = Pose(pose.position.double(), pose.orientation.double())
        inputs = pose_inputs(pose, reference)
        low = torch.minimum(low, inputs.amin(dim=0))
        high = torch.maximum(high, inputs.amax(dim=0))
    lows, highs = (torch.stack(distributed.gather(end)) for end in (low, high))
    return lows.amin(dim=0), highs.amax(dim=0)


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
    without = weights_without_each(folds, precision, noise)
    error = sum(fold.squared_error(W) for fold, W in zip(folds, without, strict=True))
    return error / sum(fold.count for fold in folds)


def weights_without_each(
    folds: Sequence[RegressionStatistics], precision: Float[Tensor, "P P"], noise: float
) -> list[Float[Tensor, "P 2"]]:
    """Posterior means, each of all folds but one."""
    rests = (reduce(add, [*folds[:i], *folds[i + 1 :]]) for i in range(len(folds)))
    return [solve(rest, precision, noise).mean for rest in rests]
