"""Pandas that every test leaves disconnected."""

import pytest

from hrc_learn.lerobot.arm_robot import robot_registry
from hrc_learn.lerobot.robots import MujocoArmRobot, MujocoArmRobotConfig


@pytest.fixture(autouse=True)
def nothing_left_connected():
    yield
    for robot in robot_registry():
        robot.disconnect()


@pytest.fixture
def simulated(tmp_path):
    """Makes connected robots of their settings."""

    def connected(**settings) -> MujocoArmRobot:
        robot = MujocoArmRobot(MujocoArmRobotConfig(calibration_dir=tmp_path, **settings))
        robot.connect()
        return robot

    return connected
