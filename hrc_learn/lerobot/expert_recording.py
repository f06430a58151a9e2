"""Recording the scripted expert in simulated time, as lerobot-record does by the clock."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from lerobot.datasets import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_STR
from lerobot.utils.feature_utils import build_dataset_frame, hw_to_dataset_features

from hrc_learn.lerobot.robots import MujocoPanda, MujocoPandaConfig
from hrc_learn.lerobot.teleoperators import PandaExpert, PandaExpertConfig
from hrc_learn.store import DATASET, replacing


def record_expert(
    folder: Path, config: MujocoPandaConfig, episodes: int
) -> Iterator[tuple[int, bool]]:
    """Let the expert show a scenario, and write what lerobot-record would have written.

    Every episode is shown to its end and cut there, however busy the machine is. Those that
    fail are thrown away and shown again, from the next seed.

    Args:
        folder: Of the new dataset; must not exist.
        config: Of the robot, with the scenario and the first seed.
        episodes: To be written.

    Yields:
        After each demonstration: how many are written, and whether it succeeded.

    Raises:
        BusyError: Another process is recording there.
        FileExistsError: There is something at `folder`.
        RuntimeError: More demonstrations fail than succeed.
    """
    robot, expert = MujocoPanda(config), PandaExpert(PandaExpertConfig())
    features = hw_to_dataset_features(robot.action_features, ACTION) | hw_to_dataset_features(
        robot.observation_features, OBS_STR
    )
    with replacing(folder, DATASET) as new:
        dataset = LeRobotDataset.create(
            f"local/{folder.name}",
            round(config.fps),
            root=new,
            robot_type=robot.name,
            features=features,
            video_backend="pyav",
        )
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
            dataset.finalize()
            expert.disconnect()
            robot.disconnect()


def _show(robot: MujocoPanda, expert: PandaExpert, dataset: LeRobotDataset) -> bool:
    """One demonstration, kept in the dataset's buffer; whether it succeeded."""
    scenario = robot.run.scenario
    for _ in range(round(scenario.duration / robot.dt)):
        observation, action = robot.get_observation(), expert.get_action()
        robot.send_action(action)
        dataset.add_frame(
            {
                **build_dataset_frame(dataset.features, observation, prefix=OBS_STR),
                **build_dataset_frame(dataset.features, action, prefix=ACTION),
                "task": scenario.task,
            }
        )
    return robot.run.succeeded()
