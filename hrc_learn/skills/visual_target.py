"""Learned target of visual servoing: where an object is relative to a tool right above it.

Demonstrations end with the end effector right above an object. The position of the object's
marker in the tool frame at that moment is learned from the pixels of both markers. In a new
scene, the estimated camera turns the object's pixel into a ray, which is intersected with the
plane at the demonstrated height of objects. The goal of the end effector is the pose at which
this intersection has the learned position in the tool frame. The target in the image is the
pixel that the end effector's marker will have at the goal. Calibration errors cancel if they
move both markers alike.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import CameraSpread
from hrc_learn.jacobian.perspective import MARKER, SIZE, marker_pixels, on_plane
from hrc_learn.store import Metres, Pixels, read_json, write_json

LONGEST_OFFSET = 0.4
"""Longest offset of the object's marker from the tool centre point [m]. Demonstrations at one
place contain little information on the object's height: without this bound, the offset could
become metres long."""

# Iterations of the fit of the offset; each iteration solves a linearised projection.
_STEPS = 8
# Offset from which the fit starts: below the end effector [m].
_BELOW = (0.0, 0.0, 0.1)
# A marker's direction in the image is converted to a heading by projecting the ends of a
# segment onto the marker's plane; this is the half length of the segment [px].
_ALONG = 20.0


@dataclass(frozen=True, kw_only=True)
class _TargetFile:
    version: Literal[3] = 3
    offset_m: tuple[Metres, Metres, Metres]
    error_px: Pixels | None


@dataclass(frozen=True, kw_only=True)
class VisualTarget:
    """Position of the object's marker relative to a tool right above the object."""

    offset: Float[np.ndarray, "3"]
    """Position of the object's marker in the tool frame [m]."""
    error: float
    """Root mean square leave-one-out error [px]; NaN with fewer than five demonstrations."""

    @classmethod
    def fit(
        cls, camera: Float[Tensor, "13"], objects: Float[np.ndarray, "demos 2"], poses: Pose
    ) -> "VisualTarget":
        """Fit the offset to the ends of demonstrations.

        Args:
            camera: Camera of the demonstrations (see `jacobian.perspective`).
            objects: Pixels of the object's marker [px].
            poses: Poses of the end effector right above the object, (demos,).

        Raises:
            ValueError: There are fewer than three demonstrations.
        """
        if len(objects) < 3:
            raise ValueError(
                f"the visual target needs three or more demonstrations, got {len(objects)}."
            )
        offset, error = np.array(_BELOW), math.nan
        for _ in range(_STEPS):
            # The object is treated as a marker on the tool.
            carrying = torch.cat([camera[: MARKER.start], torch.from_numpy(offset)])
            seen, slope = marker_pixels(carrying, poses)
            design = slope[..., MARKER].numpy()
            towards = objects - seen.numpy() + design @ offset
            offset, error = _solved(design.reshape(-1, 3), towards)
        return cls(offset=offset, error=error)

    def tool_position(
        self, camera: Float[Tensor, "*batch 13"], pixel: Float[Tensor, "2"], above: Pose
    ) -> Float[Tensor, "*batch 3"]:
        """Position of a tool right above an object, in the base frame [m].

        Args:
            camera: Cameras.
            pixel: Pixel of the object's marker [px].
            above: Orientation of the tool, and height of the tool at the end of demonstrations.
        """
        offset = quaternion.rotate(above.orientation, torch.from_numpy(self.offset))
        height = above.position[2] + offset[2]
        return on_plane(camera, pixel.expand(*camera.shape[:-1], 2), height) - offset

    def __call__(
        self,
        camera: Float[Tensor, "*batch 13"],
        pixel: Float[Tensor, "2"],
        above: Pose,
        height: float | Float[Tensor, ""] | None = None,
    ) -> Float[Tensor, "*batch 2"]:
        """Target pixel of the end effector's marker for an object's marker at `pixel` [px].

        Args:
            camera: Cameras.
            pixel: Pixel of the object's marker [px].
            above: Orientation of the tool, and height of the tool at the end of demonstrations.
            height: Height of the tool now [m]; None: the height of `above`.
        """
        place = self.tool_position(camera, pixel, above)
        if height is not None:
            level = torch.as_tensor(height).to(place).expand(place.shape[:-1])
            place = torch.cat([place[..., :2], level[..., None]], dim=-1)
        orientation = above.orientation.expand(*place.shape[:-1], 4)
        one = Pose(place.unsqueeze(-2), orientation.unsqueeze(-2))
        return marker_pixels(camera, one)[0].squeeze(-2)

    def uncertainty(
        self,
        cameras: CameraSpread,
        image_jacobian: Float[np.ndarray, "2 6"],
        pixel: Float[Tensor, "2"],
        above: Pose,
    ) -> float:
        """Standard deviation of the tool's position above the object, both axes combined [m].

        The loop is closed through the image, so only the error of the target pixel counts.

        Args:
            cameras: Estimate of the camera.
            image_jacobian: Image Jacobian of the end effector's marker [px/m, px/rad].
            pixel: Pixel of the object's marker [px].
            above: Orientation of the tool, and height of the tool at the end of demonstrations.
        """
        best, *others = self(cameras.samples, pixel, above)
        apart = (torch.stack(others) - best).numpy()
        metres = np.linalg.lstsq(image_jacobian[:, :2], apart.T, rcond=None)[0]
        return float(np.sqrt(cameras.weights.numpy() @ (metres**2).sum(0)))

    def save(self, path: str | Path) -> None:
        """Write a JSON file, atomically."""
        x, y, z = self.offset.tolist()
        write_json(path, _TargetFile(offset_m=(x, y, z), error_px=self.error))

    @classmethod
    def load(cls, path: str | Path) -> "VisualTarget":
        """Read a saved target.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is damaged or has an unknown version.
        """
        content = read_json(path, _TargetFile, "fit the visual target again")
        error = math.nan if content.error_px is None else content.error_px
        return cls(offset=np.array(content.offset_m), error=error)


def _solved(
    design: Float[np.ndarray, "equations unknowns"], pixels: Float[np.ndarray, "demos 2"]
) -> tuple[Float[np.ndarray, " unknowns"], float]:
    """Least-squares solution, with two equations per demonstration, and leave-one-out error.

    The error is the root mean square over the demonstrations [px].
    A solution longer than `LONGEST_OFFSET` is shortened by the smallest sufficient ridge
    penalty.
    """
    u, s, vt = np.linalg.svd(design, full_matrices=False)
    # Directions that no demonstration shows get no offset; the divisions below stay finite.
    u, s = u * (s > 1e-12 * s[0]), np.maximum(s, 1e-12 * s[0])
    along = u.T @ pixels.ravel()

    def too_long(penalty: float) -> bool:
        return float(np.linalg.norm(s * along / (s**2 + penalty))) > LONGEST_OFFSET

    low, high = 0.0, 0.0
    if too_long(0.0):
        high = float(s[0] * np.linalg.norm(along)) / LONGEST_OFFSET
        # Bisection: the length decreases as the penalty grows.
        while high - low > 1e-6 * high:
            middle = (low + high) / 2
            low, high = (middle, high) if too_long(middle) else (low, middle)
    inverse = (vt.T * (s / (s**2 + high))) @ u.T
    solution = inverse @ pixels.ravel()
    if len(pixels) < 5:
        return solution, float("nan")
    residuals = pixels - (design @ solution).reshape(-1, 2)
    # Errors of left-out demonstrations, from blocks of the hat matrix (PRESS, Allen 1974).
    hat = (design @ inverse).reshape(len(pixels), 2, len(pixels), 2)
    own = hat[np.arange(len(pixels)), :, np.arange(len(pixels))]
    press = np.linalg.solve(np.eye(2) - own, residuals[..., None])
    return solution, float(np.sqrt((press**2).sum(axis=(1, 2)).mean()))


def object_heading(
    camera: Float[Tensor, "13"], pixel: Float[Tensor, "2"], angle: float, height: float
) -> float:
    """Heading in the base frame of a marker that lies flat [rad].

    Args:
        camera: Camera.
        pixel: Pixel of the marker [px].
        angle: Direction of the marker in the image [rad].
        height: Height of the marker [m].
    """
    along = _ALONG * pixel.new_tensor([math.cos(angle), math.sin(angle)])
    ends = torch.stack([pixel - along, pixel + along])
    start, end = on_plane(camera.expand(2, SIZE), ends, height)
    x, y, _ = (end - start).tolist()
    return math.atan2(y, x)
