"""Statistics of whole sets of demonstrations, one demonstration in memory at a time."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn import distributed
from hrc_learn.geometry import Pose
from hrc_learn.jacobian.pairs import KeyMotion, PairConfig, PairStatistics

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
