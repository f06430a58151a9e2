"""Placing and grasping as environments for lerobot-eval."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import Float, UInt8
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from hrc_learn.lerobot.arm_robot import ValuesConfig
from hrc_learn.lerobot.mujoco_arm import (
    CAMERA,
    MujocoArmRobot,
    MujocoArmRobotConfig,
    WorkplaceConfig,
)
from hrc_learn.teleoperation.scenarios import ScenarioView, make_scenario

_GYM_ID = "hrc_learn/mujoco_arm"
_MORE_TIME = 1.25
"""Time limit of a policy, as a multiple of the duration of a demonstration."""


@EnvConfig.register_subclass("mujoco_arm")
@dataclass
class ArmEnvConfig(WorkplaceConfig, ValuesConfig, EnvConfig):
    """Scenarios of a `mujoco_arm`, judged by MuJoCo's contacts; `--env.type=mujoco_arm`.

    Observations and actions are those of the robot with the same settings, in the same order.
    Therefore a policy trained on recordings of the robot can be evaluated here.
    """

    task: str | None = "placing"
    """Task: "placing" or "grasping"."""
    fps: int = 50
    """Frame rate of the training dataset [Hz]."""
    episode_length: int | None = None
    """Number of actions after which an episode has failed; None: a quarter more than in a
    demonstration."""

    def __post_init__(self) -> None:
        robot = MujocoArmRobot(self.robot_config())
        values = robot.observation_features
        state = sum(shape is float for shape in values.values())
        self.features = {
            ACTION: PolicyFeature(FeatureType.ACTION, (len(robot.action_features),)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (state,)),
        }
        self.features_map = {ACTION: ACTION, "agent_pos": OBS_STATE}
        if CAMERA in values:
            image = PolicyFeature(FeatureType.VISUAL, values[CAMERA])
            self.features[f"pixels/{CAMERA}"] = image
            self.features_map[f"pixels/{CAMERA}"] = f"{OBS_IMAGES}.{CAMERA}"

    def robot_config(self) -> MujocoArmRobotConfig:
        """Settings of the environment's robot."""
        shared = [f.name for f in (*fields(WorkplaceConfig), *fields(ValuesConfig))]
        return MujocoArmRobotConfig(
            scenario=self.task or "placing",
            fps=float(self.fps),
            **{name: getattr(self, name) for name in shared},
        )

    @property
    def gym_id(self) -> str:
        return _GYM_ID

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        robot, length = self.robot_config(), self.episode_length
        if length is None:
            scenario = make_scenario(robot.scenario, robot.shelf, robot.work_arm())
            length = round(_MORE_TIME * scenario.duration * self.fps)
        return {"config": robot, "max_episode_steps": length}


_PICTURE = (240, 180)
"""Size of the pictures of `render` [px]."""
_STEADY = 0.3
"""Time for which the task must stay done to count [s]: a toppling object rests for a moment."""


class ArmEnv(gym.Env):
    """Environment whose episodes end once MuJoCo's contacts show that the task stays done.

    The same seed and actions lead to the same result.
    """

    def __init__(self, config: MujocoArmRobotConfig):
        """Set up.

        Args:
            config: Configuration of the robot, with the scenario.
        """
        self._robot = MujocoArmRobot(config)
        self._robot.judged = False
        self._robot.connect()
        self._actions = tuple(self._robot.action_features)
        self._done = 0
        self._view: ScenarioView | None = None
        self.task = config.scenario
        self.task_description = self._robot.run.scenario.task
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": round(config.fps)}
        self.render_mode = "rgb_array"
        values = self._robot.observation_features
        self._state = [name for name, shape in values.items() if shape is float]
        self.action_space = _unbounded(len(self._actions))
        spaces: dict[str, gym.Space] = {"agent_pos": _unbounded(len(self._state))}
        if CAMERA in values:
            image = gym.spaces.Box(0, 255, values[CAMERA], np.uint8)
            spaces["pixels"] = gym.spaces.Dict({CAMERA: image})
        self.observation_space = gym.spaces.Dict(spaces)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin the episode of a seed; None: the seed is the next random number."""
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(2**31))
        self._robot.begin(seed)
        self._done = 0
        return self._observation(), {"is_success": False}

    def step(
        self, action: Float[np.ndarray, " values"]
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Send an action, and advance time by 1/fps. The reward is 1 once the task is done."""
        values = np.asarray(action).tolist()
        self._robot.send_action(dict(zip(self._actions, values, strict=True)))
        self._done = self._done + 1 if self._robot.run.succeeded() else 0
        success = self._done * self._robot.dt >= _STEADY
        return self._observation(), float(success), success, False, {"is_success": success}

    def render(self) -> UInt8[np.ndarray, "height width 3"]:
        """A picture of the workplace."""
        if self._view is None:
            self._view = ScenarioView(self._robot.run, *_PICTURE)
        return self._view.read()

    def close(self) -> None:
        """Disconnect the robot."""
        if self._robot.is_connected:
            self._robot.disconnect()

    def _observation(self) -> dict[str, Any]:
        values = self._robot.get_observation()
        state = np.array([values[name] for name in self._state], dtype=np.float32)
        observation: dict[str, Any] = {"agent_pos": state}
        if CAMERA in values:
            observation["pixels"] = {CAMERA: values[CAMERA]}
        return observation


gym.register(_GYM_ID, f"{__name__}:{ArmEnv.__name__}")


def _unbounded(size: int) -> gym.spaces.Box:
    return gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
