"""Recursive least squares with exponential forgetting."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from hrc_learn.jacobian.estimators.interface import ImageJacobianEstimator, Measurement
from hrc_learn.jacobian.estimators.key_frames import KeyFrame, advance
from hrc_learn.jacobian.estimators.recursive import (
    RecursiveConfig,
    RecursiveState,
    condition,
    prior_covariance,
)
from hrc_learn.jacobian.network import RBFImageJacobian


@dataclass(frozen=True, kw_only=True)
class LeastSquaresConfig(RecursiveConfig):
    """Prior, noise and forgetting."""

    forgetting: float = 0.99
    """Weight of all that was learned against each new pair, 0 to 1."""


class RecursiveLeastSquaresEstimator(ImageJacobianEstimator):
    """Weighted least squares over all pairs so far, a pair k ago counting forgetting^k.

    Forgetting inflates the covariance where nothing new is seen; it is kept from growing
    beyond the prior, which bounds the gain (no covariance wind-up).
    """

    largest_trace: Tensor

    def __init__(self, network: RBFImageJacobian, config: LeastSquaresConfig | None = None):
        super().__init__(network)
        self.config = config or LeastSquaresConfig()
        trace = prior_covariance(network, self.config).diagonal().sum()
        self.register_buffer("largest_trace", trace, persistent=False)

    def initial_state(self, *batch: int) -> RecursiveState:
        """The network's weights, the prior (or the fit's posterior), no key frame."""
        covariance = prior_covariance(self.network, self.config)
        return RecursiveState(
            weight=self.initial_weight(*batch),
            covariance=covariance.expand(*batch, *covariance.shape).clone(),
            key=KeyFrame.absent(self.network, *batch),
        )

    def update(self, state: RecursiveState, measurement: Measurement) -> RecursiveState:
        """One pair if there is a new one."""
        key, pair = advance(state.key, measurement, self.network, self.config)
        weight, covariance = condition(
            state.weight, state.covariance, pair, self.config, self.config.forgetting
        )
        trace = covariance.diagonal(dim1=-2, dim2=-1).sum(-1)
        shrink = torch.clamp_max(self.largest_trace / trace, 1.0)
        covariance = covariance * shrink.unsqueeze(-1).unsqueeze(-1)
        return RecursiveState(weight=weight, covariance=covariance, key=key)
