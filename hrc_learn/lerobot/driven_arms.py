"""Real arms as LeRobot robots: a Panda at its control box, and an arm over topics of ROS 2.

Tested with simulators of the Panda's network protocol and, over real ROS 2 middleware, with our
simulated arm; NOT RUN ON HARDWARE.
"""

from __future__ import annotations

import threading
import time
from abc import abstractmethod
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from lerobot.cameras import Camera, CameraConfig, make_cameras_from_configs
from lerobot.robots import RobotConfig
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

from hrc_learn.controller import SafetyConfig
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.hardware import ArmProcess, FrankyArm, FrankyConfig, Ros2Arm, Ros2Config
from hrc_learn.hardware.driver_process import StoppableArm
from hrc_learn.hardware.ros2_topics import Ros2Session, found_description, quality
from hrc_learn.kinematics import Arm as ArmModel
from hrc_learn.kinematics import ArmChoice, panda
from hrc_learn.lerobot.arm_robot import ArmRobot, ArmRobotConfig

if TYPE_CHECKING:
    from hrc_learn.skills.arm_motion import PositionServo


# Time from reading the joints until the arm follows [s], as in `Imperfections.nominal()`. With
# franky and simulators, a command took 2 ms to reach the servos. The rest allows for the
# network, the scheduling and the computation of a step, which the simulators do not include.
_DELAY = 0.030


@dataclass(kw_only=True)
class DrivenArmConfig(ArmRobotConfig):
    """Settings common to real arms."""

    tcp_speed: float = 0.25
    """Cap on the speed of the tool centre point [m/s] (ISO 10218: reduced speed)."""
    cameras: dict[str, CameraConfig] = field(default_factory=dict)
    """Cameras of LeRobot, by name."""
    dynamics: float = 0.3
    """Fraction of the arm's acceleration limits that is used."""
    timeout: float = 0.15
    """Longest time without an action, after which the arm is stopped [s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_settings(self, positive=["tcp_speed"], fraction=["dynamics"])
        if not 5 <= self.fps <= 1000:
            raise ValueError(f"fps must be from 5 to 1000, but is {self.fps}.")
        if self.person.kind == "scripted":
            raise ValueError("person.kind: scripts push simulated arms only, not real ones.")
        if self.person.worker:
            raise ValueError("person.worker: workers are simulated near simulated arms only.")
        if not self.timeout > 1.5 / self.fps:
            raise ValueError(
                f"timeout must be longer than an action and a half at {self.fps:g} fps, but is "
                f"{self.timeout} s."
            )


class DrivenArm(ArmRobot):
    """An arm commanded by positions, through a driver that accepts velocities.

    An action passes four stages on its way to the arm. `MotionFilter` keeps the limits of the
    joints' motion. The safety filter caps the speed of the tool. A watchdog, in a separate
    process together with the driver, stops the arm if the loop sends nothing. The driver stops
    the arm if it receives no new velocity in time. Keep the stop button in hand.

    Attributes:
        arm: The driver's process, while connected.
    """

    config: DrivenArmConfig

    def __init__(self, config: DrivenArmConfig, work_arm: ArmModel):
        super().__init__(config, work_arm)
        self.config = config
        self.cameras = make_cameras_from_configs(config.cameras)
        self._arm: ArmProcess
        self._servo: PositionServo
        self._trips = 0

    @property
    def observation_features(self) -> dict[str, Any]:
        shapes = {
            name: (camera.height, camera.width, 3)
            for name, camera in self.config.cameras.items()
        }
        return super().observation_features | shapes

    @property
    def arm(self) -> ArmProcess:
        return self._arm

    @property
    def servo(self) -> PositionServo:
        return self._servo

    @abstractmethod
    def _driver(self) -> Callable[[], StoppableArm]:
        """Function that connects to the arm; the driver's process calls it."""

    def _open(self) -> None:
        from hrc_learn.skills.arm_motion import PositionServo, PositionServoConfig

        config = self.config
        safety = SafetyConfig(tcp_speed=config.tcp_speed, braking=config.dynamics, delay=_DELAY)
        with ExitStack() as devices:
            for camera in self.cameras.values():
                camera.connect()
                devices.callback(camera.disconnect)
            process = ArmProcess(self._driver(), timeout=config.timeout)
            self._arm = devices.enter_context(process)
            self._trips = self._arm.trips
            self._servo = PositionServo(
                self.work_arm.chain, self._arm, self.dt, PositionServoConfig(safety=safety)
            )
            self._devices = devices.pop_all()

    def _close(self) -> None:
        self._devices.close()

    def get_observation(self) -> dict[str, Any]:
        values = super().get_observation()
        for name, camera in self.cameras.items():
            values[name] = camera.read_latest()
        return values

    def _command(
        self, joints: Float[np.ndarray, " joints"], width: float
    ) -> Float[np.ndarray, " joints"]:
        # The answer reports whether the arm was stopped while the policy computed the action.
        self._arm.feed()
        if self._arm.trips != self._trips:
            self._trips = self._arm.trips
            self._servo.restart()  # the arm is at rest, which the servo does not know
        with torch.inference_mode():
            _, sent = self._servo.follow(joints)
        if np.isfinite(width):
            self._arm.move(width)
        return sent


@RobotConfig.register_subclass("franka_panda")
@dataclass(kw_only=True)
class FrankaPandaConfig(FrankyConfig, DrivenArmConfig):
    """A Franka Panda at its control box; `--robot.type=franka_panda`."""

    ip: str
    """Address of the control box."""

    def __post_init__(self) -> None:
        DrivenArmConfig.__post_init__(self)
        FrankyConfig.__post_init__(self)

    def driver(self) -> FrankyConfig:
        """Settings of the driver alone, which the driver's process can read without LeRobot."""
        return FrankyConfig(**{f.name: getattr(self, f.name) for f in fields(FrankyConfig)})


class FrankaPanda(DrivenArm):
    """A Franka Panda through its velocity interface; NOT RUN ON HARDWARE."""

    config_class = FrankaPandaConfig
    name = "franka_panda"
    config: FrankaPandaConfig

    def __init__(self, config: FrankaPandaConfig):
        super().__init__(config, panda)

    def _driver(self) -> Callable[[], StoppableArm]:
        return partial(FrankyArm, self.config.ip, self.config.driver())


@RobotConfig.register_subclass("ros2")
@dataclass(kw_only=True)
class Ros2ArmRobotConfig(DrivenArmConfig):
    """An arm with the topics of stock controllers; `--robot.type=ros2`."""

    arm: str = "/robot_description"
    """Topic of the arm's description, registered name of the arm, or FILE:TIP."""
    topics: Ros2Config = field(default_factory=Ros2Config)
    """Topics of the arm."""


class Ros2ArmRobot(DrivenArm):
    """An arm controlled by ros2_control, for LeRobot's own commands."""

    config_class = Ros2ArmRobotConfig
    name = "ros2"
    config: Ros2ArmRobotConfig

    def __init__(self, config: Ros2ArmRobotConfig):
        super().__init__(config, ArmChoice(found_description(config.arm)).arm())

    def _driver(self) -> Callable[[], StoppableArm]:
        # A velocity must last until the next action, also at a low rate.
        topics, least = self.config.topics, 1.5 * self.dt
        topics = replace(topics, timeout=max(topics.timeout, least))
        return partial(Ros2Arm, self.work_arm.chain, topics)


@CameraConfig.register_subclass("ros2")
@dataclass(kw_only=True)
class Ros2CameraConfig(CameraConfig):
    """Camera of an image topic; width and height must be those of the published images."""

    topic: str
    """Topic of raw images, or of compressed images if its name ends in /compressed."""
    fps: int | None = 30
    """Rate at which the topic publishes [1/s]."""
    timeout: float = 2.0
    """Longest wait for an image [s]."""

    def __post_init__(self) -> None:
        if not (self.width and self.height):
            raise ValueError(f"camera {self.topic}: give width and height of its images.")


class Ros2Camera(Camera):
    """Camera that reads an image topic."""

    def __init__(self, config: Ros2CameraConfig):
        super().__init__(config)
        self.config, self._session = config, None
        self._image: np.ndarray | None = None
        self._taken_at, self._came, self._refused = 0.0, threading.Condition(), ""

    @property
    def is_connected(self) -> bool:
        return self._session is not None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        return []

    @check_if_already_connected
    def connect(self, warmup: bool = True) -> None:
        """Wait for the first image.

        Raises:
            ConnectionError: No usable image comes, or its size is not the configured one.
        """
        from sensor_msgs.msg import CompressedImage, Image

        topic = self.config.topic
        kind = CompressedImage if topic.endswith("/compressed") else Image
        self._session = Ros2Session("hrc_camera")
        self._session.node.create_subscription(kind, topic, self._take, quality())
        try:
            height, width = self.read().shape[:2]
            if (height, width) != (self.height, self.width):
                text = f"camera {topic} publishes {width}x{height}"
                raise ConnectionError(f"{text}, not {self.width}x{self.height}: set that size.")
        except BaseException:
            self.disconnect()
            raise

    def _take(self, message: Any) -> None:
        from hrc_learn.demos.recording_messages import image_of

        try:
            image = image_of(message)
        except ValueError as error:  # the error would end the thread of the session
            self._refused = f" ({error})"
            return
        with self._came:
            self._image, self._taken_at, self._refused = image, time.monotonic(), ""
            self._came.notify_all()

    def read(self) -> np.ndarray:
        """The next image, RGB.

        Raises:
            ConnectionError: No image has come within the timeout.
        """
        return self.async_read(1e3 * self.config.timeout)

    @check_if_not_connected
    def async_read(self, timeout_ms: float = 200) -> np.ndarray:
        since = time.monotonic()
        with self._came:
            if not self._came.wait_for(lambda: self._taken_at > since, timeout_ms / 1e3):
                text = f"no image on {self.config.topic} for {timeout_ms / 1e3:g} s"
                text += self._refused
                raise ConnectionError(f"{text}: is the camera's driver running?")
            assert self._image is not None
            return self._image

    def read_latest(self, max_age_ms: int = 500) -> np.ndarray:
        """The newest image, RGB.

        Raises:
            ConnectionError: The newest image is older than the given age [ms].
        """
        age = time.monotonic() - self._taken_at
        if self._image is None or age > max_age_ms / 1e3:
            raise ConnectionError(
                f"the newest image on {self.config.topic} is {age:.2f} s old{self._refused}."
            )
        return self._image

    def disconnect(self) -> None:
        if self._session is not None:
            self._session.close()
            self._session = None
