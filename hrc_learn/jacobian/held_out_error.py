"""How well image motion is predicted where nothing was learned from it, place by place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import reduce
from operator import add

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.jacobian.fitting import ImageJacobianFitConfig, prior_precision, solve
from hrc_learn.jacobian.network import RBFImageJacobian
from hrc_learn.jacobian.samples import (
    ImageDemonstration,
    component_scale,
    samples_by_fold,
    statistics_by_fold,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldOutSamples:
    """Pairs of key frames, each predicted without its fold of the data."""

    position: Float[Tensor, "pairs 3"]
    """Of the tool half-way [m]."""
    motion: Float[Tensor, "pairs 2"]
    """Of the image [px]."""
    error: Float[Tensor, "pairs 2"]
    """Motion less its prediction [px]."""
    uncertainty: Float[Tensor, " pairs"]
    """Posterior deviation of the Jacobian there over its size, rotation counted in metres."""

    def by_cell(self, cells: int = 3) -> CellErrors:
        """Errors over a grid on the horizontal plane.

        Args:
            cells: Along each of x and y, equally wide over the range of the pairs.
        """
        place = self.position[:, :2]
        low, high = place.amin(dim=0), place.amax(dim=0)
        edges = torch.stack([torch.linspace(0, 1, cells + 1).double()] * 2, dim=1)
        edges = low + (high - low) * edges
        # Points on the upper edge, and all where nothing moves along an axis, stay inside.
        cell = ((place - low) / (high - low).clamp_min(1e-9) * cells).long().clamp(0, cells - 1)
        flat = cell[:, 0] * cells + cell[:, 1]

        def total(values: Tensor) -> Tensor:
            return torch.zeros(cells**2, dtype=values.dtype).index_add(0, flat, values)

        error, motion = total(self.error.square().sum(-1)), total(self.motion.square().sum(-1))
        pairs = total(torch.ones_like(flat))
        return CellErrors(
            edges=edges,
            pairs=pairs.view(cells, cells),
            relative=(error / motion).sqrt().view(cells, cells),
            uncertainty=(total(self.uncertainty) / pairs).view(cells, cells),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class CellErrors:
    """Held-out error in cells of the horizontal plane."""

    edges: Float[Tensor, "cells_and_1 2"]
    """Of the cells along x and y [m]."""
    pairs: Int[Tensor, "cells cells"]
    """In each cell, x first."""
    relative: Float[Tensor, "cells cells"]
    """Root mean square of the error over that of the motion; NaN in an empty cell."""
    uncertainty: Float[Tensor, "cells cells"]
    """Mean of the posterior deviation over the Jacobian's size; NaN in an empty cell."""


def cross_validate(
    demonstrations: Sequence[ImageDemonstration],
    network: RBFImageJacobian,
    config: ImageJacobianFitConfig,
) -> HeldOutSamples:
    """Predict every pair with the weights fitted to the other folds of the data.

    Of several processes, each predicts the pairs of its share.

    Args:
        demonstrations: That the network was fitted to.
        network: Just fitted.
        config: Of that fit.

    Raises:
        ValueError: The network was loaded, or there is one fold only.
    """
    report = network.report
    if report is None:
        raise ValueError("only a network just fitted knows what it was fitted with.")
    network = network.double()
    K = len(network.centers)
    folds = statistics_by_fold(network.basis, K, demonstrations, config)
    if sum(fold.count > 0 for fold in folds) < 2:
        raise ValueError("held-out errors need pairs in at least two folds of the data.")
    precision = prior_precision(network.centers, config)
    without = [
        solve(reduce(add, [*folds[:i], *folds[i + 1 :]]), precision, report.noise**2).mean
        for i in range(len(folds))
    ]
    pairs: list[HeldOutSamples] = []
    with torch.no_grad():
        for fold, motion in samples_by_fold(demonstrations, config):
            pairs.append(
                HeldOutSamples(
                    position=(motion.before.position + motion.after.position) / 2,
                    motion=motion.dx,
                    error=motion.dx - motion.regressors(network.basis) @ without[fold],
                    uncertainty=relative_uncertainty(network, motion.before, config),
                )
            )
    names = [field.name for field in fields(HeldOutSamples)]
    return HeldOutSamples(
        **{name: torch.cat([getattr(one, name) for one in pairs]) for name in names}
    )


def relative_uncertainty(
    network: RBFImageJacobian, pose: Pose, config: ImageJacobianFitConfig
) -> Float[Tensor, " pairs"]:
    """Posterior deviation of the Jacobian over its size, rotation counted in metres."""
    scale = component_scale(pose.position, config.rotation_scale)
    size = (network(pose) / scale).flatten(-2).norm(dim=-1)
    # Both image rows have the same deviation, which makes the norm over both sqrt(2) times it.
    deviation = network.uncertainty(pose, config.rotation_scale) / scale
    return 2**0.5 * deviation.norm(dim=-1) / size
