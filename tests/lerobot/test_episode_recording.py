"""Recording in simulated time, with demonstrations that succeed or fail as a test says."""

from dataclasses import dataclass

import pytest
from unchecked import shapes_unchecked

from hrc_learn.demos.read.contract import read_sidecar
from hrc_learn.lerobot import episode_recording
from hrc_learn.lerobot.mujoco_arm import MujocoArmRobotConfig
from hrc_learn.lerobot.policy.policy_base import read_episodes

FPS = 10.0


@dataclass
class Short:
    """The first half second of a scenario."""

    scenario: object
    duration = 0.5

    def __getattr__(self, name):
        return getattr(self.scenario, name)


@pytest.fixture
def outcomes(monkeypatch):
    """Makes demonstrations short, and their outcomes those of a list; keeps their seeds."""
    seeds, show = [], episode_recording._show

    def scripted(results):
        results = iter(results)

        def shown(robot, expert, dataset):
            seeds.append(robot.run.seed)
            scenario, robot.run.scenario = robot.run.scenario, Short(robot.run.scenario)
            show(robot, expert, dataset)
            robot.run.scenario = scenario
            return next(results)

        monkeypatch.setattr(episode_recording, "_show", shown)
        return seeds

    with shapes_unchecked():
        yield scripted


def config(folder):
    return MujocoArmRobotConfig(calibration_dir=folder, scenario="grasping", fps=FPS, seed=5)


def test_what_fails_is_shown_again_from_the_next_seed(tmp_path, outcomes):
    seeds = outcomes([True, False, True])
    folder = tmp_path / "set"
    told = list(episode_recording.record_expert(folder, config(tmp_path), episodes=2))
    assert told == [(1, True), (1, False), (2, True)]
    assert seeds == [5, 6, 7]
    episodes = read_episodes(folder, ["action", "observation.state"])
    assert [len(episode["action"]) for episode in episodes] == [5, 5]
    assert all(episode["observation.state"].shape == (5, 8) for episode in episodes)
    assert read_sidecar(folder).units == {"joint_position": "rad"}


def test_more_failures_than_successes_are_too_many(tmp_path, outcomes):
    outcomes([False] * 9)
    recording = episode_recording.record_expert(tmp_path / "set", config(tmp_path), episodes=2)
    assert [next(recording) for _ in range(4)] == [(0, False)] * 4
    with pytest.raises(RuntimeError, match="4 of 4 demonstrations failed"):
        next(recording)
    assert not (tmp_path / "set").exists()
