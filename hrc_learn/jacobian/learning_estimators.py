"""Online learning laws of the image Jacobian.

Gradient laws: the paper's law, the composite law with the prediction error, and Broyden's
update of one Jacobian for the whole workspace. Recursive laws: least squares with forgetting,
and a Kalman filter. The recursive laws keep one Gaussian for both image rows, whose regressors
are the same.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry.numerics import matmul
from hrc_learn.jacobian.estimator import (
    ImageJacobianEstimator,
    KeyFrame,
    KeyFrameEstimator,
    KeyFrameState,
    LearningConfig,
    Measurement,
    MotionSample,
    WeightState,
    all_numbers,
    evaluate,
)
from hrc_learn.jacobian.fitting import weight_covariance
from hrc_learn.jacobian.motion_samples import component_scale
from hrc_learn.jacobian.network import RBFImageJacobian
from hrc_learn.pytree import pytree


class PaperEstimator(ImageJacobianEstimator):
    """The paper's law,  W_dot = -[L theta s^T xi_x']^T,  s = J_s_hat^T xi_x + xi_r  (update).

    L is a multiple of the identity. The law reduces the energy |s|^2 that the command puts
    into the task. It uses no measured image motion, so it cannot correct a wrong Jacobian. With
    Table I's L = 0.25 I, weights of 1e3 px/m change by parts in 1e9.
    """

    def __init__(self, network: RBFImageJacobian, gain: float = 0.25):
        """Prepare the law.

        Args:
            network: Neurons and initial weights.
            gain: Diagonal of L.
        """
        super().__init__(network)
        self.gain = gain

    def initial_state(self, *batch: int) -> WeightState:
        """The network's weights."""
        return WeightState(weight=self.initial_weight(*batch))

    def update(self, state: WeightState, measurement: Measurement) -> WeightState:
        """Take one explicit Euler step of dt."""
        theta = self.network.basis(measurement.pose)
        rate = paper_rate(state.weight, theta, measurement, self.gain)
        return WeightState(weight=state.weight + measurement.dt * rate)


def paper_rate(
    weight: Float[Tensor, "*batch entries K"],
    theta: Float[Tensor, "*batch K"],
    measurement: Measurement,
    gain: float,
) -> Float[Tensor, "*batch entries K"]:
    """Rate W_dot of the paper's law.

    xi_x'^T s is the outer product of xi_x and s, row by row, so d(J_s_hat)/dt =
    -gain |theta|^2 xi_x s^T at the present pose.
    """
    xi_x = measurement.xi_x.unsqueeze(-1)
    J = evaluate(weight, theta)
    s = matmul(J.mT, xi_x).squeeze(-1) + measurement.xi_r
    push = (xi_x * s.unsqueeze(-2)).flatten(-2)  # (*batch, 12)
    return -gain * push.unsqueeze(-1) * theta.unsqueeze(-2)


@dataclass(frozen=True, kw_only=True)
class CompositeConfig(LearningConfig):
    """Gains of the composite law."""

    task_gain: float = 0.25
    """Gain of the paper's term, the diagonal of L."""
    prediction_gain: float = 0.5
    """Fraction of the prediction error removed by one pair, in [0, 2)."""
    noise_floor: float = 2e-3
    """Motion at which half of that fraction is removed [m]; smaller motions are mostly
    noise."""


class GradientEstimator[Config: LearningConfig](KeyFrameEstimator[Config]):
    """Estimator with weights and the last key frame as its state."""

    def initial_state(self, *batch: int) -> KeyFrameState:
        """The network's weights and no key frame."""
        weight, key = self.initial_weight(*batch), KeyFrame.absent(self.network, *batch)
        return KeyFrameState(weight=weight, key=key)


class CompositeEstimator(GradientEstimator[CompositeConfig]):
    """Composite adaptation: task error and prediction error (Slotine and Li 1989).

    Between key frames the prediction error is e = dx - J_s_hat dr. Each pair moves the
    weights along the gradient of |e|^2, normalised by the size of the regressor:

        W <- W + gamma e (x) dr theta^T / (|theta|^2 (|dr|^2 + floor^2))

    so |e| shrinks by the factor 1 - gamma |dr|^2 / (|dr|^2 + floor^2), never grows for
    0 < gamma < 2, and pairs with little motion, mostly noise, count little. The entries of the
    weights are bounded.
    """

    def __init__(self, network: RBFImageJacobian, config: CompositeConfig | None = None):
        super().__init__(network, config or CompositeConfig())

    def update(self, state: KeyFrameState, measurement: Measurement) -> KeyFrameState:
        """One step of dt of the paper's term, and the correction by a new pair."""
        theta = self.network.basis(measurement.pose)
        key, pair = self.advance(state.key, measurement, theta)
        rate = paper_rate(state.weight, theta, measurement, self.config.task_gain)
        change = measurement.dt * rate + self._correction(state.weight, pair)
        weight = state.weight + change
        return KeyFrameState(weight=self.projected(weight), key=key)

    def _correction(self, weight: Tensor, pair: MotionSample) -> Tensor:
        """Normalised gradient step on the prediction error; zero without a new pair."""
        config = self.config
        motion = pair.dr.square().sum(-1) + config.noise_floor**2
        # Normalised neurons never fade. Others do between and beyond the centres: dividing by
        # their small activity there would change weights far too much that act elsewhere.
        least = 0.0 if self.network.normalized else 1.0
        activity = pair.theta.square().sum(-1).clamp_min(least)
        size = (motion * activity).clamp_min(torch.finfo(motion.dtype).tiny)
        step = config.prediction_gain * pair.error(weight) / size.unsqueeze(-1)
        entries = step.unsqueeze(-1) * (pair.dr * self.scale).unsqueeze(-2)
        return entries.flatten(-2).unsqueeze(-1) * pair.theta.unsqueeze(-2)


@dataclass(frozen=True, kw_only=True)
class BroydenConfig(LearningConfig):
    """Step of Broyden's update."""

    min_step: float = 2e-3
    """Least motion between key frames [m]; large, because the update has no noise model."""
    gain: float = 0.5
    """Fraction of the prediction error removed by one pair, in (0, 1]."""


def check_normalised(network: RBFImageJacobian, law: str) -> None:
    """Raise ValueError unless equal weights of all neurons give a constant Jacobian."""
    if not network.normalized:
        raise ValueError(
            f"{law} a constant Jacobian, which only normalised neurons can represent: build "
            "the network with normalized=True."
        )


class BroydenEstimator(GradientEstimator[BroydenConfig]):
    """Broyden's update,  J_s <- J_s + gain (dx - J_s dr) dr^T / |dr|^2 (Jägersand 1997).

    It applies everywhere at once: equal changes of all normalised neurons add a constant.
    """

    def __init__(self, network: RBFImageJacobian, config: BroydenConfig | None = None):
        """Prepare the update.

        Raises:
            ValueError: The network's neurons are not normalised.
        """
        super().__init__(network, config or BroydenConfig())
        check_normalised(network, "Broyden's update adds")

    def update(self, state: KeyFrameState, measurement: Measurement) -> KeyFrameState:
        """Update with a new pair, if there is one."""
        theta = self.network.basis(measurement.pose)
        key, pair = self.advance(state.key, measurement, theta)
        # dr is zero without a pair; the floor avoids 0 / 0.
        size = pair.dr.square().sum(-1).clamp_min((self.config.min_step / 2) ** 2)
        step = self.config.gain * pair.error(state.weight) / size.unsqueeze(-1)
        change = step.unsqueeze(-1) * (pair.dr * self.scale).unsqueeze(-2)
        weight = state.weight + change.flatten(-2).unsqueeze(-1)
        return KeyFrameState(weight=self.projected(weight), key=key)


@dataclass(frozen=True, kw_only=True)
class RecursiveConfig(LearningConfig):
    """Noise and prior of recursive estimators."""

    pixel_noise: float = 0.5
    """Standard deviation of the measured feature [px]; enters twice into each pair."""
    bias_std: float = 1500.0
    """Prior standard deviation of the mean Jacobian [px/m]."""
    weight_std: float = 500.0
    """Prior standard deviation of each neuron's deviation from the mean [px/m]."""

    def pair_noise(
        self, weight: Float[Tensor, "*batch entries K"], theta: Float[Tensor, "*batch K"]
    ) -> float | Float[Tensor, "*batch 1 1"]:
        """Variance of each coordinate of dx - J_s_hat dr [px^2].

        Both ends of a pair are measured with noise in the image and in the pose, and the
        Jacobian turns the latter into pixels: the effective variance of an errors-in-variables
        model.

        Args:
            weight: Weights of the network [px/m, px/rad].
            theta: Neurons of the pair.
        """
        pixels = 2 * self.pixel_noise**2
        if self.pose_noise == 0:
            return pixels
        rows = evaluate(weight, theta)
        # Pose noise in radians is scaled to metres.
        metres = rows / component_scale(rows, self.rotation_scale)
        # The larger image row, as both have one covariance.
        square = metres.square().sum(-1).amax(-1)
        return (pixels + 2 * self.pose_noise**2 * square)[..., None, None]


@pytree
@dataclass(frozen=True, kw_only=True)
class RecursiveState(KeyFrameState):
    """Mean and covariance of the weights, and the last key frame."""

    covariance: Float[Tensor, "*batch P P"]
    """Covariance of either image row, in (component, neuron) order [(px/m)^2]."""


class RecursiveEstimator[Config: RecursiveConfig](KeyFrameEstimator[Config]):
    """Base of estimators that keep a covariance of the weights."""

    first_covariance: Tensor
    """Initial covariance, (P, P)."""

    def __init__(self, network: RBFImageJacobian, config: Config):
        super().__init__(network, config)
        # The posterior of an offline fit, or the prior.
        covariance = network.covariance
        if covariance is None:
            neurons = weight_covariance(network.centers, config.bias_std, config.weight_std)
            covariance = torch.block_diag(*[neurons] * 6)
        covariance = (covariance + covariance.mT) / 2  # symmetric to the last bit
        self.register_buffer("first_covariance", covariance, persistent=False)

    def initial_state(self, *batch: int) -> RecursiveState:
        """The network's weights, its posterior or the prior, and no key frame."""
        shape = self.first_covariance.shape
        return RecursiveState(
            weight=self.initial_weight(*batch),
            covariance=self.first_covariance.expand(*batch, *shape).clone(),
            key=KeyFrame.absent(self.network, *batch),
        )

    def restored(self, state: RecursiveState) -> RecursiveState:
        """The state reset where invalid, with the initial covariance for initial weights."""
        known = all_numbers(state.weight) & all_numbers(state.covariance)
        covariance = torch.where(known, state.covariance, self.first_covariance)
        return replace(super().restored(state), covariance=covariance)


def condition(
    weight: Float[Tensor, "*batch entries K"],
    covariance: Float[Tensor, "*batch P P"],
    pair: MotionSample,
    scale: Float[Tensor, "6"],
    noise: float | Float[Tensor, "*batch 1 1"],
) -> tuple[Float[Tensor, "*batch entries K"], Float[Tensor, "*batch P P"]]:
    """Mean and covariance conditioned on one more pair; unchanged without one.

    With phi = dr (x) theta and P the covariance, the gain is P phi / (phi' P phi + noise).

    Args:
        weight: Mean before.
        covariance: Covariance before.
        pair: Observed motion.
        scale: Metres per unit of each component of a twist.
        noise: Variance of each coordinate of dx - J_s_hat dr [px^2].
    """
    phi = (pair.dr.unsqueeze(-1) * pair.theta.unsqueeze(-2)).flatten(-2).unsqueeze(-2)
    P_phi = matmul(phi, covariance)  # (*batch, 1, P); P is symmetric
    spread = (P_phi * phi).sum(-1, keepdim=True) + noise
    change = pair.error(weight).unsqueeze(-1) * (P_phi / spread)
    change = change.unflatten(-1, (6, -1)) * scale.unsqueeze(-1)  # (*batch, 2, 6, K)
    # The outer product of a vector with itself is exactly symmetric. That of the gain and P_phi
    # is not, and forgetting amplifies the difference until the covariance is indefinite.
    root = P_phi / spread.sqrt()
    return weight + change.flatten(-3, -2), covariance - root.mT * root


@dataclass(frozen=True, kw_only=True)
class LeastSquaresConfig(RecursiveConfig):
    """Prior, noise and forgetting."""

    forgetting: float = 0.99
    """Weight of earlier pairs relative to each new one, 0 to 1."""


class RecursiveLeastSquaresEstimator(RecursiveEstimator[LeastSquaresConfig]):
    """Weighted least squares over all pairs; a pair k pairs ago has the weight forgetting^k.

    Forgetting inflates the covariance where there is no new data. Its trace is bounded by that
    of the prior, which bounds the gain and prevents covariance wind-up.
    """

    largest_trace: Tensor
    """Trace of the initial covariance."""

    def __init__(self, network: RBFImageJacobian, config: LeastSquaresConfig | None = None):
        super().__init__(network, config or LeastSquaresConfig())
        trace = self.first_covariance.diagonal().sum()
        self.register_buffer("largest_trace", trace, persistent=False)

    def update(self, state: RecursiveState, measurement: Measurement) -> RecursiveState:
        """Update with a new pair, if there is one."""
        theta = self.network.basis(measurement.pose)
        key, pair = self.advance(state.key, measurement, theta)
        # Forgetting is a division of the covariance by the factor before the new pair.
        kept = 1 - (1 - self.config.forgetting) * pair.valid.to(state.covariance.dtype)
        weight, covariance = condition(
            state.weight,
            state.covariance / kept[..., None, None],
            pair,
            self.scale,
            self.config.pair_noise(state.weight, pair.theta),
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
    """Random walk of the mean Jacobian [px/m/sqrt(s)]."""
    watched_drift: float | None = None
    """Random walk while images arrive, when a motion of the camera would be noticed; `drift`
    then applies to pauses alone. None: `drift`."""


class KalmanEstimator(RecursiveEstimator[KalmanConfig]):
    """Random walk on a bias Jacobian plus the weights, observed through dx = J_s dr.

    With normalised neurons a bias is an equal change of all weights, so it needs no state of
    its own, only its covariance. Both image rows have the same regressors and one covariance.
    """

    walk: Tensor
    """Covariance of the random walk per second, (P, P)."""

    def __init__(self, network: RBFImageJacobian, config: KalmanConfig | None = None):
        """Prepare the filter.

        Args:
            network: Neurons and initial weights. The covariance of an offline fit is the
                initial one of the filter.
            config: Prior, noise and drift.

        Raises:
            ValueError: The network's neurons are not normalised.
        """
        super().__init__(network, config or KalmanConfig())
        check_normalised(network, "the filter's drift is")
        # An equal drift of all neurons, independent between the six components.
        K = len(network.centers)
        walk = torch.block_diag(*[network.centers.new_ones(K, K)] * 6)
        self.register_buffer("walk", self.config.drift**2 * walk, persistent=False)
        drift, watched = self.config.drift, self.config.watched_drift
        self.watched = 1.0 if watched is None else (watched / drift) ** 2

    def resumed(self, state: RecursiveState, pause: float) -> RecursiveState:
        """No key frame, and the drift of the pause."""
        state = super().resumed(state, pause)
        return replace(state, covariance=state.covariance + pause * self.walk)

    def update(self, state: RecursiveState, measurement: Measurement) -> RecursiveState:
        """Drift for dt, then one pair if there is a new one."""
        theta = self.network.basis(measurement.pose)
        key, pair = self.advance(state.key, measurement, theta)
        weight, covariance = condition(
            state.weight,
            state.covariance + measurement.dt * self.watched * self.walk,
            pair,
            self.scale,
            self.config.pair_noise(state.weight, pair.theta),
        )
        return RecursiveState(weight=self.projected(weight), covariance=covariance, key=key)
