"""A pinhole camera that watches a point on the tool: its true image Jacobian for tests."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import ImageDemonstration


@dataclass(frozen=True, kw_only=True)
class Pinhole:
    """Camera fixed in the room; the marker sits at `lever` in the tool's frame."""

    rotation: Tensor
    """R_camera_base, (3, 3)."""
    position: Tensor
    """Of the camera in the base frame, (3,) [m]."""
    focal: float = 1400.0
    lever: tuple[float, float, float] = (0.03, 0.05, -0.06)

    @staticmethod
    def overhead(roll: float = 0.3, tilt: float = 0.2, height: float = 1.5) -> Pinhole:
        """About `height` above the table, looking down and turned by `roll` [rad]."""
        down = torch.diag(torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64))
        turn = quaternion.to_matrix(quaternion.exp(torch.tensor([0, 0, roll]).double()))
        lean = quaternion.to_matrix(quaternion.exp(torch.tensor([tilt, 0, 0]).double()))
        position = torch.tensor([0.25, 0.35, height], dtype=torch.float64)
        return Pinhole(rotation=turn @ lean @ down, position=position)

    def project(self, pose: Pose) -> Tensor:
        """Feature (*batch, 2) [px]."""
        lever = torch.tensor(self.lever, dtype=torch.float64)
        p = (pose.apply(lever) - self.position) @ self.rotation.mT
        return self.focal * p[..., :2] / p[..., 2:] + torch.tensor([720.0, 540.0]).double()

    def jacobian(self, pose: Pose) -> Tensor:
        """True J_s (*batch, 2, 6), by autograd through a small base-frame motion."""

        def moved(twist: Tensor, position: Tensor, orientation: Tensor) -> Tensor:
            turned = quaternion.multiply(quaternion.exp(twist[3:]), orientation)
            return self.project(Pose(position + twist[:3], turned))

        derivative = torch.func.jacfwd(moved)
        batch = pose.position.shape[:-1]
        still = torch.zeros(6, dtype=torch.float64)
        flat = torch.vmap(derivative, in_dims=(None, 0, 0))(
            still, pose.position.reshape(-1, 3), pose.orientation.reshape(-1, 4)
        )
        return flat.reshape(*batch, 2, 6)


def wander(
    frames: int, *batch: int, rng: torch.Generator, spread: float = 0.12, turn: float = 0.3
) -> Pose:
    """Smooth random paths about the paper's grid with the gripper pointing down.

    Args:
        frames: Of each path, 1/30 s apart.
        batch: Number of paths.
        rng: Source of the random phases.
        spread: Amplitude of each of three sines in x, y (half of it in z) [m].
        turn: Amplitude of each of three sines about each axis [rad].
    """
    time = torch.arange(frames, dtype=torch.float64)[:, None, None] / 30
    rate = 0.2 + 0.8 * torch.rand(*batch, 1, 3, 6, generator=rng, dtype=torch.float64)
    phase = 6.3 * torch.rand(*batch, 1, 3, 6, generator=rng, dtype=torch.float64)
    wave = torch.sin(rate * time + phase).sum(-2) / 3**0.5  # (*batch, frames, 6)
    size = torch.tensor([spread, spread, spread / 2, turn, turn, turn], dtype=torch.float64)
    center = torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
    down = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64)
    motion = wave * size
    turned = quaternion.multiply(quaternion.exp(motion[..., 3:]), down)
    return Pose(center + motion[..., :3], turned)


def image_demonstrations(poses, features, visible=None) -> list[ImageDemonstration]:
    """Demonstrations from their columns; a feature is visible where it is not NaN."""
    if visible is None:
        visible = [~feature.isnan().any(-1) for feature in features]
    return [
        ImageDemonstration(pose=pose, feature=feature, visible=seen)
        for pose, feature, seen in zip(poses, features, visible, strict=True)
    ]
