"""The interface of online estimators of the image Jacobian, and their common part.

`FixedEstimator` never changes the Jacobian. Learning estimators compare key frames: pairs of
poses and images far enough apart to distinguish motion from noise, which `KeyFrameEstimator`
selects online.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.utils._pytree import tree_map

from hrc_learn.geometry import Pose
from hrc_learn.geometry.numerics import is_number, matmul
from hrc_learn.jacobian.motion_samples import KeyFrameConfig, component_scale
from hrc_learn.jacobian.network import RBFImageJacobian
from hrc_learn.pytree import pytree


@pytree
@dataclass(frozen=True, kw_only=True)
class Measurement:
    """Measurement of one control step."""

    pose: Pose
    """Pose of the tool when the image was taken."""
    feature: Float[Tensor, "*batch rows"]
    """Image feature [px], u and v of one point or of several in turn; any value, also NaN,
    where not `valid`."""
    valid: Bool[Tensor, "*batch"]
    """True if the feature is visible and from an image not used before."""
    dt: float | Float[Tensor, ""]
    """Time since the last step [s]."""
    xi_x: Float[Tensor, "*batch rows"]
    """Vision feedback of the controller."""
    xi_r: Float[Tensor, "*batch 6"]
    """Cartesian feedback of the controller."""


@pytree
@dataclass(frozen=True, kw_only=True)
class WeightState:
    """State of an estimator that consists of the weights alone."""

    weight: Float[Tensor, "*batch entries K"]
    """W [px/m, px/rad], one matrix for each element of the batch."""


class ImageJacobianEstimator(nn.Module, ABC):
    """Adapts the weights of a network while the robot moves.

    `update` is pure: it takes a state and returns a new one, so thousands of robots adapt in
    one batch. The network supplies the neurons and the initial weights; it is not changed.
    """

    def __init__(self, network: RBFImageJacobian):
        super().__init__()
        self.network = network

    @abstractmethod
    def initial_state(self, *batch: int) -> Any:
        """State before the first step, for a batch of robots.

        Its tensors have the dtype and device of the network.
        """

    @abstractmethod
    def update(self, state: Any, measurement: Measurement) -> Any:
        """State after one control step."""

    def restored(self, state: Any) -> Any:
        """The state, reset where it is not finite."""
        known = all_numbers(state.weight)
        initial = self.network.weight.detach()
        return replace(state, weight=torch.where(known, state.weight, initial))

    def resumed(self, state: Any, pause: float) -> Any:
        """State after a pause without images.

        Frames before and after the pause must not be compared: the camera may have been moved
        meanwhile.

        Args:
            state: State before the pause.
            pause: Duration of the pause [s].
        """
        return state

    def compared(self, state: Any, before: Measurement, now: Measurement) -> Any:
        """State after learning from two frames chosen by the caller.

        Neighbouring pairs of a motion share the noise of the frame between them, which a filter
        does not model. One pair of means over many images, at rest at both ends, is more
        informative than all pairs of the motion.

        Args:
            state: State before.
            before: First frame, its feature corrected for perspective.
            now: Second frame, at which the Jacobian is learned; its `dt` should be 0 if that
                time has already passed in `update`.
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
        return evaluate(state.weight, self.network.basis(r))

    def initial_weight(self, *batch: int) -> Float[Tensor, "*batch entries K"]:
        """The network's weights, repeated for each element of a batch."""
        weight = self.network.weight.detach()
        return weight.expand(*batch, *weight.shape).clone()


def all_numbers(matrix: Float[Tensor, "*batch rows columns"]) -> Bool[Tensor, "*batch 1 1"]:
    """True where all entries are finite."""
    return is_number(matrix).all(-1, keepdim=True).all(-2, keepdim=True)


def evaluate(
    weight: Float[Tensor, "*batch entries K"], theta: Float[Tensor, "*batch K"]
) -> Float[Tensor, "*batch rows 6"]:
    """J_s_hat from  vec(J_s_hat^T) = W theta."""
    return matmul(weight, theta.unsqueeze(-1)).squeeze(-1).unflatten(-1, (-1, 6))


class FixedEstimator(ImageJacobianEstimator):
    """Keeps the network's weights: the baseline for all other estimators."""

    def initial_state(self, *batch: int) -> WeightState:
        """The network's weights."""
        return WeightState(weight=self.initial_weight(*batch))

    def update(self, state: WeightState, measurement: Measurement) -> WeightState:
        """The same state."""
        return state


@pytree
@dataclass(frozen=True, kw_only=True)
class KeyFrame:
    """Frame with which the next one is compared."""

    pose: Pose
    """Pose of the tool."""
    feature: Float[Tensor, "*batch rows"]
    """Feature at that pose [px]."""
    theta: Float[Tensor, "*batch K"]
    """Neurons at the pose."""
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
@dataclass(frozen=True, kw_only=True)
class KeyFrameState:
    """Weights, and the frame with which the next one is compared."""

    weight: Float[Tensor, "*batch entries K"]
    """W [px/m, px/rad]."""
    key: KeyFrame
    """Last key frame."""


@dataclass(frozen=True, kw_only=True)
class LearningConfig(KeyFrameConfig):
    """Settings of all estimators that learn from key frames."""

    weight_bound: float = 2e4
    """Largest entry of the weights [px/m], rotation scaled with `rotation_scale`."""


@pytree
@dataclass(frozen=True, kw_only=True)
class MotionSample:
    """Motion from the key frame to the present one; zero without a valid pair."""

    twist: Float[Tensor, "*batch 6"]
    """Motion of the tool, linear [m] and angular [rad]."""
    dr: Float[Tensor, "*batch 6"]
    """Motion of the tool with rotation scaled to metres [m]."""
    dx: Float[Tensor, "*batch rows"]
    """Motion of the feature [px]."""
    theta: Float[Tensor, "*batch K"]
    """Neurons half-way, as the mean of both ends."""
    valid: Bool[Tensor, "*batch"]
    """True where there is a pair to learn from."""

    def error(self, weight: Float[Tensor, "*batch entries K"]) -> Float[Tensor, "*batch rows"]:
        """Prediction error dx - J_s_hat dr [px]."""
        J = evaluate(weight, self.theta)
        return self.dx - matmul(J, self.twist.unsqueeze(-1)).squeeze(-1)


class KeyFrameEstimator[Config: LearningConfig](ImageJacobianEstimator):
    """Base of estimators that learn from pairs of key frames."""

    config: Config

    scale: Tensor
    """Metres per unit of each component of a twist, (6,)."""

    bound: Tensor
    """Largest absolute value of each entry of the weights, (entries, 1)."""

    def __init__(self, network: RBFImageJacobian, config: Config):
        """Prepare the scales.

        Args:
            network: Neurons and initial weights.
            config: Choice of key frames, and settings of the estimator.
        """
        super().__init__(network)
        self.config = config
        scale = component_scale(network.centers, config.rotation_scale)
        bound = config.weight_bound * scale.repeat(network.rows).unsqueeze(-1)
        self.register_buffer("scale", scale, persistent=False)
        self.register_buffer("bound", bound, persistent=False)

    def projected(
        self, weight: Float[Tensor, "*batch entries K"]
    ) -> Float[Tensor, "*batch entries K"]:
        """Weights clamped to their bound.

        The projection on a convex set never moves an estimate away from a truth inside it.
        """
        return weight.clamp(-self.bound, self.bound)

    def restored(self, state: Any) -> Any:
        """The state with weights and key frame reset where they are not finite."""
        state = super().restored(state)
        key, batch = state.key, state.weight.shape[:-2]
        pose = key.pose
        numbers = torch.cat([pose.position, pose.orientation, key.feature, key.theta], dim=-1)
        known = is_number(numbers).all(-1)
        absent = KeyFrame.absent(self.network, *batch)
        key = tree_map(
            lambda x, none: torch.where(
                known if x.dim() == known.dim() else known[..., None], x, none
            ),
            key,
            absent,
        )
        return replace(state, key=key)

    def resumed(self, state: Any, pause: float) -> Any:
        """The same weights, and no key frame."""
        batch = state.weight.shape[:-2]
        return replace(state, key=KeyFrame.absent(self.network, *batch))

    def compared(self, state: Any, before: Measurement, now: Measurement) -> Any:
        """State after one more pair; the key frame stays."""
        first = KeyFrame(
            pose=before.pose,
            feature=before.feature,
            theta=self.network.basis(now.pose),
            present=before.valid,
        )
        learned = self.update(replace(state, key=first), now)
        return replace(learned, key=state.key)

    def advance(
        self,
        key: KeyFrame,
        measurement: Measurement,
        theta: Float[Tensor, "*batch K"],
    ) -> tuple[KeyFrame, MotionSample]:
        """Compare with the key frame, and move it here once the tool is `min_step` away.

        Where the tool has moved further than `max_step`, for example while the feature was
        lost, the key frame moves without a pair.

        Args:
            key: Last key frame.
            measurement: Present measurement.
            theta: Neurons at the pose of the measurement.
        """
        config = self.config
        twist = key.pose.twist_to(measurement.pose)
        distance = torch.linalg.vector_norm(twist * self.scale, dim=-1)
        moved = measurement.valid & key.present & (distance >= config.least_step)
        valid = moved & (distance <= config.max_step)
        # An invalid pair may contain NaN; zeros leave every weight unchanged.
        use = valid.unsqueeze(-1)
        twist = torch.where(use, twist, 0.0)
        pair = MotionSample(
            twist=twist,
            dr=twist * self.scale,
            dx=torch.where(use, measurement.feature - key.feature, 0.0),
            theta=(key.theta + theta) / 2,
            valid=valid,
        )
        # The first frame seen becomes a key frame, and so does the end of every pair.
        take = (moved | (measurement.valid & ~key.present)).unsqueeze(-1)
        here = KeyFrame(
            pose=Pose(
                torch.where(take, measurement.pose.position, key.pose.position),
                torch.where(take, measurement.pose.orientation, key.pose.orientation),
            ),
            feature=torch.where(take, measurement.feature, key.feature),
            theta=torch.where(take, theta, key.theta),
            present=key.present | measurement.valid,
        )
        return here, pair
