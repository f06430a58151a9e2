"""What LeRobot asks of robots and teleoperators alike, and which of our robots are
connected.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING

from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

if TYPE_CHECKING:
    from hrc_learn.lerobot.robots.panda_robot import PandaRobot

# What LeRobot asks of robots and teleoperators alike.


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


# Which of our robots are connected in this process.
#
# LeRobot tells a teleoperator nothing of the robot it leads. One that leads the hand, rather
# than
# copying joints of its own, needs to know where the arm is.

CONNECTED: list[PandaRobot] = []
"""In the order they were connected in."""


def connected_robot(id: str | None) -> PandaRobot:
    """The robot that is connected under a name, or the only one.

    Raises:
        DeviceNotConnectedError: There is none, or several and no name is given.
    """
    found = [robot for robot in CONNECTED if id in (None, robot.id)]
    if len(found) == 1:
        return found[0]
    names = ", ".join(repr(robot.id) for robot in CONNECTED) or "none"
    wanted = "a robot of hrc_learn" if id is None else f"one robot with id {id!r}"
    raise DeviceNotConnectedError(
        f"this teleoperator leads {wanted} (mujoco_panda or franka_panda); connected: {names}. "
        "Give --teleop.robot_id where there are several."
    )
