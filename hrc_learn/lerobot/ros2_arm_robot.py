"""An arm over topics of ROS 2 as a LeRobot robot, and cameras of image topics.

Run over real middleware against our simulated arm; NOT RUN ON HARDWARE.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from lerobot.cameras import Camera, CameraConfig
from lerobot.robots import RobotConfig

from hrc_learn.hardware import Ros2Arm, Ros2Config
from hrc_learn.hardware.driver_process import StoppableArm
from hrc_learn.hardware.ros2_topics import Ros2Session, found_description, quality
from hrc_learn.kinematics import ArmChoice
from hrc_learn.lerobot.franka_panda import DrivenArm, DrivenArmConfig


@RobotConfig.register_subclass("ros2")
@dataclass(kw_only=True)
class Ros2ArmRobotConfig(DrivenArmConfig):
    """An arm with the topics of stock controllers; `--robot.type=ros2`."""

    arm: str = "/robot_description"
    """Topic of the arm's description, registered name, or FILE:TIP."""
    topics: Ros2Config = field(default_factory=Ros2Config)
    """Topics of the arm."""


class Ros2ArmRobot(DrivenArm):
    """An arm of ros2_control for LeRobot's own commands."""

    config_class = Ros2ArmRobotConfig
    name = "ros2"
    config: Ros2ArmRobotConfig

    def __init__(self, config: Ros2ArmRobotConfig):
        super().__init__(config, ArmChoice(found_description(config.arm)).arm())

    def _driver(self) -> Callable[[], StoppableArm]:
        return partial(Ros2Arm, self.work_arm.chain, self.config.topics)


@CameraConfig.register_subclass("ros2")
@dataclass(kw_only=True)
class Ros2CameraConfig(CameraConfig):
    """Images of a topic; give width and height as it publishes them."""

    topic: str
    """Topic of raw or, if it ends in /compressed, of compressed images."""
    fps: int | None = 30
    """Rate at which the topic publishes [1/s]."""
    timeout: float = 2.0
    """Longest wait for an image [s]."""

    def __post_init__(self) -> None:
        if not (self.width and self.height):
            raise ValueError(f"camera {self.topic}: give width and height of its images.")


class Ros2Camera(Camera):
    """A camera of an image topic."""

    def __init__(self, config: Ros2CameraConfig):
        super().__init__(config)
        self.config, self._session = config, None
        self._image: np.ndarray | None = None
        self._taken_at, self._came = 0.0, threading.Condition()

    @property
    def is_connected(self) -> bool:
        return self._session is not None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        return []

    def connect(self, warmup: bool = True) -> None:
        """Wait for the first image.

        Raises:
            ConnectionError: None comes, or of another size.
        """
        from sensor_msgs.msg import CompressedImage, Image

        topic = self.config.topic
        kind = CompressedImage if topic.endswith("/compressed") else Image
        self._session = Ros2Session("hrc_camera")
        self._session.node.create_subscription(kind, topic, self._take, quality())
        shape, wanted = self.read().shape[:2], (self.height, self.width)
        if shape != wanted:
            self.disconnect()
            text = f"camera {topic} publishes {shape[1]}x{shape[0]}"
            raise ConnectionError(f"{text}, not {self.width}x{self.height}: say so.")

    def _take(self, message: Any) -> None:
        from hrc_learn.demos.recording_messages import image_of

        image = image_of(message)
        with self._came:
            self._image, self._taken_at = image, time.monotonic()
            self._came.notify_all()

    def read(self) -> np.ndarray:
        """The next image, RGB.

        Raises:
            ConnectionError: None has come within the timeout.
        """
        return self.async_read(1e3 * self.config.timeout)

    def async_read(self, timeout_ms: float = 200) -> np.ndarray:
        since = time.monotonic()
        with self._came:
            if not self._came.wait_for(lambda: self._taken_at > since, timeout_ms / 1e3):
                text = f"no image on {self.config.topic} for {timeout_ms / 1e3:g} s"
                raise ConnectionError(f"{text}: is the camera's driver running?")
            assert self._image is not None
            return self._image

    def read_latest(self, max_age_ms: int = 500) -> np.ndarray:
        """The newest image, RGB.

        Raises:
            ConnectionError: It is older than the given age [ms].
        """
        age = time.monotonic() - self._taken_at
        if self._image is None or age > max_age_ms / 1e3:
            raise ConnectionError(
                f"the newest image on {self.config.topic} is {age:.2f} s old."
            )
        return self._image

    def disconnect(self) -> None:
        if self._session is not None:
            self._session.close()
            self._session = None
