"""The interface of online estimators of the image Jacobian, and the one that never
changes it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

from jaxtyping import Bool, Float
from torch import Tensor, nn

from hrc_learn.geometry import Pose
from hrc_learn.geometry.small_matrices import matmul
from hrc_learn.jacobian.network import RBFImageJacobian
from hrc_learn.pytree import pytree

# What an online estimator of the image Jacobian is told, keeps and answers.


@pytree
@dataclass(frozen=True, kw_only=True)
class Measurement:
    """One control step as an estimator sees it."""

    pose: Pose
    """Of the tool when the image was taken."""
    feature: Float[Tensor, "*batch rows"]
    """Image feature [px], u and v of one point or of several in turn; anything, also NaN,
    where not `valid`."""
    valid: Bool[Tensor, "*batch"]
    """Whether the feature is visible and stems from an image not used before."""
    dt: float | Float[Tensor, ""]
    """Time since the step before [s]."""
    xi_x: Float[Tensor, "*batch rows"]
    """Vision feedback of the controller."""
    xi_r: Float[Tensor, "*batch 6"]
    """Cartesian feedback of the controller."""


@pytree
@dataclass(frozen=True, kw_only=True)
class WeightState:
    """State of an estimator that remembers nothing but the weights."""

    weight: Float[Tensor, "*batch entries K"]
    """W [px/m, px/rad], one matrix for each element of the batch."""


class ImageJacobianEstimator(nn.Module, ABC):
    """Adapts the weights of a network while the robot moves.

    Pure: `update` takes a state and returns a new one, so that thousands of robots adapt in
    one batch. The network supplies the neurons and the weights to start from; it is not
    changed.
    """

    def __init__(self, network: RBFImageJacobian):
        super().__init__()
        self.network = network

    @abstractmethod
    def initial_state(self, *batch: int) -> Any:
        """State before the first step, for a batch of robots.

        Its tensors are of the dtype and device of the network.
        """

    @abstractmethod
    def update(self, state: Any, measurement: Measurement) -> Any:
        """State after one control step."""

    def resumed(self, state: Any, pause: float) -> Any:
        """State after a pause in which nobody watched.

        What was seen before it must not be compared with what is seen after it: meanwhile the
        camera may have been moved.

        Args:
            state: At the end of the watching before.
            pause: [s]
        """
        return state

    def jacobian(
        self, state: Any, r: Pose | Float[Tensor, "*batch 6"]
    ) -> Float[Tensor, "*batch rows 6"]:
        """J_s_hat at a pose with the weights of a state.

        Args:
            state: Of this estimator.
            r: Position [m] and rotation vector [rad], or a pose.
        """
        return evaluate(state.weight, self.network.basis(r))

    def initial_weight(self, *batch: int) -> Float[Tensor, "*batch entries K"]:
        """The network's weights, once for each element of a batch."""
        weight = self.network.weight.detach()
        return weight.expand(*batch, *weight.shape).clone()


def evaluate(
    weight: Float[Tensor, "*batch entries K"], theta: Float[Tensor, "*batch K"]
) -> Float[Tensor, "*batch rows 6"]:
    """J_s_hat from vec(J_s_hat^T) = W theta."""
    return matmul(weight, theta.unsqueeze(-1)).squeeze(-1).unflatten(-1, (-1, 6))


# No adaptation: what every other estimator is measured against.


class FixedEstimator(ImageJacobianEstimator):
    """Keeps the network's weights."""

    def initial_state(self, *batch: int) -> WeightState:
        """The network's weights."""
        return WeightState(weight=self.initial_weight(*batch))

    def update(self, state: WeightState, measurement: Measurement) -> WeightState:
        """The same state."""
        return state
