"""What a moved camera sees, told as if it had not been moved.

`CameraWatch` notices the motion; all frames since then tell it better and better. With it, the
map from places to pixels is known again: that of the demonstrations, seen from elsewhere. The
pixel of the tool's marker is corrected by where the tool is, that of an object by the plane on
which the demonstrations found it.
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

_FRAMES = 600
"""Of the marker from which a motion is found: half a minute at 20 a second."""
_FEWEST = 1
"""Frames that tell a motion to begin with: until then what is seen leads the arm astray, soon
to where no demonstration went and nothing can be told."""
_AGREEMENT = 10.0
"""Root mean square [px] up to which pixels of objects and the places they were taken from are
of the same camera: people grasp an object some millimetres from where its marker is."""
_REFINEMENTS = 20
"""Steps of Gauss and Newton for an offset of decimetres seen from a metre away."""


@dataclass(frozen=True, kw_only=True)
class ObjectPlane:
    """Where objects lie: a plane across the base's z axis, in the frame of a `MarkerCamera`.

    That frame is the base's but for what the demonstrations do not tell of the marker's place
    on the tool, so a height that was measured is not this one.
    """

    height: float
    """[m]"""

    @staticmethod
    def fit(
        reference: CameraReference,
        places: Float[np.ndarray, "episodes 3"],
        pixels: Float[np.ndarray, "episodes 2"],
    ) -> ObjectPlane:
        """Find it from where objects were seen and where the tool took them.

        The objects are at one offset from the tool when it takes them, which leads the rays of
        their pixels through them all.

        Args:
            reference: The camera.
            places: Of the tool in the base frame when it took the object [m]; four or more, in
                different places.
            pixels: Where the camera had seen the object (u, v) [px].

        Raises:
            ValueError: There are too few, or the pixels are not those of what was taken.
        """
        if len(places) < 4:
            raise ValueError(
                f"where objects lie takes four demonstrations or more, got {len(places)}."
            )
        camera = reference.camera
        offset, errors = np.zeros(3), pixels
        for _ in range(_REFINEMENTS):
            seen = camera.from_base(places + offset)
            errors = pixels - camera.project(seen)
            # A camera that moves sees a point move the other way.
            jacobian = -camera.motion_jacobian(seen)[..., 3:] @ camera.rotation_matrix
            step, *_ = np.linalg.lstsq(jacobian.reshape(-1, 3), errors.ravel(), rcond=None)
            offset = offset + step
        off = float(np.sqrt((errors**2).sum(-1).mean()))
        if not off <= _AGREEMENT:
            raise ValueError(
                f"the object's pixels and the places it was taken from are {off:.0f} px apart: "
                "they are of different things, or it was moved in between."
            )
        return ObjectPlane(height=float((places + offset)[:, 2].mean()))


class CameraCorrection:
    """Follows a camera's motions, and undoes what they do to pixels.

    Attributes:
        motion: Of the camera from where it stood in the demonstrations; None while it is there.
    """

    def __init__(self, reference: CameraReference):
        self.motion: CameraMotion | None = None
        self._reference = reference
        self._watch = CameraWatch(reference, _FEWEST)
        self._frames: deque[tuple[float, np.ndarray, np.ndarray]] = deque(maxlen=_FRAMES)
        self._twist = np.zeros(6)

    def clear(self) -> None:
        """Before another episode: the clock begins anew, the camera stays where it is."""
        self._watch.clear()
        known = () if self.motion is None else self._frames
        # Frames of former episodes are older than any window.
        self._frames = deque(((-np.inf, f[1], f[2]) for f in known), maxlen=_FRAMES)

    def update(
        self, time: float, pose: Pose, pixel: Float[np.ndarray, "2"]
    ) -> CameraMotion | None:
        """Take one frame in which the marker was found, as of `CameraWatch.update`.

        Returns:
            The camera's motion when it has been noticed with this frame: at first, and when
            the camera was moved again.
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
            self._find(steps=1)  # from where the frame before has led
            return None
        self._watch.clear()
        if self.motion is not None and len(self._frames) < FEWEST_FRAMES:
            there = camera.project(point)
            if np.linalg.norm(pixel - there) < np.linalg.norm(corrected - there):
                # A marker was wrong in the first frames: the camera stands where it stood.
                self.motion, self._twist = None, np.zeros(6)
                self._frames.clear()
            else:
                self._find()
            return None
        if self.motion is not None and self._find() <= self._reference.threshold:
            return None  # it is known better now, that is all
        self._forget(time)
        self._find()
        return self.motion

    def marker(self, pose: Pose, pixel: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """Where the camera would have seen the tool's marker from where it stood [px]."""
        if self.motion is None:
            return pixel
        camera = self._reference.camera
        point = camera.points(Pose(pose.position.double(), pose.orientation.double()))
        change = camera.project(from_moved(point, self._twist)) - camera.project(point)
        return pixel - change

    def object(
        self, plane: ObjectPlane, pixel: Float[np.ndarray, "2"]
    ) -> Float[np.ndarray, "2"]:
        """Where it would have seen what lies on a plane [px]."""
        if self.motion is None:
            return pixel
        camera = self._reference.camera
        place = camera.moved(self._twist).on_plane(pixel, plane.height)
        return camera.project(camera.from_base(place))

    def _forget(self, time: float) -> None:
        """What is older than the window in which a motion is noticed."""
        while self._frames and self._frames[0][0] < time - self._reference.window:
            self._frames.popleft()

    def _find(self, steps: int = 5) -> float:
        """The motion that all frames tell; what it leaves of the last window, rms [px]."""
        camera = self._reference.camera
        points, pixels = (np.array([f[i] for f in self._frames]) for i in (1, 2))
        self._twist = refined_twist(camera, points, pixels, self._twist, steps)
        self.motion = motion_of(self._twist, points, camera)
        now = self._frames[-1][0] - self._reference.window
        recent = np.array([f[0] >= now for f in self._frames])
        left = pixels - camera.project(from_moved(points, self._twist))
        return float(np.sqrt((left[recent] ** 2).sum(-1).mean()))
