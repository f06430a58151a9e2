"""Our own task: grasping in the simulated work cell, as in `mujoco_arm` for LeRobot.

The object is observed by its initial pixel only, so it cannot be moved during an episode.
"""

from typing import Any

import numpy as np
from jaxtyping import Float
from public_tasks.protocol import ACTION, AGENT_POS, ENVIRONMENT_STATE, Expert, Observation

from hrc_learn.lerobot.arm_teleoperators import GuidedRobot
from hrc_learn.lerobot.envs import ArmEnv, ArmEnvConfig
from hrc_learn.lerobot.mujoco_arm import MujocoArmRobot

OBJECT = 2
"""Number of the last components of a `mujoco_arm` observation: the object's pixel."""


class Grasping:
    """A box somewhere on the table is grasped and lifted."""

    fps = 20.0
    moved_at: int | None = None

    def __init__(self):
        """Build the work cell."""
        config = ArmEnvConfig(task="grasping", pixels=True, fps=round(self.fps))
        settings = config.gym_kwargs
        self._env = ArmEnv(settings["config"])
        self.expert: Expert = _Expert(self._env._robot)
        self.longest = settings["max_episode_steps"]
        self.n_actions = config.features[ACTION].shape[0]

    def begin(self, seed: int) -> Observation:
        """Begin an episode with the box at the place drawn from the seed."""
        return _parted(self._env.reset(seed=seed)[0])

    def step(self, action: Float[np.ndarray, "A"]) -> tuple[Observation, bool]:
        """Observation after an action, and True once MuJoCo's contacts have shown success for
        some time.
        """
        seen, _, done, _, _ = self._env.step(action)
        return _parted(seen), done

    def move_object(self, rng: np.random.Generator) -> Observation:
        """Not available: the object is observed at the beginning only."""
        raise RuntimeError("where the object is is told at the beginning only")

    def render(self) -> Any:
        """Image of the work cell."""
        return self._env.render()


class _Expert:
    """The scripted expert with tremor, which knows the place of the box."""

    def __init__(self, robot: MujocoArmRobot):
        self._robot = robot

    def begin(self) -> None:
        """Begin at the arm's present pose."""
        self._guided = GuidedRobot(self._robot, self._robot.run.expert)

    def act(self, seen: Observation) -> Float[np.ndarray, "A"]:
        """Next demonstrated action."""
        return np.array(list(self._guided.next()[0].values()))


def _parted(seen: dict[str, Any]) -> Observation:
    numbers = seen["agent_pos"]
    return {AGENT_POS: numbers[:-OBJECT], ENVIRONMENT_STATE: numbers[-OBJECT:]}
