"""Use OpenCV's cameras, streams and video files as a `Camera`, and measure the delay of images.

Neither the lens nor the pose of the camera has to be known. Each image has an age, from which
the controller finds the position that the arm had at the exposure.

The delay is measured by moving the robot: a joint turns back and forth, and the position of its
marker in the images lags behind the joint. No calibration is needed: over such a small motion,
the marker's pixel is a smooth function of the joint position. This function is fitted for each
candidate delay; the delay with the smallest residual is the result.
"""

import math
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from hrc_learn.hardware.driver_process import Connected, imported
from hrc_learn.protocols import Arm, Camera, TimedCamera
from hrc_learn.vision import MarkerDetector, centre

type RGB = UInt8[np.ndarray, "height width 3"]
"""RGB image."""

_FIRST_IMAGE = 5.0
"""Additional time allowed for the first image [s]: cameras adjust their exposure first, and
streams send complete pictures (key frames) only now and then.
"""
_CLOSING = 2.0
"""Longest wait for the reading thread on closing [s]."""


class CameraError(RuntimeError):
    """A camera cannot be opened, or sends no usable images."""


class CaptureCamera(Connected, TimedCamera):
    """A camera, stream or video file; a thread reads it and keeps only the newest image.

    The backend buffers several images, so a reader slower than the camera would otherwise
    receive older and older images. A file plays at its own rate from the first `read` on.
    """

    def __init__(self, source: int | str | Path, *, delay: float = 0.0, timeout: float = 1.0):
        """Open the source, and wait for the first image.

        Args:
            source: Device number (0 or "0"), device path (/dev/video0), URL of a stream
                (rtsp://..., http://...), or path of a video file.
            delay: Time between exposure and arrival of an image [s], in addition to what the
                backend reports; see `measure_delay`.
            timeout: Longest time without a new image [s].

        Raises:
            FileNotFoundError: There is no such file.
            CameraError: The source cannot be opened, or sends no usable image.
            ValueError: The delay is negative, or the timeout is not positive or infinite.
        """
        if not delay >= 0:
            raise ValueError(f"delay must not be negative, but is {delay} s.")
        if not 0 < timeout < math.inf:
            raise ValueError(f"timeout must be positive and finite, but is {timeout} s.")
        name = str(source)
        device = name.isdecimal() or name.startswith("/dev/")
        self._is_file = not device and "://" not in name
        self._name = f"video {name}" if self._is_file else f"camera {name}"
        self._delay, self._timeout, self._age = delay, timeout, 0.0
        self._capture = _opened(name, self._name, timeout)
        self._arrived = threading.Condition()
        # Time at which the newest image was taken, as far as known [s], and the image (BGR).
        # Times of a file count from its first reading.
        self._newest: tuple[float, np.ndarray] | None = None
        self._begun: float | None = None if self._is_file else 0.0
        self._failure, self._closing = "", False
        self._thread = threading.Thread(target=self._keep_newest, name=self._name, daemon=True)
        self._thread.start()
        try:
            _as_rgb(self._first_image(), self._name)
        except BaseException:
            self.close()
            raise

    @property
    def age(self) -> float:
        """Age that the last image had when `read` returned it [s]."""
        return self._age

    def read(self) -> RGB:
        """Return the newest image, RGB.

        Raises:
            CameraError: No image has come within the timeout, or the image is not usable.
        """
        with self._arrived:
            newest, failure, now = self._newest, self._failure, time.monotonic()
            if self._begun is None:
                self._begun = now
                self._arrived.notify_all()
        if newest is None:
            raise CameraError(failure or f"{self._name} is closed: open it again.")
        since = max(now - self._begun - newest[0], 0.0)
        if since > self._timeout:
            raise CameraError(failure or self._silent(since))
        self._age = since + self._delay
        return _as_rgb(newest[1], self._name)

    def close(self) -> None:
        """Release the camera."""
        with self._arrived:
            self._closing = True
            self._arrived.notify_all()
        self._thread.join(_CLOSING)
        # A capture must not be released while its backend still waits for an image.
        if not self._thread.is_alive():
            self._capture.release()
        with self._arrived:
            self._newest = None

    def _first_image(self) -> np.ndarray:
        longest = self._timeout + _FIRST_IMAGE
        with self._arrived:
            self._arrived.wait_for(lambda: self._newest or self._failure, longest)
            if self._newest is None:
                raise CameraError(self._failure or self._silent(longest))
            return self._newest[1]

    def _silent(self, passed: float) -> str:
        return (
            f"{self._name} has sent no image for {passed:.1f} s (timeout: "
            f"{self._timeout:g} s): check its cable, its light and its rate."
        )

    def _keep_newest(self) -> None:
        """Read images until closed, in the thread."""
        import cv2

        while not self._closing:
            if not self._capture.grab():
                with self._arrived:
                    self._failure = (
                        f"{self._name} has ended or does not answer: see that it is plugged "
                        "in, or that its server runs, and open it again."
                    )
                    self._arrived.notify_all()
                return
            now = time.monotonic()
            if self._is_file:
                taken = 1e-3 * self._capture.get(cv2.CAP_PROP_POS_MSEC)
                self._await(taken)
            else:
                taken = taken_by(self._capture, now, self._timeout)
            whole, image = self._capture.retrieve()
            if whole:
                with self._arrived:
                    self._newest = taken, image
                    self._arrived.notify_all()

    def _await(self, position: float) -> None:
        """Wait until an image of a file is due; the first one always is."""
        with self._arrived:
            if self._newest is None:
                return
            self._arrived.wait_for(lambda: self._closing or self._begun is not None)
            begun = self._begun or 0.0
            left = max(0.0, begun + position - time.monotonic())
            self._arrived.wait_for(lambda: self._closing, left)


def taken_by(capture: Any, now: float, oldest: float) -> float:
    """Time at which the image just grabbed was taken, on `time.monotonic` [s].

    Linux drivers stamp their buffers with that clock, and OpenCV reports the stamp as the
    position of the video (CAP_PROP_POS_MSEC, backend V4L2). A position that does not lie
    shortly before now counts from the start of the stream or is undefined. In this case, the
    time of arrival is used.

    Args:
        capture: OpenCV's capture.
        now: Time of the grab [s].
        oldest: Age beyond which the position cannot be the image's time [s].
    """
    import cv2

    stamp = 1e-3 * capture.get(cv2.CAP_PROP_POS_MSEC)
    return stamp if 0 <= now - stamp < oldest else now


def _opened(source: str, name: str, timeout: float) -> Any:
    """Open a capture of OpenCV."""
    advice = "pip install opencv-python-headless, or hrc-learn[hardware]"
    cv2 = imported("cv2", f"{name} needs OpenCV: {advice}")
    if "://" in source:
        limits = {
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC: timeout + _FIRST_IMAGE,
            cv2.CAP_PROP_READ_TIMEOUT_MSEC: timeout,
        }
        options = [x for key, limit in limits.items() for x in (key, round(1e3 * limit))]
        capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, options)
        hint = "is its server running, and can this machine reach it?"
    elif source.isdecimal() or source.startswith("/dev/"):
        capture = cv2.VideoCapture(int(source) if source.isdecimal() else source)
        hint = (
            "is it plugged in (ls /dev/video*), does another program use it, and may this "
            "user read it (group video)?"
        )
    else:
        if not Path(source).is_file():
            raise FileNotFoundError(f"no video file {source}: give a path, a number or a URL.")
        capture, hint = cv2.VideoCapture(source), "is it a video, and complete?"
    if not capture.isOpened():
        raise CameraError(f"{name} cannot be opened: {hint}")
    return capture


def _as_rgb(image: np.ndarray, name: str) -> RGB:
    """Convert a BGR image to RGB.

    Raises:
        CameraError: The image is not an 8-bit colour image.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise CameraError(
            f"{name} sends images of shape {image.shape} and type {image.dtype}, and not of "
            "(height, width, 3) and uint8: choose one of its colour streams."
        )
    return np.ascontiguousarray(image[..., ::-1])


# Frequencies of the joint's oscillation at the beginning and at the end [Hz]: with a single
# frequency, delays that differ by a period would fit equally well.
_SLOWEST, _FASTEST = 0.4, 1.0
# Largest joint velocity [rad/s]: a marker at 0.5 m moves at 75 mm/s, by 3 cm to each side.
_SPEED = 0.15
# `_DT`: period of the readings of arm and camera [s]. `_LONGEST`: longest delay searched [s].
_DT, _LONGEST = 0.01, 0.5
# Degree of the polynomial that is fitted to the pixels: perspective makes them nonlinear in the
# joint position.
_POWERS = 3
# Step between the delays tried [s]; the minimum is interpolated between them.
_STEP = 2e-3
# For a valid delay: fewest images, and smallest fraction of the pixels' variance that the fit
# must explain.
_FEWEST, _EXPLAINED = 30, 0.9
# Return of the joint to its start. `_RETURN`: decay rate [1/s]. `_BACK`: position error at
# which the return ends [rad]. `_LONGEST_WAY_BACK`: longest duration [s].
_RETURN, _BACK, _LONGEST_WAY_BACK = 2.0, 1e-3, 3.0


def turning_velocity(passed: float, duration: float) -> float:
    """Joint velocity [rad/s]: an oscillation of rising frequency, smooth at both ends.

    Args:
        passed: Time since the start [s].
        duration: Duration of the whole motion [s].
    """
    progress = passed / duration
    turns = passed * (_SLOWEST + 0.5 * (_FASTEST - _SLOWEST) * progress)
    gentle = min(1.0, 8 * progress, 8 * (1 - progress))
    return _SPEED * gentle * math.sin(2 * math.pi * turns)


class MeasuredDelay(NamedTuple):
    """A measured camera delay."""

    delay: float
    """Time between exposure and reading of an image [s], without the age that the camera
    reports.
    """
    deviation: float
    """Standard deviation of the delay, from the residuals of the fit [s]."""
    images: int
    """Number of images used, in all of which the marker was seen."""


def measure_delay(
    arm: Arm,
    camera: Camera,
    marker: int,
    *,
    advance: Callable[[float], None],
    joint: int = 1,
    duration: float = 8.0,
) -> MeasuredDelay:
    """Measure a camera's delay by moving the arm in front of it; the arm ends where it began.

    Use the result as `delay` of the camera and of the work cell (`LatencyConfig(delay=...)`).

    Args:
        arm: Arm with the marker; nothing else may move the marker or the camera.
        camera: Camera that sees the marker, from anywhere.
        marker: ArUco number on the arm.
        advance: Lets a given time pass [s].
        joint: Joint that turns, counted from 1; its motion must move the marker across the
            image. Obstacles in the way are not considered.
        duration: Duration of the motion [s].

    Raises:
        ValueError: The arm has no such joint, or the duration is not positive.
        CameraError: The marker is seen in too few images or does not move with the joint, or
            the delay is not between 0 and 0.5 s.
    """
    home = arm.read().joint_position
    if not 1 <= joint <= len(home):
        raise ValueError(f"joint must be one of 1 to {len(home)}, but is {joint}.")
    if not duration > 0:
        raise ValueError(f"duration must be positive, but is {duration}.")
    detector, turned = MarkerDetector([marker]), np.eye(len(home))[joint - 1]
    times, positions, taken, pixels, last = [], [], [], [], None
    try:
        for k in range(round(duration / _DT)):
            arm.command(turning_velocity(k * _DT, duration) * turned)
            advance(_DT)
            state = arm.read()
            times.append(state.time)
            positions.append(float(turned @ state.joint_position))
            image = camera.read()
            # Skip an image that was read before.
            if last is not None and np.array_equal(image, last):
                continue
            last, seen = image, detector.detect(image).get(marker)
            if seen is not None:
                age = camera.age if isinstance(camera, TimedCamera) else 0.0
                taken.append(state.time - age)
                pixels.append(centre(seen))
        for _ in range(round(_LONGEST_WAY_BACK / _DT)):
            velocity = _RETURN * turned * (home - arm.read().joint_position)
            if np.abs(velocity).max() < _RETURN * _BACK:
                break
            arm.command(velocity)
            advance(_DT)
    finally:
        arm.command(0 * home)
    if len(taken) < _FEWEST:
        raise CameraError(
            f"the camera saw marker {marker} in {len(taken)} different images, and at least "
            f"{_FEWEST} are needed: move the arm into the view, and light it."
        )
    shown = np.array(taken), np.array(pixels)
    return fit_delay(np.array(times), np.array(positions), *shown, _LONGEST)


def fit_delay(
    time: Float[np.ndarray, " readings"],
    position: Float[np.ndarray, " readings"],
    taken: Float[np.ndarray, " images"],
    pixel: Float[np.ndarray, "images 2"],
    longest: float,
) -> MeasuredDelay:
    """Fit the delay with which pixels follow a joint.

    Args:
        time: Times of the joint readings [s].
        position: Joint positions [rad].
        taken: Supposed time of exposure of each image [s].
        pixel: Position of the marker in each image [px].
        longest: Longest delay tried [s].

    Raises:
        CameraError: The pixels do not follow the joint, or the delay is not between 0 and
            `longest`.
    """
    # Skip images that may have been taken before the first joint reading.
    known = taken - longest >= time[0]
    taken, pixel = taken[known], pixel[known]
    delays = np.arange(-1, math.ceil(longest / _STEP) + 2) * _STEP  # and one beyond each end
    rest = np.array(
        [_rest(np.interp(taken - delay, time, position), pixel) for delay in delays]
    )
    k = int(rest.argmin())
    whole = ((pixel - pixel.mean(axis=0)) ** 2).sum()
    if not rest[k] < (1 - _EXPLAINED) * whole:
        raise CameraError(
            f"the marker does not follow the joint: {100 * (1 - rest[k] / whole):.0f} % of its "
            "motion in the image is explained. Does the camera stand still, and is the marker "
            "on the arm?"
        )
    if not 0 < k < len(delays) - 1:
        raise CameraError(
            f"the delay is not between 0 and {longest:g} s: search for a longer delay, or "
            "check that the times of arm and images come from the same clock."
        )
    # Minimum of a parabola through the smallest residual and its neighbours.
    bend = rest[k - 1] - 2 * rest[k] + rest[k + 1]
    between = 0.5 * (rest[k - 1] - rest[k + 1]) / bend
    variance = rest[k] / (2 * len(pixel) - 2 * (_POWERS + 1) - 1)
    return MeasuredDelay(
        delay=float(delays[k] + _STEP * between),
        # Least squares: the variance of a pixel divided by half the curvature.
        deviation=float(np.sqrt(2 * variance / bend) * _STEP),
        images=len(pixel),
    )


def _rest(
    position: Float[np.ndarray, " images"], pixel: Float[np.ndarray, "images 2"]
) -> float:
    """Sum of squared residuals of a polynomial fit from joint positions to pixels [px^2]."""
    powers = np.vander(position - position.mean(), _POWERS + 1)
    fitted, *_ = np.linalg.lstsq(powers, pixel, rcond=None)
    return float(((pixel - powers @ fitted) ** 2).sum())
