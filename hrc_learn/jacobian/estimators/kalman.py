"""Kalman filter on the weights."""

from __future__ import annotations

from dataclasses import dataclass, replace

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
class KalmanConfig(RecursiveConfig):
    """Prior, noise and drift."""

    drift: float = 100.0
    """Random walk of the Jacobian as a whole [px/m/sqrt(s)]."""


class KalmanEstimator(RecursiveEstimator):
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
        self.config = config or KalmanConfig()
        super().__init__(network, self.config)
        if not network.normalized:
            raise ValueError(
                "the filter's drift is a constant Jacobian, which only normalised neurons can "
                "represent: build the network with normalized=True."
            )
        # A drift alike in all neurons, independent between the six components.
        K = len(network.centers)
        walk = torch.block_diag(*[network.centers.new_ones(K, K)] * 6)
        self.register_buffer("walk", self.config.drift**2 * walk, persistent=False)

    def resumed(self, state: RecursiveState, pause: float) -> RecursiveState:
        """No key frame, and the drift of the pause."""
        state = super().resumed(state, pause)
        return replace(state, covariance=state.covariance + pause * self.walk)

    def update(self, state: RecursiveState, measurement: Measurement) -> RecursiveState:
        """Drift for dt, then one pair if there is a new one."""
        theta = self.network.basis(measurement.pose)
        key, pair = self.advance(state.key, measurement, theta, self.config)
        weight, covariance = condition(
            state.weight,
            state.covariance + measurement.dt * self.walk,
            pair,
            self.scale,
            self.config.pair_noise,
        )
        return RecursiveState(weight=self.projected(weight), covariance=covariance, key=key)
