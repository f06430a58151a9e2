"""Settings of the simulated Panda."""

from dataclasses import dataclass, field
from typing import Literal

from lerobot.robots import RobotConfig

from hrc_learn.lerobot.panda_features import ActionSpace
from hrc_learn.teleoperation.scenarios import check_scenario


@dataclass
class ImagesConfig:
    """Images of the simulated workplace."""

    kind: Literal["none", "auto", "egl", "synthetic"] = "none"
    """Which camera: "egl" renders everything, "synthetic" draws the markers on the table only
    and needs no OpenGL, "auto" renders where that is possible."""
    width: int = 160
    """[px]"""
    height: int = 120
    """[px]"""


@RobotConfig.register_subclass("mujoco_panda")
@dataclass(kw_only=True)
class MujocoPandaConfig(RobotConfig):
    """The Panda in our MuJoCo workplace; `--robot.type=mujoco_panda`."""

    scenario: str = "placing"
    """What is to be done: "placing" or "grasping"."""
    shelf: str = "middle"
    """Where to place: "lower", "middle" or "upper"."""
    fps: float = 50.0
    """Commands a second of simulated time: the rate of the dataset, or of the rollout."""
    seed: int = 0
    """Of the first beginning; each one after has the next."""
    action_space: ActionSpace = "joint"
    """What actions give: positions of the joints, or of the hand ("ee")."""
    velocity: bool = False
    """Whether joint velocities are observed."""
    hand: bool = False
    """Whether the pose of the hand is observed; it is where actions give it."""
    pixels: bool = False
    """Whether the pixel of the object is observed, as the fixed camera saw it at the beginning:
    what a policy needs to grasp without images."""
    images: ImagesConfig = field(default_factory=ImagesConfig)
    """Images to be observed."""
    episode_time: float = 0.0
    """Begin anew when this much time [s] has passed, as `--dataset.episode_time_s` says when
    lerobot-record ends an episode, of which it tells a robot nothing; 0: never."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_scenario(self.scenario, self.shelf, self.pixels)
        if not 5 <= self.fps <= 500:
            raise ValueError(f"fps must be from 5 to 500, but is {self.fps}.")
        if self.episode_time < 0:
            raise ValueError("episode_time must not be negative.")
