"""What LeRobot asks of robots and teleoperators alike."""

from __future__ import annotations

from abc import abstractmethod

from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError


class Device:
    """A device that has nothing to calibrate; to derive from before LeRobot's own class."""

    _connected = False

    @property
    def is_connected(self) -> bool:
        return self._connected

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    def connect(self, calibrate: bool = True) -> None:
        """Take hold of the device.

        Raises:
            DeviceAlreadyConnectedError: It is held already.
        """
        if self._connected:
            raise DeviceAlreadyConnectedError(f"{self} is connected already.")
        self._open()
        self._connected = True

    def disconnect(self) -> None:
        """Let it go.

        Raises:
            DeviceNotConnectedError: It is not held.
        """
        self._need_connection()
        self._connected = False
        self._close()

    def _need_connection(self) -> None:
        if not self._connected:
            raise DeviceNotConnectedError(f"{self} is not connected: call connect() first.")

    @abstractmethod
    def _open(self) -> None:
        """Take hold of it."""

    @abstractmethod
    def _close(self) -> None:
        """Let it go."""
