"""Which of our robots are connected in this process.

LeRobot tells a teleoperator nothing of the robot it leads. One that leads the hand, rather than
copying joints of its own, needs to know where the arm is.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lerobot.utils.errors import DeviceNotConnectedError

if TYPE_CHECKING:
    from .robots.panda_robot import PandaRobot

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
