"""Record episodes of the scripted expert or of a policy, in simulated time.

LeRobot's own commands use the wall clock, and cannot record the input of a person.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies import get_policy_class, make_pre_post_processors
from lerobot.policies.utils import prepare_observation_for_inference
from lerobot.utils.constants import ACTION, OBS_STR
from lerobot.utils.feature_utils import build_dataset_frame, hw_to_dataset_features

from hrc_learn.demos.read.contract import Sidecar
from hrc_learn.demos.read.metadata import SIDECAR_PATH, dump_json
from hrc_learn.lerobot.arm_robot import ArmRobot
from hrc_learn.lerobot.arm_teleoperators import ArmExpert, ArmExpertConfig
from hrc_learn.lerobot.mujoco_arm import MujocoArmRobot, MujocoArmRobotConfig
from hrc_learn.lerobot.person import COLUMNS
from hrc_learn.store import DATASET, replacing


def observation_features(robot: ArmRobot) -> dict[str, dict]:
    """Dataset features of a robot's observations, with separate columns for the person."""
    values = robot.observation_features.items()
    rest = {name: shape for name, shape in values if name not in robot.person_names}
    features = hw_to_dataset_features(rest, OBS_STR)
    for key, names_of in COLUMNS.items() if robot.person_names else ():
        names = list(names_of(robot.values.chain))
        features[key] = {"dtype": "float32", "shape": (len(names),), "names": names}
    return features


@contextmanager
def new_dataset(folder: str | Path, robot: ArmRobot) -> Iterator[LeRobotDataset]:
    """New dataset of a robot's observations and actions; the folder appears when complete.

    Args:
        folder: Folder of the new dataset; must not exist.
        robot: Recorded robot.
    """
    features = hw_to_dataset_features(robot.action_features, ACTION)
    with replacing(folder, DATASET) as new:
        dataset = LeRobotDataset.create(
            f"local/{Path(folder).name}",
            round(1 / robot.dt),
            root=new,
            robot_type=robot.name,
            features=features | observation_features(robot),
            video_backend="pyav",
        )
        try:
            yield dataset
        finally:
            dataset.finalize()
        dump_json(new / SIDECAR_PATH, Sidecar(units={"joint_position": "rad"}))


def add_frame(
    dataset: LeRobotDataset,
    observation: Mapping[str, Any],
    action: Mapping[str, float],
    task: str,
) -> None:
    """Add an observation, and the action sent in response to it, to the dataset's buffer."""
    dataset.add_frame(
        {
            **build_dataset_frame(dataset.features, dict(observation), prefix=OBS_STR),
            **build_dataset_frame(dataset.features, dict(action), prefix=ACTION),
            "task": task,
        }
    )


def record_expert(
    folder: str | Path, config: MujocoArmRobotConfig, episodes: int
) -> Iterator[tuple[int, bool]]:
    """Record demonstrations of the scripted expert, as lerobot-record would.

    Every episode covers its whole scenario, however busy the machine is. A failed episode is
    discarded, and another one is recorded from the next seed.

    Args:
        folder: Folder of the new dataset; must not exist.
        config: Configuration of the robot, with the scenario and the first seed.
        episodes: Number of episodes to write.

    Yields:
        Number of episodes written after each demonstration, and True if it succeeded.

    Raises:
        BusyError: Another process is recording to this folder.
        FileExistsError: There is something at `folder`.
        RuntimeError: More demonstrations fail than succeed.
    """
    robot, expert = MujocoArmRobot(config), ArmExpert(ArmExpertConfig())
    with new_dataset(folder, robot) as dataset, robot, expert:
        written = failed = 0
        while written < episodes:
            if written + failed:
                robot.begin(robot.run.seed + 1)
            succeeded = _show(robot, expert, dataset)
            if succeeded:
                dataset.save_episode()
                written += 1
            else:
                dataset.clear_episode_buffer()
                failed += 1
            yield written, succeeded
            if failed > max(3, written):
                raise RuntimeError(f"{failed} of {failed + written} demonstrations failed.")


def _show(robot: MujocoArmRobot, expert: ArmExpert, dataset: LeRobotDataset) -> bool:
    """Add one demonstration to the dataset's buffer; returns True if it succeeded."""
    scenario = robot.run.scenario
    for _ in range(round(scenario.duration / robot.dt)):
        observation, action = robot.get_observation(), expert.get_action()
        robot.send_action(action)
        add_frame(dataset, observation, action, scenario.task)
    return robot.run.succeeded()


_ROLLOUT_TIME = 1.5
"""Length of a rollout, as a multiple of the duration of a demonstration: the policy may have to
wait for a person."""


class CheckpointPolicy:
    """Any policy of LeRobot, from its checkpoint."""

    def __init__(self, folder: str | Path, robot: ArmRobot):
        """Load a checkpoint.

        Args:
            folder: `pretrained_model` of a checkpoint.
            robot: Robot with the observations and actions for which the policy was trained.

        Raises:
            FileNotFoundError: There is no checkpoint.
        """
        file = Path(folder, "config.json")
        if not file.is_file():
            raise FileNotFoundError(
                f"there is no {file}: give the folder `pretrained_model` of "
                "a LeRobot checkpoint."
            )
        config = PreTrainedConfig.from_pretrained(folder)
        self._policy = get_policy_class(config.type).from_pretrained(folder)
        self._before, self._after = make_pre_post_processors(
            self._policy.config, pretrained_path=str(folder)
        )
        self._device = torch.device(config.device or "cpu")
        # As in lerobot-rollout, the policy does not receive the person's values.
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
    robot: MujocoArmRobot, policy: CheckpointPolicy, seed: int
) -> Iterator[tuple[dict[str, Any], dict[str, float]]]:
    """Roll a policy out once in the scenario of a simulated robot.

    Args:
        robot: Connected robot.
        policy: The policy.
        seed: Seed of the initial configuration, and of the person's pulls.

    Yields:
        The observation before each action, and the action.
    """
    robot.begin(seed)
    policy.reset()
    for _ in range(round(_ROLLOUT_TIME * robot.run.scenario.duration / robot.dt)):
        observation = robot.get_observation()
        action = policy.act(observation)
        robot.send_action(action)
        yield observation, action


def record_rollouts(
    folder: str | Path, policy: str | Path, config: MujocoArmRobotConfig, episodes: int
) -> Iterator[bool]:
    """Roll a policy out and record it, successful or not.

    Args:
        folder: Folder of the new dataset; must not exist.
        policy: Folder `pretrained_model` of a checkpoint.
        config: Configuration of the robot, with the scenario, the first seed and the person.
        episodes: Number of episodes to record.

    Yields:
        True after each episode in which the task was done, else False.
    """
    robot = MujocoArmRobot(config)
    leader = CheckpointPolicy(policy, robot)
    with new_dataset(folder, robot) as dataset, robot:
        for k in range(episodes):
            for observation, action in roll_out(robot, leader, config.seed + k):
                add_frame(dataset, observation, action, robot.run.scenario.task)
            dataset.save_episode()
            yield robot.run.succeeded()
