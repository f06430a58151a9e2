"""Radial basis functions of the image Jacobian, and the regression of their weights.

Each basis function is called a neuron, as in the paper by Yan et al. The weights w follow from
Bayesian ridge regression on pairs of key frames. For a pair, dr is the motion of the tool, dx
the motion of the image feature, and theta are the activations of the neurons. The model of each
image row is dx = w . phi + noise, with the Kronecker product phi = dr (x) theta, a Gaussian
prior on w and Gaussian noise. Mean and covariance of w then have a closed form in statistics
that are summed over pairs, demonstrations and processes, so only one demonstration is in memory
at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils._pytree import tree_map

from hrc_learn import distributed
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.pytree import registered

# Least distance of the outer neurons from the middle neuron [m, rad]. Along a component with
# hardly any demonstrated motion, neurons would otherwise be too close to be distinguished.
_LEAST_REACH = 0.05
# Width of the neurons relative to the largest distance of a neuron from the middle: wide enough
# to blend over the whole workspace, narrow enough to distinguish its ends.
_WIDTH_OVER_REACH = 1.5
# Number of folds of the data; each is held out in turn to measure the error on unseen data.
FOLDS = 5


@dataclass(frozen=True, kw_only=True)
class KeyFrameConfig:
    """Choice of key frames, which are the frames that are compared."""

    min_step: float = 2e-4
    """Least motion between key frames [m]; `rotation_scale` converts rotations. Choose at least
    ten times the noise of measured poses: pose noise shrinks the Jacobian towards zero
    (regression dilution). At ten times the noise, the Jacobian shrinks by 2 %."""
    max_step: float = 0.05
    """Largest motion of a pair of key frames [m]. A larger motion spans a gap in visibility,
    and is left out."""
    rotation_scale: float = 0.15
    """Length by which rotations are converted to motions, a typical lever arm [m/rad]."""

    def __post_init__(self) -> None:
        check_settings(self, positive=("max_step", "rotation_scale"), not_negative=["min_step"])


@registered
@dataclass(frozen=True, eq=False)
class RegressionStatistics:
    """Sufficient statistics of the linear fit dx = w . phi: sums over pairs of key frames."""

    gram: Float[Tensor, "P P"]
    """Sum of phi phi^T [m^2]."""
    cross: Float[Tensor, "P 2"]
    """Sum of phi dx^T [m px]."""
    energy: Float[Tensor, ""]
    """Sum of |dx|^2 [px^2]."""
    count: int
    """Number of pairs."""

    @staticmethod
    def of(phi: Float[Tensor, "pairs P"], dx: Float[Tensor, "pairs 2"]) -> RegressionStatistics:
        """Statistics of pairs, from their regressors (see `MotionSamples`)."""
        return RegressionStatistics(phi.mT @ phi, phi.mT @ dx, dx.square().sum(), len(dx))

    @staticmethod
    def empty(regressors: int) -> RegressionStatistics:
        """Statistics of no pairs."""
        zeros = torch.zeros(regressors, regressors + 2, dtype=torch.float64)
        return RegressionStatistics(zeros[:, 2:], zeros[:, :2], zeros.new_zeros(()), 0)

    def over_processes(self) -> RegressionStatistics:
        """Statistics of the pairs of all processes."""
        total = distributed.differentiable_sum
        pairs = torch.tensor(float(self.count), dtype=torch.float64)
        return RegressionStatistics(
            total(self.gram), total(self.cross), total(self.energy), int(total(pairs))
        )

    def __add__(self, other: RegressionStatistics) -> RegressionStatistics:
        """Statistics of the pairs of both operands."""
        return tree_map(add, self, other)

    def squared_error(self, weights: Float[Tensor, "P 2"]) -> float:
        """Sum over the pairs of |dx - weights^T phi|^2 [px^2]."""
        change = (weights * (self.gram @ weights - 2 * self.cross)).sum()
        # Rounding may take the sum of a perfect fit below zero.
        return max(float(self.energy + change), 0.0)


@registered
@dataclass(frozen=True, eq=False)
class MotionSamples:
    """Motion from each key frame to the next one; motions beyond `max_step` are left out."""

    before: Pose
    """Poses of the tool at the first frame of each pair, (pairs,)."""
    after: Pose
    """Poses of the tool at the second frame, (pairs,)."""
    dr: Float[Tensor, "pairs 6"]
    """Motion of the tool, rotation scaled to metres [m]."""
    dx: Float[Tensor, "pairs 2"]
    """Motion of the image feature [px]."""

    @staticmethod
    def of(
        pose: Pose,
        feature: Float[Tensor, "time 2"],
        visible: Bool[Tensor, " time"],
        config: KeyFrameConfig,
    ) -> MotionSamples:
        """Motion along one demonstration.

        Args:
            pose: Poses of the tool, (time,).
            feature: Image feature [px].
            visible: True where the feature was found.
            config: Choice of key frames.
        """
        keys = key_frames(pose, visible, config)
        before, after = pose[keys[:-1]], pose[keys[1:]]
        dr = before.twist_to(after) * component_scale(pose.position, config.rotation_scale)
        near = torch.linalg.vector_norm(dr, dim=-1) <= config.max_step
        return MotionSamples(
            before=before[near],
            after=after[near],
            dr=dr[near],
            dx=feature[keys].diff(dim=0)[near],
        )

    @staticmethod
    def empty() -> MotionSamples:
        """No pairs."""
        none = torch.zeros(0, 6, dtype=torch.float64)
        pose = Pose(none[:, :3], none[:, :4])
        return MotionSamples(pose, pose, none, none[:, :2])

    @staticmethod
    def joined(motions: Sequence[MotionSamples]) -> MotionSamples:
        """The pairs of several demonstrations together."""
        return tree_map(lambda *parts: torch.cat(parts), MotionSamples.empty(), *motions)

    def thinned(self, most: int) -> MotionSamples:
        """At most `most` pairs, evenly chosen."""
        pairs = len(self.dx)
        if pairs <= most:
            return self
        index = torch.linspace(0, pairs - 1, most).long()
        return tree_map(lambda values: values[index], self)

    def regressors(self, basis: Callable[[Pose], Tensor]) -> Float[Tensor, "pairs P"]:
        """Regressors phi = dr (x) theta, 6 K columns in (component, neuron) order [m].

        Args:
            basis: Function from poses to activations of the neurons, (pairs, K).
        """
        # The mean over both frames is accurate to second order, as is the value half-way.
        theta = (basis(self.before) + basis(self.after)) / 2
        return (self.dr[:, :, None] * theta[:, None, :]).flatten(-2)


def component_scale(like: Tensor, rotation_scale: float) -> Float[Tensor, "6"]:
    """Metres per unit of each component of a twist: 1 for metres, `rotation_scale` for radians.

    dr times the scale is in metres; a Jacobian divided by the scale is in px/m.
    """
    return like.new_tensor([1.0] * 3 + [rotation_scale] * 3)


def key_frames(pose: Pose, visible: Bool[Tensor, " time"], config: KeyFrameConfig) -> Tensor:
    """Indices of visible frames, each at least `min_step` away from the previous key frame."""
    # For close orientations, the distance in R^4 is half the angle between them.
    turn = 2 * config.rotation_scale * quaternion.continuous(pose.orientation)
    place = torch.cat([pose.position, turn], dim=-1).detach().cpu().numpy()
    keys: list[int] = []
    for frame in visible.nonzero().flatten().tolist():
        if not keys or np.linalg.norm(place[frame] - place[keys[-1]]) >= config.min_step:
            keys.append(frame)
    return torch.tensor(keys, dtype=torch.long, device=visible.device)


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageDemonstration:
    """One demonstration during which the camera saw the tool."""

    pose: Pose
    """Poses of the tool, (time,)."""
    feature: Float[Tensor, "time 2"]
    """Image feature [px]; any value where the feature is not visible."""
    visible: Bool[Tensor, " time"]
    """True where the feature was found."""

    def double(self) -> ImageDemonstration:
        """The demonstration in float64."""
        pose = Pose(self.pose.position.double(), self.pose.orientation.double())
        return replace(self, pose=pose, feature=self.feature.double())

    def seen(self) -> tuple[Pose, Float[Tensor, "_frames 2"]]:
        """Poses and image features where the feature was found, in float64."""
        known = self.double()
        return known.pose[self.visible], known.feature[self.visible]

    def motion(self, config: KeyFrameConfig) -> MotionSamples:
        """Motion between the key frames of the demonstration, in float64."""
        known = self.double()
        return MotionSamples.of(known.pose, known.feature, self.visible, config)


def statistics_by_fold(
    basis: Callable[[Pose], Tensor],
    neurons: int,
    demonstrations: Sequence[ImageDemonstration],
    config: KeyFrameConfig,
) -> list[RegressionStatistics]:
    """Statistics of each fold of the data, so that each fold can be held out in turn.

    In a distributed run, each process reads a part of the demonstrations, and all processes get
    the statistics of all demonstrations.

    Args:
        basis: Function from poses to activations of the neurons, (time, neurons) float64.
        neurons: Number of neurons.
        demonstrations: Demonstrations, read one by one.
        config: Choice of key frames.

    Returns:
        Statistics of five folds. Fold k holds the items k, k + 5, k + 10, ... of
        `recorded_parts`; some folds may be empty.
    """
    folds = [RegressionStatistics.empty(6 * neurons) for _ in range(FOLDS)]
    with torch.no_grad():
        for i, recorded in distributed.local_items(recorded_parts(demonstrations)):
            motion, fold = recorded.motion(config), i % FOLDS
            part = RegressionStatistics.of(motion.regressors(basis), motion.dx)
            # The first part of a fold sets the fold's device.
            folds[fold] = folds[fold] + part if folds[fold].count else part
    return [fold.over_processes() for fold in folds]


def recorded_parts(
    demonstrations: Sequence[ImageDemonstration],
) -> Sequence[ImageDemonstration]:
    """The demonstrations; a single demonstration is cut into five consecutive parts."""
    if len(demonstrations) != 1:
        return demonstrations
    (whole,) = demonstrations
    pieces = torch.arange(len(whole.visible)).tensor_split(FOLDS)
    return [
        ImageDemonstration(
            pose=whole.pose[piece], feature=whole.feature[piece], visible=whole.visible[piece]
        )
        for piece in pieces
    ]


def radial_basis(
    inputs: Float[Tensor, "*batch n"],
    centers: Float[Tensor, "K n"],
    width: Float[Tensor, ""],
    *,
    normalized: bool,
) -> Float[Tensor, "*batch K"]:
    """Gaussian neurons theta_k = exp(-|x - c_k|^2 / (2 width^2)), as in the paper (eq_rbf).

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
    """The paper's centres (Table I): (0.05, 0.35) + (0.15 i, 0.15 j) [m] for i, j = 0, 1, 2."""
    return grid((0.05, 0.35, 3), (0.35, 0.65, 3))


@dataclass(frozen=True, kw_only=True, eq=False)
class RBFCenters:
    """Normalised Gaussian neurons over selected components of the tool pose."""

    centers: Float[Tensor, "K n"]
    """Centre of each neuron (row), one column per input [m, rad]."""
    width: float | Float[Tensor, ""]
    """Standard deviation of the Gaussians, one number for metres and radians."""
    input_indices: tuple[int, ...] = (0, 1)
    """Components of (x, y, z, rotation vector) that are inputs of the neurons."""
    reference: Float[Tensor, "4"] | None = None
    """Orientation to which the rotation vector is relative; None: orientation of the base."""

    @staticmethod
    def paper() -> RBFCenters:
        """The paper's nine neurons, whose inputs are x and y (Table I)."""
        return RBFCenters(centers=paper_grid(), width=0.1)

    @staticmethod
    def around(demonstrations: Sequence[ImageDemonstration]) -> RBFCenters:
        """Thirteen neurons: one in the middle of the demonstrated poses, one at each end of the
        six axes.

        In a small workspace the image Jacobian is nearly linear in position and rotation. These
        neurons can represent such a function; a grid over six inputs would need hundreds.

        Args:
            demonstrations: Demonstrations, read twice, one by one. In a distributed run, each
                process reads a part of them.
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
        """Function from poses (time,) to activations (time, K).

        The function is differentiable in the centres and the width.
        """

        def activation(pose: Pose) -> Tensor:
            inputs = pose_inputs(pose, self.reference)[..., self.input_indices]
            width = torch.as_tensor(self.width, dtype=inputs.dtype)
            return radial_basis(inputs, self.centers.to(inputs), width, normalized=True)

        return activation


def pose_inputs(pose: Pose, reference: Float[Tensor, "4"] | None) -> Float[Tensor, "*batch 6"]:
    """Position [m] and rotation vector from the reference to the orientation [rad].

    A rotation vector jumps at 180 degrees: choose the reference in the middle of the tool's
    orientations.
    """
    if reference is None:
        return pose.vector()
    back = quaternion.conjugate(reference)
    turn = quaternion.log(quaternion.multiply(pose.orientation, back))
    return torch.cat([pose.position, turn], dim=-1)


def _mean_orientation(demonstrations: Sequence[ImageDemonstration]) -> Float[Tensor, "4"]:
    """Mean orientation of either sign: the principal eigenvector of the summed outer products
    of quaternions (Markley et al. 2007).
    """
    total = torch.zeros(4, 4, dtype=torch.float64)
    for _, demonstration in distributed.local_items(demonstrations):
        orientation = demonstration.pose.orientation.double()
        total += orientation.mT @ orientation
    return torch.linalg.eigh(distributed.sum_over_processes(total)).eigenvectors[:, -1]


def _range(
    demonstrations: Sequence[ImageDemonstration], reference: Float[Tensor, "4"]
) -> tuple[Float[Tensor, "6"], Float[Tensor, "6"]]:
    """Smallest and largest value of each component of the demonstrated poses [m, rad]."""
    low = torch.full((6,), torch.inf, dtype=torch.float64)
    high = -low
    for _, demonstration in distributed.local_items(demonstrations):
        inputs = pose_inputs(demonstration.double().pose, reference)
        low = torch.minimum(low, inputs.amin(dim=0))
        high = torch.maximum(high, inputs.amax(dim=0))
    lows, highs = (torch.stack(distributed.gather(end)) for end in (low, high))
    return lows.amin(dim=0), highs.amax(dim=0)


@dataclass(frozen=True, kw_only=True)
class ImageJacobianFitConfig(KeyFrameConfig):
    """Choice of key frames, noise and prior of a fit."""

    pixel_noise: float = 0.5
    """Standard deviation of the measured feature [px]; dx is a difference of two measurements.
    If the held-out error is larger, it replaces this noise: the network is then too coarse."""
    bias_std: float = 1500.0
    """Prior standard deviation of the mean Jacobian of the workspace [px/m]."""
    weight_std: float = 500.0
    """Prior standard deviation of each neuron's deviation from the mean [px/m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_settings(self, positive=("pixel_noise", "bias_std", "weight_std"))

    @classmethod
    def of_residual(cls) -> ImageJacobianFitConfig:
        """Settings for the residual of a fitted camera.

        The residual is some thousandths of the image Jacobian. Key frames are a centimetre
        apart: for smaller motions, the noise of the marker detector exceeds the residual.
        """
        return cls(pixel_noise=0.1, bias_std=5.0, weight_std=2.0, min_step=0.01)


@dataclass(frozen=True, kw_only=True)
class ImageJacobianFitReport:
    """Prediction errors of a fitted image Jacobian for feature motion between key frames.

    Errors are root mean squares of the length of the error vector [px].
    """

    pairs: int
    """Number of pairs of key frames."""
    motion: float
    """Motion of the feature [px], which equals the error of predicting no motion."""
    error: float
    """Error over the fitted pairs [px]."""
    held_out_error: float
    """Cross-validation error over folds of the demonstrations, or over the five parts of a
    single demonstration [px]. NaN if all pairs belong to one fold."""
    noise: float
    """Standard deviation of each coordinate of dx, as assumed by the posterior [px]."""


def weight_covariance(
    centers: Float[Tensor, "K _"],
    bias_std: float | Float[Tensor, ""],
    weight_std: float | Float[Tensor, ""],
) -> Float[Tensor, "K K"]:
    """Prior covariance between neurons for a single entry of the Jacobian.

    Each weight is the sum of a bias, common to all neurons, and an independent deviation.
    Normalised neurons sum to one, so the bias adds a constant Jacobian to the network: an
    observation at one pose applies everywhere until other poses are observed.

    Args:
        centers: Centres of the neurons; only their number, dtype and device matter.
        bias_std: Standard deviation of the bias [px/m].
        weight_std: Standard deviation of each deviation [px/m].
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
) -> tuple[Float[Tensor, "P 2"], Float[Tensor, "P P"], ImageJacobianFitReport]:
    """Fit the weights to all folds; hold out each fold in turn to measure the held-out error.

    Args:
        folds: Statistics of the folds of the data.
        precision: Prior precision (see `prior_precision`).
        config: Noise of the feature.

    Returns:
        Posterior mean and covariance of the weights, and the prediction errors.

    Raises:
        ValueError: There is no pair of key frames.
    """
    folds = [fold for fold in folds if fold.count]
    if not folds:
        raise ValueError(
            "no two visible key frames form a pair: the feature was not seen, or the tool "
            "moved less than min_step, or more than max_step between key frames."
        )
    total = reduce(add, folds)
    noise = 2 * config.pixel_noise**2  # variance of a difference of two measurements
    held_out = _held_out_square(folds, precision, noise)
    # The error of a network that is too coarse for the data acts as noise on the weights. The
    # squared error sums two coordinates, so half of it counts. With a single fold, the held-out
    # error is NaN, and `max` keeps the noise.
    noise = max(noise, held_out / 2)
    mean, covariance = solve(total, precision, noise)
    report = ImageJacobianFitReport(
        pairs=total.count,
        motion=float(total.energy / total.count) ** 0.5,
        error=(total.squared_error(mean) / total.count) ** 0.5,
        held_out_error=held_out**0.5,
        noise=noise**0.5,
    )
    return mean, covariance, report


def solve(
    statistics: RegressionStatistics, precision: Float[Tensor, "P P"], noise: float
) -> tuple[Float[Tensor, "P 2"], Float[Tensor, "P P"]]:
    """Posterior mean and covariance of the weights [px/m] for a zero-mean prior.

    The mean has one column for each image row; the covariance is the same for both rows.

    Args:
        statistics: Statistics of the data.
        precision: Inverse covariance of the prior.
        noise: Variance of each coordinate of dx [px^2].
    """
    factor = torch.linalg.cholesky(statistics.gram / noise + precision)
    mean = torch.cholesky_solve(statistics.cross / noise, factor)
    return mean, torch.cholesky_inverse(factor)


def _held_out_square(
    folds: Sequence[RegressionStatistics], precision: Tensor, noise: float
) -> float:
    """Mean squared error over all pairs, each predicted from the other folds."""
    if len(folds) == 1:
        return float("nan")
    error = 0.0
    for i, fold in enumerate(folds):
        rest = reduce(add, [*folds[:i], *folds[i + 1 :]])
        error += fold.squared_error(solve(rest, precision, noise)[0])
    return error / sum(fold.count for fold in folds)
