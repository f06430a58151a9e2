"""The benchmark of policies in environments, with a task small enough to be solved by hand."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
import bench_environments as bench  # pyright: ignore[reportMissingImports]
from public_tasks import known, lerobot_env, protocol  # pyright: ignore[reportMissingImports]


class Walk:
    """On a line, one step a time, to a thing that is at 3 or more; it may move 4 further."""

    fps, n_actions, longest, moved_at = 10.0, 1, 12, 2

    def __init__(self):
        self.expert = self
        self.renders = 0

    def begin(self, seed=None):
        if seed is not None:
            self.where, self.thing = 0.0, 3.0 + seed % 4
        return self._seen()

    def act(self, seen):
        return np.sign(seen["environment_state"] - seen["agent_pos"])

    def step(self, action):
        self.where += float(np.clip(action, -1, 1).item())
        return self._seen(), self.where == self.thing

    def move_object(self, rng):
        self.thing += 4
        return self._seen()

    def render(self):
        return np.zeros((4, 4, 3), np.uint8)

    def _seen(self):
        return {
            "agent_pos": np.array([self.where]),
            "environment_state": np.array([self.thing]),
        }


class Lost(Walk):
    """Whose expert does not know the way."""

    def act(self, seen):
        return np.zeros(1)


@pytest.fixture(autouse=True)
def walks(monkeypatch):
    for name, task in (("walk", Walk), ("lost", Lost)):
        setting = known.Setting(make=task, chunk=8, executed=2)
        monkeypatch.setitem(known.TASKS, name, setting)


def test_a_demonstration_is_what_was_seen_before_each_action():
    shown = protocol.demonstrate(Walk(), 0)
    assert shown["observation.state"].tolist() == [[0.0], [1.0], [2.0]]
    assert shown["observation.environment_state"].tolist() == [[3.0]] * 3
    assert shown["action"].tolist() == [[1.0]] * 3
    assert protocol.demonstrate(Lost(), 0) is None


def test_an_expert_is_tried_with_the_thing_moved():
    assert protocol.succeeds(Walk(), 3, moved=True)  # 6 + 4 of 12 actions
    assert not protocol.succeeds(Lost(), 0, moved=False)


@pytest.mark.parametrize(("moved", "expected"), [(False, 3), (True, 7)])
def test_lerobots_environment_moves_the_thing_under_way(moved, expected):
    config = lerobot_env.PublicTaskConfig(task="walk", move_object=moved)
    assert {k: f.shape for k, f in config.features.items()} == {
        "action": (1,),
        "agent_pos": (1,),
        "environment_state": (1,),
    }
    env = lerobot_env.PublicTaskEnv(**config.gym_kwargs)
    seen, info = env.reset(seed=0)
    assert seen["agent_pos"].dtype == np.float32
    things, steps, done = [], 0, False
    while not done:
        things.append(seen["environment_state"].item())
        seen, reward, done, late, info = env.step(np.ones(1, np.float32))
        steps += 1
        assert not late
    assert steps == expected
    assert info["is_success"]
    assert reward == 1
    assert things == ([3.0] * 3 if not moved else [3.0] * 2 + [7.0] * 5)


def test_a_thing_that_is_out_of_reach_by_then_is_left_there(monkeypatch):
    def nowhere(self, rng):
        raise RuntimeError("no such place")

    monkeypatch.setattr(Walk, "move_object", nowhere)
    env = lerobot_env.PublicTaskEnv("walk", move_object=True)
    env.reset(seed=0)
    things = [env.step(np.zeros(1))[0]["environment_state"].item() for _ in range(4)]
    assert things == [3.0] * 4


def test_an_episode_that_takes_too_long_ends_without_success():
    env = lerobot_env.PublicTaskEnv("walk")
    env.reset(seed=0)
    for k in range(12):
        _, reward, done, late, info = env.step(np.zeros(1, np.float32))
        assert (reward, done, info["is_success"]) == (0, False, False)
        assert late == (k == 11)


def test_there_is_no_such_task():
    with pytest.raises(ValueError, match="no task 'dance'; there are pusht, "):
        known.make_task("dance")


def test_demonstrations_are_kept_and_taken_again(tmp_path, monkeypatch):
    first = bench.demonstrations("walk", 4, tmp_path, Console())
    assert [len(e["action"]) for e in first] == [3, 4, 5, 6]
    monkeypatch.setattr(bench, "make_task", None)  # nothing is shown again
    again = bench.demonstrations("walk", 4, tmp_path, Console())
    for one, two in zip(first, again, strict=True):
        assert one.keys() == two.keys()
        assert all(torch.equal(one[key], two[key]) for key in one)
    assert len(bench.demonstrations("walk", 2, tmp_path, Console())) == 2


def test_an_expert_who_mostly_fails_shows_nothing(tmp_path):
    with pytest.raises(RuntimeError, match="lost: 4 of 4 demonstrations failed"):
        bench.demonstrations("lost", 2, tmp_path, Console())
    assert not any(tmp_path.iterdir())


@pytest.mark.long
def test_successes_are_counted_by_lerobots_evaluation():
    """A policy that steps on, whatever it sees, gets there, and later where the thing moved."""
    args = bench.Args(demonstrations=8, minutes=0.02)
    shown = [protocol.demonstrate(Walk(), seed) for seed in range(8)]
    learned = bench._learn("walk", "motion_chunk", shown, args)
    for moved in (False, True):
        with bench.environments("walk", 4, moved=moved) as vector:
            assert vector.num_envs == 4
            assert 0 <= bench.successes(vector, learned) <= 4
    learned.policy.select_action = lambda seen: torch.full((4, 1), 1e3)
    learned = bench.Learned(learned.policy, learned.before, lambda action: action, False)
    for moved in (False, True):
        with bench.environments("walk", 4, moved=moved) as vector:
            assert bench.successes(vector, learned) == 4
