"""Pairs of poses and images far enough apart to tell motion from noise, found online."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.jacobian.estimators.interface import Measurement
from hrc_learn.jacobian.network import RBFImageJacobian
from hrc_learn.jacobian.pairs import PairConfig
from hrc_learn.jacobian.prior import component_scale
from hrc_learn.regions.pytree import pytree


@pytree
@dataclass(frozen=True, kw_only=True)
class KeyFrame:
    """The frame that the next one will be compared with."""

    pose: Pose
    """Of the tool."""
    feature: Float[Tensor, "*batch 2"]
    """Where the feature was [px]."""
    theta: Float[Tensor, "*batch K"]
    """Neurons at the pose."""
    present: Bool[Tensor, "*batch"]
    """False until the feature was seen for the first time."""

    @staticmethod
    def absent(network: RBFImageJacobian, *batch: int) -> KeyFrame:
        """Before anything was seen."""
        like = network.centers
        upright = like.new_tensor([1.0, 0, 0, 0]).expand(*batch, 4).clone()
        return KeyFrame(
            pose=Pose(like.new_zeros(*batch, 3), upright),
            feature=like.new_zeros(*batch, 2),
            theta=like.new_zeros(*batch, len(like)),
            present=torch.zeros(batch, dtype=torch.bool, device=like.device),
        )


@pytree
@dataclass(frozen=True, kw_only=True)
class Pair:
    """Motion from the key frame to now; zero where there is none to learn from."""

    dr: Float[Tensor, "*batch 6"]
    """Of the tool, rotation counted in metres [m]."""
    dx: Float[Tensor, "*batch 2"]
    """Of the feature [px]."""
    theta: Float[Tensor, "*batch K"]
    """Neurons half-way: the mean of both ends."""
    valid: Bool[Tensor, "*batch"]
    """Whether there is a pair."""


def advance(
    key: KeyFrame, measurement: Measurement, network: RBFImageJacobian, config: PairConfig
) -> tuple[KeyFrame, Pair]:
    """Compare with the key frame; move it here once the tool is `min_step` away.

    Where the tool has meanwhile moved further than `max_step`, as after a loss of the
    feature, the key frame moves without a pair.
    """
    theta = network.basis(measurement.pose)
    scale = component_scale(theta, config.rotation_scale)
    dr = key.pose.twist_to(measurement.pose) * scale
    distance = torch.linalg.vector_norm(dr, dim=-1)
    moved = measurement.valid & key.present & (distance >= config.min_step)
    valid = moved & (distance <= config.max_step)
    take = (moved | (measurement.valid & ~key.present)).unsqueeze(-1)
    use = valid.unsqueeze(-1)
    pair = Pair(
        dr=torch.where(use, dr, 0.0),
        dx=torch.where(use, measurement.feature - key.feature, 0.0),
        theta=(key.theta + theta) / 2,
        valid=valid,
    )
    moved_key = KeyFrame(
        pose=Pose(
            torch.where(take, measurement.pose.position, key.pose.position),
            torch.where(take, measurement.pose.orientation, key.pose.orientation),
        ),
        feature=torch.where(take, measurement.feature, key.feature),
        theta=torch.where(take, theta, key.theta),
        present=key.present | measurement.valid,
    )
    return moved_key, pair
