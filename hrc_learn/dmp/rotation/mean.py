"""The orientation in the middle of others."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.geometry import quaternion

ITERATIONS = 10
"""Each leaves a small share of the distance, or of its cube where all are close."""


def intrinsic_mean(
    q: Float[Tensor, "*batch n 4"], mask: Bool[Tensor, "*batch n"] | None = None
) -> Float[Tensor, "*batch 4"]:
    """The orientation from which the rotation vectors to all others sum up to zero.

    (Moakher 2002, "Means and averaging in the group of rotations".) Fixed-point iteration
    from the extrinsic mean, the first eigenvector of sum q q^T, which knows no signs.

    Args:
        q: Unit quaternions, of either sign.
        mask: False where one does not count.
    """
    weight = _shares(q, mask)
    return _settled(torch.linalg.eigh((weight * q).mT @ q).eigenvectors[..., -1], q, weight)


def mean_along(
    q: Float[Tensor, "*batch T 4"], mask: Bool[Tensor, "*batch T"]
) -> Float[Tensor, "*batch 4"]:
    """Intrinsic mean of a motion, on the side that the motion keeps to.

    One that swings by 170 degrees either way spends most of its time about the orientation
    opposite to its centre: the iteration starts from the mean of the way it took instead.

    Args:
        q: Unit quaternions along time, neighbours less than half a turn apart.
        mask: False where one does not count.
    """
    weight = _shares(q, mask)
    first = q[..., :1, :]
    way = quaternion.log(quaternion.multiply(q, quaternion.conjugate(first)))
    way = (weight * quaternion.unwrap_log(way)).sum(-2)
    return _settled(quaternion.multiply(quaternion.exp(way), first[..., 0, :]), q, weight)


def _shares(q: Tensor, mask: Tensor | None) -> Float[Tensor, "*batch n 1"]:
    weight = torch.ones_like(q[..., 0]) if mask is None else mask.to(q)
    return (weight / weight.sum(-1, keepdim=True))[..., None]


def _settled(
    mean: Float[Tensor, "*batch 4"],
    q: Float[Tensor, "*batch n 4"],
    weight: Float[Tensor, "*batch n 1"],
) -> Float[Tensor, "*batch 4"]:
    for _ in range(ITERATIONS):
        away = quaternion.log(quaternion.multiply(q, quaternion.conjugate(mean)[..., None, :]))
        mean = quaternion.multiply(quaternion.exp((weight * away).sum(-2)), mean)
    return quaternion.normalize(mean)
