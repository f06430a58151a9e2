"""Kalman filter on the weights."""

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
class KalmanConfig(RecursiveConfig):
    """Prior, noise and drift."""

    drift: float = 100.0
    """Random walk of the Jacobian as a whole [px/m/sqrt(s)]."""


class KalmanEstimator(ImageJacobianEstimator):
    """Random walk on a bias Jacobian plus the weights, observed through dx = J_s dr.

    With normalised neurons a bias is the same change of every neuron's weight, so it needs no
    state of its own, only its covariance. Both image rows see the same regressors and share
    one covariance.
    """

    walk: Tensor

    def __init__(self, network: RBFImageJacobian, config: KalmanConfig | None = None):
        """Set up the filter.

        Args:
            network: Neurons and initial weights. If fitted offline, its covariance is where
                the filter starts.
            config: Prior, noise and drift.

        Raises:
            ValueError: The network's neurons are not normalised.
        """
        super().__init__(network)
        if not network.normalized:
            raise ValueError(
                "the filter's drift is a constant Jacobian, which only normalised neurons can "
                "represent: build the network with normalized=True."
            )
        self.config = config or KalmanConfig()
        # A drift alike in all neurons, independent between the six components.
        K = len(network.centers)
        walk = torch.block_diag(*[network.centers.new_ones(K, K)] * 6)
        self.register_buffer("walk", self.config.drift**2 * walk, persistent=False)

    def initial_state(self, *batch: int) -> RecursiveState:
        """The network's weights, the prior (or the fit's posterior), no key frame."""
        covariance = prior_covariance(self.network, self.config)
        return RecursiveState(
            weight=self.initial_weight(*batch),
            covariance=covariance.expand(*batch, *covariance.shape).clone(),
            key=KeyFrame.absent(self.network, *batch),
        )

    def update(self, state: RecursiveState, measurement: Measurement) -> RecursiveState:
        """Drift for dt, then one pair if there is a new one."""
        key, pair = advance(state.key, measurement, self.network, self.config)
        drifted = state.covariance + measurement.dt * self.walk
        weight, covariance = condition(state.weight, drifted, pair, self.config)
        return RecursiveState(weight=weight, covariance=covariance, key=key)
