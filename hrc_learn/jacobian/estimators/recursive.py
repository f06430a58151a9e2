"""Recursive Bayesian estimation of the weights: one Gaussian for both image rows."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.jacobian.estimators.key_frames import KeyFrame, Pair
from hrc_learn.jacobian.network import RBFImageJacobian
from hrc_learn.jacobian.pairs import PairConfig
from hrc_learn.jacobian.prior import component_scale, weight_covariance
from hrc_learn.regions.pytree import pytree


@dataclass(frozen=True, kw_only=True)
class RecursiveConfig(PairConfig):
    """What is believed before the first image."""

    pixel_noise: float = 0.5
    """Standard deviation of the measured feature [px]; enters twice into each pair."""
    bias_std: float = 1500.0
    """Prior standard deviation of the Jacobian as a whole [px/m]."""
    weight_std: float = 500.0
    """Prior standard deviation of each neuron's departure from it [px/m]."""


@pytree
@dataclass(frozen=True, kw_only=True)
class RecursiveState:
    """Mean and covariance of the weights, and the frame to compare with next."""

    weight: Float[Tensor, "*batch 12 K"]
    """Mean of W [px/m, px/rad]."""
    covariance: Float[Tensor, "*batch P P"]
    """Of one image row, alike for both, in (component, neuron) order [(px/m)^2]."""
    key: KeyFrame
    """Last key frame."""


def prior_covariance(
    network: RBFImageJacobian, config: RecursiveConfig
) -> Float[Tensor, "P P"]:
    """What is believed at the start: the posterior of an offline fit, or else the prior."""
    if network.covariance is not None:
        return network.covariance
    neurons = weight_covariance(network.centers, config.bias_std, config.weight_std)
    return torch.block_diag(*[neurons] * 6)


def condition(
    weight: Float[Tensor, "*batch 12 K"],
    covariance: Float[Tensor, "*batch P P"],
    pair: Pair,
    config: RecursiveConfig,
    discount: float = 1.0,
) -> tuple[Float[Tensor, "*batch 12 K"], Float[Tensor, "*batch P P"]]:
    """Mean and covariance after one more pair; unchanged where there is none.

    With phi = dr (x) theta and P the covariance, the gain is P phi / (phi' P phi + noise).

    Args:
        weight: Mean before.
        covariance: Covariance before.
        pair: Motion seen.
        config: Noise.
        discount: Weight of all earlier pairs against this one, 0 to 1.
    """
    phi = (pair.dr.unsqueeze(-1) * pair.theta.unsqueeze(-2)).flatten(-2).unsqueeze(-1)
    P_phi = covariance @ phi  # (*batch, P, 1)
    noise = 2 * config.pixel_noise**2 * discount
    gain = P_phi / (phi.mT @ P_phi + noise)
    scale = component_scale(weight, config.rotation_scale)
    rows = weight.unflatten(-2, (2, 6)) / scale.unsqueeze(-1)  # (*batch, 2, 6, K)
    error = pair.dx.unsqueeze(-1) - rows.flatten(-2) @ phi  # (*batch, 2, 1)
    change = (error @ gain.mT).unflatten(-1, rows.shape[-2:]) * scale.unsqueeze(-1)
    weight = weight + change.flatten(-3, -2)
    shrunk = covariance - gain @ P_phi.mT
    if discount == 1.0:
        return weight, shrunk  # gain is zero where there is no pair
    there = pair.valid.unsqueeze(-1).unsqueeze(-1)
    return weight, torch.where(there, shrunk / discount, covariance)
