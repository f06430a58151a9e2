"""Real cameras behind the protocol `Camera`: devices, streams and files that OpenCV opens.

Neither lens nor camera pose has to be known. Each image carries its time, from which the
controller finds the arm's position at exposure.
"""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from hrc_learn.hardware.driver_process import Connected
from hrc_learn.protocols import TimedCamera

type RGB = UInt8[np.ndarray, "height width 3"]
"""An image."""

_FIRST_IMAGE = 5.0
"""Additional time allowed for the first image [s]: cameras adjust their exposure, and streams
send complete pictures only now and then.
"""
_CLOSING = 2.0
"""Longest wait for the reading thread on closing [s]."""


class CameraError(RuntimeError):
    """A camera cannot be opened, or sends no images or none that can be used."""


class CaptureCamera(Connected, TimedCamera):
    """A camera, stream or video file; a thread reads it and keeps only the newest image.

    The backend buffers several images, so a reader slower than the camera would receive ever
    older ones. A file plays at its own rate from the first reading on.
    """

    def __init__(
        self,
        source: int | str | Path,
        *,
        delay: float = 0.0,
        timeout: float = 1.0,
    ):
        """Open it, and wait for the first image.

        Args:
            source: Number of a device ("0" too), path of one (/dev/video0), URL of a stream
                (rtsp://..., http://...), or path of a video file.
            delay: Time between exposure and arrival of an image [s], in addition to what the
                backend reports; see `measure_delay`.
            timeout: Longest time without an image [s].

        Raises:
            FileNotFoundError: There is no such file.
            CameraError: It cannot be opened, or sends no image.
            ValueError: The delay is negative, or the timeout is not positive.
        """
        if not delay >= 0:
            raise ValueError(f"delay must not be negative, but is {delay} s.")
        if not timeout > 0:
            raise ValueError(f"timeout must be positive, but is {timeout} s.")
        name = str(source)
        device = name.isdecimal() or name.startswith("/dev/")
        self._is_file = not device and "://" not in name
        self._name = f"video {name}" if self._is_file else f"camera {name}"
        self._delay, self._timeout, self._age = delay, timeout, 0.0
        self._capture = _opened(name, self._name, timeout)
        self._arrived = threading.Condition()
        # Time at which it was taken as far as is known [s], and the image, BGR. Times of a file
        # count from its first reading.
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
        """Age of the newest image when it was read [s]."""
        return self._age

    def read(self) -> RGB:
        """Return the newest image, RGB.

        Raises:
            CameraError: None has come for the timeout, or not one that can be used.
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
        """Give the camera back."""
        with self._arrived:
            self._closing = True
            self._arrived.notify_all()
        self._thread.join(_CLOSING)
        # Of a backend that still waits for an image nothing may be taken away.
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
            self._arrived.wait_for(
                lambda: self._closing, max(0.0, begun + position - time.monotonic())
            )


def taken_by(capture: Any, now: float, oldest: float) -> float:
    """Time at which the image just grabbed was taken, on `time.monotonic` [s].

    Linux drivers stamp their buffers with that clock, and OpenCV reports the stamp as the
    position of the video (CAP_PROP_POS_MSEC, backend V4L2). A position that is not shortly
    before now is a time since the start of the stream, or nothing; then the time of arrival
    counts.

    Args:
        capture: OpenCV's capture.
        now: Time of the grab [s].
        oldest: Age beyond which the position cannot be the image's time [s].
    """
    import cv2

    stamp = 1e-3 * capture.get(cv2.CAP_PROP_POS_MSEC)
    return stamp if 0 <= now - stamp < oldest else now


def _opened(source: str, name: str, timeout: float) -> Any:
    """A capture of OpenCV's that is open."""
    try:
        import cv2
    except ImportError as error:
        raise ImportError(
            f"{name} needs OpenCV: pip install opencv-python-headless, or hrc-learn[hardware]."
        ) from error
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
        capture, hint = cv2.VideoCapture(source), "is it a video, and whole?"
    if not capture.isOpened():
        raise CameraError(f"{name} cannot be opened: {hint}")
    return capture


def _as_rgb(image: np.ndarray, name: str) -> RGB:
    """RGB image of a BGR one.

    Raises:
        CameraError: It is no colour image of 8 bits.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise CameraError(
            f"{name} sends images of shape {image.shape} and type {image.dtype}, and not of "
            "(height, width, 3) and uint8: choose one of its colour streams."
        )
    return np.ascontiguousarray(image[..., ::-1])
