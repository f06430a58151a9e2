"""LeRobot's real Panda, connected by its driver to a simulated arm behind the protocol."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from franky_servers import READY
from lerobot.robots import make_robot_from_config

from hrc_learn.hardware.protocol_server import ArmServer, serve_world
from hrc_learn.lerobot.driven_arms import FrankaPanda, FrankaPandaConfig
from hrc_learn.protocols import ArmState
from hrc_learn.sim import SceneConfig, World


@dataclass
class ServedFranka:
    """The robot, and the server of its arm: time passes by actions only."""

    robot: FrankaPanda
    server: ArmServer
    world: World

    def drive(self, action: dict, steps: int) -> np.ndarray:
        """Send an action again and again; joint velocities of the arm at each one's end."""
        velocities = []
        for _ in range(steps):
            with self.server.running():
                self.robot.send_action(action)
            self.server.advance(1 / self.robot.config.fps)
            velocities.append(self.read().joint_velocity)
        return np.array(velocities)

    def read(self) -> ArmState:
        """Return the newest state."""
        with self.server.running():
            return self.robot.arm.read()


@contextmanager
def served_franka(folder: Path, joints=READY, **settings) -> Iterator[ServedFranka]:
    """A connected robot whose watchdog tolerates minutes of silence.

    Args:
        folder: For LeRobot's calibration.
        joints: Where the arm is [rad].
        settings: Other ones of the robot.
    """
    if find_spec("franky") is None:
        pytest.skip("franky comes with the extra hardware")
    world = World(SceneConfig(objects=()))
    world.reset(joints)
    settings = {"fps": 20.0, "timeout": 600.0} | settings
    with serve_world(world) as server:
        config = FrankaPandaConfig(
            calibration_dir=folder, ip=server.address, realtime=False, **settings
        )
        robot = make_robot_from_config(config)
        assert isinstance(robot, FrankaPanda)
        with server.running():
            robot.connect()
        server.begin()
        try:
            yield ServedFranka(robot=robot, server=server, world=world)
        finally:
            if robot.is_connected:
                with server.running():
                    robot.disconnect()
