"""A batched pinhole camera in torch that sees a marker on the end effector."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.pytree import pytree, static

OVERHEAD = (0.0, 0.0, 1.0, 0.0)
"""Orientation of the paper's camera: it looks down, image right is -x and image down is +y."""


@pytree
class PinholeCamera:
    """Fixed camera that sees a marker on the end effector."""

    pose: Pose
    """Pose of the camera in the base frame: z along the optical axis, x right, y down."""
    marker: Float[Tensor, "*#batch 3"]
    """Marker in the frame of the tool centre point [m]."""
    corners: Float[Tensor, "points 3"] | None = None
    """Points of a feature that has several, from the marker in the tool's frame [m]; None: the
    marker's centre is the feature."""
    focal_length: float = static(1600.0)
    """[px]"""
    image_size: tuple[int, int] = static((1440, 1080))
    """Width and height [px]."""

    @classmethod
    def above(
        cls,
        point: Float[Tensor, "*batch 3"],
        *,
        height: Float[Tensor, "*#batch"],
        roll: Float[Tensor, "*#batch"],
        tilt: Float[Tensor, "*#batch"],
        bearing: Float[Tensor, "*#batch"],
        marker: Float[Tensor, "*#batch 3"],
        **options,
    ) -> PinholeCamera:
        """Camera that looks at a point from a distance.

        Args:
            point: Point in the middle of the image [m].
            height: Distance of the camera from it [m].
            roll: Turn about the optical axis, from the paper's camera [rad].
            tilt: Angle of the optical axis with the vertical [rad].
            bearing: Horizontal direction in which the camera leans, from base x [rad].
            marker: Position of the marker in the frame of the tool centre point [m].
            options: The remaining fields.
        """
        zero = torch.zeros_like(roll + tilt + bearing)
        lean = torch.stack([-torch.sin(bearing) + zero, torch.cos(bearing) + zero, zero], -1)
        turn = torch.stack([zero, zero, roll + zero], dim=-1)
        overhead = point.new_tensor(OVERHEAD)
        orientation = quaternion.multiply(
            quaternion.exp(tilt.unsqueeze(-1) * lean),
            quaternion.multiply(overhead, quaternion.exp(turn)),
        )
        axis = quaternion.rotate(orientation, point.new_tensor((0.0, 0.0, 1.0)))
        position = point - height.unsqueeze(-1) * axis
        return cls(pose=Pose(position, orientation), marker=marker, **options)

    def project(
        self, tool: Pose
    ) -> tuple[Float[Tensor, "*batch rows"], Bool[Tensor, "*batch"]]:
        """Feature in the image [px], and whether all of it is inside the image."""
        ray, _ = self._rays(tool)
        pixel = self.focal_length * ray[..., :2] / ray[..., 2:] + self._centre(ray)
        inside = (pixel >= 0) & (pixel <= 2 * self._centre(ray))
        seen = inside.all(-1) & (ray[..., 2] > 0)
        return pixel.flatten(-2), seen.all(-1)

    def image_jacobian(self, tool: Pose) -> Float[Tensor, "*batch rows 6"]:
        """True J_s: pixel velocity for a twist of the tool [px/m, px/rad]."""
        ray, arm = self._rays(tool)
        x, y, z = ray.unbind(-1)
        zero = torch.zeros_like(z)
        rows = [torch.stack([z, zero, -x], -1), torch.stack([zero, z, -y], -1)]
        over_ray = self.focal_length * torch.stack(rows, -2) / (z * z)[..., None, None]
        rotation = quaternion.to_matrix(quaternion.conjugate(self.pose.orientation))
        over_point = over_ray @ rotation.unsqueeze(-3)
        # Turning by w moves a point by w x arm, so a row g of d(pixel)/d(point) contributes
        # g . (w x arm) = (arm x g) . w.
        arm, over_point = torch.broadcast_tensors(arm.unsqueeze(-2), over_point)
        over_turn = torch.linalg.cross(arm, over_point)
        return torch.cat([over_point, over_turn], dim=-1).flatten(-3, -2)

    def _rays(self, tool: Pose) -> tuple[Tensor, Tensor]:
        """Points in the camera frame, and their arms on the tool in the base frame [m].

        Both have an axis of points before the last.
        """
        points = self.marker.unsqueeze(-2)
        if self.corners is not None:
            points = points + self.corners
        arm = quaternion.rotate(tool.orientation.unsqueeze(-2), points)
        offset = arm + (tool.position - self.pose.position).unsqueeze(-2)
        turn = quaternion.conjugate(self.pose.orientation).unsqueeze(-2)
        return quaternion.rotate(turn, offset), arm

    def _centre(self, like: Tensor) -> Tensor:
        return (like.new_tensor(self.image_size) - 1) / 2
