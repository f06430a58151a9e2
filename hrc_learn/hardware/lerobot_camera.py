"""Cameras of LeRobot's behind the protocol `Camera`."""

from __future__ import annotations

import time
from typing import Protocol, runtime_checkable

import numpy as np

from hrc_learn.hardware.opencv_cameras import RGB, CameraError, as_rgb, check_times
from hrc_learn.protocols import TimedCamera


@runtime_checkable
class ConnectedCamera(Protocol):
    """The methods used of LeRobot's cameras (`lerobot.cameras.Camera`, 0.6)."""

    @property
    def is_connected(self) -> bool: ...
    def connect(self, warmup: bool = True) -> None: ...
    def read_latest(self, max_age_ms: int = 500) -> np.ndarray: ...
    def disconnect(self) -> None: ...


class LeRobotCamera(TimedCamera):
    """A camera of LeRobot's: OpenCV, RealSense, ZMQ and others; its own thread reads it."""

    def __init__(
        self,
        camera: ConnectedCamera,
        *,
        size: tuple[int, int] | None = None,
        delay: float = 0.0,
        timeout: float = 1.0,
    ):
        """Wrap a camera, and connect to it unless it is connected.

        Args:
            camera: A `lerobot.cameras.Camera`.
            size: Required width and height of its images [px]; None: any.
            delay: Time between exposure and arrival of an image [s]; see `measure_delay`.
            timeout: Longest time without an image [s].

        Raises:
            CameraError: The camera cannot be connected.
            ValueError: The delay is negative, or the timeout is not positive.
        """
        check_times(delay, timeout)
        self._camera, self._name, self._size = camera, f"camera {camera}", size
        self._delay, self._timeout, self._age = delay, timeout, 0.0
        self._connected_here = not camera.is_connected
        if self._connected_here:
            try:
                camera.connect()
            except (OSError, RuntimeError, TimeoutError) as error:
                raise CameraError(
                    f"{self._name} cannot be connected: {error} (lerobot-find-cameras lists "
                    "those that there are)."
                ) from error

    @property
    def age(self) -> float:
        """Age of the newest image when it was read [s]."""
        return self._age

    def read(self) -> RGB:
        """Return the newest image, RGB.

        Raises:
            CameraError: None has come for the timeout, or not one that can be used.
        """
        # An image that comes in between counts as older than it is, by one at most; with the
        # stamp read last it would count as younger.
        arrived = self._stamp()
        try:
            image = self._camera.read_latest(max_age_ms=round(1e3 * self._timeout))
        except (OSError, RuntimeError, TimeoutError) as error:
            raise CameraError(
                f"{self._name} has no image of the last {self._timeout:g} s: {error} Check it, "
                "and connect again."
            ) from error
        since = 0.0 if arrived is None else max(time.perf_counter() - arrived, 0.0)
        self._age = since + self._delay
        # LeRobot gives either order of colours, by its camera's own setting.
        mode = str(getattr(self._camera, "color_mode", "rgb")).lower()
        return as_rgb(image, self._name, self._size, bgr=mode.endswith("bgr"))

    def close(self) -> None:
        """Disconnect from it, if it was connected here."""
        if self._connected_here:
            self._camera.disconnect()

    def _stamp(self) -> float | None:
        """Time at which the newest image arrived, on `time.perf_counter` [s]; None if not
        reported.
        """
        stamp = getattr(self._camera, "latest_timestamp", None)
        return stamp if isinstance(stamp, float) else None
