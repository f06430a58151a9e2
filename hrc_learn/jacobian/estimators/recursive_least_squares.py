"""Recursive least squares with exponential forgetting."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from hrc_learn.jacobian.estimators.interface import Measurement
from hrc_learn.jacobian.estimators.recursive import (
    RecursiveConfig,
    RecursiveEstimator,
    RecursiveState,
    condition,
)
from hrc_learn.jacobian.network import RBFImageJacobian


@dataclass(frozen=True, kw_only=True)
class LeastSquaresConfig(RecursiveConfig):
    """Prior, noise and forgetting."""

    forgetting: float = 0.99
    """Weight of all that was learned against each new pair, 0 to 1."""


class RecursiveLeastSquaresEstimator(RecursiveEstimator):
    """Weighted least squares over all pairs so far, a pair k ago counting forgetting^k.

    Forgetting inflates the covariance where nothing new is seen; it is kept from growing
    beyond the prior, which bounds the gain (no covariance wind-up).
    """

    largest_trace: Tensor

    def __init__(self, network: RBFImageJacobian, config: LeastSquaresConfig | None = None):
        self.config = config or LeastSquaresConfig()
        super().__init__(network, self.config)
        trace = self.first_covariance.diagonal().sum()
        self.register_buffer("largest_trace", trace, persistent=False)

    def update(self, state: RecursiveState, measurement: Measurement) -> RecursiveState:
        """One pair if there is a new one."""
        theta = self.network.basis(measurement.pose)
        key, pair = self.advance(state.key, measurement, theta, self.config)
        # Forgetting is one more pair against a covariance divided by the factor.
        kept = 1 - (1 - self.config.forgetting) * pair.valid.to(state.covariance.dtype)
        weight, covariance = condition(
            state.weight,
            state.covariance / kept[..., None, None],
            pair,
            self.scale,
            self.config.pair_noise,
        )
        trace = covariance.diagonal(dim1=-2, dim2=-1).sum(-1)
        shrink = torch.clamp_max(self.largest_trace / trace, 1.0)[..., None, None]
        return RecursiveState(
            weight=self.projected(weight), covariance=covariance * shrink, key=key
        )
