"""Gradient laws for the image Jacobian.

The paper's; the composite law with the prediction error, which the paper's lacks; and
Broyden's update of one Jacobian for the whole workspace.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry.numerics import matmul
from hrc_learn.jacobian.estimator import (
    ImageJacobianEstimator,
    KeyFrame,
    KeyFrameEstimator,
    Measurement,
    MotionSample,
    WeightState,
    evaluate,
)
from hrc_learn.jacobian.network import RBFImageJacobian
from hrc_learn.jacobian.samples import KeyFrameConfig
from hrc_learn.pytree import pytree


class PaperEstimator(ImageJacobianEstimator):
    """W_dot = -[L theta s^T xi_x']^T,  s = J_s_hat^T xi_x + xi_r      (update)

    L is a multiple of the identity. The law reduces the energy |s|^2 that the command puts
    into the task; no measured image motion enters, so it cannot learn a wrong Jacobian
    right. With Table I's L = 0.25 I weights of 1e3 px/m change by parts in 1e9.
    """

    def __init__(self, network: RBFImageJacobian, gain: float = 0.25):
        """Set up the law.

        Args:
            network: RBFCenters and initial weights.
            gain: Diagonal of L.
        """
        super().__init__(network)
        self.gain = gain

    def initial_state(self, *batch: int) -> WeightState:
        """The network's weights."""
        return WeightState(weight=self.initial_weight(*batch))

    def update(self, state: WeightState, measurement: Measurement) -> WeightState:
        """One explicit Euler step of dt."""
        theta = self.network.basis(measurement.pose)
        rate = paper_rate(state.weight, theta, measurement, self.gain)
        return WeightState(weight=state.weight + measurement.dt * rate)


def paper_rate(
    weight: Float[Tensor, "*batch entries K"],
    theta: Float[Tensor, "*batch K"],
    measurement: Measurement,
    gain: float,
) -> Float[Tensor, "*batch entries K"]:
    """W_dot of the printed law.

    xi_x'^T s is the outer product of xi_x and s, row by row: so d(J_s_hat)/dt =
    -gain |theta|^2 xi_x s^T at the present pose.
    """
    xi_x = measurement.xi_x.unsqueeze(-1)
    J = evaluate(weight, theta)
    s = matmul(J.mT, xi_x).squeeze(-1) + measurement.xi_r
    push = (xi_x * s.unsqueeze(-2)).flatten(-2)  # (*batch, 12)
    return -gain * push.unsqueeze(-1) * theta.unsqueeze(-2)


@dataclass(frozen=True, kw_only=True)
class CompositeConfig(KeyFrameConfig):
    """Gains of the composite law."""

    task_gain: float = 0.25
    """Of the paper's term: diagonal of L."""
    prediction_gain: float = 0.5
    """Fraction of the prediction error that one pair removes, 0 to below 2."""
    noise_floor: float = 2e-3
    """Motion [m] at which half of that share is believed: below it noise is."""
    weight_bound: float = 2e4
    """Largest entry of the weights [px/m], rotation counted with `rotation_scale`."""


@pytree
@dataclass(frozen=True, kw_only=True)
class CompositeState:
    """Weights and the frame that the next one is compared with."""

    weight: Float[Tensor, "*batch entries K"]
    """W [px/m, px/rad]."""
    key: KeyFrame
    """Last key frame."""


class CompositeEstimator(KeyFrameEstimator):
    """Composite adaptation: task error and prediction error (Slotine and Li 1989).

    Between key frames the prediction error is e = dx - J_s_hat dr. Each pair moves the
    weights along the gradient of |e|^2, normalised by the size of the regressor:

        W <- W + gamma e (x) dr theta^T / (|theta|^2 (|dr|^2 + floor^2))

    so that |e| shrinks by the factor 1 - gamma |dr|^2 / (|dr|^2 + floor^2), never grows for
    0 < gamma < 2, and pairs of little motion, mostly noise, count for little. Entries of the
    weights are bounded.
    """

    def __init__(self, network: RBFImageJacobian, config: CompositeConfig | None = None):
        self.config = config or CompositeConfig()
        super().__init__(network, self.config, self.config.weight_bound)

    def initial_state(self, *batch: int) -> CompositeState:
        """The network's weights and no key frame."""
        weight, key = self.initial_weight(*batch), KeyFrame.absent(self.network, *batch)
        return CompositeState(weight=weight, key=key)

    def update(self, state: CompositeState, measurement: Measurement) -> CompositeState:
        """One step of dt of the paper's term, and one pair if there is a new one."""
        theta = self.network.basis(measurement.pose)
        key, pair = self.advance(state.key, measurement, theta, self.config)
        rate = paper_rate(state.weight, theta, measurement, self.config.task_gain)
        change = measurement.dt * rate + self._correction(state.weight, pair)
        weight = state.weight + change
        return CompositeState(weight=self.projected(weight), key=key)

    def _correction(self, weight: Tensor, pair: MotionSample) -> Tensor:
        """Normalised gradient step on the prediction error; zero without a pair."""
        config = self.config
        motion = pair.dr.square().sum(-1) + config.noise_floor**2
        # Normalised neurons never fade. Others do between and beyond the centres: dividing by
        # their activity there would write far too much into weights that act elsewhere.
        least = 0.0 if self.network.normalized else 1.0
        activity = pair.theta.square().sum(-1).clamp_min(least)
        size = (motion * activity).clamp_min(torch.finfo(motion.dtype).tiny)
        step = config.prediction_gain * pair.error(weight) / size.unsqueeze(-1)
        entries = step.unsqueeze(-1) * (pair.dr * self.scale).unsqueeze(-2)
        return entries.flatten(-2).unsqueeze(-1) * pair.theta.unsqueeze(-2)


@dataclass(frozen=True, kw_only=True)
class BroydenConfig(KeyFrameConfig):
    """Step of Broyden's update."""

    min_step: float = 2e-3
    """Least motion between key frames [m]: without a noise model it must be large."""
    gain: float = 0.5
    """Fraction of the prediction error that one pair removes, above 0 to 1."""
    weight_bound: float = 2e4
    """Largest entry of the weights [px/m], rotation counted with `rotation_scale`."""


class BroydenEstimator(KeyFrameEstimator):
    """J_s <- J_s + gain (dx - J_s dr) dr^T / |dr|^2 (Jägersand 1997), everywhere at once.

    The same change of every neuron changes a network of normalised neurons by a constant.
    """

    def __init__(self, network: RBFImageJacobian, config: BroydenConfig | None = None):
        """Set up the update.

        Raises:
            ValueError: The network's neurons are not normalised.
        """
        self.config = config or BroydenConfig()
        super().__init__(network, self.config, self.config.weight_bound)
        if not network.normalized:
            raise ValueError(
                "Broyden's update adds a constant Jacobian, which only normalised neurons can "
                "represent: build the network with normalized=True."
            )

    def initial_state(self, *batch: int) -> CompositeState:
        """The network's weights and no key frame."""
        weight, key = self.initial_weight(*batch), KeyFrame.absent(self.network, *batch)
        return CompositeState(weight=weight, key=key)

    def update(self, state: CompositeState, measurement: Measurement) -> CompositeState:
        """One pair if there is a new one."""
        theta = self.network.basis(measurement.pose)
        key, pair = self.advance(state.key, measurement, theta, self.config)
        # dr is zero without a pair: then the floor keeps 0 / 0 away.
        size = pair.dr.square().sum(-1).clamp_min((self.config.min_step / 2) ** 2)
        step = self.config.gain * pair.error(state.weight) / size.unsqueeze(-1)
        change = step.unsqueeze(-1) * (pair.dr * self.scale).unsqueeze(-2)
        weight = state.weight + change.flatten(-2).unsqueeze(-1)
        return CompositeState(weight=self.projected(weight), key=key)
