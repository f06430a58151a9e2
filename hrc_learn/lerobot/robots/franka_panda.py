"""The real Panda as a LeRobot robot. NOT RUN ON HARDWARE: tested with a fake driver only."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from lerobot.cameras import make_cameras_from_configs

from hrc_learn.controller import SafetyConfig, Watchdog
from hrc_learn.geometry import Pose
from hrc_learn.hardware.franky_arm import FrankyArm
from hrc_learn.kinematics import panda
from hrc_learn.lerobot.robots.config_franka_panda import FrankaPandaConfig
from hrc_learn.lerobot.robots.panda_robot import PandaRobot
from hrc_learn.protocols import Arm

if TYPE_CHECKING:
    from hrc_learn.skills.arm_motion import PositionServo


class FrankaPanda(PandaRobot):
    """A Franka Panda led by positions, through its velocity interface.

    NOT RUN ON HARDWARE. Between an action and the arm stand, in this order: the limits of the
    joints' motion (`ActionChunkFilter`), the safety filter with a cap on the speed of the tool,
    a watchdog that stops the arm when the loop falls silent, and the driver, which ends every
    velocity by itself. Keep the stop button in hand.

    Attributes:
        watchdog: While connected; counts its trips.
    """

    config_class = FrankaPandaConfig
    name = "franka_panda"
    watchdog: Watchdog

    def __init__(self, config: FrankaPandaConfig):
        super().__init__(
            config, config.action_space, velocity=config.velocity, hand=config.hand
        )
        self.config = config
        self.dt = 1.0 / config.fps
        self.cameras = make_cameras_from_configs(config.cameras)
        self._arm: FrankyArm
        self._servo: PositionServo

    @property
    def observation_features(self) -> dict[str, Any]:
        shapes = {
            name: (camera.height, camera.width, 3)
            for name, camera in self.config.cameras.items()
        }
        return super().observation_features | shapes

    @property
    def arm(self) -> Arm:
        return self._arm

    def _open(self) -> None:
        from hrc_learn.skills.arm_motion import PositionServo, PositionServoConfig

        config = self.config
        self._arm = FrankyArm(
            config.ip,
            dynamics=config.dynamics,
            timeout=config.timeout,
            grip_force=config.grip_force,
            grip_speed=config.grip_speed,
        )
        safety = SafetyConfig(tcp_speed=config.tcp_speed)
        self._servo = PositionServo(
            panda, self._arm, self.dt, PositionServoConfig(safety=safety)
        )
        for camera in self.cameras.values():
            camera.connect()
        self.watchdog = Watchdog(config.timeout, self._arm.stop)
        self.watchdog.__enter__()

    def _close(self) -> None:
        self.watchdog.__exit__(None, None, None)
        self._arm.stop()
        for camera in self.cameras.values():
            camera.disconnect()

    def get_observation(self) -> dict[str, Any]:
        values = super().get_observation()
        for name, camera in self.cameras.items():
            values[name] = camera.read_latest()
        return values

    def _joints_at(self, pose: Pose) -> Float[np.ndarray, "7"]:
        return self._servo.joints_at(pose)

    def _command(self, joints: Float[np.ndarray, "7"], width: float) -> Float[np.ndarray, "7"]:
        if self.watchdog.tripped:
            self._servo.restart()  # the arm is at rest, which the servo does not know
        with torch.inference_mode():
            _, sent = self._servo.follow(joints)
        if np.isfinite(width):
            self._arm.move(width)
        self.watchdog.feed()
        return sent
