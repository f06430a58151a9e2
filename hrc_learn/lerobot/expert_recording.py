"""Recording in simulated time, as lerobot-record does by the clock; of the scripted expert."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lerobot.datasets import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_STR
from lerobot.utils.feature_utils import build_dataset_frame, hw_to_dataset_features

from hrc_learn.lerobot.arm_robot import ArmRobot
from hrc_learn.lerobot.person import COLUMNS
from hrc_learn.lerobot.robots import MujocoArmRobot, MujocoArmRobotConfig
from hrc_learn.lerobot.teleoperators import ArmExpert, ArmExpertConfig
from hrc_learn.store import DATASET, replacing


def observation_features(robot: ArmRobot) -> dict[str, dict]:
    """Features of what a robot observes in a dataset: what concerns the person in columns of
    its own, the rest as LeRobot has it.
    """
    columns = {key: names(robot.values.chain) for key, names in COLUMNS.items()}
    own = {key: names for key, names in columns.items() if names[0] in robot.person_names}
    rest = {
        name: shape
        for name, shape in robot.observation_features.items()
        if name not in robot.person_names
    }
    return hw_to_dataset_features(rest, OBS_STR) | {
        key: {"dtype": "float32", "shape": (len(names),), "names": list(names)}
        for key, names in own.items()
    }


@contextmanager
def new_dataset(folder: Path, robot: ArmRobot) -> Iterator[LeRobotDataset]:
    """A dataset of what a robot observes and is sent, whole at the end or not there.

    Args:
        folder: Folder of the new dataset; must not exist.
        robot: Whose it is.
    """
    features = hw_to_dataset_features(robot.action_features, ACTION)
    with replacing(folder, DATASET) as new:
        dataset = LeRobotDataset.create(
            f"local/{folder.name}",
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


def add_frame(
    dataset: LeRobotDataset,
    observation: Mapping[str, Any],
    action: Mapping[str, float],
    task: str,
) -> None:
    """Keep what was observed, and what was sent then, in the dataset's buffer."""
    dataset.add_frame(
        {
            **build_dataset_frame(dataset.features, dict(observation), prefix=OBS_STR),
            **build_dataset_frame(dataset.features, dict(action), prefix=ACTION),
            "task": task,
        }
    )


def record_expert(
    folder: Path, config: MujocoArmRobotConfig, episodes: int
) -> Iterator[tuple[int, bool]]:
    """Let the expert show a scenario, and write what lerobot-record would have written.

    Every episode is shown to its end and cut there, however busy the machine is. Those that
    fail are thrown away and shown again, from the next seed.

    Args:
        folder: Folder of the new dataset; must not exist.
        config: Configuration of the robot, with the scenario and the first seed.
        episodes: Number of episodes to write.

    Yields:
        After each demonstration: how many are written, and whether it succeeded.

    Raises:
        BusyError: Another process is recording there.
        FileExistsError: There is something at `folder`.
        RuntimeError: More demonstrations fail than succeed.
    """
    robot, expert = MujocoArmRobot(config), ArmExpert(ArmExpertConfig())
    with new_dataset(folder, robot) as dataset:
        robot.connect()
        expert.connect()
        try:
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
        finally:
            expert.disconnect()
            robot.disconnect()


def _show(robot: MujocoArmRobot, expert: ArmExpert, dataset: LeRobotDataset) -> bool:
    """One demonstration, kept in the dataset's buffer; whether it succeeded."""
    scenario = robot.run.scenario
    for _ in range(round(scenario.duration / robot.dt)):
        observation, action = robot.get_observation(), expert.get_action()
        robot.send_action(action)
        add_frame(dataset, observation, action, scenario.task)
    return robot.run.succeeded()
