"""Find tool and objects in the images of a fixed camera, with or without markers.

Images may arrive late or be lost (`DelayedDetection`), and markers may be half hidden
(`MarkerConsistency`).
"""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.kinematics import SerialChain
from hrc_learn.log import StepLog
from hrc_learn.protocols import Camera, TimedCamera
from hrc_learn.vision import MarkerDetector, angle, centre
from hrc_learn.vision.landmarks import Finding, LandmarkDetector, Landmarks, draw_finding

# A landmark whose pixel has a larger standard deviation counts as not found [px].
_UNSURE = 2.5


class SeenFeature(NamedTuple):
    """Place of a tool or an object in an image."""

    pixel: Float[np.ndarray, "2"]
    """Image position (u, v) [px]."""
    angle: float
    """Direction in the image [rad]; NaN: no direction."""


class FeatureSensor(ABC):
    """Camera that finds tool and objects; each has a number, even if it carries no marker."""

    def __init__(self, camera: Camera):
        """Take images from a camera."""
        self._camera = camera

    @property
    def age(self) -> float:
        """Age of the newest image when it was read [s]; 0 if the camera has no time stamps."""
        return self._camera.age if isinstance(self._camera, TimedCamera) else 0.0

    def read(self) -> UInt8[np.ndarray, "height width 3"]:
        """Take an RGB image for display."""
        return self._camera.read()

    @abstractmethod
    def features(self, ids: Iterable[int] | None = None) -> dict[int, SeenFeature]:
        """Take an image and return the features found in it, by marker number.

        Args:
            ids: Numbers to search for; None: all. Searching for an invisible marker takes ten
                times as long as tracking a visible one.
        """

    def detect(self, ids: Iterable[int] | None = None) -> dict[int, Float[np.ndarray, "2"]]:
        """Take an image, find features as `features` does, and return their pixels (u, v)."""
        return {number: seen.pixel for number, seen in self.features(ids).items()}


class MarkerSensor(FeatureSensor):
    """Detects markers in a camera's images."""

    def __init__(self, camera: Camera, marker_ids: Iterable[int]):
        """Set up the detector.

        Args:
            camera: Source of the images.
            marker_ids: ArUco numbers to report; others are ignored.
        """
        super().__init__(camera)
        self._detector = MarkerDetector(marker_ids)

    def features(self, ids: Iterable[int] | None = None) -> dict[int, SeenFeature]:
        """Take an image; return centre and direction of each marker in the image, by number."""
        found = self.corners(ids).items()
        return {id: SeenFeature(centre(corners), angle(corners)) for id, corners in found}

    def corners(self, ids: Iterable[int] | None = None) -> dict[int, Float[np.ndarray, "4 2"]]:
        """Take an image; return the corners of each marker in it, clockwise from top left."""
        return self._detector.detect(self._camera.read(), ids)


class LandmarkSensor(FeatureSensor):
    """Finds tool and objects without markers, by landmarks learned from demonstrations."""

    def __init__(self, camera: Camera, landmarks: Landmarks, names: Mapping[int, str]):
        """Set up the search.

        Args:
            camera: Source of the images.
            landmarks: Landmarks of tool and objects.
            names: Names of the landmarks, by marker number.
        """
        super().__init__(camera)
        self._names, self._detector = names, LandmarkDetector(landmarks)
        self._found: dict[str, Finding] = {}
        self._is_fresh = False  # True if features were searched after the last `read`

    def read(self) -> UInt8[np.ndarray, "height width 3"]:
        """Take an image for display, and draw the landmarks found since the last display."""
        image = self._camera.read().copy()
        for finding in self._found.values() if self._is_fresh else ():
            draw_finding(image, finding)
        self._is_fresh = False
        return image

    def features(self, ids: Iterable[int] | None = None) -> dict[int, SeenFeature]:
        """Take an image; return the landmarks that are located well in it, by number."""
        wanted = [i for i in (self._names if ids is None else ids) if i in self._names]
        found = self._detector.find(self._camera.read(), [self._names[i] for i in wanted])
        # Landmarks that were not searched for, such as an object under the tool, are drawn
        # where they were last found.
        gone = {self._names[i] for i in wanted} - set(found)
        self._found = {k: v for k, v in self._found.items() if k not in gone} | found
        self._is_fresh = True
        return {
            i: SeenFeature(one.pixel, one.angle)
            for i in wanted
            if (one := found.get(self._names[i])) is not None and one.deviation < _UNSURE
        }


def feature_sensor(
    camera: Camera, landmarks: Landmarks | None, tool: int, objects: Iterable[int]
) -> FeatureSensor:
    """Sensor that finds landmarks if there are any, else markers.

    Args:
        camera: Source of the images.
        landmarks: Landmarks of a model fitted without markers; None: markers are detected.
        tool: Marker number of the end effector.
        objects: Marker numbers of the objects; landmarks describe one kind of object only.
    """
    if landmarks is None:
        return MarkerSensor(camera, [tool, *objects])
    names = {number: name for number in objects for name in landmarks.objects}
    return LandmarkSensor(camera, landmarks, {tool: "tool", **names})


@dataclass(frozen=True, kw_only=True)
class MarkerObservation:
    """Markers detected in an image."""

    time: float = -np.inf
    """Time at which the image was taken [s]."""
    joints: Float[Tensor, " joints"] | None = None
    """Joint positions when the image was taken [rad]."""
    features: Mapping[int, SeenFeature] = field(default_factory=dict)
    """Markers in the image, by number."""


@dataclass(frozen=True, kw_only=True)
class LatencyConfig:
    """Delay and loss of images between the camera and the controller."""

    delay: float = 0.0
    """Time from the exposure of an image until its markers are available [s]. Markers that are
    detected sooner are held back until then. The age that a `TimedCamera` reports is a part of
    this time."""
    frame_loss: float = 0.0
    """Fraction of lost images."""

    def __post_init__(self) -> None:
        check_settings(self, not_negative=["delay"], below_one=["frame_loss"])


# `_SAME_IMAGE`: two images count as the same image if their times differ by at most this [s].
# The age of an image comes from another clock, and the arm's time advances in steps of up to
# 8 ms (125 Hz). A camera of 120 Hz takes an image every 8.3 ms.
# `_REMEMBERED`: time for which joint positions are stored, longer than the delay of any camera
# [s].
_SAME_IMAGE, _REMEMBERED = 8.2e-3, 1.0


class DelayedDetection:
    """Detects markers, and delays or loses the results.

    Each observation holds the joint positions at the time of its image.
    """

    def __init__(
        self,
        sensor: FeatureSensor | None,
        latency: LatencyConfig,
        dt: float,
        rng: np.random.Generator,
    ):
        """Start without detections.

        Args:
            sensor: Camera that finds tool and objects; None: no camera.
            latency: Delay and loss of images.
            dt: Control step [s].
            rng: Random generator of the losses.
        """
        self._sensor, self._latency, self._rng = sensor, latency, rng
        self._pending: deque[MarkerObservation] = deque()
        self._taken = -np.inf  # time of the newest image [s]
        self._joints: deque[tuple[float, np.ndarray]] = deque(maxlen=round(_REMEMBERED / dt))

    def image(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """An image taken now, for display; None without a camera."""
        return None if self._sensor is None else self._sensor.read()

    def remember(self, time: float, joints: Float[np.ndarray, " joints"]) -> None:
        """Store the joint positions [rad] at a time [s]."""
        self._joints.append((time, joints))

    def detect(
        self, time: float, joints: Float[Tensor, " joints"], ids: Iterable[int] | None = None
    ) -> None:
        """Take an image, and detect markers in it.

        Args:
            time: Present time [s].
            joints: Present joint positions [rad].
            ids: Markers to search for; None: all.
        """
        found, taken = {}, time
        if self._sensor is not None:
            found, taken = self._sensor.features(ids), time - self._sensor.age
        # A camera that is slower than the detection returns the same image again.
        if abs(taken - self._taken) > _SAME_IMAGE:
            self._taken = taken
        if self._rng.random() < self._latency.frame_loss:
            return
        then = self._joints_at(self._taken, time, joints)
        self._pending.append(MarkerObservation(time=self._taken, joints=then, features=found))

    def newest(self, time: float) -> MarkerObservation | None:
        """Newest observation that has arrived since the last call; None: no observation has
        arrived.

        Args:
            time: Present time [s].
        """
        arrived = None
        # Clocks sum rounded steps, so an image that is a nanosecond early counts as in time.
        taken_by = time - self._latency.delay + 1e-9
        while self._pending and self._pending[0].time <= taken_by:
            arrived = self._pending.popleft()
        return arrived

    def _joints_at(
        self, time: float, now: float, joints: Float[Tensor, " joints"]
    ) -> Float[Tensor, " joints"]:
        """Joint positions at a time [rad]; before the oldest stored time, the oldest positions.

        Args:
            time: Time of the wanted positions [s].
            now: Present time [s].
            joints: Present joint positions [rad].
        """
        if time >= now or not self._joints:
            return joints
        times, passed = zip(*self._joints, (now, joints.numpy()), strict=True)
        columns = np.stack(passed, axis=-1)
        return torch.tensor([np.interp(time, times, column) for column in columns])


# If the end effector is within this distance of the middle of the table, the camera should see
# its marker [m]: the view of the camera reaches about 0.25 m to each side.
_OVER_TABLE = 0.22


def longest_occlusion(log: StepLog, middle: Pose, since: float, chain: SerialChain) -> float:
    """Longest time for which the end effector was over the table without a detection [s].

    Args:
        log: Log of a work cell.
        middle: Pose of the end effector above the middle of the table.
        since: Time of the first step that counts [s].
        chain: Kinematics of the arm.
    """
    time = log["time"]
    rows = time >= since
    position = chain.forward(torch.from_numpy(log["joint_position"][rows])).position
    over_table = ((position - middle.position).norm(dim=-1) < _OVER_TABLE).numpy()
    occluded = over_table & np.isnan(log["feature"][rows, 0])
    steps = max((len([*run]) for hidden, run in groupby(occluded) if hidden), default=0)
    return steps * float(np.median(np.diff(time))) if len(time) > 1 else 0.0


# Number of images that are averaged for the reference pixel of a held marker: half a second.
_AVERAGED_IMAGES = 12


@dataclass(frozen=True, kw_only=True, eq=False)
class MarkerConsistency:
    """Test whether a marker moves with the end effector or is half hidden.

    The corners of a half-hidden marker are detected at the edge of the occluding object, some
    pixels off. An instance holds the state of the test; `updated` returns the next state.
    """

    tolerance: float
    """Largest deviation from the predicted pixel [px]."""
    consistent: bool = False
    """True if the newest image shows the marker at the predicted pixel."""
    time: float = -np.inf
    """Time of the newest image [s]."""
    start: Pose | None = None
    """Pose of the end effector at the first image; None: no image so far."""
    pixel: Float[np.ndarray, "2"] = field(default_factory=lambda: np.zeros(2))
    """Mean pixel of the first images, each converted to the pixel at the first pose [px]."""
    images: int = 0
    """Number of images in the mean."""

    def updated(
        self,
        time: float,
        pixel: Float[np.ndarray, "2"],
        pose: Pose,
        jacobian: Float[np.ndarray, "2 6"],
    ) -> "MarkerConsistency":
        """State of the test after an image; an image seen before changes nothing.

        Args:
            time: Time at which the newest image was taken [s].
            pixel: Pixel of the marker in the image [px]; NaN if the marker is not detected.
            pose: Pose of the end effector when the image was taken.
            jacobian: Image Jacobian at this pose [px/m, px/rad].
        """
        if time <= self.time:
            return self
        if not np.isfinite(pixel).all():
            return replace(self, time=time, consistent=False)
        start = pose if self.start is None else self.start
        mean, images = self.pixel, self.images
        first = pixel - jacobian @ start.twist_to(pose).numpy()
        if images < _AVERAGED_IMAGES:
            images += 1
            mean = mean + (first - mean) / images
        consistent = bool(np.linalg.norm(first - mean) <= self.tolerance)
        return replace(
            self, consistent=consistent, time=time, start=start, pixel=mean, images=images
        )
