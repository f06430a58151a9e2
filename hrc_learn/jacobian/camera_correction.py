"""Correction of the pixels of a moved camera to those of the camera before its motion.

`CameraWatch` detects the motion; all frames since then refine its estimate. With the motion,
the map from positions to pixels is known again. The pixel of the tool's marker is corrected by
the tool pose, that of an object by the plane on which the demonstrations found objects.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from hrc_learn.geometry import Pose
from hrc_learn.jacobian.camera_motion import (
    FEWEST_FRAMES,
    CameraMotion,
    CameraReference,
    CameraWatch,
    from_moved,
    motion_of,
    refined_twist,
)

# Frames of the marker used for the motion estimate: half a minute at 20 Hz.
_FRAMES = 600
# Frames needed to detect a motion. One, because wrong pixels soon guide the arm out of the
# region of the demonstrations, where no motion can be detected.
_FEWEST = 1
# Largest root mean square error [px] between object pixels and the positions of grasps: people
# grasp an object some millimetres from its marker.
_AGREEMENT = 10.0
# Gauss-Newton steps, enough for an offset of decimetres seen from a distance of one metre.
_REFINEMENTS = 20


@dataclass(frozen=True, kw_only=True)
class ObjectPlane:
    """Horizontal plane on which objects lie, in the base frame of a `MarkerCamera`.

    That frame differs from the base frame by the part of the marker's position on the tool that
    the demonstrations do not determine, so a measured height is not this one.
    """

    height: float
    """Height of the plane [m]."""

    @staticmethod
    def fit(
        reference: CameraReference,
        places: Float[np.ndarray, "episodes 3"],
        pixels: Float[np.ndarray, "episodes 2"],
    ) -> ObjectPlane:
        """Fit the plane to the pixels of objects and the positions of their grasps.

        All objects have the same offset from the tool when grasped, which is found by least
        squares on the pixels.

        Args:
            reference: Camera of the demonstrations.
            places: Positions of the tool in the base frame at the grasp [m]; four or more
                different ones.
            pixels: Pixels of the objects (u, v) before the grasp [px].

        Raises:
            ValueError: There are too few demonstrations, or pixels and grasps do not agree.
        """
        if len(places) < 4:
            raise ValueError(
                f"the objects' plane needs four or more demonstrations, got {len(places)}."
            )
        camera = reference.camera
        offset, errors = np.zeros(3), pixels
        for _ in range(_REFINEMENTS):
            seen = camera.from_base(places + offset)
            errors = pixels - camera.project(seen)
            # Points move opposite to the camera.
            jacobian = -camera.motion_jacobian(seen)[..., 3:] @ camera.rotation_matrix
            step, *_ = np.linalg.lstsq(jacobian.reshape(-1, 3), errors.ravel(), rcond=None)
            offset = offset + step
        off = float(np.sqrt((errors**2).sum(-1).mean()))
        if not off <= _AGREEMENT:
            raise ValueError(
                f"object pixels and grasp positions disagree by {off:.0f} px: they belong to "
                "different objects, or the objects were moved in between."
            )
        return ObjectPlane(height=float((places + offset)[:, 2].mean()))


class CameraCorrection:
    """Estimates the motion of a camera and corrects pixels for it.

    Attributes:
        motion: Motion of the camera since the demonstrations; None: no motion detected.
    """

    def __init__(self, reference: CameraReference):
        self.motion: CameraMotion | None = None
        self._reference = reference
        self._watch = CameraWatch(reference, _FEWEST)
        self._frames: deque[tuple[float, np.ndarray, np.ndarray]] = deque(maxlen=_FRAMES)
        self._twist = np.zeros(6)

    def clear(self) -> None:
        """Prepare for another episode: the clock restarts, the camera motion is kept."""
        self._watch.clear()
        known = () if self.motion is None else self._frames
        # Frames of earlier episodes are older than any window.
        self._frames = deque(((-np.inf, f[1], f[2]) for f in known), maxlen=_FRAMES)

    def update(
        self, time: float, pose: Pose, pixel: Float[np.ndarray, "2"]
    ) -> CameraMotion | None:
        """Add one frame in which the marker was found; arguments as for `CameraWatch.update`.

        Returns:
            The camera motion, if it is detected with this frame: the first one, and each
            further one.
        """
        camera = self._reference.camera
        point = camera.points(Pose(pose.position.double(), pose.orientation.double()))
        corrected = self.marker(pose, pixel)
        noticed = self._watch.update(time, pose, corrected)
        if not self._reference.covers(point):
            return None
        self._frames.append((time, point, pixel))
        if self.motion is None and noticed is None:
            self._forget(time)
            return None
        if noticed is None:
            self._find(steps=1)  # starts from the estimate of the last frame
            return None
        self._watch.clear()
        if self.motion is not None and len(self._frames) < FEWEST_FRAMES:
            there = camera.project(point)
            if np.linalg.norm(pixel - there) < np.linalg.norm(corrected - there):
                # The marker was wrong in the first frames: the camera has not moved.
                self.motion, self._twist = None, np.zeros(6)
                self._frames.clear()
            else:
                self._find()
            return None
        if self.motion is not None and self._find() <= self._reference.threshold:
            return None  # a better estimate of the same motion
        self._forget(time)
        self._find()
        return self.motion

    def marker(self, pose: Pose, pixel: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """Pixel of the tool's marker corrected for the camera motion [px]."""
        if self.motion is None:
            return pixel
        camera = self._reference.camera
        point = camera.points(Pose(pose.position.double(), pose.orientation.double()))
        change = camera.project(from_moved(point, self._twist)) - camera.project(point)
        return pixel - change

    def object(
        self, plane: ObjectPlane, pixel: Float[np.ndarray, "2"]
    ) -> Float[np.ndarray, "2"]:
        """Pixel of a point on a plane corrected for the camera motion [px]."""
        if self.motion is None:
            return pixel
        camera = self._reference.camera
        place = camera.moved(self._twist).on_plane(pixel, plane.height)
        return camera.project(camera.from_base(place))

    def _forget(self, time: float) -> None:
        """Drop frames older than the time window of the detection."""
        while self._frames and self._frames[0][0] < time - self._reference.window:
            self._frames.popleft()

    def _find(self, steps: int = 5) -> float:
        """Fit the motion to all frames; returns the error in the last window, rms [px]."""
        camera = self._reference.camera
        points, pixels = (np.array([f[i] for f in self._frames]) for i in (1, 2))
        self._twist = refined_twist(camera, points, pixels, self._twist, steps)
        self.motion = motion_of(self._twist, points, camera)
        now = self._frames[-1][0] - self._reference.window
        recent = np.array([f[0] >= now for f in self._frames])
        left = pixels - camera.project(from_moved(points, self._twist))
        return float(np.sqrt((left[recent] ** 2).sum(-1).mean()))
