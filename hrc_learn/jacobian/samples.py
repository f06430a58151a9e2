"""Samples of image motion: pairs of key frames of demonstrations, and the sums a fit
needs of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hrc_learn import distributed
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian.radial_basis import component_scale

# Pairs of key frames of a demonstration, and the sums a fit needs of them.


@dataclass(frozen=True, kw_only=True)
class PairConfig:
    """Which frames of a demonstration are compared."""

    min_step: float = 2e-4
    """Least motion between key frames [m], rotation counted with `rotation_scale`."""
    max_step: float = 0.05
    """Pairs further apart [m] span a gap in visibility and are left out."""
    rotation_scale: float = 0.15
    """Metres that a radian counts for [m/rad]: a typical lever arm."""


@dataclass(frozen=True, eq=False)
class PairStatistics:
    """Sums over pairs: all a linear fit needs to know, in any order and from any machine."""

    gram: Float[Tensor, "P P"]
    """Sum of phi phi^T [m^2]."""
    cross: Float[Tensor, "P 2"]
    """Sum of phi dx^T [m px]."""
    energy: Float[Tensor, ""]
    """Sum of |dx|^2 [px^2]."""
    count: int
    """Number of pairs."""

    @staticmethod
    def of(phi: Float[Tensor, "pairs P"], dx: Float[Tensor, "pairs 2"]) -> PairStatistics:
        """Statistics of some pairs, from their regressors (see `KeyMotion`)."""
        return PairStatistics(phi.mT @ phi, phi.mT @ dx, dx.square().sum(), len(dx))

    @staticmethod
    def empty(regressors: int) -> PairStatistics:
        """Statistics of no pairs."""
        zeros = torch.zeros(regressors, regressors + 2, dtype=torch.float64)
        return PairStatistics(zeros[:, 2:], zeros[:, :2], zeros.new_zeros(()), 0)

    def over_processes(self) -> PairStatistics:
        """Statistics of the pairs of all processes."""
        total = distributed.differentiable_sum
        pairs = torch.tensor(float(self.count), dtype=torch.float64)
        return PairStatistics(
            total(self.gram), total(self.cross), total(self.energy), int(total(pairs))
        )

    def __add__(self, other: PairStatistics) -> PairStatistics:
        """Statistics of both sets of pairs together."""
        return PairStatistics(
            self.gram + other.gram,
            self.cross + other.cross,
            self.energy + other.energy,
            self.count + other.count,
        )

    def squared_error(self, weights: Float[Tensor, "P 2"]) -> float:
        """Sum over the pairs of |dx - weights^T phi|^2 [px^2]."""
        change = (weights * (self.gram @ weights - 2 * self.cross)).sum()
        return max(float(self.energy + change), 0.0)


@dataclass(frozen=True, eq=False)
class KeyMotion:
    """Motion from each key frame of a demonstration to the next one within reach."""

    before: Pose
    """Of the tool at the first frame of each pair, (pairs,)."""
    after: Pose
    """At the second."""
    dr: Float[Tensor, "pairs 6"]
    """Motion of the tool, rotation counted in metres [m]."""
    dx: Float[Tensor, "pairs 2"]
    """Motion of its image [px]."""
    frames: Int[Tensor, "pairs 2"]
    """Which two frames."""

    @staticmethod
    def of(
        pose: Pose,
        feature: Float[Tensor, "time 2"],
        visible: Bool[Tensor, " time"],
        config: PairConfig,
    ) -> KeyMotion:
        """Motion along one demonstration.

        Args:
            pose: Of the tool, (time,).
            feature: Image feature [px].
            visible: Where the feature was found.
            config: Choice of key frames.
        """
        keys = key_frames(pose, visible, config)
        before, after = pose[keys[:-1]], pose[keys[1:]]
        dr = before.twist_to(after) * component_scale(pose.position, config.rotation_scale)
        near = torch.linalg.vector_norm(dr, dim=-1) <= config.max_step
        return KeyMotion(
            before=before[near],
            after=after[near],
            dr=dr[near],
            dx=feature[keys].diff(dim=0)[near],
            frames=torch.stack([keys[:-1], keys[1:]], dim=-1)[near],
        )

    @staticmethod
    def empty() -> KeyMotion:
        """No pairs."""
        none = torch.zeros(0, 6, dtype=torch.float64)
        pose = Pose(none[:, :3], none[:, :4])
        return KeyMotion(pose, pose, none, none[:, :2], none[:, :2].long())

    @staticmethod
    def joined(motions: Sequence[KeyMotion]) -> KeyMotion:
        """The pairs of several demonstrations as one."""

        def join(name: str) -> Any:
            parts = [getattr(motion, name) for motion in (KeyMotion.empty(), *motions)]
            if isinstance(parts[0], Tensor):
                return torch.cat(parts)
            return Pose(
                torch.cat([part.position for part in parts]),
                torch.cat([part.orientation for part in parts]),
            )

        return KeyMotion(*(join(field.name) for field in fields(KeyMotion)))

    def split(self, parts: int) -> list[KeyMotion]:
        """The pairs in order, in parts of nearly the same number."""
        return [self[piece] for piece in torch.arange(len(self.dx)).tensor_split(parts)]

    def thinned(self, most: int) -> KeyMotion:
        """So many of the pairs at most, evenly chosen."""
        pairs = len(self.dx)
        return self if pairs <= most else self[torch.linspace(0, pairs - 1, most).long()]

    def __getitem__(self, index: Tensor) -> KeyMotion:
        """Some of the pairs."""
        return KeyMotion(*(getattr(self, field.name)[index] for field in fields(self)))

    def regressors(self, basis: Callable[[Pose], Tensor]) -> Float[Tensor, "pairs P"]:
        """Columns phi = dr (x) theta, 6 K of them columns in (component, neuron) order [m].

        Args:
            basis: Neurons at poses, (pairs, K).
        """
        # The mean of both ends is exact to second order, like the Jacobian half-way.
        theta = (basis(self.before) + basis(self.after)) / 2
        return (self.dr[:, :, None] * theta[:, None, :]).flatten(-2)


def key_frames(pose: Pose, visible: Bool[Tensor, " time"], config: PairConfig) -> Tensor:
    """Indices of visible frames, each at least `min_step` away from the one before."""
    # For close orientations the distance in R^4 is half the angle between them.
    turn = 2 * config.rotation_scale * quaternion.continuous(pose.orientation)
    place = torch.cat([pose.position, turn], dim=-1).detach().cpu().numpy()
    keys: list[int] = []
    for frame in visible.nonzero().flatten().tolist():
        if not keys or np.linalg.norm(place[frame] - place[keys[-1]]) >= config.min_step:
            keys.append(frame)
    return torch.tensor(keys, dtype=torch.long, device=visible.device)


# Statistics of whole sets of demonstrations, one demonstration in memory at a time.

PARTS = 5
"""In which the data are held out in turn."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Watched:
    """One demonstration in which the camera watched the tool."""

    pose: Pose
    """Of the tool, (time,)."""
    feature: Float[Tensor, "time 2"]
    """Of the image [px]; anything where it is not visible."""
    visible: Bool[Tensor, " time"]
    """Where the feature was found."""

    def motion(self, config: PairConfig) -> KeyMotion:
        """Between its key frames, in float64."""
        pose = Pose(self.pose.position.double(), self.pose.orientation.double())
        return KeyMotion.of(pose, self.feature.double(), self.visible, config)


def watched(
    poses: Sequence[Pose],
    features: Sequence[Float[Tensor, "_ 2"]],
    visible: Sequence[Bool[Tensor, "_"]] | None = None,
) -> list[Watched]:
    """Demonstrations from their columns.

    Args:
        poses: Of the tool along each demonstration, (time,).
        features: Image feature along each [px].
        visible: Where the feature was found; None: wherever it is not NaN.

    Raises:
        ValueError: The sequences do not match in number or in length.
    """
    if visible is None:
        visible = [~feature.isnan().any(-1) for feature in features]
    _check_lengths(poses, features, visible)
    return [
        Watched(pose=pose, feature=feature, visible=seen)
        for pose, feature, seen in zip(poses, features, visible, strict=True)
    ]


def statistics_by_part(
    basis: Callable[[Pose], Tensor],
    neurons: int,
    demonstrations: Sequence[Watched],
    config: PairConfig,
) -> list[PairStatistics]:
    """Sums over five parts of the data, so that each can be held out in turn.

    Each of several processes reads its share of the demonstrations; all get all the sums.

    Args:
        basis: Neurons at poses, (time, neurons) float64.
        neurons: Their number.
        demonstrations: Read one by one.
        config: Choice of key frames.

    Returns:
        Parts made of whole demonstrations, or fifths of a single one; some may be empty.
    """
    parts = [PairStatistics.empty(6 * neurons) for _ in range(PARTS)]
    with torch.no_grad():
        for part, motion in motion_by_part(demonstrations, config):
            parts[part] += PairStatistics.of(motion.regressors(basis), motion.dx)
    return [part.over_processes() for part in parts]


def motion_by_part(
    demonstrations: Sequence[Watched], config: PairConfig
) -> Iterator[tuple[int, KeyMotion]]:
    """Motion between key frames of this process's share, with the part it belongs to."""
    for i, demonstration in distributed.share(demonstrations):
        motion = demonstration.motion(config)
        if len(demonstrations) == 1:
            yield from enumerate(motion.split(PARTS))
        else:
            yield i % PARTS, motion


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
