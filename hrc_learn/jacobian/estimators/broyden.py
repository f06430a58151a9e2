"""Broyden's rank-one update of one Jacobian for the whole workspace."""

from __future__ import annotations

from dataclasses import dataclass

from hrc_learn.jacobian.estimators.estimator import Measurement
from hrc_learn.jacobian.estimators.gradient import CompositeState
from hrc_learn.jacobian.estimators.key_frames import KeyFrame, KeyFrameEstimator
from hrc_learn.jacobian.network import RBFImageJacobian
from hrc_learn.jacobian.samples import KeyFrameConfig


@dataclass(frozen=True, kw_only=True)
class BroydenConfig(KeyFrameConfig):
    """Step of Broyden's update."""

    min_step: float = 2e-3
    """Least motion between key frames [m]: without a noise model it must be large."""
    gain: float = 0.5
    """Share of the prediction error that one pair removes, above 0 to 1."""
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
