"""A fixed camera as a sensor of markers: detections, their delay and loss, occlusions."""

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import SerialChain
from hrc_learn.log import StepLog
from hrc_learn.protocols import Camera, TimedCamera
from hrc_learn.vision import MarkerDetector, angle, centre


class MarkerSensor:
    """Detects the centres of markers in a camera's images."""

    def __init__(self, camera: Camera, marker_ids: Iterable[int]):
        """Set up the detector.

        Args:
            camera: Source of the images.
            marker_ids: ArUco numbers to report; others are ignored.
        """
        self._camera = camera
        self._detector = MarkerDetector(list(marker_ids))

    @property
    def age(self) -> float:
        """Of the newest image when it was read, as far as the camera tells [s]."""
        return self._camera.age if isinstance(self._camera, TimedCamera) else 0.0

    def read(self) -> UInt8[np.ndarray, "height width 3"]:
        """Take an image, RGB."""
        return self._camera.read()

    def detect(self, ids: Iterable[int] | None = None) -> dict[int, Float[np.ndarray, "2"]]:
        """Take an image; return the pixel (u, v) of each marker in it, by number.

        Args:
            ids: Markers that matter now; None: all. Searching for one that is out of sight
                takes ten times as long as tracking one that is seen.
        """
        return {id: centre(corners) for id, corners in self.corners(ids).items()}

    def corners(self, ids: Iterable[int] | None = None) -> dict[int, Float[np.ndarray, "4 2"]]:
        """The same with the pixels of each marker's corners, top left first and clockwise."""
        return self._detector.detect(self.read(), ids)


@dataclass(frozen=True, kw_only=True)
class MarkerObservation:
    """Markers detected in an image."""

    time: float = -np.inf
    """When the image was taken [s]."""
    joints: Float[Tensor, " joints"] | None = None
    """Joint positions at that time [rad]."""
    pixels: Mapping[int, Float[np.ndarray, "2"]] = field(default_factory=dict)
    """Centre of each marker in it, by number (u, v) [px]."""
    angles: Mapping[int, float] = field(default_factory=dict)
    """Direction of each marker in it, by number [rad]."""


@dataclass(frozen=True, kw_only=True)
class LatencyConfig:
    """Delay and loss of images between the camera and the controller."""

    delay: float = 0.0
    """From an image being taken until its markers are known [s]. Markers are held back until
    then; those of a camera that tells its images' age (`TimedCamera`) come that late."""
    frame_loss: float = 0.0
    """Fraction of the images that never arrive."""

    def __post_init__(self) -> None:
        if self.delay < 0 or not 0 <= self.frame_loss < 1:
            raise ValueError(
                "delay must not be negative and frame_loss must be in [0, 1), but are "
                f"{self.delay:g} s and {self.frame_loss:g}."
            )


class DelayedChannel:
    """Delivers observations late, in the order in which they were taken, and loses some."""

    def __init__(self, config: LatencyConfig, rng: np.random.Generator):
        """Start with an empty channel.

        Args:
            config: How late, and how many are lost.
            rng: Decides which.
        """
        self._config, self._rng = config, rng
        self._pending: deque[MarkerObservation] = deque()

    def send(self, observation: MarkerObservation) -> None:
        """Put an observation into the channel."""
        if self._rng.random() >= self._config.frame_loss:
            self._pending.append(observation)

    def newest(self, time: float) -> MarkerObservation | None:
        """The newest that has arrived by a time [s] since last asked; None if none has."""
        arrived = None
        # Clocks add up steps of rounded length: a nanosecond early still counts as in time.
        taken_by = time - self._config.delay + 1e-9
        while self._pending and self._pending[0].time <= taken_by:
            arrived = self._pending.popleft()
        return arrived


# Images taken less than this apart are one image, whose age was read from another clock; and
# for how long joint positions are remembered, longer than any camera's delay [s].
_SAME_IMAGE, _REMEMBERED = 1e-3, 1.0


class DelayedDetection:
    """Markers as a controller comes to know them: late, some never, each with the joint
    positions of when its image was taken.
    """

    def __init__(
        self,
        sensor: MarkerSensor | None,
        latency: LatencyConfig,
        dt: float,
        rng: np.random.Generator,
    ):
        """Begin with nothing detected.

        Args:
            sensor: The camera with its detector; None where a task needs none.
            latency: How late images are, and how many are lost.
            dt: Control step [s].
            rng: Decides which images are lost.
        """
        self._sensor, self._channel = sensor, DelayedChannel(latency, rng)
        self._taken = -np.inf  # the newest image [s]
        self._joints: deque[tuple[float, np.ndarray]] = deque(maxlen=round(_REMEMBERED / dt))

    def image(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """An image taken now; None without a camera."""
        return None if self._sensor is None else self._sensor.read()

    def remember(self, time: float, joints: Float[np.ndarray, " joints"]) -> None:
        """Where the joints are at a time [s, rad]."""
        self._joints.append((time, joints))

    def detect(
        self, time: float, joints: Float[Tensor, " joints"], ids: Iterable[int] | None = None
    ) -> None:
        """Take an image, and detect markers in it.

        Args:
            time: The clock [s].
            joints: Where the joints are by then [rad].
            ids: Markers that matter now; None: all.
        """
        found = {} if self._sensor is None else self._sensor.corners(ids)
        taken = time - (0.0 if self._sensor is None else self._sensor.age)
        # A camera that is slower than the detection gives the same image again: no new one.
        if abs(taken - self._taken) > _SAME_IMAGE:
            self._taken = taken
        self._channel.send(
            MarkerObservation(
                time=self._taken,
                joints=self._joints_at(self._taken, time, joints),
                pixels={id: centre(corners) for id, corners in found.items()},
                angles={id: angle(corners) for id, corners in found.items()},
            )
        )

    def newest(self, time: float) -> MarkerObservation | None:
        """The newest that has arrived by a time [s] since last asked; None if none has."""
        return self._channel.newest(time)

    def _joints_at(
        self, time: float, now: float, joints: Float[Tensor, " joints"]
    ) -> Float[Tensor, " joints"]:
        """Where the joints were at a time [s], as far back as is remembered [rad]."""
        if time >= now or not self._joints:
            return joints
        times, passed = zip(*self._joints, (now, joints.numpy()), strict=True)
        columns = np.stack(passed, axis=-1)
        return torch.tensor([np.interp(time, times, column) for column in columns])


_OVER_TABLE = 0.22
"""Distance of the end effector from the middle of the table within which the camera should see
its marker [m]: the camera's view reaches about 0.25 m to each side."""


def longest_occlusion(log: StepLog, middle: Pose, since: float, chain: SerialChain) -> float:
    """Longest time without a detection while the end effector was over the table [s].

    Args:
        log: Of a work cell.
        middle: Of the end effector above the middle of the table.
        since: Steps from this time on count [s].
        chain: The arm.
    """
    time = log["time"]
    rows = time >= since
    position = chain.forward(torch.from_numpy(log["joint_position"][rows])).position
    over_table = ((position - middle.position).norm(dim=-1) < _OVER_TABLE).numpy()
    occluded = over_table & np.isnan(log["feature"][rows, 0])
    # Rising and falling edges alternate: their distances are the lengths in steps.
    edges = np.flatnonzero(np.diff(np.concatenate([[False], occluded, [False]]).astype(int)))
    steps = edges[1::2] - edges[::2]
    dt = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    return float(steps.max()) * dt if len(steps) else 0.0


class HeldMarker:
    """Tells a marker that something half hides from one that moves with the end effector.

    Its corners are then found where the edge of what hides it is, by some pixels elsewhere.
    """

    # Images that are averaged for where it is: half a second of them.
    _IMAGES = 12

    def __init__(self, tolerance: float):
        self._tolerance = tolerance
        self._before: Pose | None = None
        self._pixel, self._images = np.zeros(2), 0
        self._time, self._fits = -np.inf, False

    def fits(
        self,
        time: float,
        pixel: Float[np.ndarray, "2"],
        pose: Pose,
        jacobian: Float[np.ndarray, "2 6"],
    ) -> bool:
        """Whether a marker is seen where the end effector has taken it since the first image.

        Args:
            time: When the newest image was taken [s].
            pixel: Of the marker in it [px]; NaN if it is not seen.
            pose: Of the end effector then.
            jacobian: Image Jacobian there [px/m, px/rad].
        """
        if time > self._time:
            self._time, self._fits = time, self._agrees(pixel, pose, jacobian)
        return self._fits

    def _agrees(
        self,
        pixel: Float[np.ndarray, "2"],
        pose: Pose,
        jacobian: Float[np.ndarray, "2 6"],
    ) -> bool:
        if not np.isfinite(pixel).all():
            return False
        if self._before is None:
            self._before = pose
        rest = pixel - jacobian @ self._before.twist_to(pose).numpy()
        if self._images < self._IMAGES:
            self._images += 1
            self._pixel += (rest - self._pixel) / self._images
        return bool(np.linalg.norm(rest - self._pixel) <= self._tolerance)
