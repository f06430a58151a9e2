"""Policy rollouts in simulated time; lerobot-rollout uses the wall clock.

They record the person's input in additional columns, which LeRobot's own command does not
support.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import get_policy_class, make_pre_post_processors
from lerobot.policies.utils import prepare_observation_for_inference
from lerobot.utils.constants import OBS_STR
from lerobot.utils.feature_utils import build_dataset_frame

from hrc_learn.lerobot.arm_robot import ArmRobot
from hrc_learn.lerobot.expert_recording import add_frame, new_dataset, observation_features
from hrc_learn.lerobot.person import COLUMNS
from hrc_learn.lerobot.robots import MujocoArmRobot, MujocoArmRobotConfig

# What a rollout gets, in durations of a demonstration: as of the environment, and time to wait
# for a person.
_MORE_TIME = 1.5


@runtime_checkable
class Leader(Protocol):
    """Source of a robot's actions: a policy, a replay."""

    def reset(self) -> None:
        """Begin an episode."""
        ...

    def act(self, observation: Mapping[str, Any]) -> dict[str, float]:
        """The next action."""
        ...


class CheckpointPolicy:
    """Any policy of LeRobot's, from its checkpoint."""

    def __init__(self, folder: Path, robot: ArmRobot):
        """Load it.

        Args:
            folder: `pretrained_model` of a checkpoint.
            robot: Robot with the observations and actions that the policy knows.

        Raises:
            FileNotFoundError: There is no checkpoint.
        """
        if not (folder / "config.json").is_file():
            raise FileNotFoundError(
                f"there is no {folder / 'config.json'}: give the folder `pretrained_model` of "
                "a LeRobot checkpoint."
            )
        config = PreTrainedConfig.from_pretrained(folder)
        self._policy = get_policy_class(config.type).from_pretrained(folder)
        self._before, self._after = make_pre_post_processors(
            self._policy.config, pretrained_path=str(folder)
        )
        self._device = torch.device(config.device or "cpu")
        # As in lerobot-rollout a policy sees nothing of what concerns the person.
        features = observation_features(robot)
        self._features = {key: f for key, f in features.items() if key not in COLUMNS}
        self._actions = tuple(robot.action_features)

    def reset(self) -> None:
        """Begin an episode."""
        for part in (self._policy, self._before, self._after):
            part.reset()

    @torch.inference_mode()
    def act(self, observation: Mapping[str, Any]) -> dict[str, float]:
        """The next action."""
        frame = build_dataset_frame(self._features, dict(observation), prefix=OBS_STR)
        batch = prepare_observation_for_inference(frame, self._device)
        action = self._after(self._policy.select_action(self._before(batch)))
        return dict(zip(self._actions, action.squeeze(0).tolist(), strict=True))


def roll_out(
    robot: MujocoArmRobot, leader: Leader, seed: int
) -> Iterator[tuple[dict[str, Any], dict[str, float]]]:
    """Let a policy do the scenario of a simulated robot once.

    Args:
        robot: Connected.
        leader: The policy.
        seed: Seed of the initial configuration, and of the person's pulls.

    Yields:
        After each action: what was observed before it, and the action.
    """
    robot.begin(seed)
    leader.reset()
    for _ in range(round(_MORE_TIME * robot.run.scenario.duration / robot.dt)):
        observation = robot.get_observation()
        action = leader.act(observation)
        robot.send_action(action)
        yield observation, action


def record_rollouts(
    folder: Path, policy: Path, config: MujocoArmRobotConfig, episodes: int
) -> Iterator[bool]:
    """Roll a policy out and record it, successful or not.

    Args:
        folder: Folder of the new dataset; must not exist.
        policy: Checkpoint, its folder `pretrained_model`.
        config: Configuration of the robot, with the scenario, the first seed and the person.
        episodes: Number of episodes to record.

    Yields:
        After each episode: whether the job was done.
    """
    robot = MujocoArmRobot(config)
    leader = CheckpointPolicy(policy, robot)
    with new_dataset(folder, robot) as dataset:
        robot.connect()
        try:
            for k in range(episodes):
                for observation, action in roll_out(robot, leader, config.seed + k):
                    add_frame(dataset, observation, action, robot.run.scenario.task)
                dataset.save_episode()
                yield robot.run.succeeded()
        finally:
            robot.disconnect()
