"""Settings of the environments, and how LeRobot makes them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from hrc_learn.lerobot.panda_features import ActionSpace, action_names
from hrc_learn.lerobot.robots import MujocoPanda, MujocoPandaConfig
from hrc_learn.lerobot.robots.config_mujoco_panda import ImagesConfig
from hrc_learn.lerobot.robots.mujoco_panda import CAMERA
from hrc_learn.teleoperation.scenarios import make_scenario

if TYPE_CHECKING:
    import gymnasium as gym

_MORE_TIME = 1.25
"""What a policy gets, in durations of a demonstration."""


@EnvConfig.register_subclass("panda")
@dataclass
class PandaEnvConfig(EnvConfig):
    """Scenarios of a `mujoco_panda`, judged by MuJoCo's contacts; `--env.type=panda`.

    Observations and actions are those of the robot with the same settings, in the same order,
    so that what was recorded on it can be evaluated here.
    """

    task: str | None = "placing"
    """What is to be done: "placing" or "grasping"."""
    fps: int = 50
    """Of the dataset that the policy was trained on."""
    shelf: str = "middle"
    """Where to place: "lower", "middle" or "upper"."""
    action_space: ActionSpace = "joint"
    """As of the robot."""
    velocity: bool = False
    """As of the robot."""
    hand: bool = False
    """As of the robot."""
    pixels: bool = False
    """As of the robot."""
    images: ImagesConfig = field(default_factory=ImagesConfig)
    """As of the robot."""
    episode_length: int | None = None
    """Actions after which an episode has failed; None: a quarter more than a demonstration."""

    def __post_init__(self) -> None:
        robot = MujocoPanda(self.robot_config())
        values = robot.observation_features
        state = sum(shape is float for shape in values.values())
        self.features = {
            ACTION: PolicyFeature(FeatureType.ACTION, (len(action_names(self.action_space)),)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (state,)),
        }
        self.features_map = {ACTION: ACTION, "agent_pos": OBS_STATE}
        if CAMERA in values:
            self.features[f"pixels/{CAMERA}"] = PolicyFeature(
                FeatureType.VISUAL, values[CAMERA]
            )
            self.features_map[f"pixels/{CAMERA}"] = f"{OBS_IMAGES}.{CAMERA}"

    def robot_config(self) -> MujocoPandaConfig:
        """Settings of the robot in it."""
        return MujocoPandaConfig(
            scenario=self.task or "placing",
            shelf=self.shelf,
            fps=float(self.fps),
            action_space=self.action_space,
            velocity=self.velocity,
            hand=self.hand,
            pixels=self.pixels,
            images=self.images,
        )

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {"config": self.robot_config(), "max_episode_steps": self._length()}

    def _length(self) -> int:
        if self.episode_length is not None:
            return self.episode_length
        robot = self.robot_config()
        duration = make_scenario(robot.scenario, robot.shelf).duration
        return round(_MORE_TIME * duration * self.fps)

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """One vector of environments that differ by their seeds."""
        from functools import partial

        import gymnasium as gym
        from gymnasium.vector import AutoresetMode

        from hrc_learn.lerobot.envs.panda_env import PandaEnv

        make = partial(PandaEnv, **self.gym_kwargs)
        if use_async_envs and n_envs > 1:
            vector = gym.vector.AsyncVectorEnv(
                [make] * n_envs, autoreset_mode=AutoresetMode.SAME_STEP, context="forkserver"
            )
        else:
            vector = gym.vector.SyncVectorEnv(
                [make] * n_envs, autoreset_mode=AutoresetMode.SAME_STEP
            )
        return {self.type: {0: vector}}
