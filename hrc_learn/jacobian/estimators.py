"""Estimators that adapt the image Jacobian J_s online, while the robot moves.

`FixedEstimator` never changes the Jacobian. `PaperEstimator` follows the adaptation law of the
paper by Yan et al. (`docs/concepts/paper.md`). The other estimators compare key frames: frames
far enough apart to distinguish motion from noise. `KeyFrameEstimator` selects them online. The
composite law and Broyden's update follow gradients. The Kalman filter keeps one covariance for
both image rows, since both rows have the same regressors.

Below, W are the weights of the network, theta the activations of its neurons, J_s_hat the
estimate of J_s, dr the motion of the tool and dx the motion of the image feature between two
key frames; (x) is the Kronecker product.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.utils._pytree import tree_leaves

from hrc_learn.geometry import Pose, numerics
from hrc_learn.geometry.numerics import check_settings, everywhere, has_numbers, is_number
from hrc_learn.jacobian.fitting import KeyFrameConfig, component_scale, weight_covariance
from hrc_learn.jacobian.network import RBFImageJacobian
from hrc_learn.pytree import chosen, pytree

# Shorter motions between key frames count as rest [m].
_REST = 1e-12


@pytree
class Measurement:
    """Measurement of one control step."""

    pose: Pose
    """Pose of the tool when the image was taken."""
    feature: Float[Tensor, "*batch rows"]
    """Image feature [px]: u and v of the first point, then of the next. Where `valid` is False,
    the value does not matter and may be NaN."""
    valid: Bool[Tensor, "*batch"]
    """True if the feature is visible and its image was not used before."""
    dt: float | Float[Tensor, ""]
    """Time since the last step [s]."""
    xi_x: Float[Tensor, "*batch rows"]
    """Vision feedback of the controller."""
    xi_r: Float[Tensor, "*batch 6"]
    """Cartesian feedback of the controller."""


@pytree
class WeightState:
    """Estimator state that consists of the weights only."""

    weight: Float[Tensor, "*batch entries K"]
    """Weights W [px/m, px/rad], one matrix for each element of the batch."""


class ImageJacobianEstimator(nn.Module, ABC):
    """Adapts the weights of a network while the robot moves.

    `update` is pure: it takes a state and returns a new one, so thousands of robots adapt in
    one batch. The network supplies the neurons and the initial weights; it is not changed.
    """

    def __init__(self, network: RBFImageJacobian):
        super().__init__()
        self.network = network

    def initial_state(self, *batch: int) -> Any:
        """State before the first step for a batch of robots: the network's weights.

        The tensors have the dtype and device of the network.
        """
        return WeightState(weight=self.initial_weight(*batch))

    @abstractmethod
    def update(self, state: Any, measurement: Measurement) -> Any:
        """State after one control step."""

    def restored(self, state: Any) -> Any:
        """The state; elements of the batch with a number that is not finite start anew."""
        if has_numbers(state):
            return state
        batch = state.weight.shape[:-2]
        numbers = [x for x in tree_leaves(state) if x.is_floating_point()]
        finite = [is_number(x.reshape(*batch, -1)).all(-1) for x in numbers]
        known = reduce(torch.logical_and, finite)
        return chosen(known, state, self.initial_state(*batch))

    def resumed(self, state: Any, pause: float) -> Any:
        """State after a pause without images.

        Frames before and after the pause must not be compared, since the camera may have been
        moved meanwhile.

        Args:
            state: State before the pause.
            pause: Duration of the pause [s].
        """
        return state

    def jacobian(
        self, state: Any, r: Pose | Float[Tensor, "*batch 6"]
    ) -> Float[Tensor, "*batch rows 6"]:
        """J_s_hat at a pose with the weights of a state.

        Args:
            state: State of this estimator.
            r: Position [m] and rotation vector [rad], or a pose.
        """
        learned, first = evaluate(state.weight, self.network.basis(r)), self.network.first(r)
        return learned if first is None else first + learned

    def initial_weight(self, *batch: int) -> Float[Tensor, "*batch entries K"]:
        """The network's weights, repeated for each element of a batch."""
        weight = self.network.weight.detach()
        return weight.expand(*batch, *weight.shape).clone()


def evaluate(
    weight: Float[Tensor, "*batch entries K"], theta: Float[Tensor, "*batch K"]
) -> Float[Tensor, "*batch rows 6"]:
    """Image Jacobian J_s_hat of weights W and activations theta: vec(J_s_hat^T) = W theta."""
    return numerics.matmul(weight, theta.unsqueeze(-1)).squeeze(-1).unflatten(-1, (-1, 6))


class FixedEstimator(ImageJacobianEstimator):
    """Keeps the network's weights; the baseline for all other estimators."""

    def update(self, state: WeightState, measurement: Measurement) -> WeightState:
        """The same state."""
        return state


@pytree
class KeyFrame:
    """Frame with which later frames are compared."""

    pose: Pose
    """Pose of the tool."""
    feature: Float[Tensor, "*batch rows"]
    """Image feature at the pose [px]."""
    theta: Float[Tensor, "*batch K"]
    """Activations of the neurons at the pose."""
    present: Bool[Tensor, "*batch"]
    """False until the feature is first seen."""

    @staticmethod
    def absent(network: RBFImageJacobian, *batch: int) -> KeyFrame:
        """Key frame before the first image."""
        like = network.centers
        upright = like.new_tensor([1.0, 0, 0, 0]).expand(*batch, 4).clone()
        return KeyFrame(
            pose=Pose(like.new_zeros(*batch, 3), upright),
            feature=like.new_zeros(*batch, network.rows),
            theta=like.new_zeros(*batch, len(like)),
            present=torch.zeros(batch, dtype=torch.bool, device=like.device),
        )


@pytree
class KeyFrameState(WeightState):
    """Weights, and the key frame with which the next frame is compared."""

    key: KeyFrame
    """Last key frame."""


@dataclass(frozen=True, kw_only=True)
class LearningConfig(KeyFrameConfig):
    """Settings of all estimators that learn from key frames."""

    weight_bound: float = 2e4
    """Largest entry of the weights [px/m]; `rotation_scale` converts entries of rotations."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_settings(self, positive=["weight_bound"])


@pytree
class MotionSample:
    """Motion from the key frame to the present frame; zero if the two are no valid pair."""

    twist: Float[Tensor, "*batch 6"]
    """Motion of the tool, linear [m] and angular [rad]."""
    dr: Float[Tensor, "*batch 6"]
    """Motion of the tool with rotation scaled to metres [m]."""
    dx: Float[Tensor, "*batch rows"]
    """Motion of the feature [px]. If the network has a camera model, the motion that this model
    predicts is subtracted."""
    theta: Float[Tensor, "*batch K"]
    """Mean of the neurons' activations at both frames."""
    valid: Bool[Tensor, "*batch"]
    """True where there is a pair to learn from."""

    def error(self, weight: Float[Tensor, "*batch entries K"]) -> Float[Tensor, "*batch rows"]:
        """Prediction error dx - J_s_hat dr [px]."""
        J = evaluate(weight, self.theta)
        return self.dx - numerics.matmul(J, self.twist.unsqueeze(-1)).squeeze(-1)


class KeyFrameEstimator[Config: LearningConfig](ImageJacobianEstimator):
    """Base of estimators that learn from pairs of key frames."""

    constant: ClassVar[bool] = False
    """True if the estimator adds constants to the Jacobian, which needs normalised neurons."""

    config: Config

    def __init__(self, network: RBFImageJacobian, config: Config):
        """Prepare the scales.

        Args:
            network: Neurons and initial weights.
            config: Key-frame selection and settings of the estimator.

        Raises:
            ValueError: The estimator needs normalised neurons, but the network's are not.
        """
        super().__init__(network)
        # Equal weights of all normalised neurons give a constant Jacobian.
        if self.constant and not network.normalized:
            text = f"{type(self).__name__} adds a constant, which only normalised neurons"
            raise ValueError(f"{text} can represent: build the network with normalized=True.")
        self.config = config
        scale = component_scale(network.centers, config.rotation_scale)
        bound = config.weight_bound * scale.repeat(network.rows).unsqueeze(-1)
        self.scale = nn.Buffer(scale, persistent=False)
        """Metres per unit of each component of a twist, (6,)."""
        self.bound = nn.Buffer(bound, persistent=False)
        """Largest absolute value of each entry of the weights, (entries, 1)."""

    def initial_state(self, *batch: int) -> Any:
        """The network's weights and no key frame."""
        weight, key = self.initial_weight(*batch), KeyFrame.absent(self.network, *batch)
        return KeyFrameState(weight=weight, key=key)

    @abstractmethod
    def learned(self, state: Any, now: Measurement, theta: Tensor, pair: MotionSample) -> Any:
        """State after learning from a pair of frames, if there is one.

        Args:
            state: State before the measurement.
            now: Measurement of this step.
            theta: Activations of the neurons at the measured pose, (*batch, K).
            pair: Motion from the key frame.
        """

    def update(self, state: Any, measurement: Measurement) -> Any:
        """State after one control step, with the weights clamped to their bound."""
        theta = self.network.basis(measurement.pose)
        key, pair = self.advance(state.key, measurement, theta)
        learned = self.learned(state, measurement, theta, pair)
        # Clamping projects on a convex set: it never moves the estimate away from a true value
        # inside the set.
        return replace(learned, weight=learned.weight.clamp(-self.bound, self.bound), key=key)

    def along(
        self, step: Float[Tensor, "*batch rows"], pair: MotionSample
    ) -> Float[Tensor, "*batch entries 1"]:
        """Change of a neuron's weights along the motion dr of a pair: step dr^T, flattened.

        Args:
            step: Correction of the feature's motion, divided by a squared motion [px/m^2].
            pair: Motion from the key frame.
        """
        entries = step.unsqueeze(-1) * (pair.dr * self.scale).unsqueeze(-2)
        return entries.flatten(-2).unsqueeze(-1)

    def resumed(self, state: Any, pause: float) -> Any:
        """State with the same weights and no key frame."""
        batch = state.weight.shape[:-2]
        return replace(state, key=KeyFrame.absent(self.network, *batch))

    def advance(
        self, key: KeyFrame, measurement: Measurement, theta: Float[Tensor, "*batch K"]
    ) -> tuple[KeyFrame, MotionSample]:
        """Compare with the key frame; once the tool is `min_step` away, start a new key frame.

        If the tool has moved further than `max_step`, for example while the feature was lost,
        the new key frame starts without a pair.

        Args:
            key: Last key frame.
            measurement: Present measurement.
            theta: Activations of the neurons at the measured pose.

        Returns:
            The key frame for the next step, and the motion from the last key frame.
        """
        config = self.config
        twist = key.pose.twist_to(measurement.pose)
        distance = torch.linalg.vector_norm(twist * self.scale, dim=-1)
        # At rest there is nothing to learn from, even if every frame is a key frame.
        moved = measurement.valid & key.present & (distance >= max(config.min_step, _REST))
        valid = moved & (distance <= config.max_step)
        now, before = map(self.network.first_pixel, (measurement.pose, key.pose))
        explained = 0.0 if now is None or before is None else now - before
        # An invalid pair may contain NaN; zeros leave every weight unchanged.
        use = valid.unsqueeze(-1)
        twist = torch.where(use, twist, 0.0)
        pair = MotionSample(
            twist=twist,
            dr=twist * self.scale,
            dx=torch.where(use, measurement.feature - key.feature - explained, 0.0),
            theta=(key.theta + theta) / 2,
            valid=valid,
        )
        # The first valid frame becomes a key frame, and so does the second frame of every pair.
        take = moved | (measurement.valid & ~key.present)
        if everywhere(~take):
            return key, pair
        pose, feature = measurement.pose, measurement.feature
        here = KeyFrame(pose=pose, feature=feature, theta=theta, present=take)
        return chosen(take, here, key), pair


class PaperEstimator(ImageJacobianEstimator):
    """The paper's law,  W_dot = -[L theta s^T xi_x']^T,  s = J_s_hat^T xi_x + xi_r  (update).

    xi_x and xi_r are the controller's vision and Cartesian feedback. L is a multiple of the
    identity. The law reduces the energy |s|^2 that the command puts into the task. It uses no
    measured image motion, so it cannot correct a wrong Jacobian. With L = 0.25 I (Table I),
    weights of 1e3 px/m change by a few parts in 1e9.
    """

    def __init__(self, network: RBFImageJacobian, gain: float = 0.25):
        """Prepare the law.

        Args:
            network: Neurons and initial weights.
            gain: Diagonal of L.
        """
        super().__init__(network)
        self.gain = gain

    def update(self, state: WeightState, measurement: Measurement) -> WeightState:
        """Take one explicit Euler step of dt."""
        theta = self.network.basis(measurement.pose)
        J = self.jacobian(state, measurement.pose)
        rate = paper_rate(J, theta, measurement, self.gain)
        return WeightState(weight=state.weight + measurement.dt * rate)


def paper_rate(
    J: Float[Tensor, "*batch rows 6"],
    theta: Float[Tensor, "*batch K"],
    measurement: Measurement,
    gain: float,
) -> Float[Tensor, "*batch entries K"]:
    """Rate W_dot of the paper's law.

    In the law, s^T xi_x' stacks the rows of the outer product xi_x s^T, so at the present pose
    d(J_s_hat)/dt = -gain |theta|^2 xi_x s^T.
    """
    xi_x = measurement.xi_x.unsqueeze(-1)
    s = numerics.matmul(J.mT, xi_x).squeeze(-1) + measurement.xi_r
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
    """Motion at which half of `prediction_gain` applies [m]; smaller motions are mostly
    noise."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_settings(self, not_negative=("task_gain", "prediction_gain", "noise_floor"))
        if self.prediction_gain >= 2:
            raise ValueError(f"prediction_gain must be below 2, but is {self.prediction_gain}")


class CompositeEstimator(KeyFrameEstimator[CompositeConfig]):
    """Composite adaptation: task error and prediction error (Slotine and Li 1989).

    Between key frames the prediction error is e = dx - J_s_hat dr. Each pair moves the
    weights along the gradient of |e|^2, normalised by the size of the regressor:

        W <- W + gamma e (x) dr theta^T / (|theta|^2 (|dr|^2 + floor^2))

    Here gamma is `prediction_gain`, and floor is `noise_floor`. An update multiplies e by
    1 - gamma |dr|^2 / (|dr|^2 + floor^2). Therefore |e| never grows for 0 < gamma < 2, and
    pairs with little motion, which are mostly noise, count little. The weights are bounded.
    """

    def __init__(self, network: RBFImageJacobian, config: CompositeConfig | None = None):
        super().__init__(network, config or CompositeConfig())

    def learned(
        self, state: KeyFrameState, now: Measurement, theta: Tensor, pair: MotionSample
    ) -> KeyFrameState:
        """State after the paper's term acted for dt, and after the correction by a new pair."""
        J = self.jacobian(state, now.pose)
        rate = paper_rate(J, theta, now, self.config.task_gain)
        change = now.dt * rate + self._correction(state.weight, pair)
        return replace(state, weight=state.weight + change)

    def _correction(self, weight: Tensor, pair: MotionSample) -> Tensor:
        """Normalised gradient step on the prediction error; zero without a new pair."""
        config = self.config
        motion = pair.dr.square().sum(-1) + config.noise_floor**2
        # Normalised neurons sum to one everywhere. Other neurons fade between and beyond the
        # centres: division by their small activity would change the weights far too much.
        least = 0.0 if self.network.normalized else 1.0
        activity = pair.theta.square().sum(-1).clamp_min(least)
        size = (motion * activity).clamp_min(torch.finfo(motion.dtype).tiny)
        step = config.prediction_gain * pair.error(weight) / size.unsqueeze(-1)
        return self.along(step, pair) * pair.theta.unsqueeze(-2)


@dataclass(frozen=True, kw_only=True)
class BroydenConfig(LearningConfig):
    """Step of Broyden's update."""

    min_step: float = 2e-3
    """Least motion between key frames [m]; large, because the update has no noise model."""
    gain: float = 0.5
    """Fraction of the prediction error removed by one pair, in (0, 1]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_settings(self, fraction=["gain"])


class BroydenEstimator(KeyFrameEstimator[BroydenConfig]):
    """Broyden's update,  J_s <- J_s + gain (dx - J_s dr) dr^T / |dr|^2 (Jägersand 1997).

    The update changes the weights of all normalised neurons equally. This adds a constant to
    the Jacobian, so one update applies everywhere.
    """

    constant = True

    def __init__(self, network: RBFImageJacobian, config: BroydenConfig | None = None):
        super().__init__(network, config or BroydenConfig())

    def learned(
        self, state: KeyFrameState, now: Measurement, theta: Tensor, pair: MotionSample
    ) -> KeyFrameState:
        """State after an update with a new pair, if there is a pair."""
        # dr is zero without a pair; the floor avoids 0 / 0.
        size = pair.dr.square().sum(-1).clamp_min(_REST**2 / 4)
        step = self.config.gain * pair.error(state.weight) / size.unsqueeze(-1)
        return replace(state, weight=state.weight + self.along(step, pair))


@dataclass(frozen=True, kw_only=True)
class KalmanConfig(LearningConfig):
    """Prior, noise and drift of the Kalman filter."""

    pixel_noise: float = 0.5
    """Standard deviation of the measured feature [px]; a pair has two measurements."""
    bias_std: float = 1500.0
    """Prior standard deviation of the mean Jacobian [px/m]."""
    weight_std: float = 500.0
    """Prior standard deviation of each neuron's deviation from the mean [px/m]."""
    drift: float = 100.0
    """Random walk of the mean Jacobian [px/m/sqrt(s)]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        prior = "drift", "bias_std", "weight_std"
        check_settings(self, positive=["pixel_noise"], not_negative=prior)


@pytree
class KalmanState(KeyFrameState):
    """Mean and covariance of the weights, and the last key frame."""

    covariance: Float[Tensor, "*batch P P"]
    """Covariance of each image row, in (component, neuron) order [(px/m)^2]."""


class KalmanEstimator(KeyFrameEstimator[KalmanConfig]):
    """Kalman filter of the weights and a drifting bias Jacobian, observed through dx = J_s dr.

    With normalised neurons, a bias is an equal change of all weights. Therefore the filter has
    no separate state for the bias: the covariance of the weights includes it. Both image rows
    have the same regressors and therefore the same covariance.
    """

    constant = True

    def __init__(self, network: RBFImageJacobian, config: KalmanConfig | None = None):
        """Prepare the filter.

        Args:
            network: Neurons and initial weights; also the initial covariance, if the network
                was fitted.
            config: Prior, noise and drift.
        """
        super().__init__(network, config or KalmanConfig())
        # Start from the posterior of an offline fit, or else from the prior.
        covariance = network.covariance
        if covariance is None:
            bias, weight = self.config.bias_std, self.config.weight_std
            neurons = weight_covariance(network.centers, bias, weight)
            covariance = torch.block_diag(*[neurons] * 6)
        else:  # convert from the `rotation_scale` of the fit to that of this filter
            scale = component_scale(covariance, network.rotation_scale) / self.scale
            scale = scale.repeat_interleave(len(network.centers))
            covariance = scale * covariance * scale[:, None]
        covariance = (covariance + covariance.mT) / 2  # exactly symmetric
        self.first_covariance = nn.Buffer(covariance, persistent=False)
        """Initial covariance, (P, P)."""
        # All neurons drift equally; the six components drift independently.
        K = len(network.centers)
        walk = torch.block_diag(*[network.centers.new_ones(K, K)] * 6)
        self.walk = nn.Buffer(self.config.drift**2 * walk, persistent=False)
        """Covariance that the random walk adds per second, (P, P)."""

    def initial_state(self, *batch: int) -> KalmanState:
        """The network's weights with their initial covariance, and no key frame."""
        shape = self.first_covariance.shape
        return KalmanState(
            weight=self.initial_weight(*batch),
            covariance=self.first_covariance.expand(*batch, *shape).clone(),
            key=KeyFrame.absent(self.network, *batch),
        )

    def resumed(self, state: KalmanState, pause: float) -> KalmanState:
        """State without a key frame, with the drift of the pause added to the covariance."""
        state = super().resumed(state, pause)
        return replace(state, covariance=state.covariance + pause * self.walk)

    def learned(
        self, state: KalmanState, now: Measurement, theta: Tensor, pair: MotionSample
    ) -> KalmanState:
        """State after a drift for dt, conditioned on a new pair, if there is a pair.

        With phi = dr (x) theta and P the covariance, the gain is P phi / (phi' P phi + noise).
        """
        weight = state.weight
        covariance = state.covariance + now.dt * self.walk
        if everywhere(~pair.valid):
            return replace(state, covariance=covariance)
        phi = (pair.dr.unsqueeze(-1) * pair.theta.unsqueeze(-2)).flatten(-2).unsqueeze(-2)
        P_phi = numerics.matmul(phi, covariance)  # (*batch, 1, P); P is symmetric
        spread = (P_phi * phi).sum(-1, keepdim=True) + 2 * self.config.pixel_noise**2
        change = pair.error(weight).unsqueeze(-1) * (P_phi / spread)
        change = change.unflatten(-1, (6, -1)) * self.scale.unsqueeze(-1)  # (*batch, 2, 6, K)
        # The outer product of a vector with itself is exactly symmetric. The outer product of
        # gain and P_phi is not: the asymmetry would grow until the covariance is indefinite.
        root = P_phi / spread.sqrt()
        return replace(
            state,
            weight=weight + change.flatten(-3, -2),
            covariance=covariance - root.mT * root,
        )
