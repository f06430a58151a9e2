"""Random views of one marker, shared by the tests of cameras and detectors."""

import cv2
import numpy as np

from hrc_learn.vision import CameraModel, ImageNoise, Marker, SyntheticCamera

MARKER = Marker(7, 0.06)


def overhead() -> CameraModel:
    """A camera 1.3 m above the middle of the table, with a little barrel distortion."""
    model = CameraModel(distortion=(-0.12, 0.03, 5e-4, -3e-4, 0.0))
    return model.look_at(np.array([0.5, 0.0, 1.3]), np.array([0.5, 0.0, 0.0]))


def corners_of(marker: Marker, pose: np.ndarray) -> np.ndarray:
    """Corners of the black square in the base frame [m]."""
    return marker.corners @ pose[:3, :3].T + pose[:3, 3]


def upright_pose(rng: np.random.Generator, *, tilt: float = np.pi / 4) -> np.ndarray:
    """A marker that faces up to within `tilt` [rad], somewhere above the table."""
    about = rng.uniform(-np.pi, np.pi)
    axis = np.array([np.cos(about), np.sin(about), 0.0])
    tilted, _ = cv2.Rodrigues(rng.uniform(0, tilt) * axis)
    turned, _ = cv2.Rodrigues(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
    pose = np.eye(4)
    pose[:3, :3] = tilted @ turned
    pose[:3, 3] = rng.uniform([0.0, -0.6, -0.3], [1.0, 0.6, 0.7])
    return pose


def poses_in_view(model: CameraModel, marker: Marker, n: int, seed: int) -> list[np.ndarray]:
    """Poses whose whole plate, quiet zone included, is inside the image."""
    rng = np.random.default_rng(seed)
    poses = []
    while len(poses) < n:
        pose = upright_pose(rng)
        plate = marker.plate_corners @ pose[:3, :3].T + pose[:3, 3]
        if model.in_view(plate).all():
            poses.append(pose)
    return poses


def camera_on(
    model: CameraModel, shown: dict[int, np.ndarray], *markers: Marker, **options
) -> SyntheticCamera:
    """A seeded camera that sees whatever `shown` holds at the time."""
    options.setdefault("noise", ImageNoise())
    return SyntheticCamera(
        model, markers, lambda: shown, rng=np.random.default_rng(0), **options
    )
