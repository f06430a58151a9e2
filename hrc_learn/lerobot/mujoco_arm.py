"""Simulated arms as LeRobot robots."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float
from lerobot.robots import RobotConfig
from lerobot.utils.decorators import check_if_not_connected
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.kinematics import Arm as ArmModel
from hrc_learn.kinematics import ArmChoice
from hrc_learn.lerobot.arm_robot import ArmRobot, ArmRobotConfig
from hrc_learn.lerobot.arm_values import DOWN, MARKER, OBJECT, PIXELS
from hrc_learn.lerobot.person import PersonConfig, scripted_person
from hrc_learn.protocols import Arm
from hrc_learn.teleoperation.scenarios import check_scenario, make_scenario

if TYPE_CHECKING:
    from hrc_learn.sim import World
    from hrc_learn.skills.arm_motion import PositionServo
    from hrc_learn.teleoperation.scenarios import ScenarioRun

logger = logging.getLogger(__name__)


@dataclass
class ImagesConfig:
    """Images of the simulated workplace."""

    kind: Literal["none", "auto", "egl", "synthetic"] = "none"
    """Camera type: "egl" renders everything; "synthetic" draws only the markers on the table
    and needs no OpenGL; "auto" renders where possible.
    """
    width: int = 160
    """Width of the images [px]."""
    height: int = 120
    """Height of the images [px]."""


@dataclass
class MovedCameraConfig:
    """Displacement of the fixed camera; it still sees the table."""

    distance: float = 0.0
    """Distance by which the camera is moved [m]."""
    angle: float = 0.0
    """Angle by which the camera is turned [degrees]."""
    seed: int = 0
    """Random seed of the direction of motion and of the axis of rotation."""


@dataclass(kw_only=True)
class WorkplaceConfig:
    """Settings of the simulated workplace, common to the robot and the environment."""

    arm: str = "panda"
    """Registered name of the arm, or its URDF or MJCF file."""
    base: str = ""
    """Link in the file that is the arm's base; empty: the root of the file."""
    tip: str = ""
    """Link in the file that is the arm's flange; empty: the only end of the arm."""
    shelf: str = "middle"
    """Target shelf: "lower", "middle" or "upper"."""
    pixels: bool = False
    """Observe the pixel of the object in the fixed camera at the start of the episode, which a
    policy needs to grasp without images.
    """
    marker: bool = False
    """Observe the present pixel of the tool's marker in the fixed camera, and its visibility;
    used to detect that the camera has moved.
    """
    object_pose: bool = False
    """Observe the present pose of the object, as position and rotation vector; `hrc multiply`
    needs it.
    """
    moved_camera: MovedCameraConfig = field(default_factory=MovedCameraConfig)
    """Displacement of the fixed camera from its pose in the demonstrations."""
    images: ImagesConfig = field(default_factory=ImagesConfig)
    """Images to be observed."""


@RobotConfig.register_subclass("mujoco_arm")
@dataclass(kw_only=True)
class MujocoArmRobotConfig(WorkplaceConfig, ArmRobotConfig):
    """An arm in our MuJoCo workplace; `--robot.type=mujoco_arm`.

    `fps` counts commands a second of simulated time.
    """

    scenario: str = "placing"
    """Task: "placing" or "grasping"."""
    seed: int = 0
    """Seed of the first initial configuration; each reset increments it."""
    imperfections: float = 0.0
    """Size of the errors of arm, calibration and workplace, in multiples of the nominal errors;
    each seed draws other errors."""
    episode_time: float = 0.0
    """Time [s] after which the scenario starts again, equal to `--dataset.episode_time_s`:
    lerobot-record does not report the end of an episode. 0: never."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_scenario(self.scenario, self.shelf, self.pixels)
        if not 5 <= self.fps <= 500:
            raise ValueError(f"fps must be from 5 to 500, but is {self.fps}.")
        check_settings(self, not_negative=("episode_time", "imperfections"))

    def work_arm(self) -> ArmModel:
        """The arm with the two-finger hand of our work cell.

        Raises:
            ValueError: There is no such arm, or it cannot do the work.
        """
        return ArmChoice(self.arm, self.base, self.tip).work_arm()


CAMERA = "front"


class MujocoArmRobot(ArmRobot):
    """An arm in our MuJoCo workplace, for lerobot-record, -replay, -teleoperate, -rollout.

    The robot type in a dataset names the arm: `mujoco_panda`, `mujoco_ur5e`, ... The workplace
    is laid out for the arm's reach. Every action advances simulated time by 1/fps, whatever the
    wall clock shows: a loop that is late records the same frames, only later.

    Attributes:
        run: Present run of the scenario, while connected.
    """

    config_class = MujocoArmRobotConfig
    name = "mujoco_arm"
    in_real_time = False
    run: ScenarioRun

    def __init__(self, config: MujocoArmRobotConfig):
        work_arm = config.work_arm()
        self.name = f"mujoco_{work_arm.name}"  # before LeRobot derives folders from it
        super().__init__(config, work_arm)
        self.config = config

    @property
    def observation_features(self) -> dict[str, Any]:
        config, images = self.config, self.config.images
        wanted = (config.pixels, PIXELS), (config.marker, MARKER), (config.object_pose, OBJECT)
        more = {name: float for wants, names in wanted if wants for name in names}
        features = super().observation_features | more
        if images.kind != "none":
            features[CAMERA] = (images.height, images.width, 3)
        return features

    @property
    def arm(self) -> Arm:
        return self.run.world.arm

    @property
    def servo(self) -> PositionServo:
        return self.run.servo

    @property
    def world(self) -> World:
        return self.run.world

    def _touching(self) -> tuple[str, ...]:
        last, self._looked = self._looked, self.world.time
        return self.world.touched_since(last)

    def clearance(
        self, joint_position: Float[Tensor, "*batch joints"]
    ) -> Float[Tensor, "*batch"]:
        return self.run.scenario.workplace.arm_clearance(joint_position)

    def _invite(self, config: PersonConfig) -> None:
        super()._invite(config)
        self._pull_from(self.run.seed)

    def _pull_from(self, seed: int) -> None:
        """Draw the pulls of a scripted person from a seed."""
        if self.complement is not None and self.config.person.kind == "scripted":
            self.complement.human = scripted_person(self.work_arm.chain, seed)

    def _open(self) -> None:
        from hrc_learn.sim import CameraChange, Imperfections
        from hrc_learn.teleoperation.scenarios import ScenarioRun, ScenarioView

        self._began = self._looked = 0.0
        self._marker, self._rotation = (0.0, 0.0, 0.0), DOWN
        config, images = self.config, self.config.images
        scenario = make_scenario(config.scenario, config.shelf, self.work_arm)
        sizes = Imperfections.nominal().scaled(config.imperfections)
        self.run = ScenarioRun(
            scenario,
            config.fps,
            seed=config.seed,
            imperfections=sizes,
            worker=config.person.mode if config.person.worker else None,
        )
        moved = config.moved_camera
        if moved.distance or moved.angle:
            change = CameraChange(distance=moved.distance, angle=math.radians(moved.angle))
            self.run.move_camera(change, np.random.default_rng(moved.seed))
        if images.kind != "none":
            self.cameras = {
                CAMERA: ScenarioView(self.run, images.width, images.height, images.kind)
            }

    def _close(self) -> None:
        self.cameras = {}
        self.initial_configurations += 1  # `connect` builds another scene

    @check_if_not_connected
    def get_observation(self) -> dict[str, Any]:
        self._begin_anew_in_time()
        values = super().get_observation()
        if self.config.pixels:
            values |= zip(PIXELS, map(float, self.run.object_pixel()), strict=True)
        if self.config.marker:
            values |= zip(MARKER, self._look_at_marker(), strict=True)
        if self.config.object_pose:
            name = self.run.scenario.workplace.scene.objects[0].name
            pose = Pose.from_matrix(self.world.object_pose(name))
            values |= zip(OBJECT, pose.vector().tolist(), strict=True)
        for name, camera in self.cameras.items():
            values[name] = camera.read()
        return values

    def _look_at_marker(self) -> tuple[float, float, float]:
        """Pixel (u, v) of the tool's marker, and 1; if it is hidden, its last pixel, and 0."""
        pixel = self.run.tool_pixel()
        u, v = self._marker[:2] if pixel is None else pixel.tolist()
        self._marker = (u, v, float(pixel is not None))
        return self._marker

    def _begin_anew_in_time(self) -> None:
        """Start the scenario again when the recorder starts its next episode.

        The recorder ends an episode at the first frame after its time, and saving takes longer
        than a frame. The threshold lies one frame after the end, so that a last frame still
        belongs to its episode, however busy the machine is.
        """
        now, length = time.monotonic(), self.config.episode_time
        if not self.run.commands:
            self._began = now
        elif length and now - self._began > length + self.dt:
            self._warn_of_half_an_episode()
            self.begin(self.run.seed + 1)
            self._began = now

    @check_if_not_connected
    def disconnect(self) -> None:
        if self.config.episode_time and self.run.commands:
            self._warn_of_half_an_episode()
        super().disconnect()

    def _warn_of_half_an_episode(self) -> None:
        """Warn if the time limit or a late loop ended the episode before the task was done."""
        shown, whole = self.dt * self.run.commands, self.run.scenario.duration
        if not self.run.succeeded():
            logger.warning(
                "episode %d of this recording ends before the job is done: %.1f s of the "
                "demonstration's %.1f s were shown. Delete it (lerobot-edit-dataset "
                "--operation.type delete_episodes), and give more time (--robot.episode_time "
                "and --dataset.episode_time_s)",
                self.initial_configurations,
                shown,
                whole,
            )

    def begin(self, seed: int) -> None:
        """Start the scenario of a seed."""
        self._loop.end()
        self.run.begin(seed)
        self._looked = 0.0
        if self.complement is not None:
            self.complement.restart()
        self._pull_from(seed)
        self.initial_configurations += 1
        self._rotation = DOWN

    def _command(
        self, joints: Float[np.ndarray, " joints"], width: float
    ) -> Float[np.ndarray, " joints"]:
        return self.run.command(joints, width)
