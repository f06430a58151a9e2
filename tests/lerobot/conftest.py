"""Pandas that every test leaves disconnected."""

import pytest

from hrc_learn.lerobot.panda_robot import robot_registry
from hrc_learn.lerobot.robots import MujocoPanda, MujocoPandaConfig


@pytest.fixture(autouse=True)
def nothing_left_connected():
    yield
    for robot in robot_registry():
        robot.disconnect()


@pytest.fixture
def simulated(tmp_path):
    """Makes connected robots of their settings."""

    def connected(**settings) -> MujocoPanda:
        robot = MujocoPanda(MujocoPandaConfig(calibration_dir=tmp_path, **settings))
        robot.connect()
        return robot

    return connected
