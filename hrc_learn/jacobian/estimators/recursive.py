"""Recursive Bayesian estimation of the weights: one Gaussian for both image rows."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry.small_matrices import matmul
from hrc_learn.jacobian.estimators.key_frames import KeyFrame, Pair, PairEstimator
from hrc_learn.jacobian.network import RBFImageJacobian
from hrc_learn.jacobian.pairs import PairConfig
from hrc_learn.jacobian.prior import weight_covariance
from hrc_learn.pytree import pytree


@dataclass(frozen=True, kw_only=True)
class RecursiveConfig(PairConfig):
    """What is believed before the first image."""

    pixel_noise: float = 0.5
    """Standard deviation of the measured feature [px]; enters twice into each pair."""
    bias_std: float = 1500.0
    """Prior standard deviation of the Jacobian as a whole [px/m]."""
    weight_std: float = 500.0
    """Prior standard deviation of each neuron's departure from it [px/m]."""
    weight_bound: float = 2e4
    """Largest entry of the weights [px/m], rotation counted with `rotation_scale`."""

    @property
    def pair_noise(self) -> float:
        """Variance of each coordinate of dx [px^2]."""
        return 2 * self.pixel_noise**2


@pytree
@dataclass(frozen=True, kw_only=True)
class RecursiveState:
    """Mean and covariance of the weights, and the frame to compare with next."""

    weight: Float[Tensor, "*batch entries K"]
    """Mean of W [px/m, px/rad]."""
    covariance: Float[Tensor, "*batch P P"]
    """Of one image row, alike for both, in (component, neuron) order [(px/m)^2]."""
    key: KeyFrame
    """Last key frame."""


class RecursiveEstimator(PairEstimator):
    """An estimator that keeps a covariance of the weights."""

    first_covariance: Tensor
    """Covariance to start with, (P, P)."""

    def __init__(self, network: RBFImageJacobian, config: RecursiveConfig):
        super().__init__(network, config, config.weight_bound)
        # The posterior of an offline fit, or else the prior.
        covariance = network.covariance
        if covariance is None:
            neurons = weight_covariance(network.centers, config.bias_std, config.weight_std)
            covariance = torch.block_diag(*[neurons] * 6)
        covariance = (covariance + covariance.mT) / 2  # symmetric to the last bit
        self.register_buffer("first_covariance", covariance, persistent=False)

    def initial_state(self, *batch: int) -> RecursiveState:
        """The network's weights, the prior (or the fit's posterior), no key frame."""
        shape = self.first_covariance.shape
        return RecursiveState(
            weight=self.initial_weight(*batch),
            covariance=self.first_covariance.expand(*batch, *shape).clone(),
            key=KeyFrame.absent(self.network, *batch),
        )


def condition(
    weight: Float[Tensor, "*batch entries K"],
    covariance: Float[Tensor, "*batch P P"],
    pair: Pair,
    scale: Float[Tensor, "6"],
    noise: float,
) -> tuple[Float[Tensor, "*batch entries K"], Float[Tensor, "*batch P P"]]:
    """Mean and covariance given one more pair; unchanged where there is none.

    With phi = dr (x) theta and P the covariance, the gain is P phi / (phi' P phi + noise).

    Args:
        weight: Mean before.
        covariance: Covariance before.
        pair: Motion seen.
        scale: Metres that each component of a twist counts for.
        noise: Variance of each coordinate of dx [px^2].
    """
    phi = (pair.dr.unsqueeze(-1) * pair.theta.unsqueeze(-2)).flatten(-2).unsqueeze(-2)
    P_phi = matmul(phi, covariance)  # (*batch, 1, P); P is symmetric
    spread = (P_phi * phi).sum(-1, keepdim=True) + noise
    change = pair.error(weight).unsqueeze(-1) * (P_phi / spread)
    change = change.unflatten(-1, (6, -1)) * scale.unsqueeze(-1)  # (*batch, 2, 6, K)
    # An outer product of a vector with itself is symmetric to the last bit. That of the gain
    # and P_phi is not, and forgetting amplifies the difference until the covariance is none.
    root = P_phi / spread.sqrt()
    return weight + change.flatten(-3, -2), covariance - root.mT * root
