"""Demonstrations of a simulated job as lerobot-record writes them, without its waiting."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from hrc_learn.lerobot.envs import PandaEnvConfig
from hrc_learn.lerobot.robots import MujocoPanda
from hrc_learn.lerobot.teleoperators.config_panda_expert import PandaExpertConfig
from hrc_learn.lerobot.teleoperators.panda_expert import PandaExpert

STATE, ACTION = "observation.state", "action"


def record_shown(folder: Path, env: PandaEnvConfig, seeds: Iterable[int]) -> None:
    """Record the scripted expert, one episode for each beginning, as a LeRobot dataset."""
    from lerobot.datasets import LeRobotDataset

    robot, expert = MujocoPanda(env.robot_config()), PandaExpert(PandaExpertConfig())
    dataset = LeRobotDataset.create(
        f"local/{folder.name}",
        fps=env.fps,
        root=folder,
        robot_type=robot.name,
        features={
            STATE: _feature(robot.observation_features),
            ACTION: _feature(robot.action_features),
        },
        use_videos=False,
    )
    robot.connect()
    expert.connect()
    try:
        for seed in seeds:
            robot.begin(seed)
            for _ in range(round(robot.run.scenario.duration * env.fps)):
                seen = robot.get_observation()
                sent = robot.send_action(expert.get_action())
                columns = {STATE: _row(seen), ACTION: _row(sent)}
                dataset.add_frame(columns | {"task": robot.run.scenario.task})
            if not robot.run.succeeded():
                raise RuntimeError(f"the expert failed from beginning {seed}")
            dataset.save_episode()
    finally:
        robot.disconnect()
    dataset.finalize()


def _feature(values: dict[str, Any]) -> dict[str, Any]:
    return {"dtype": "float32", "shape": (len(values),), "names": [*values]}


def _row(values: dict[str, float]) -> np.ndarray:
    return np.array([*values.values()], dtype=np.float32)
