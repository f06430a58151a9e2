"""A camera and a marker detector together: what it saw, how late it arrives, and how long
a marker was occluded.
"""

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import panda
from hrc_learn.protocols import Camera
from hrc_learn.sim import HAND_MARKER, SceneConfig
from hrc_learn.vision import MarkerDetector, centre
from hrc_learn.viz import StepLog

# A camera and a marker detector together: images in, pixels of markers out.


class Eye:
    """Finds the centres of markers in a camera's images."""

    def __init__(self, camera: Camera, marker_ids: Iterable[int]):
        self._camera = camera
        self._detector = MarkerDetector(list(marker_ids))

    @classmethod
    def on(cls, camera: Camera, scene: SceneConfig) -> "Eye":
        """An eye that looks for the markers of a scene."""
        return cls(camera, [HAND_MARKER, *(item.marker.id for item in scene.objects)])

    def read(self) -> UInt8[np.ndarray, "height width 3"]:
        """Take an image, RGB."""
        return self._camera.read()

    def look(self, ids: Iterable[int] | None = None) -> dict[int, Float[np.ndarray, "2"]]:
        """Take an image; return the pixel (u, v) of each marker in it, by number.

        Args:
            ids: Markers that matter now; None: all. Looking for one that is out of sight
                takes ten times as long as following one that is seen.
        """
        found = self._detector.detect(self.read(), ids)
        return {id: centre(corners) for id, corners in found.items()}


# What a camera saw, and how it gets to the task: late, and not always.


@dataclass(frozen=True, kw_only=True)
class Sight:
    """Markers found in an image."""

    time: float = -np.inf
    """When the image was taken [s]."""
    joints: Float[Tensor, " joints"] | None = None
    """Joint positions at that time [rad]."""
    pixels: Mapping[int, Float[np.ndarray, "2"]] = field(default_factory=dict)
    """Centre of each marker in it, by number (u, v) [px]."""


@dataclass(frozen=True, kw_only=True)
class TransportConfig:
    """What happens to images on their way."""

    latency: float = 0.0
    """From an image being taken until its markers are known [s]."""
    dropped: float = 0.0
    """Share of the images that never arrive."""

    def __post_init__(self) -> None:
        if self.latency < 0 or not 0 <= self.dropped < 1:
            raise ValueError(
                "latency must not be negative and dropped must be in [0, 1), but are "
                f"{self.latency:g} s and {self.dropped:g}."
            )


class Transport:
    """Images on their way from camera to task, in the order in which they were taken."""

    def __init__(self, config: TransportConfig, rng: np.random.Generator):
        """Nothing is under way yet.

        Args:
            config: How late, and how many are lost.
            rng: Decides which.
        """
        self._config, self._rng = config, rng
        self._under_way: deque[Sight] = deque()

    def send(self, sight: Sight) -> None:
        """Hand over what was found in an image."""
        if self._rng.random() >= self._config.dropped:
            self._under_way.append(sight)

    def newest(self, time: float) -> Sight | None:
        """The newest that has arrived by a time [s] since last asked; None if none has."""
        arrived = None
        taken_by = time - self._config.latency + 1e-9  # clocks add up steps
        while self._under_way and self._under_way[0].time <= taken_by:
            arrived = self._under_way.popleft()
        return arrived


# For how long the hand's marker was out of sight where it should have been seen.

_NEAR = 0.22
"""Distance of the hand from the middle of the table within which it should be seen [m]."""


def longest_unseen(log: StepLog, middle: Pose, since: float) -> float:
    """Longest spell in which the marker was not seen while the hand was over the table [s].

    Args:
        log: Of a station.
        middle: Of the hand above the middle of the table.
        since: Steps from this time on count [s].
    """
    time = log["time"]
    rows = time >= since
    hand = panda.forward(torch.from_numpy(log["joint_position"][rows])).position
    over = ((hand - middle.position).norm(dim=-1) < _NEAR).numpy()
    unseen = over & np.isnan(log["feature"][rows, 0])
    # Steps of each spell, by where it begins and ends.
    edges = np.flatnonzero(np.diff(np.concatenate([[False], unseen, [False]]).astype(int)))
    steps = edges[1::2] - edges[::2]
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    return float(steps.max()) * step if len(steps) else 0.0
