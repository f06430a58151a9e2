"""Our own: grasping in the simulated work cell, as `mujoco_arm` has it for LeRobot.

What is seen of the object is where its pixel was at the beginning, so it cannot be moved.
"""

from typing import Any

import numpy as np
from jaxtyping import Float
from public_tasks.protocol import ACTION, AGENT_POS, ENVIRONMENT_STATE, Expert, Observation

from hrc_learn.lerobot.arm_teleoperators import GuidedRobot
from hrc_learn.lerobot.envs import ArmEnv, ArmEnvConfig
from hrc_learn.lerobot.mujoco_arm import MujocoArmRobot

OBJECT = 2
"""Last numbers of what a `mujoco_arm` observes: the object's pixel."""


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
        """The box where the seed has it."""
        return _parted(self._env.reset(seed=seed)[0])

    def step(self, action: Float[np.ndarray, "A"]) -> tuple[Observation, bool]:
        """One action; done once MuJoCo's contacts have said so for a while."""
        seen, _, done, _, _ = self._env.step(action)
        return _parted(seen), done

    def move_object(self, rng: np.random.Generator) -> Observation:
        """Not here."""
        raise RuntimeError("where the object is is told at the beginning only")

    def render(self) -> Any:
        """The work cell."""
        return self._env.render()


class _Expert:
    """The scripted expert with its trembling hand, which knows where the box is."""

    def __init__(self, robot: MujocoArmRobot):
        self._robot = robot

    def begin(self) -> None:
        """From where the arm is."""
        self._guided = GuidedRobot(self._robot, self._robot.run.expert)

    def act(self, seen: Observation) -> Float[np.ndarray, "A"]:
        """What it shows next."""
        return np.array(list(self._guided.next()[0].values()))


def _parted(seen: dict[str, Any]) -> Observation:
    numbers = seen["agent_pos"]
    return {AGENT_POS: numbers[:-OBJECT], ENVIRONMENT_STATE: numbers[-OBJECT:]}
