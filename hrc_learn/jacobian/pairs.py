"""Pairs of key frames of a demonstration, and the sums a fit needs of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian.prior import component_scale


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
        """Statistics of some pairs (see `demonstration_pairs`)."""
        return PairStatistics(phi.mT @ phi, phi.mT @ dx, dx.square().sum(), len(dx))

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


def demonstration_pairs(
    theta: Float[Tensor, "time K"],
    pose: Pose,
    feature: Float[Tensor, "time 2"],
    visible: Bool[Tensor, " time"],
    config: PairConfig,
) -> tuple[Float[Tensor, "pairs P"], Float[Tensor, "pairs 2"]]:
    """Regressors and image motions between neighbouring key frames.

    Args:
        theta: Neurons along the demonstration.
        pose: Of the tool, (time,).
        feature: Image feature [px].
        visible: Where the feature was found.
        config: Choice of key frames.

    Returns:
        phi = dr (x) theta of 6 K columns in (component, neuron) order [m], and dx [px].
    """
    keys = key_frames(pose, visible, config)
    pose, theta = pose[keys], theta[keys]
    scale = component_scale(theta, config.rotation_scale)
    dr = pose[:-1].twist_to(pose[1:]) * scale
    # The mean of both ends is exact to second order, like the Jacobian half-way.
    theta = (theta[1:] + theta[:-1]) / 2
    phi = (dr[:, :, None] * theta[:, None, :]).flatten(-2)
    near = torch.linalg.vector_norm(dr, dim=-1) <= config.max_step
    return phi[near], feature[keys].diff(dim=0)[near]


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
