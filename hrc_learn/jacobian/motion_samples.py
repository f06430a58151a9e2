"""Samples of image motion: pairs of key frames of demonstrations, and their sums for a fit.

The sums add up over demonstrations and processes, so one demonstration is in memory at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from operator import add

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils._pytree import tree_map

from hrc_learn import distributed
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.pytree import pytree

# Number of parts of the data, each held out in turn to measure the error on unseen data.
FOLDS = 5


@dataclass(frozen=True, kw_only=True)
class KeyFrameConfig:
    """Choice of key frames, the frames that are compared."""

    min_step: float = 2e-4
    """Least motion between key frames [m], rotation scaled with `rotation_scale`; larger where
    `pose_noise` requires it."""
    pose_noise: float = 0.0
    """Standard deviation of each component of a measured pose [m], rotation scaled with
    `rotation_scale`. Pairs closer than ten times that show mostly noise, which would shrink the
    Jacobian towards zero (regression dilution)."""
    max_step: float = 0.05
    """Largest motion of a pair [m]; a larger one spans a gap in visibility and is left out."""
    rotation_scale: float = 0.15
    """Metres per radian, a typical lever arm [m/rad]."""

    @property
    def least_step(self) -> float:
        """Least motion between key frames, noise considered [m]."""
        # The estimate shrinks by the ratio of the variances: at a factor of ten by 2 %.
        return max(self.min_step, 10.0 * self.pose_noise)


@pytree
@dataclass(frozen=True, eq=False)
class RegressionStatistics:
    """Sufficient statistics of a linear fit: sums over samples, in any order."""

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
        """Statistics of both sets of pairs together."""
        return tree_map(add, self, other)

    def squared_error(self, weights: Float[Tensor, "P 2"]) -> float:
        """Sum over the pairs of |dx - weights^T phi|^2 [px^2]."""
        change = (weights * (self.gram @ weights - 2 * self.cross)).sum()
        # Rounding may take the sum of a perfect fit below zero.
        return max(float(self.energy + change), 0.0)


@pytree
@dataclass(frozen=True, eq=False)
class MotionSamples:
    """Motion from each key frame of a demonstration to the next one, up to `max_step`."""

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

    def split(self, parts: int) -> list[MotionSamples]:
        """The pairs in order, in parts of nearly equal size."""
        return [self[piece] for piece in torch.arange(len(self.dx)).tensor_split(parts)]

    def thinned(self, most: int) -> MotionSamples:
        """Evenly chosen pairs, at most `most` of them."""
        pairs = len(self.dx)
        return self if pairs <= most else self[torch.linspace(0, pairs - 1, most).long()]

    def __getitem__(self, index: Tensor) -> MotionSamples:
        """The pairs at some indices."""
        return tree_map(lambda values: values[index], self)

    def regressors(self, basis: Callable[[Pose], Tensor]) -> Float[Tensor, "pairs P"]:
        """Columns phi = dr (x) theta, 6 K of them columns in (component, neuron) order [m].

        Args:
            basis: Neurons at poses, (pairs, K).
        """
        # The mean of both ends is accurate to second order, like the Jacobian half-way.
        theta = (basis(self.before) + basis(self.after)) / 2
        return (self.dr[:, :, None] * theta[:, None, :]).flatten(-2)


def component_scale(like: Tensor, rotation_scale: float) -> Float[Tensor, "6"]:
    """Metres per unit of each component of a twist: 1 per metre, `rotation_scale` per radian.

    dr times the scale is in metres; a Jacobian divided by it is in px/m.
    """
    return like.new_tensor([1.0] * 3 + [rotation_scale] * 3)


def key_frames(pose: Pose, visible: Bool[Tensor, " time"], config: KeyFrameConfig) -> Tensor:
    """Indices of visible frames, each at least `min_step` away from the one before."""
    # For close orientations, the distance in R^4 is half the angle between them.
    turn = 2 * config.rotation_scale * quaternion.continuous(pose.orientation)
    place = torch.cat([pose.position, turn], dim=-1).detach().cpu().numpy()
    keys: list[int] = []
    for frame in visible.nonzero().flatten().tolist():
        if not keys or np.linalg.norm(place[frame] - place[keys[-1]]) >= config.least_step:
            keys.append(frame)
    return torch.tensor(keys, dtype=torch.long, device=visible.device)


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageDemonstration:
    """One demonstration during which the camera saw the tool."""

    pose: Pose
    """Poses of the tool, (time,)."""
    feature: Float[Tensor, "time 2"]
    """Image feature [px]; any value where it is not visible."""
    visible: Bool[Tensor, " time"]
    """True where the feature was found."""

    def motion(self, config: KeyFrameConfig) -> MotionSamples:
        """Motion between its key frames, in float64."""
        pose = Pose(self.pose.position.double(), self.pose.orientation.double())
        return MotionSamples.of(pose, self.feature.double(), self.visible, config)


def image_demonstrations(
    poses: Sequence[Pose],
    features: Sequence[Float[Tensor, "_ 2"]],
    visible: Sequence[Bool[Tensor, "_"]] | None = None,
) -> list[ImageDemonstration]:
    """Demonstrations from their columns.

    Args:
        poses: Poses of the tool along each demonstration, (time,).
        features: Image feature along each [px].
        visible: True where the feature was found; None: wherever it is not NaN.

    Raises:
        ValueError: The sequences do not match in number or in length.
    """
    if visible is None:
        visible = [~feature.isnan().any(-1) for feature in features]
    _check_lengths(poses, features, visible)
    return [
        ImageDemonstration(pose=pose, feature=feature, visible=seen)
        for pose, feature, seen in zip(poses, features, visible, strict=True)
    ]


def statistics_by_fold(
    basis: Callable[[Pose], Tensor],
    neurons: int,
    demonstrations: Sequence[ImageDemonstration],
    config: KeyFrameConfig,
) -> list[RegressionStatistics]:
    """Sums over each fold of the data, so that each can be held out in turn.

    Each of several processes reads a part of the demonstrations; all get all the sums.

    Args:
        basis: Neurons at poses, (time, neurons) float64.
        neurons: Their number.
        demonstrations: Read one by one.
        config: Choice of key frames.

    Returns:
        Folds made of whole demonstrations, or fifths of a single one; some may be empty.
    """
    folds = [RegressionStatistics.empty(6 * neurons) for _ in range(FOLDS)]
    with torch.no_grad():
        for fold, motion in samples_by_fold(demonstrations, config):
            part = RegressionStatistics.of(motion.regressors(basis), motion.dx)
            # The first part of a fold sets its device.
            folds[fold] = folds[fold] + part if folds[fold].count else part
    return [fold.over_processes() for fold in folds]


def samples_by_fold(
    demonstrations: Sequence[ImageDemonstration], config: KeyFrameConfig
) -> Iterator[tuple[int, MotionSamples]]:
    """Motion between key frames in the demonstrations of this process, with its fold."""
    for i, demonstration in distributed.local_items(demonstrations):
        motion = demonstration.motion(config)
        if len(demonstrations) == 1:
            yield from enumerate(motion.split(FOLDS))
        else:
            yield i % FOLDS, motion


def _check_lengths(
    poses: Sequence[Pose], features: Sequence[Tensor], visible: Sequence[Tensor]
) -> None:
    if not len(poses) == len(features) == len(visible):
        raise ValueError(
            f"each demonstration needs poses, features and visibility, but there are "
            f"{len(poses)}, {len(features)} and {len(visible)} of them."
        )
    for i, (pose, feature, seen) in enumerate(zip(poses, features, visible, strict=True)):
        if not len(pose.position) == len(feature) == len(seen):
            raise ValueError(
                f"demonstration {i} has {len(pose.position)} poses, {len(feature)} features "
                f"and {len(seen)} visibilities: they must be of the same frames."
            )
