"""What LeRobot asks of robots and teleoperators alike, and how they find each other."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from functools import cache
from typing import TYPE_CHECKING

from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

if TYPE_CHECKING:
    from hrc_learn.lerobot.robots.panda_robot import PandaRobot


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


class RobotRegistry:
    """The connected robots among which a teleoperator finds the one that it guides.

    LeRobot gives a teleoperator no reference to the robot. One that guides the end effector,
    rather than copying joints of its own, needs to know where the arm is.
    """

    def __init__(self) -> None:
        self._robots: list[PandaRobot] = []

    def __iter__(self) -> Iterator[PandaRobot]:
        """In the order in which they were connected."""
        return iter(tuple(self._robots))

    def add(self, robot: PandaRobot) -> None:
        """Note a robot that has been connected."""
        self._robots.append(robot)

    def remove(self, robot: PandaRobot) -> None:
        """Forget a robot that has been disconnected."""
        self._robots.remove(robot)

    def find(self, id: str | None) -> PandaRobot:
        """The robot with a name, or the only one.

        Raises:
            DeviceNotConnectedError: There is none, or several and no name is given.
        """
        found = [robot for robot in self._robots if id in (None, robot.id)]
        if len(found) == 1:
            return found[0]
        names = ", ".join(repr(robot.id) for robot in self._robots) or "none"
        wanted = "a robot of hrc_learn" if id is None else f"one robot with id {id!r}"
        raise DeviceNotConnectedError(
            f"this teleoperator guides {wanted} (mujoco_panda or franka_panda); connected: "
            f"{names}. Give --teleop.robot_id where there are several."
        )


@cache
def robot_registry() -> RobotRegistry:
    """The registry of this process, which robots and teleoperators share."""
    return RobotRegistry()
