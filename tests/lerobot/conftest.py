"""Pandas that every test leaves disconnected."""

import pytest

from hrc_learn.lerobot.arm_robot import connected_robots
from hrc_learn.lerobot.mujoco_arm import MujocoArmRobot, MujocoArmRobotConfig


@pytest.fixture(autouse=True)
def nothing_left_connected():
    yield
    for robot in list(connected_robots):
        robot.disconnect()


@pytest.fixture
def simulated(tmp_path):
    """Makes connected robots of their settings."""

    def connected(**settings) -> MujocoArmRobot:
        robot = MujocoArmRobot(MujocoArmRobotConfig(calibration_dir=tmp_path, **settings))
        robot.connect()
        return robot

    return connected
