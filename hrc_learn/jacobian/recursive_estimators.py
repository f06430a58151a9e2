"""Recursive estimation of the weights: least squares with forgetting, and a Kalman filter.

Both keep one Gaussian for both image rows, which see the same regressors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry.numerics import matmul
from hrc_learn.jacobian.estimator import KeyFrame, KeyFrameEstimator, Measurement, MotionSample
from hrc_learn.jacobian.fitting import weight_covariance
from hrc_learn.jacobian.network import RBFImageJacobian
from hrc_learn.jacobian.samples import KeyFrameConfig
from hrc_learn.pytree import pytree


@dataclass(frozen=True, kw_only=True)
class RecursiveConfig(KeyFrameConfig):
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


class RecursiveEstimator(KeyFrameEstimator):
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
    pair: MotionSample,
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
            network: RBFCenters and initial weights. If fitted offline, its covariance is where
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
