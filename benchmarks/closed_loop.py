"""Batched kinematic simulation of the closed loop in torch, with a camera unknown to the
controller.

The arm follows its commands exactly, so thousands of runs fit into one batch and gradients pass
through. Contacts, images and marker detection need the MuJoCo simulator.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.controller import (
    INITIAL_IMAGE_JACOBIAN,
    AdaptiveController,
    Command,
    ControllerState,
    Goals,
    Observation,
)
from hrc_learn.geometry import Pose
from hrc_learn.jacobian import RBFImageJacobian, paper_grid


def guessed_network() -> RBFImageJacobian:
    """The paper's initial image Jacobian, equal everywhere."""
    guess = torch.tensor(INITIAL_IMAGE_JACOBIAN, dtype=torch.float64)
    return RBFImageJacobian.from_jacobian(guess, paper_grid(), 0.1)


@runtime_checkable
class ProjectiveCamera(Protocol):
    """A camera that projects the marker on the end effector."""

    def project(
        self, tool: Pose
    ) -> tuple[Float[Tensor, "*batch rows"], Bool[Tensor, "*batch"]]:
        """Pixel of the marker [px], and a flag for points inside the image."""
        ...


@dataclass(frozen=True, kw_only=True)
class Imperfections:
    """Measurement errors of a real camera and of real encoders."""

    frame_steps: int = 1
    """Control steps from one image to the next."""
    latency_frames: int = 0
    """Delay of a measurement, in images."""
    noise: float = 0.0
    """Standard deviation of each pixel coordinate [px]."""
    nan_fraction: float = 0.0
    """Fraction of images whose measurement is NaN although it is marked as visible."""
    loss_rate: float = 0.0
    """Rate at which occlusions of the marker begin [1/s]."""
    loss_time: float = 3.0
    """Longest time for which the marker stays covered [s]; the mean is half of it."""
    encoder_noise: float = 0.0
    """Standard deviation of each joint position reading [rad]."""


@dataclass(kw_only=True)
class VirtualCamera:
    """Converts tool poses into measurements, with the imperfections of camera and encoders.

    It stores the last images, for their delay, and the remaining time for which the marker is
    covered.
    """

    camera: ProjectiveCamera
    imperfections: Imperfections
    generator: torch.Generator
    _steps: int = 0
    _images: list[tuple[Tensor, Tensor, Tensor]] = field(default_factory=list)
    _covered: Tensor | None = None

    def observe(self, tool: Pose, joint_position: Tensor, dt: float) -> dict[str, Any]:
        """Fields of an observation that come from the camera."""
        new = self._steps % self.imperfections.frame_steps == 0
        if new:
            self._take_image(tool, joint_position, dt * self.imperfections.frame_steps)
        self._steps += 1
        feature, visible, q = self._images[0]
        return {
            "feature": feature,
            "feature_visible": visible,
            "feature_new": torch.full_like(visible, new),
            "image_joint_position": q,
        }

    def read_encoders(self, joint_position: Tensor) -> Tensor:
        """A reading of joint positions [rad]."""
        size = self.imperfections.encoder_noise
        if size == 0:
            return joint_position
        noise = torch.randn(joint_position.shape, generator=self.generator, dtype=torch.float64)
        return joint_position + size * noise

    def _take_image(self, tool: Pose, joint_position: Tensor, frame_time: float) -> None:
        imperfections = self.imperfections
        feature, visible = self.camera.project(tool)
        noise = torch.randn(feature.shape, generator=self.generator, dtype=feature.dtype)
        feature = feature + imperfections.noise * noise
        broken = self._uniform(visible) < imperfections.nan_fraction
        feature = torch.where(broken.unsqueeze(-1), torch.nan, feature)
        visible = visible & ~self._cover(visible, frame_time)
        self._images.append((feature, visible, joint_position))
        del self._images[: -1 - imperfections.latency_frames]

    def _cover(self, visible: Tensor, frame_time: float) -> Tensor:
        """True while an obstacle stands between marker and camera."""
        remaining = torch.zeros_like(visible, dtype=torch.float64)
        if self._covered is not None:
            remaining = self._covered - frame_time
        starts = self._uniform(visible) < self.imperfections.loss_rate * frame_time
        # Uniform up to the longest interval, which makes the mean half of it.
        interval = self.imperfections.loss_time * self._uniform(visible)
        self._covered = torch.where(starts & (remaining <= 0), interval, remaining)
        return self._covered > 0

    def _uniform(self, like: Tensor) -> Tensor:
        return torch.rand(like.shape, generator=self.generator, dtype=torch.float64)


def simulate_closed_loop(
    controller: AdaptiveController,
    camera: VirtualCamera,
    joint_position: Float[Tensor, "*batch n"],
    *,
    steps: int,
    dt: float,
    nullspace_input: Callable[[int, Tensor], Tensor] | None = None,
    goals: Callable[[int], Goals] | None = None,
    on_step: Callable[[int, Tensor, Observation, Command, ControllerState], None] | None = None,
    advance: Callable[[Tensor, Tensor, float], Tensor] | None = None,
) -> Float[Tensor, "*batch n"]:
    """Run the closed loop.

    Args:
        controller: Controller with its goals.
        camera: True camera.
        joint_position: Start [rad].
        steps: Number of control steps.
        dt: Control step [s].
        nullspace_input: Null-space input of a person, as a function of step number and joint
            position.
        goals: Goals as a function of the step number; default: those of the controller.
        on_step: Called after each step with its number, the joint position it started from,
            observation, command and new state.
        advance: Joint position [rad] after a step [s], from the joint position before it and
            the commanded velocity [rad/s]; default: exact integration.

    Returns:
        Joint position at the end [rad].
    """
    q, state = joint_position, controller.initial_state(joint_position)
    for k in range(steps):
        read = camera.read_encoders(q)
        observation = Observation(
            **camera.observe(controller.chain.forward(q), read, dt),
            joint_position=read,
            dt=dt,
            nullspace_input=None if nullspace_input is None else nullspace_input(k, q),
            goals=None if goals is None else goals(k),
        )
        command, state = controller.step(state, observation)
        if on_step is not None:
            on_step(k, q, observation, command, state)
        v = command.joint_velocity
        q = q + v * dt if advance is None else advance(q, v, dt)
    return q
