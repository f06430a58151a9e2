"""Real cameras behind the protocol `Camera`: devices, streams and files that OpenCV opens.

Neither lens nor camera pose has to be known. Each image carries its time, from which the
controller finds the arm's position at exposure.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from jaxtyping import UInt8

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


class VideoEndedError(CameraError):
    """A video file has no further image."""


def open_camera(
    source: int | str | Path,
    *,
    size: tuple[int, int] | None = None,
    delay: float = 0.0,
    timeout: float = 1.0,
) -> CaptureCamera | VideoFile:
    """Open a camera, a stream or a video file.

    Args:
        source: Number of a device ("0" too), path of one (/dev/video0), URL of a stream
            (rtsp://..., http://...), or path of a video file, which plays at its own rate.
        size: Requested width and height of the images [px]; None: the device's own.
        delay: Time between exposure and arrival of an image [s], in addition to what the
            backend reports; see `measure_delay`.
        timeout: Longest time without an image [s].

    Raises:
        FileNotFoundError: There is no such file.
        CameraError: The source cannot be opened, or sends no image of this size.
    """
    name = str(source)
    if name.isdecimal() or "://" in name or name.startswith("/dev/"):
        return CaptureCamera(source, size=size, delay=delay, timeout=timeout)
    return VideoFile(name, size=size)


class CaptureCamera(TimedCamera):
    """A camera or stream that OpenCV opens; a thread reads it and keeps only the newest image.

    The backend buffers several images, so a reader slower than the camera would receive ever
    older ones.
    """

    def __init__(
        self,
        source: int | str | Path,
        *,
        size: tuple[int, int] | None = None,
        delay: float = 0.0,
        timeout: float = 1.0,
    ):
        """Open it, and wait for the first image; for the arguments see `open_camera`.

        Raises:
            CameraError: It cannot be opened, or sends no image of this size.
            ValueError: The delay is negative, or the timeout is not positive.
        """
        if not delay >= 0:
            raise ValueError(f"delay must not be negative, but is {delay} s.")
        if not timeout > 0:
            raise ValueError(f"timeout must be positive, but is {timeout} s.")
        name = str(source)
        self._name, self._size, self._delay = f"camera {name}", size, delay
        self._timeout, self._age = timeout, 0.0
        self._capture = _opened(int(name) if name.isdecimal() else name, self._name, timeout)
        if size is not None:
            import cv2

            self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
            self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
        self._arrived = threading.Condition()
        # Time at which it was taken as far as is known [s], and the image, BGR.
        self._newest: tuple[float, np.ndarray] | None = None
        self._failure, self._closing = "", False
        self._thread = threading.Thread(target=self._keep_newest, name=self._name, daemon=True)
        self._thread.start()
        try:
            self._wait_for(timeout + _FIRST_IMAGE)
            self.read()
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
            newest, failure = self._newest, self._failure
        if newest is None:
            raise CameraError(failure or f"{self._name} is closed: open it again.")
        since = max(time.monotonic() - newest[0], 0.0)
        if since > self._timeout:
            raise CameraError(failure or _silent(self._name, since, self._timeout))
        self._age = since + self._delay
        return _as_rgb(newest[1], self._name, self._size)

    def close(self) -> None:
        """Give the camera back."""
        self._closing = True
        self._thread.join(_CLOSING)
        # Of a backend that still waits for an image nothing may be taken away.
        if not self._thread.is_alive():
            self._capture.release()
        with self._arrived:
            self._newest = None

    def __enter__(self) -> CaptureCamera:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _wait_for(self, longest: float) -> None:
        """Wait for the first image, so long at most [s]."""
        with self._arrived:
            self._arrived.wait_for(lambda: self._newest or self._failure, longest)
            if self._newest is None:
                raise CameraError(self._failure or _silent(self._name, longest, self._timeout))

    def _keep_newest(self) -> None:
        """Read images until closed, in the thread."""
        while not self._closing:
            if not self._capture.grab():
                self._fail(
                    f"{self._name} has ended or does not answer: see that it is plugged in, or "
                    "that its server runs, and open it again."
                )
                return
            now = time.monotonic()
            taken = taken_by(self._capture, now, self._timeout)
            whole, image = self._capture.retrieve()
            if whole:
                with self._arrived:
                    self._newest = taken, image
                    self._arrived.notify_all()

    def _fail(self, why: str) -> None:
        with self._arrived:
            self._failure = why
            self._arrived.notify_all()


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


class VideoFile(TimedCamera):
    """A video file as a camera; it begins with the first reading."""

    def __init__(
        self,
        path: str | Path,
        *,
        size: tuple[int, int] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Open it.

        Args:
            path: Of the file.
            size: Width and height that its images should have [px]; None: any.
            clock: Tells the time [s].

        Raises:
            FileNotFoundError: There is none.
            CameraError: It is no video that OpenCV reads.
        """
        if not Path(path).is_file():
            raise FileNotFoundError(f"no video file {path}: give a path, a number or a URL.")
        self._name, self._size = f"video {path}", size
        self._clock, self._begun, self._age = clock, float("nan"), 0.0
        self._capture = _opened(str(path), self._name, _FIRST_IMAGE)
        self._number, self._ahead = 0, float("inf")
        self._image: np.ndarray | None = None
        self._shown, self._interval = 0.0, 0.0
        self._look_ahead()

    @property
    def age(self) -> float:
        """Time by which the newest image was overdue when it was read [s]."""
        return self._age

    @property
    def number(self) -> int:
        """Number of images read or skipped."""
        return self._number

    def read(self) -> RGB:
        """Return the image that is due, RGB.

        Raises:
            VideoEndedError: The file has ended.
            CameraError: The image is not one that can be used.
        """
        now = self._clock()
        if self._image is None:
            self._begun = now - self._ahead
            self._step()
        passed = now - self._begun
        while self._ahead <= passed:
            self._step()
        # The last image stands as long as the one before it did.
        if self._ahead == float("inf") and passed >= self._shown + self._interval:
            raise self._ended()
        self._age = passed - self._shown
        return self._rgb()

    def close(self) -> None:
        """Close the file."""
        self._capture.release()

    def _step(self) -> None:
        if self._ahead == float("inf"):
            raise self._ended()
        whole, self._image = self._capture.retrieve()
        if not whole:
            raise CameraError(f"{self._name} cannot be decoded after {self._shown:.2f} s.")
        self._interval, self._shown = self._ahead - self._shown, self._ahead
        self._number += 1
        self._look_ahead()

    def _look_ahead(self) -> None:
        import cv2

        more = self._capture.grab()
        self._ahead = 1e-3 * self._capture.get(cv2.CAP_PROP_POS_MSEC) if more else float("inf")

    def _ended(self) -> VideoEndedError:
        return VideoEndedError(
            f"{self._name} has ended after {self._number} images, at {self._shown:.2f} s."
        )

    def _rgb(self) -> RGB:
        assert self._image is not None  # a step has been made
        return _as_rgb(self._image, self._name, self._size)


def _opened(source: int | str, name: str, timeout: float) -> Any:
    """A capture of OpenCV's that is open.

    Raises:
        CameraError: It cannot be opened.
    """
    try:
        import cv2
    except ImportError as error:
        raise ImportError(
            f"{name} needs OpenCV: pip install opencv-python-headless, or hrc-learn[hardware]."
        ) from error
    if isinstance(source, str) and "://" in source:
        longest = round(1e3 * (timeout + _FIRST_IMAGE))
        capture = cv2.VideoCapture(
            source,
            cv2.CAP_FFMPEG,
            [
                cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
                longest,
                cv2.CAP_PROP_READ_TIMEOUT_MSEC,
                round(1e3 * timeout),
            ],
        )
        hint = "is its server running, and can this machine reach it?"
    elif isinstance(source, int) or source.startswith("/dev/"):
        capture = cv2.VideoCapture(source)
        device = f"/dev/video{source}" if isinstance(source, int) else source
        hint = (
            "is it plugged in (ls /dev/video*), does another program use it, and may this "
            f"user read {device} (group video)?"
        )
    else:
        capture, hint = cv2.VideoCapture(source), "is it a video, and whole?"
    if not capture.isOpened():
        raise CameraError(f"{name} cannot be opened: {hint}")
    return capture


def _silent(name: str, passed: float, timeout: float) -> str:
    return (
        f"{name} has sent no image for {passed:.1f} s (timeout: {timeout:g} s): check its "
        "cable, its light and its rate."
    )


def _as_rgb(image: np.ndarray, name: str, size: tuple[int, int] | None) -> RGB:
    """RGB image of a BGR one.

    Raises:
        CameraError: It is no colour image of 8 bits, or not of the size.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise CameraError(
            f"{name} sends images of shape {image.shape} and type {image.dtype}, and not of "
            "(height, width, 3) and uint8: choose one of its colour streams."
        )
    height, width, _ = image.shape
    if size is not None and (width, height) != size:
        raise CameraError(
            f"{name} sends images of {width} x {height} pixels instead of {size[0]} x "
            f"{size[1]}: ask for a size that it has."
        )
    return np.ascontiguousarray(image[..., ::-1])
