"""Statistics of whole sets of demonstrations, one demonstration in memory at a time."""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.jacobian.pairs import PairConfig, PairStatistics, demonstration_pairs

_PARTS = 5


def statistics_by_part(
    basis: Callable[[Pose], Tensor],
    poses: Sequence[Pose],
    features: Sequence[Float[Tensor, "_ 2"]],
    visible: Sequence[Bool[Tensor, "_"]],
    config: PairConfig,
) -> list[PairStatistics]:
    """Sums over up to five parts of the data, so that each can be held out in turn.

    Args:
        basis: Neurons at poses, (time, K) float64.
        poses: Of the tool along each demonstration, (time,).
        features: Image feature along each [px].
        visible: Where the feature was found.
        config: Choice of key frames.

    Returns:
        Parts made of whole demonstrations, or fifths of a single one.

    Raises:
        ValueError: The sequences do not match in number or in length.
    """
    _check_lengths(poses, features, visible)
    chunks = _PARTS if len(poses) == 1 else 1
    parts: dict[int, PairStatistics] = {}
    for i, (pose, feature, seen) in enumerate(zip(poses, features, visible, strict=True)):
        pose = Pose(pose.position.double(), pose.orientation.double())
        with torch.no_grad():
            theta = basis(pose)
        phi, dx = demonstration_pairs(theta, pose, feature.double(), seen, config)
        pieces = zip(phi.tensor_split(chunks), dx.tensor_split(chunks), strict=True)
        for j, piece in enumerate(pieces):
            part, statistics = (i + j) % _PARTS, PairStatistics.of(*piece)
            parts[part] = parts[part] + statistics if part in parts else statistics
    return list(parts.values())


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
