"""Perspective: the change of a point's depth with its position, from its image Jacobian.

For a pinhole camera with square pixels, rows r_1, r_2, r_3 of its rotation, and a point at
depth z that is seen at xi = (x - c) / f, the image Jacobian is

    J = f / z (r_12 - xi r_3^T).

Given the focal length f and the image centre c, the six entries determine rotation and depth in
closed form. A point at an offset o is then seen at

    x + J o / (1 + g^T o),    g = r_3 / z.

The closed form models neither lens distortion nor an image centre off the middle; a camera
fitted to demonstrations (`MarkerCamera`) does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian.fitting import ImageDemonstration
from hrc_learn.jacobian.network import RBFImageJacobian

# Prior standard deviation of the logarithm of the focal length, about the image width: lenses
# of 30 to 80 degrees are within one standard deviation.
_FOCAL_SPREAD = 0.5
# Residual beyond which a frame counts less [px]: several times a detector's noise, about the
# calibration error of an arm.
_PIXEL_NOISE = 1.0
# Prior standard deviation of the principal point about the middle, relative to the image width:
# assembled cameras are off by some tens of pixels in two thousand.
_CENTER_SPREAD = 0.02
# Prior standard deviation of the radial coefficient: all lenses except fish eyes are within it.
_RADIAL_SPREAD = 0.2
# Least depth of a point [m].
_NEAREST = 1e-3
_TINY = 1e-12
# Steps of the fixed-point iteration that removes lens distortion. Each leaves a fraction
# 2 |k1| xi^2 of the error, a tenth at the edge of a wide image.
_LENS_STEPS = 20
# Approximate number of frames fitted to: the noise averages out well before.
_FRAMES = 2000


def depth_gradient(
    jacobian: Float[np.ndarray, "*batch 2 3"],
    pixel: Float[np.ndarray, "*batch 2"],
    focal: float,
    center: Float[np.ndarray, "2"],
) -> Float[np.ndarray, "*batch 3"]:
    """Relative change of a point's depth with its position, g = r_3 / z [1/m].

    Args:
        jacobian: Derivative of the point's pixel by its position [px/m].
        pixel: Pixel of the point [px].
        focal: Focal length [px].
        center: Centre of the image [px].
    """
    xi = (pixel - center) / focal
    _, depth, axis = _camera(jacobian / focal, xi)
    return axis / depth[..., None]


def _camera(
    jacobian: Float[np.ndarray, "*batch 2 3"], xi: Float[np.ndarray, "*batch 2"]
) -> tuple[
    Float[np.ndarray, "*batch 2 3"], Float[np.ndarray, "*batch"], Float[np.ndarray, "*batch 3"]
]:
    """First two rows of the rotation, depth, and third row, of a camera of focal length 1."""
    square = 1 + (xi**2).sum(-1)
    # trace(J J^T) z^2 = 2 + |xi|^2
    # A Jacobian of zeros, without information, is that of a camera far away.
    size = np.maximum((jacobian**2).sum((-2, -1)), _TINY)
    depth = np.asarray(np.sqrt((1 + square) / size))
    rows = depth[..., None, None] * jacobian
    # The cross product of the rows is along the ray, r_3 + xi_1 r_1 + xi_2 r_2.
    ray = np.cross(rows[..., 0, :], rows[..., 1, :])
    axis = (ray - (xi[..., None, :] @ rows)[..., 0, :]) / square[..., None]
    axis = axis / np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), _TINY)
    return rows + xi[..., :, None] * axis[..., None, :], depth, axis


@dataclass(frozen=True, kw_only=True)
class MarkerCamera:
    """A camera and the position of a marker on the tool that it sees, found from motion alone.

    The camera is a pinhole with Brown's first radial coefficient. Marker and camera are found
    together, so they absorb errors of the tool centre point and of the base.
    """

    focal: float
    """Focal length [px]."""
    center: tuple[float, float]
    """Principal point (u, v) [px]."""
    radial: float
    """Brown's k1: a point at xi is seen at xi (1 + k1 |xi|^2)."""
    rotation: tuple[float, float, float]
    """Rotation vector from base to camera frame (OpenCV's axes) [rad]."""
    shift: tuple[float, float, float]
    """Origin of the base in the camera frame [m]."""
    marker: tuple[float, float, float]
    """Position of the marker in the tool frame [m]."""

    @staticmethod
    def fit(
        demonstrations: Sequence[ImageDemonstration],
        network: RBFImageJacobian,
        image_size: tuple[int, int],
        *,
        lens: bool = True,
    ) -> MarkerCamera:
        """Fit by robust nonlinear least squares on the pixels.

        Args:
            demonstrations: Demonstrations in which the tool moved and turned, read one by one.
            network: Image Jacobian fitted to them, in float64; gives the initial guess.
            image_size: Width and height of the image [px].
            lens: True: fit principal point and radial coefficient too; False: the middle of the
                image, and zero.
        """
        # SciPy belongs to extras that read demonstrations or simulate; this package imports
        # without it.
        from scipy.optimize import least_squares

        pose, pixel = _sampled(demonstrations)
        tool, turn = pose.position.numpy(), quaternion.to_matrix(pose.orientation).numpy()
        seen_at, middle_pixel, width = pixel.numpy(), np.array(image_size) / 2, image_size[0]
        with torch.no_grad():
            jacobians = network(pose).numpy()[..., :3]
        spread = np.array([_CENTER_SPREAD * width] * 2 + [_RADIAL_SPREAD])

        def residuals(unknown: Float[np.ndarray, " unknown"]) -> Float[np.ndarray, " all"]:
            log_focal, rotation, shift, marker, optics = np.split(unknown, [1, 4, 7, 10])
            center, radial = _optics(optics, middle_pixel)
            rows = _matrix(rotation)
            point = (tool + turn @ marker - middle) @ (rows @ first).T + shift
            seen = _project(point, width * np.exp(log_focal), center, radial)
            priors = np.append(log_focal / _FOCAL_SPREAD, optics / spread[: len(optics)])
            return np.append((seen - seen_at).ravel() / _PIXEL_NOISE, priors)

        middle, xi = tool.mean(0), (seen_at.mean(0) - middle_pixel) / width
        rows, depth, axis = _camera(jacobians.mean(0) / width, xi)
        u, _, vt = np.linalg.svd(np.vstack([rows, axis]))
        first = u @ vt
        start = np.zeros(13 if lens else 10)
        start[4:7] = depth * np.append(xi, 1.0)
        found = least_squares(residuals, start, loss="soft_l1", x_scale="jac").x
        log_focal, rotation, shift, marker, optics = np.split(found, [1, 4, 7, 10])
        matrix = _matrix(rotation) @ first
        center, radial = _optics(optics, middle_pixel)
        return MarkerCamera(
            focal=width * float(np.exp(log_focal[0])),
            center=_pair(center),
            radial=radial,
            rotation=_triple(_rotation_vector(matrix)),
            shift=_triple(shift - matrix @ middle),
            marker=_triple(marker),
        )

    def points(self, pose: Pose) -> Float[np.ndarray, "*batch 3"]:
        """The marker in the camera frame [m] at poses of the tool, in float64."""
        pose = Pose(pose.position.double(), pose.orientation.double())
        return self.from_base(pose.apply(self.marker).numpy())

    def from_base(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Points of the base frame in the camera frame [m]."""
        return points @ self.rotation_matrix.T + np.array(self.shift)

    @property
    def rotation_matrix(self) -> Float[np.ndarray, "3 3"]:
        """Rotation from base to camera frame."""
        return _matrix(np.array(self.rotation))

    def project(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Pixels of points in the camera frame [px]."""
        return _project(points, self.focal, np.array(self.center), self.radial)

    def on_plane(
        self, pixel: Float[np.ndarray, "*batch 2"], height: float
    ) -> Float[np.ndarray, "*batch 3"]:
        """Points of a horizontal plane seen at pixels, in the base frame [m].

        Args:
            pixel: Pixels (u, v) [px].
            height: Height of the plane in the base frame [m].
        """
        distorted = (pixel - np.array(self.center)) / self.focal
        xi = distorted
        for _ in range(_LENS_STEPS):
            xi = distorted / (1 + self.radial * (xi**2).sum(-1, keepdims=True))
        back = self.rotation_matrix.T
        ray = np.concatenate([xi, np.ones_like(xi[..., :1])], axis=-1) @ back.T
        eye = -back @ np.array(self.shift)
        return eye + (height - eye[2]) / ray[..., 2:] * ray

    def motion_jacobian(
        self, points: Float[np.ndarray, "*batch 3"]
    ) -> Float[np.ndarray, "*batch 2 6"]:
        """Derivative of pixels by a twist of the camera in its own frame [px/rad, px/m].

        Three columns of rotation, then three of translation: the interaction matrix of
        Espiau, Chaumette and Rives (1992) for points, times the lens.

        Args:
            points: Points in the camera frame [m].
        """
        x, y, z = np.moveaxis(points, -1, 0)
        z = z.clip(min=_NEAREST)
        xi = np.stack([x / z, y / z], axis=-1)
        square = (xi**2).sum(-1)[..., None, None]
        lens = (1 + self.radial * square) * np.eye(2) + 2 * self.radial * (
            xi[..., :, None] * xi[..., None, :]
        )
        zero = np.zeros_like(z)
        pinhole = np.stack(
            [
                np.stack([1 / z, zero, -x / z**2], axis=-1),
                np.stack([zero, 1 / z, -y / z**2], axis=-1),
            ],
            axis=-2,
        )
        # For a camera that turns by w and moves by v, points move by p x w - v.
        turned = np.cross(points[..., None, :], np.eye(3)).swapaxes(-1, -2)
        moved = np.concatenate([turned, np.broadcast_to(-np.eye(3), turned.shape)], axis=-1)
        return self.focal * lens @ pinhole @ moved

    def moved(self, twist: Float[np.ndarray, "6"]) -> MarkerCamera:
        """The camera turned by a rotation vector [rad] about its own axes, then moved along the
        axes it had before the turn [m].
        """
        back = _matrix(twist[:3]).T
        return replace(
            self,
            rotation=_triple(_rotation_vector(back @ _matrix(np.array(self.rotation)))),
            shift=_triple(back @ (np.array(self.shift) - twist[3:])),
        )


def _project(
    points: Float[np.ndarray, "*batch 3"],
    focal: float | Float[np.ndarray, "1"],
    center: Float[np.ndarray, "2"],
    radial: float,
) -> Float[np.ndarray, "*batch 2"]:
    # Points behind the camera are never a solution: keep them far off, yet finite.
    xi = points[..., :2] / points[..., 2:].clip(min=_NEAREST)
    return focal * xi * (1 + radial * (xi**2).sum(-1, keepdims=True)) + center


def _optics(
    optics: Float[np.ndarray, " optics"], middle: Float[np.ndarray, "2"]
) -> tuple[Float[np.ndarray, "2"], float]:
    """Principal point [px] and radial coefficient from the unknowns of a fit."""
    return (middle + optics[:2], float(optics[2])) if len(optics) else (middle, 0.0)


def _matrix(rotation: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    return quaternion.to_matrix(quaternion.exp(torch.from_numpy(rotation))).numpy()


def _rotation_vector(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    return quaternion.log(quaternion.from_matrix(torch.from_numpy(matrix))).numpy()


def _pair(values: Float[np.ndarray, "2"]) -> tuple[float, float]:
    u, v = values.tolist()
    return u, v


def _triple(values: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def _sampled(
    demonstrations: Sequence[ImageDemonstration],
) -> tuple[Pose, Float[Tensor, "frames 2"]]:
    """Poses and pixels of frames with a visible marker, evenly over all demonstrations."""
    every = -(-len(demonstrations) // _FRAMES)
    each = -(-_FRAMES // len(demonstrations))
    positions, orientations, pixels = [], [], []
    for demo in islice(demonstrations, 0, None, every):
        pose, feature = demo.seen()
        some = slice(None, None, max(1, len(feature) // each))
        positions.append(pose.position[some])
        orientations.append(pose.orientation[some])
        pixels.append(feature[some])
    return Pose(torch.cat(positions), torch.cat(orientations)), torch.cat(pixels)
