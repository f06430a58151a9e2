"""Detection of camera motion: the robot's own marker is not seen where it should be.

A camera model fitted to demonstrations (`MarkerCamera`) predicts the pixel of the tool's marker
at any tool pose. A camera that turned by w and moved by v sees the marker with the error e = L
(w, v), to first order, where L is the interaction matrix: the derivative of the pixel by the
camera twist. Over the last seconds, one such motion is fitted to e. Its explained displacement,
the root mean square over the frames, is compared with the largest one in the demonstrations
themselves, each held out of the fit. That threshold covers errors of calibration, lens and time
stamps. Outside the region of the demonstrations these errors are unknown, and nothing is
compared.

`CameraCorrection` maps the pixels of a moved camera to those of the camera before its motion:
that of the tool's marker by the tool pose, that of an object by the plane on which the
demonstrations found objects. All frames since the motion refine the estimate.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian.fitting import FOLDS, ImageDemonstration
from hrc_learn.jacobian.perspective import MarkerCamera

# Prior standard deviation of a motion [rad, m]: that of a tripod that was knocked. It resolves
# rotations and translations that look alike in the image.
_PLAUSIBLE = np.array([0.1] * 3 + [0.1] * 3)
# Largest motion in these standard deviations: beyond it, the camera would not see the table.
_FARTHEST = 5.0
FEWEST_FRAMES = 10
"""Frames with a visible marker below which no motion is reported."""
# Errors are clipped at this multiple of their median: a half-covered marker is off by pixels in
# a frame or two, a moved camera in all frames.
_OUTLIER = 3.0
# Time window for a motion [s]. A small motion counts in full after half of it, on average.
_WINDOW = 1.0
# Threshold relative to the largest displacement in held-out demonstrations.
_MARGIN = 2.5
# Difference of camera placements, in median differences of neighbouring episodes.
_APART = 6.0
# Gauss-Newton steps: three are enough for ten degrees.
_REFINEMENTS = 5
# Frames of the marker used for the motion estimate: half a minute at 20 Hz.
_KEPT_FRAMES = 600
# Frames needed to detect a motion. One, because wrong pixels soon guide the arm out of the
# region of the demonstrations, where no motion can be detected.
_FEWEST = 1
# Largest root mean square error [px] between object pixels and the positions of grasps: people
# grasp an object some millimetres from its marker.
_AGREEMENT = 10.0
# Gauss-Newton steps, enough for an offset of decimetres seen from a distance of one metre.
_PLANE_STEPS = 20


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraMotion:
    """Motion of a camera since the demonstrations."""

    twist: Float[np.ndarray, "6"]
    """Rotation vector about the camera's axes (x right, y down, z along the view) [rad], and
    translation along them [m], as for `MarkerCamera.moved`."""
    displacement: float
    """Explained displacement in the image, root mean square over the frames [px]."""

    @staticmethod
    def of(
        twist: Float[np.ndarray, "6"],
        points: Float[np.ndarray, "frames 3"],
        camera: MarkerCamera,
    ) -> CameraMotion:
        """Motion by a twist, with the displacement of points of the camera frame [m]."""
        displacement = _root_mean_square(camera.motion_jacobian(points) @ twist)
        return CameraMotion(twist=twist, displacement=displacement)

    @property
    def angle(self) -> float:
        """Angle of the rotation [rad]."""
        return float(np.linalg.norm(self.twist[:3]))

    @property
    def distance(self) -> float:
        """Length of the translation [m]."""
        return float(np.linalg.norm(self.twist[3:]))

    def __str__(self) -> str:
        return (
            f"camera moved by {np.rad2deg(self.angle):.1f} degrees and "
            f"{1e3 * self.distance:.0f} mm ({self.displacement:.1f} px in the image)"
        )


@dataclass(frozen=True, kw_only=True)
class CameraReference:
    """A camera as seen in demonstrations, and the threshold for its motion."""

    camera: MarkerCamera
    """Camera fitted to all demonstrations."""
    threshold: float
    """Displacement above which the camera has moved [px]."""
    window: float
    """Time window of the threshold [s]."""
    lower: tuple[float, float, float]
    """Lower corner of the box of demonstrated marker positions, in the camera frame [m]."""
    upper: tuple[float, float, float]
    """Upper corner of that box [m]."""

    def covers(self, point: Float[np.ndarray, "3"]) -> bool:
        """True if a point of the camera frame is within the box of the demonstrations."""
        return bool(((point >= self.lower) & (point <= self.upper)).all())

    @staticmethod
    def fit(
        demonstrations: Sequence[ImageDemonstration], fps: float, image_size: tuple[int, int]
    ) -> CameraReference:
        """Learn the camera and the largest displacement without any motion.

        Args:
            demonstrations: Two or more demonstrations with one fixed camera; read several
                times.
            fps: Frame rate [1/s].
            image_size: Width and height of the image [px].

        Raises:
            ValueError: There are fewer than two demonstrations, or they hardly show the marker.
        """
        if len(demonstrations) < 2:
            raise ValueError(
                f"a camera's reference needs two demonstrations or more, to hold one out; got "
                f"{len(demonstrations)}."
            )
        if not fps > 0:
            raise ValueError(f"fps must be positive, got {fps}.")
        largest, folds = 0.0, min(FOLDS, len(demonstrations))
        for fold in range(folds):
            others = [d for i, d in enumerate(demonstrations) if i % folds != fold]
            watch = CameraWatch(
                _reference(MarkerCamera.fit(others, image_size), others, np.inf)
            )
            for demo in demonstrations[fold::folds]:
                watch.clear()
                for k in demo.visible.nonzero()[:, 0].tolist():
                    watch.update(k / fps, demo.pose[k], demo.feature[k].double().numpy())
                    largest = max(largest, watch.displacement)
        if not largest:
            raise ValueError(
                f"no demonstration shows the marker {FEWEST_FRAMES} times within {_WINDOW} s: "
                "record some in which the camera sees the marker."
            )
        camera = MarkerCamera.fit(demonstrations, image_size)
        return _reference(camera, demonstrations, _MARGIN * largest)


def _reference(
    camera: MarkerCamera, demonstrations: Sequence[ImageDemonstration], threshold: float
) -> CameraReference:
    points = np.concatenate([camera.points(demo.seen()[0]) for demo in demonstrations])
    lower, upper = (tuple(corner.tolist()) for corner in (points.min(0), points.max(0)))
    return CameraReference(
        camera=camera, threshold=threshold, window=_WINDOW, lower=lower, upper=upper
    )


class CameraWatch:
    """Compares the seen pixel of a marker with the predicted one, frame by frame.

    Attributes:
        reference: Camera of the demonstrations.
        displacement: Explained displacement of the last seconds [px]; 0 with too few frames.
    """

    def __init__(self, reference: CameraReference, fewest: int = FEWEST_FRAMES):
        """Start with a camera at its place.

        Args:
            reference: Camera of the demonstrations.
            fewest: Number of frames needed to report a motion. Below 10, the threshold grows as
                frames are missing.
        """
        self.reference = reference
        self.displacement = 0.0
        self._fewest = fewest
        self._frames: deque[tuple[float, np.ndarray, np.ndarray]] = deque()

    def clear(self) -> None:
        """Forget all frames: before another episode, or after a pause."""
        self.displacement = 0.0
        self._frames.clear()

    def update(
        self, time: float, pose: Pose, pixel: Float[np.ndarray, "2"]
    ) -> CameraMotion | None:
        """Add one frame in which the marker was found.

        Frames outside the region of the demonstrations are ignored.

        Args:
            time: Time of the image [s], later than that of the last frame.
            pose: Pose of the tool at that time, unbatched.
            pixel: Pixel of the marker [px].

        Returns:
            The motion since the demonstrations, if it exceeds the threshold.

        Raises:
            ValueError: Time or pixel are not finite, or time does not increase.
        """
        if not (np.isfinite(time) and np.isfinite(pixel).all()):
            raise ValueError(
                f"time and pixel must be finite, got {time} and {pixel}: leave out frames "
                "without the marker."
            )
        frames = self._frames
        if frames and not time > frames[-1][0]:
            raise ValueError(
                f"time must increase, but {time} follows {frames[-1][0]}: call clear() "
                "between episodes."
            )
        camera = self.reference.camera
        point = camera.points(pose)
        if self.reference.covers(point):
            frames.append((time, point, pixel))
        while frames and frames[0][0] < time - self.reference.window:
            frames.popleft()
        self.displacement = 0.0
        if len(frames) < self._fewest:
            return None
        points, pixels = (np.array([frame[i] for frame in frames]) for i in (1, 2))
        errors, jacobians = pixels - camera.project(points), camera.motion_jacobian(points)
        twist, self.displacement = _explained(errors, jacobians)
        if self.displacement <= self.reference.threshold * max(1, FEWEST_FRAMES / len(frames)):
            return None
        return CameraMotion.of(refined_twist(camera, points, pixels, twist), points, camera)


@dataclass(frozen=True, kw_only=True)
class CameraPlacement:
    """Episodes with the camera at one place."""

    episodes: tuple[int, ...]
    """Indices into the demonstrations."""
    motion: CameraMotion
    """Motion from the first placement."""


def camera_placements(
    demonstrations: Sequence[ImageDemonstration], image_size: tuple[int, int]
) -> list[CameraPlacement]:
    """Camera placements of a data set, in the order of recording.

    Camera and marker are fitted to all episodes together, and the camera's motion to each
    episode. An episode joins the first placement from which it differs by less than six times
    the median difference of neighbouring episodes. A camera that was moved every second
    episode, or more often, is not detected.

    Args:
        demonstrations: Demonstrations in the order of recording; in memory, as they are read
            several times.
        image_size: Width and height of the image [px].

    Returns:
        One placement if the camera never moved. Episodes that hardly show the marker are in
        none.
    """
    seen = {
        index: frames
        for index, demo in enumerate(demonstrations)
        if len(frames := demo.seen()[1]) >= FEWEST_FRAMES
    }
    if len(seen) < 2:
        return []
    chosen = [demonstrations[index] for index in seen]
    camera, twists = _camera_of_episodes(chosen, image_size)
    points = [camera.points(demo.seen()[0]) for demo in chosen]

    def apart(first: int, second: int) -> float:
        return max(
            CameraMotion.of(twists[first] - twists[second], points[i], camera).displacement
            for i in (first, second)
        )

    typical = np.median([apart(i, i + 1) for i in range(len(chosen) - 1)])
    groups: list[list[int]] = []
    for i in range(len(chosen)):
        home = next((g for g in groups if apart(g[0], i) <= _APART * typical), None)
        if home is None:
            groups.append([i])
        else:
            home.append(i)
    index = list(seen)
    first = np.median(twists[groups[0]], axis=0)
    return [
        CameraPlacement(
            episodes=tuple(index[i] for i in group),
            motion=CameraMotion.of(
                np.median(twists[group], axis=0) - first,
                np.concatenate([points[i] for i in group]),
                camera,
            ),
        )
        for group in groups
    ]


def _camera_of_episodes(
    demonstrations: Sequence[ImageDemonstration], image_size: tuple[int, int]
) -> tuple[MarkerCamera, Float[np.ndarray, "episodes 6"]]:
    """Camera of the median episode, and its motion from there in each episode."""
    camera, twists = MarkerCamera.fit(demonstrations, image_size), np.zeros(0)
    for _ in range(_REFINEMENTS):
        seen = [demo.seen() for demo in demonstrations]
        twists = np.array(
            [
                refined_twist(camera, camera.points(pose), pixel.numpy(), np.zeros(6))
                for pose, pixel in seen
            ]
        )
        twists -= np.median(twists, axis=0)
        unmoved = []
        for demo, twist in zip(demonstrations, twists, strict=True):
            shift = torch.from_numpy(_displacement(camera, demo.pose, twist))
            unmoved.append(replace(demo, feature=demo.feature.double() - shift))
        camera = MarkerCamera.fit(unmoved, image_size)
    return camera, twists


def _explained(
    errors: Float[np.ndarray, "frames 2"],
    jacobians: Float[np.ndarray, "frames 2 6"],
    already: Float[np.ndarray, "6"] | None = None,
) -> tuple[Float[np.ndarray, "6"], float]:
    """Most plausible motion for the errors, and the displacement it explains, rms [px].

    `already` is the motion applied so far, which the prior includes.
    """
    size = np.linalg.norm(errors, axis=-1)
    # At least a tenth of a pixel, so that not all frames of exact images are outliers.
    most = max(_OUTLIER * float(np.median(size)), 0.1)
    errors = errors * np.minimum(1.0, most / np.maximum(size, most))[:, None]
    scaled = jacobians * _PLAUSIBLE
    gram = np.einsum("fij,fik->jk", scaled, scaled) + np.eye(6)
    towards = np.einsum("fij,fi->j", scaled, errors)
    if already is not None:
        towards -= already / _PLAUSIBLE
    unit = np.linalg.solve(gram, towards)
    return _PLAUSIBLE * unit, _root_mean_square(scaled @ unit)


def refined_twist(
    camera: MarkerCamera,
    points: Float[np.ndarray, "frames 3"],
    pixels: Float[np.ndarray, "frames 2"],
    twist: Float[np.ndarray, "6"],
    steps: int = _REFINEMENTS,
) -> Float[np.ndarray, "6"]:
    """Camera motion [rad, m] by Gauss-Newton, also for large motions."""
    for _ in range(steps):
        seen = from_moved(points, twist)
        errors = pixels - camera.project(seen)
        step, _ = _explained(errors, camera.motion_jacobian(seen), twist)
        # In the frame of the camera as moved so far.
        turn = quaternion.exp(torch.from_numpy(np.stack([twist[:3], step[:3]])))
        both = quaternion.log(quaternion.multiply(turn[0], turn[1])).numpy()
        shift = quaternion.rotate(turn[0], torch.from_numpy(step[3:])).numpy()
        twist = np.concatenate([both, twist[3:] + shift])
        # Two contradictory frames would place both points behind the camera.
        twist = twist * min(1.0, _FARTHEST / float(np.linalg.norm(twist / _PLAUSIBLE)))
    return twist


def from_moved(
    points: Float[np.ndarray, "*batch 3"], twist: Float[np.ndarray, "6"]
) -> Float[np.ndarray, "*batch 3"]:
    """Points [m] in the frame of a camera that turned and moved (see `MarkerCamera.moved`)."""
    turn = quaternion.exp(torch.from_numpy(twist[:3]))
    return (points - twist[3:]) @ quaternion.to_matrix(turn).numpy()


def _displacement(
    camera: MarkerCamera, pose: Pose, twist: Float[np.ndarray, "6"]
) -> Float[np.ndarray, "*batch 2"]:
    """Change of the marker's pixel at poses of the tool by a motion of the camera [px]."""
    points = camera.points(pose)
    return camera.project(from_moved(points, twist)) - camera.project(points)


def _root_mean_square(pixels: Float[np.ndarray, "frames 2"]) -> float:
    return float(np.sqrt((pixels**2).sum(-1).mean()))


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
        for _ in range(_PLANE_STEPS):
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
        self._frames: deque[tuple[float, np.ndarray, np.ndarray]] = deque(maxlen=_KEPT_FRAMES)
        self._twist = np.zeros(6)

    def clear(self) -> None:
        """Prepare for another episode: the clock restarts, the camera motion is kept."""
        self._watch.clear()
        known = () if self.motion is None else self._frames
        # Frames of earlier episodes are older than any window.
        self._frames = deque(((-np.inf, f[1], f[2]) for f in known), maxlen=_KEPT_FRAMES)

    def update(
        self, time: float, pose: Pose, pixel: Float[np.ndarray, "2"]
    ) -> CameraMotion | None:
        """Add one frame in which the marker was found; arguments as for `CameraWatch.update`.

        Returns:
            The camera motion, if it is detected with this frame: the first one, and each
            further one.
        """
        camera = self._reference.camera
        point = camera.points(pose)
        corrected = self.marker(pose, pixel)
        noticed = self._watch.update(time, pose, corrected)
        if not self._reference.covers(point):
            return None
        self._frames.append((time, point, pixel))
        if noticed is None:
            if self.motion is None:
                self._forget(time)
            else:
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
        return pixel - _displacement(self._reference.camera, pose, self._twist)

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
        self.motion = CameraMotion.of(self._twist, points, camera)
        now = self._frames[-1][0] - self._reference.window
        recent = np.array([f[0] >= now for f in self._frames])
        left = pixels - camera.project(from_moved(points, self._twist))
        return float(np.sqrt((left[recent] ** 2).sum(-1).mean()))
