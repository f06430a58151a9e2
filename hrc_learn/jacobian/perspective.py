"""Perspective: how the depth of a point changes with its place, from its image Jacobian.

For a pinhole camera with square pixels, rows r_1, r_2, r_3 of its rotation, and a point at
depth z that is seen at xi = (x - c) / f, the image Jacobian is

    J = f / z (r_12 - xi r_3^T).

Its six entries tell rotation and depth in closed form once focal length f and image centre c
are known. A point at an offset o then is seen at

    x + J o / (1 + g^T o),    g = r_3 / z.

Neither lens distortion nor an image centre off the middle is modelled.
"""

from collections.abc import Sequence
from itertools import islice

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian.network import RBFImageJacobian
from hrc_learn.jacobian.samples import ImageDemonstration

_FOCAL_SPREAD = 0.5
"""Prior standard deviation of the logarithm of the focal length, about the image's width:
lenses of 30 to 80 degrees are within one of it."""
_PIXEL_NOISE = 1.0
"""Residual beyond which a frame counts less [px]: several times a detector's noise, about what
the calibration of an arm leaves."""
_TINY = 1e-12
_FRAMES = 2000
"""About so many are fitted to: the noise averages out long before."""


def depth_gradient(
    jacobian: Float[np.ndarray, "*batch 2 3"],
    pixel: Float[np.ndarray, "*batch 2"],
    focal: float,
    center: Float[np.ndarray, "2"],
) -> Float[np.ndarray, "*batch 3"]:
    """Relative change of a point's depth with its place, g = r_3 / z [1/m].

    Args:
        jacobian: Of the point's pixel by its place [px/m].
        pixel: Where it is seen [px].
        focal: Focal length [px].
        center: Of the image [px].
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
    # A Jacobian of zeros, of which nothing is known, is one of a camera far away.
    size = np.maximum((jacobian**2).sum((-2, -1)), _TINY)
    depth = np.asarray(np.sqrt((1 + square) / size))
    rows = depth[..., None, None] * jacobian
    # The rows' cross product is along the ray, r_3 + xi_1 r_1 + xi_2 r_2.
    ray = np.cross(rows[..., 0, :], rows[..., 1, :])
    axis = (ray - (xi[..., None, :] @ rows)[..., 0, :]) / square[..., None]
    axis = axis / np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), _TINY)
    return rows + xi[..., :, None] * axis[..., None, :], depth, axis


def fit_focal_length(
    demonstrations: Sequence[ImageDemonstration],
    network: RBFImageJacobian,
    image_size: tuple[int, int],
) -> float:
    """Focal length of the camera that saw a marker of a moving tool [px].

    Found together with the pose of the camera and the marker's place on the tool, by robust
    nonlinear least squares on the pixels. Motions that do not tell it leave it near the width
    of the image.

    Args:
        demonstrations: In which the tool moved, read one by one.
        network: Image Jacobian fitted to them, to begin with.
        image_size: Width and height [px].
    """
    # Of the extras that read demonstrations and simulate; this package does without.
    from scipy.optimize import least_squares

    pose, pixel = _sampled(demonstrations)
    tool, turn = pose.position.numpy(), quaternion.to_matrix(pose.orientation).numpy()
    seen_at, center, width = pixel.numpy(), np.array(image_size) / 2, float(image_size[0])
    with torch.no_grad():
        jacobians = network(pose).numpy()[..., :3]

    def residuals(unknown: Float[np.ndarray, "10"]) -> Float[np.ndarray, " residuals"]:
        log_focal, rotation, shift, marker = np.split(unknown, [1, 4, 7])
        rows = quaternion.to_matrix(quaternion.exp(torch.from_numpy(rotation))).numpy()
        point = (tool + turn @ marker - middle) @ (rows @ first).T + shift
        # Points behind the camera are no solution: far off, yet finite.
        depth = point[:, 2:].clip(min=1e-3)
        error = width * np.exp(log_focal) * point[:, :2] / depth + center - seen_at
        return np.append(error.ravel() / _PIXEL_NOISE, log_focal / _FOCAL_SPREAD)

    middle, xi = tool.mean(0), (seen_at.mean(0) - center) / width
    rows, depth, axis = _camera(jacobians.mean(0) / width, xi)
    u, _, vt = np.linalg.svd(np.vstack([rows, axis]))
    first = u @ vt
    start = np.zeros(10)
    start[4:7] = depth * np.append(xi, 1.0)
    found = least_squares(residuals, start, loss="soft_l1", x_scale="jac")
    return width * float(np.exp(found.x[0]))


def _sampled(
    demonstrations: Sequence[ImageDemonstration],
) -> tuple[Pose, Float[Tensor, "frames 2"]]:
    """Frames in which the marker was seen, evenly over all demonstrations."""
    every = -(-len(demonstrations) // _FRAMES)
    each = -(-_FRAMES // len(demonstrations))
    positions, orientations, pixels = [], [], []
    for demo in islice(demonstrations, 0, None, every):
        seen = demo.visible.nonzero()[:, 0]
        seen = seen[:: max(1, len(seen) // each)]
        positions.append(demo.pose.position[seen].double())
        orientations.append(demo.pose.orientation[seen].double())
        pixels.append(demo.feature[seen].double())
    return Pose(torch.cat(positions), torch.cat(orientations)), torch.cat(pixels)
