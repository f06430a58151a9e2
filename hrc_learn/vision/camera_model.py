"""A fixed camera: intrinsics, lens distortion, pose; projection and its derivatives.

Distortion follows Brown (1966), in OpenCV's parameter order, and applies to normalised image
points, (x / z, y / z) in the camera frame. The controller never sees a `CameraModel`, which
belongs to simulation and evaluation.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

Coefficients = tuple[float, float, float, float, float]
"""(k1, k2, p1, p2, k3): radial k, tangential p."""

IMAGE_SIZE = (1440, 1080)
"""Width and height of the images of the paper's camera [px]."""

NONE: Coefficients = (0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraModel:
    """Pinhole camera with Brown distortion, at rest in the base frame.

    Camera axes are OpenCV's: x right, y down, z along the view. Pixel (0, 0) is the
    *centre* of the top left pixel, so the middle of the image is ((W-1)/2, (H-1)/2).
    """

    width: int = 1440
    """Image width W [px]."""
    height: int = 1080
    """Image height H [px]."""
    focal: tuple[float, float] = (1200.0, 1200.0)
    """Focal lengths (fx, fy) [px]."""
    principal: tuple[float, float] = (719.5, 539.5)
    """Principal point (cx, cy) [px]."""
    distortion: Coefficients = NONE
    """(k1, k2, p1, p2, k3), as OpenCV orders them."""
    pose: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    """Pose of the camera in the base frame: p_base = pose @ p_camera."""

    def __post_init__(self) -> None:
        R = self.pose[:3, :3]
        if not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0:
            raise ValueError(
                "pose must hold a rotation in its upper left 3x3, but R R^T differs from the "
                f"identity by {np.abs(R @ R.T - np.eye(3)).max():.2g} and det R is "
                f"{np.linalg.det(R):.3g}. CameraModel.look_at() builds a pose from two points."
            )
        sizes = self.width, self.height, self.focal
        numbers = [*sizes[:2], *self.focal, *self.principal, *self.distortion]
        if not (np.isfinite(numbers).all() and min(numbers[:4]) > 0):
            raise ValueError(f"width, height and focal must be positive, but are {sizes}.")

    def look_at(
        self, eye: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"], *, roll: float = 0.0
    ) -> "CameraModel":
        """The same camera placed at `eye` with `target` on its optical axis.

        Args:
            eye: Camera centre in the base frame [m].
            target: Point to look at in the base frame [m].
            roll: Turn about the optical axis [rad]. At zero, the base's z axis points up in the
                image; if the camera looks straight up or down, the base's x axis points up.
        """
        z = target - eye
        distance = float(np.linalg.norm(z))
        if distance < 1e-9:
            raise ValueError("eye and target must differ, but both are " + str(eye.tolist()))
        z = z / distance
        # Within 2.6 degrees of the vertical, the base's z axis does not define "up" reliably.
        up = np.array([0.0, 0.0, 1.0]) if abs(z[2]) < 0.999 else np.array([1.0, 0.0, 0.0])
        x = np.cross(z, up)
        x /= np.linalg.norm(x)
        y = np.cross(z, x)
        c, s = np.cos(roll), np.sin(roll)
        pose = np.eye(4)
        pose[:3, :4] = np.column_stack([c * x + s * y, c * y - s * x, z, eye])
        return replace(self, pose=pose)

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """Intrinsic matrix K [px]."""
        (fx, fy), (cx, cy) = self.focal, self.principal
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def to_camera(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Transform points from the base frame to the camera frame [m]."""
        return (points - self.pose[:3, 3]) @ self.pose[:3, :3]

    def project(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Pixels of points in the base frame; NaN for points behind the camera.

        Args:
            points: Positions in the base frame [m].

        Returns:
            (u right, v down) [px]. Points outside the image get the pixel that they would have
            in a larger image; `in_view` finds the points inside.
        """
        p = self.to_camera(points)
        with np.errstate(divide="ignore", invalid="ignore"):
            normalised = np.where(p[..., 2:] > 0.0, p[..., :2] / p[..., 2:], np.nan)
        return self.to_pixels(normalised)

    def to_pixels(
        self, normalised: Float[np.ndarray, "*batch 2"]
    ) -> Float[np.ndarray, "*batch 2"]:
        """Pixels of normalised (x/z, y/z) points, through the lens."""
        k1, k2, p1, p2, k3 = self.distortion
        x, y = normalised[..., 0], normalised[..., 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        v = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        return np.stack([u, v], axis=-1) * self.focal + self.principal

    def to_normalised(
        self, pixels: Float[np.ndarray, "*batch 2"]
    ) -> Float[np.ndarray, "*batch 2"]:
        """Normalised (x/z, y/z) points seen at the given pixels, without lens distortion."""
        import cv2

        if not pixels.size:  # OpenCV refuses empty arrays
            return pixels
        # Ten steps of the fixed point are enough for common lenses, thirty for wide ones.
        steps = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
        points, lens = pixels.reshape(-1, 1, 2), np.array(self.distortion)
        # In OpenCV 5, `undistortPoints` also replaces `undistortPointsIter`.
        undistort: Any = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
        found = undistort(points, self.matrix, lens, R=None, P=None, criteria=steps)
        return np.asarray(found).reshape(pixels.shape)

    def in_view(self, points: Float[np.ndarray, "*batch 3"]) -> Bool[np.ndarray, "*batch"]:
        """True where points in the base frame lie in front of the camera and in the image."""
        p = self.to_camera(points)
        u, v = np.moveaxis(self.project(points), -1, 0)
        inside = (u >= -0.5) & (u <= self.width - 0.5) & (v >= -0.5) & (v <= self.height - 0.5)
        # Far outside the image, the distortion polynomial may fold points back into the image.
        r = np.hypot(p[..., 0], p[..., 1])
        return np.asarray(inside & (r <= self.view_radius * p[..., 2]))

    @cached_property
    def view_radius(self) -> float:
        """Largest |(x/z, y/z)| inside the image, plus 1 %."""
        return 1.01 * float(np.linalg.norm(self.to_normalised(self.border()), axis=-1).max())

    def border(self) -> Float[np.ndarray, "n 2"]:
        """Pixels along the edge of the image, clockwise from the top left."""
        w, h = self.width - 0.5, self.height - 0.5
        corners = np.array([[-0.5, -0.5], [w, -0.5], [w, h], [-0.5, h]])
        t = np.linspace(0, 1, 32, endpoint=False)[:, None]
        sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
        return np.concatenate([a + t * (b - a) for a, b in sides])

    def image_jacobian(
        self,
        point: Float[np.ndarray, "*batch 3"],
        origin: Float[np.ndarray, "*batch 3"] | None = None,
    ) -> Float[np.ndarray, "*batch 2 6"]:
        """True image Jacobian of a point that is fixed to a moving body.

            d(u, v)/dt = J_s (v_origin, omega),    v_point = v_origin + omega x (point - origin)

        Args:
            point: The point in the base frame [m].
            origin: Point of the body to which the linear velocity refers, in the base frame
                [m]; None: `point` itself, so that a rotation does not move the point.

        Returns:
            J_s: derivative with respect to the twist (linear, angular) in the base frame
            [px/m, px/rad].
        """
        import cv2

        p, still, lens = self.to_camera(point), np.zeros(3), np.array(self.distortion)
        if not p.size:  # OpenCV returns nothing
            return np.zeros((*p.shape[:-1], 2, 6))
        # OpenCV differentiates by a translation that all points have in common. For each pixel,
        # this equals the derivative by a translation of its own point.
        _, slope = cv2.projectPoints(p.reshape(-1, 3), still, still, self.matrix, lens)
        slope = np.asarray(slope[:, 3:6], dtype=float).reshape(*p.shape[:-1], 2, 3)
        J_point = slope @ self.pose[:3, :3].T
        arm = np.zeros_like(point) if origin is None else point - origin
        # (omega x arm) . j = omega . (arm x j) for each row j of J_point.
        return np.concatenate([J_point, np.cross(arm[..., None, :], J_point)], axis=-1)
