"""A fixed camera as a sensor of markers: detection, delay, loss and occlusion."""

from __future__ import annotations

import copy
import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import KalmanConfig, KalmanEstimator, Measurement, RBFImageJacobian
from hrc_learn.jacobian.estimators import KalmanState
from hrc_learn.kinematics import SerialChain
from hrc_learn.kinematics.tool_orientation import turn_about_vertical
from hrc_learn.log import StepLog
from hrc_learn.protocols import Camera, TimedCamera
from hrc_learn.store import Radians, read_json, write_json
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
        """Age of the newest image when it was read [s]; 0 if the camera has no time stamps."""
        return self._camera.age if isinstance(self._camera, TimedCamera) else 0.0

    def read(self) -> UInt8[np.ndarray, "height width 3"]:
        """Take an image, RGB."""
        return self._camera.read()

    def detect(self, ids: Iterable[int] | None = None) -> dict[int, Float[np.ndarray, "2"]]:
        """Take an image; return the pixel (u, v) of each marker in it, by number.

        Args:
            ids: Markers to search for; None: all. Searching for an invisible marker takes ten
                times as long as tracking a visible one.
        """
        return {id: centre(corners) for id, corners in self.corners(ids).items()}

    def corners(self, ids: Iterable[int] | None = None) -> dict[int, Float[np.ndarray, "4 2"]]:
        """Take an image; return the corners of each marker in it, clockwise from top left."""
        return self._detector.detect(self.read(), ids)


@dataclass(frozen=True, kw_only=True)
class MarkerObservation:
    """Markers detected in an image."""

    time: float = -np.inf
    """Time at which the image was taken [s]."""
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
    """Time from the exposure of an image until its markers are available [s]. Markers are held
    back until then; those of a camera with time stamps (`TimedCamera`) have its own delay."""
    frame_loss: float = 0.0
    """Fraction of lost images."""

    def __post_init__(self) -> None:
        if self.delay < 0 or not 0 <= self.frame_loss < 1:
            raise ValueError(
                "delay must not be negative and frame_loss must be in [0, 1), but are "
                f"{self.delay:g} s and {self.frame_loss:g}."
            )


# Images closer than this are one image whose age was read from another clock; and memory of
# joint positions, longer than any camera's delay [s].
_SAME_IMAGE, _REMEMBERED = 1e-3, 1.0


class DelayedDetection:
    """Detected markers with delay and loss, each with the joint positions of its image."""

    def __init__(
        self,
        sensor: MarkerSensor | None,
        latency: LatencyConfig,
        dt: float,
        rng: np.random.Generator,
    ):
        """Start without detections.

        Args:
            sensor: Camera with its detector; None: no camera.
            latency: Delay and loss of images.
            dt: Control step [s].
            rng: Random generator of the losses.
        """
        self._sensor, self._latency, self._rng = sensor, latency, rng
        self._pending: deque[MarkerObservation] = deque()
        self._taken = -np.inf  # the newest image [s]
        self._joints: deque[tuple[float, np.ndarray]] = deque(maxlen=round(_REMEMBERED / dt))

    def image(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """An image taken now; None without a camera."""
        return None if self._sensor is None else self._sensor.read()

    def remember(self, time: float, joints: Float[np.ndarray, " joints"]) -> None:
        """Store joint positions at a time [s, rad]."""
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
        found = {} if self._sensor is None else self._sensor.corners(ids)
        taken = time - (0.0 if self._sensor is None else self._sensor.age)
        # A camera that is slower than the detection returns the same image again.
        if abs(taken - self._taken) > _SAME_IMAGE:
            self._taken = taken
        if self._rng.random() < self._latency.frame_loss:
            return
        self._pending.append(
            MarkerObservation(
                time=self._taken,
                joints=self._joints_at(self._taken, time, joints),
                pixels={id: centre(corners) for id, corners in found.items()},
                angles={id: angle(corners) for id, corners in found.items()},
            )
        )

    def newest(self, time: float) -> MarkerObservation | None:
        """Newest observation that has arrived by a time [s] since the last call; None: none."""
        arrived = None
        # Clocks sum rounded steps, so a nanosecond early counts as in time.
        taken_by = time - self._latency.delay + 1e-9
        while self._pending and self._pending[0].time <= taken_by:
            arrived = self._pending.popleft()
        return arrived

    def _joints_at(
        self, time: float, now: float, joints: Float[Tensor, " joints"]
    ) -> Float[Tensor, " joints"]:
        """Joint positions at a time [s], as far back as stored [rad]."""
        if time >= now or not self._joints:
            return joints
        times, passed = zip(*self._joints, (now, joints.numpy()), strict=True)
        columns = np.stack(passed, axis=-1)
        return torch.tensor([np.interp(time, times, column) for column in columns])


# Distance of the end effector from the middle of the table within which the camera should see
# its marker [m]: the view of the camera reaches about 0.25 m to each side.
_OVER_TABLE = 0.22


def longest_occlusion(log: StepLog, middle: Pose, since: float, chain: SerialChain) -> float:
    """Longest time without a detection while the end effector was over the table [s].

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
    # Rising and falling edges alternate; their distances are lengths in steps.
    edges = np.flatnonzero(np.diff(np.concatenate([[False], occluded, [False]]).astype(int)))
    steps = edges[1::2] - edges[::2]
    dt = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    return float(steps.max()) * dt if len(steps) else 0.0


# Images averaged for the first pixel of a held marker: half a second.
_AVERAGED_IMAGES = 12


@dataclass(frozen=True, kw_only=True, eq=False)
class MarkerConsistency:
    """Test whether a marker moves with the end effector or is half hidden.

    The corners of a half-hidden marker are detected at the edge of what hides it, off by some
    pixels. The value holds the state of the test; `updated` returns the next one.
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
    """Mean pixel of the first images, moved to the first pose [px]."""
    images: int = 0
    """Number of images in that mean."""

    def updated(
        self,
        time: float,
        pixel: Float[np.ndarray, "2"],
        pose: Pose,
        jacobian: Float[np.ndarray, "2 6"],
    ) -> "MarkerConsistency":
        """The test after an image; unchanged by an image seen before.

        Args:
            time: Time at which the newest image was taken [s].
            pixel: Pixel of the marker in it [px]; NaN if it is not detected.
            pose: Pose of the end effector at that time.
            jacobian: Image Jacobian there [px/m, px/rad].
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
        return MarkerConsistency(
            tolerance=self.tolerance,
            consistent=consistent,
            time=time,
            start=start,
            pixel=mean,
            images=images,
        )


HALF_TURN = math.pi
"""Period of the turn of a parallel grasp [rad]."""

# Distance from the range within which a chosen turn is kept [rad]: the error of its estimate
# before the tool has turned, about 5 % of up to half a turn.
_KEPT = 0.15

# Noise of a marker's direction [rad]: about 0.1 px over 50 px of its edge.
_ANGLE_NOISE = 5e-3
# Prior mean: a camera that looks down sees each turn with the opposite sign [rad/rad].
_FROM_ABOVE = -1.0
# Prior standard deviation, with rotation scaled to metres [1/m].
_PRIOR = 1.0 / 0.15
# Pairs closer than 0.1 rad show mostly noise [m], with rotation scaled to metres.
_STEP = 0.015


@dataclass(frozen=True, kw_only=True, eq=False)
class AngleDemonstration:
    """Motion of the tool, and the directions of both markers in the image."""

    pose: Pose
    """Poses of the tool, (time,)."""
    tool: Float[Tensor, " time"]
    """Direction of the tool's marker [rad]; NaN where it was not seen."""
    item: float
    """Direction of the object's marker [rad]."""
    final: float
    """Direction of the tool's marker at the end, above the object [rad]."""


@dataclass(frozen=True, kw_only=True)
class _AngleFile:
    version: Literal[1] = 1
    offset_rad: Radians
    spread_rad: Radians


@dataclass(frozen=True, kw_only=True, eq=False)
class AngleState:
    """State of an alignment with an object."""

    estimator: KalmanState
    """State of the estimator of the image Jacobian."""
    chosen: float | None = None
    """Chosen turn of the present motion [rad]; None: none so far."""


@dataclass(frozen=True, kw_only=True)
class MarkerAngle:
    """Image Jacobian of the marker's direction, and its demonstrated difference.

    `turned` turns the tool about the vertical until its marker is aligned with the object's.
    """

    jacobian: RBFImageJacobian
    """One row [rad/m, rad/rad], equal everywhere."""
    offset: float
    """Direction of the tool's marker less that of the object's, modulo half turns [rad]."""
    spread: float
    """Root mean square deviation of the offset among the demonstrations [rad]."""

    @classmethod
    def fit(cls, demonstrations: Sequence[AngleDemonstration]) -> MarkerAngle:
        """Learn image Jacobian and offset from demonstrations.

        Raises:
            ValueError: There is no demonstration.
        """
        if not demonstrations:
            raise ValueError("the direction of a marker needs one demonstration or more.")
        estimator = _estimator(_guess())
        state = estimator.initial_state()
        for demonstration in demonstrations:
            state = estimator.resumed(state, 0.0)
            for k in torch.isfinite(demonstration.tool).nonzero()[:, 0]:
                state = _updated(
                    estimator, state, demonstration.pose[k], demonstration.tool[k], 0.0
                )
        learned = _guess()
        learned.weight.data = state.weight
        differences = np.array([d.final - d.item for d in demonstrations])
        # The mean of angles modulo half turns is half the mean of their doubles.
        mean = np.exp(2j * differences).mean()
        offset = float(np.angle(mean)) / 2
        off = np.array([_wrapped(d - offset) for d in differences])
        return cls(jacobian=learned, offset=offset, spread=float(np.sqrt((off**2).mean())))

    def save(self, folder: Path) -> None:
        """Write `folder/angle` and `folder/angle.json`."""
        self.jacobian.save(folder / "angle")
        content = _AngleFile(offset_rad=self.offset, spread_rad=self.spread)
        write_json(folder / "angle.json", content)

    @classmethod
    def load(cls, folder: Path) -> MarkerAngle:
        """Read a saved direction.

        Raises:
            FileNotFoundError: There is no such folder or file.
            ValueError: A file is damaged, or has an unknown version or kind.
        """
        content = read_json(folder / "angle.json", _AngleFile, "fit it again")
        return cls(
            jacobian=RBFImageJacobian.load(folder / "angle"),
            offset=content.offset_rad,
            spread=content.spread_rad,
        )

    @cached_property
    def _estimator(self) -> KalmanEstimator:
        return _estimator(self.jacobian)

    def initial_state(self) -> AngleState:
        """State before the first image."""
        return AngleState(estimator=self._estimator.initial_state())

    def restarted(self, state: AngleState) -> AngleState:
        """State for another motion; the camera may have been moved since the last one."""
        return AngleState(estimator=self._estimator.resumed(state.estimator, 0.0))

    def updated(self, state: AngleState, pose: Pose, angle: float, dt: float) -> AngleState:
        """State that has learned from an image.

        Args:
            state: State after the last image.
            pose: Pose of the tool when the image was taken.
            angle: Direction of the tool's marker in the image [rad].
            dt: Time since the last image [s].
        """
        seen = torch.tensor(angle, dtype=torch.float64)
        learned = _updated(self._estimator, state.estimator, pose, seen, dt)
        return replace(state, estimator=learned)

    def turned(
        self,
        state: AngleState,
        pose: Pose,
        angle: float,
        item: float,
        reference: Float[Tensor, "4"],
        turn_range: tuple[float, float],
    ) -> tuple[Float[Tensor, "4"], AngleState]:
        """Orientation of the tool that is aligned with the object, and the next state.

        Args:
            state: State after `updated`.
            pose: Pose of the tool when the image was taken.
            angle: Direction of the tool's marker in the image [rad].
            item: Direction of the object's marker [rad].
            reference: Orientation of a tool that is not turned.
            turn_range: Smallest and largest turn of the tool from there about the vertical
                [rad]. Of turns that differ by half turns, the nearest one in the range is
                chosen, and kept while it is not far out of the range: near an end of the range,
                noise would otherwise turn the tool back and forth.
        """
        rate = float(self._estimator.jacobian(state.estimator, pose)[0, 5])
        # Bounds for a camera that looks down; cameras that look up are not supported.
        rate = math.copysign(min(max(abs(rate), 0.5), 2.0), rate)
        now = turn_about_vertical(pose.orientation, reference)
        missing = _wrapped(item + self.offset - angle) / rate
        chosen = _within(now + missing, now, turn_range, state.chosen)
        about = quaternion.exp(reference.new_tensor([0.0, 0.0, chosen]))
        return quaternion.multiply(about, reference), replace(state, chosen=chosen)


def _within(
    turn: float, now: float, turn_range: tuple[float, float], chosen: float | None
) -> float:
    """Turn in the range that equals `turn` modulo half turns.

    The one nearest to the present turn; the one chosen before, if it is nearly in the range.
    """
    low, high = turn_range
    candidates = [turn + k * HALF_TURN for k in range(-3, 4)]
    if chosen is not None:
        same = min(candidates, key=lambda c: abs(c - chosen))
        if low - _KEPT <= same <= high + _KEPT:
            return same
    inside = [c for c in candidates if low <= c <= high]
    return min(inside or [min(max(turn, low), high)], key=lambda c: abs(c - now))


def _wrapped(angle: float) -> float:
    """An angle modulo half turns, within a quarter turn of zero [rad]."""
    return float((angle + HALF_TURN / 2) % HALF_TURN - HALF_TURN / 2)


def _guess() -> RBFImageJacobian:
    row = torch.tensor([[0.0, 0, 0, 0, 0, _FROM_ABOVE]], dtype=torch.float64)
    centre = torch.zeros(1, 2, dtype=torch.float64)
    return RBFImageJacobian(centre, 1.0, weight=row.mT.contiguous())


def _estimator(network: RBFImageJacobian) -> KalmanEstimator:
    network = copy.deepcopy(network).double()
    network.covariance = None
    config = KalmanConfig(
        pixel_noise=_ANGLE_NOISE,
        bias_std=_PRIOR,
        weight_std=1e-3 * _PRIOR,
        drift=0.1 * _PRIOR,
        min_step=_STEP,
        max_step=0.3,
        weight_bound=10 * _PRIOR,
    )
    return KalmanEstimator(network, config)


def _updated(
    estimator: KalmanEstimator, state: KalmanState, pose: Pose, angle: Tensor, dt: float
) -> KalmanState:
    """State of the estimator after an image."""
    if bool(state.key.present):
        # The estimator learns from differences to the key frame, each less than half a turn.
        before = state.key.feature[0]
        angle = before + torch.remainder(angle - before + math.pi, 2 * math.pi) - math.pi
    return estimator.update(state, Measurement.seen(pose, angle.reshape(1), dt))
