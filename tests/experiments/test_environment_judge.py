"""An environment in Python that executes new episodes: a finger pushes a block over a table."""

import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from hrc_learn.experiments.motion_judge import EnvironmentJudge, JudgeConfig, Trial, judging
from hrc_learn.kinematics import ArmChoice

pytestmark = pytest.mark.simulation

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.

SCENE = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <geom type="plane" size="2 2 0.1"/>
    <body name="finger" pos="0 0 0.03">
      <joint name="along" type="slide" axis="1 0 0" damping="5"/>
      <geom type="box" size="0.01 0.1 0.02" mass="0.2"/>
    </body>
    <body name="block" pos="0.1 0 0.03">
      <freejoint/>
      <geom type="box" size="0.03 0.03 0.03" mass="0.1" friction="0.5"/>
    </body>
  </worldbody>
  <actuator><position joint="along" kp="300" kv="10"/></actuator>
</mujoco>
"""
FPS, GOAL = 20, 0.3


class Pushing:
    """Push the block to GOAL along x; scenes beyond it are rejected."""

    metadata = {"render_fps": FPS}  # noqa: RUF012  as in gymnasium

    def __init__(self, ends=False, key="is_success", lost=""):
        self.model = mujoco.MjModel.from_xml_string(SCENE)
        self.data, self.ends, self.key, self.lost = mujoco.MjData(self.model), ends, key, lost

    def reset(self, *, seed, options):
        mujoco.mj_resetData(self.model, self.data)
        self.seed = seed
        self.data.qpos[0] = self.data.ctrl[0] = options["joint_position"][0]
        self.data.qpos[1:] = options["objects"]["block"]
        mujoco.mj_forward(self.model, self.data)
        beyond = self.data.qpos[1] > GOAL
        return self.seen(), {"failure": "the block is beyond the goal" if beyond else ""}

    def seen(self):
        found = {
            "agent_pos": np.array([self.data.qpos[0]], np.float32),
            "environment_state": self.data.qpos[1:4].copy(),
        }
        found.pop(self.lost, None)
        return found

    def step(self, action):
        self.data.ctrl[0] = action[0]
        mujoco.mj_step(self.model, self.data, round(1 / FPS / self.model.opt.timestep))
        done = self.data.body("block").xpos[0] > GOAL
        return self.seen(), float(done), self.ends and bool(done), False, {self.key: done}


def ending():
    return Pushing(ends=True)


def metaworld_like():
    return Pushing(key="success")


def silent():
    return Pushing(key="done")


def blind():
    return Pushing(lost="environment_state")


def nothing_made():
    return None


def slow():
    made = Pushing()
    made.metadata = {"render_fps": 80}
    return made


def trial(block=0.1, reach=0.35, frames=40):
    """Planned motion of the finger, which ends at `reach`; its observations are wrong."""
    path = np.linspace(0.0, reach, frames).clip(0, reach)[:, None]
    return Trial(
        joints=path,
        gripper=np.zeros(frames),
        objects={"block": np.array([block, 0, 0.03, 1, 0, 0, 0])},
        columns={
            "observation.state": path + 9,
            "observation.environment_state": np.full((frames, 3), 9.0),
            "action": path.astype(np.float32),
            "subtask": np.arange(frames)[:, None],
        },
        seed=7,
    )


def here(name):
    return f"{Path(__file__)}:{name}"


@pytest.mark.parametrize("name", ["Pushing", "metaworld_like"])
def test_observations_are_those_of_the_environment_and_actions_as_planned(name):
    given = trial()
    judge = EnvironmentJudge(here(name), float(FPS))
    made = judge.replay(given)
    assert made.failure == ""
    assert judge._env.seed == 7
    assert made.columns.keys() == given.columns.keys()
    for key in ("action", "subtask"):
        np.testing.assert_array_equal(made.columns[key], given.columns[key])
    finger = made.columns["observation.state"][:, 0]
    block = made.columns["observation.environment_state"]
    # The first frame shows the scene, each later one what the actions before it did.
    np.testing.assert_allclose([finger[0], *block[0]], [0, 0.1, 0, 0.03], atol=1e-6)
    assert 0.25 < finger[-1] < 0.35
    touching = block[:, 0] > 0.11
    assert touching.any()
    assert (block[touching, 0] - finger[touching] >= 0.039).all()
    again = judge.replay(given)
    np.testing.assert_array_equal(again.columns["observation.state"][:, 0], finger)


def test_an_episode_ends_with_the_environment():
    given = trial(reach=0.6)
    whole = EnvironmentJudge(here("Pushing"), float(FPS)).replay(given)
    made = EnvironmentJudge(here("ending"), float(FPS)).replay(given)
    assert made.failure == ""
    assert {len(x) for x in whole.columns.values()} == {40}
    (count,) = {len(x) for x in made.columns.values()}
    assert 10 < count < 35
    for key, x in made.columns.items():
        np.testing.assert_array_equal(x, whole.columns[key][:count])


@pytest.mark.parametrize("processes", [1, pytest.param(2, marks=pytest.mark.long)])
def test_failures_have_a_reason(processes):
    config = JudgeConfig(scene=here("Pushing"), processes=processes)
    given = [trial(), trial(reach=0.1), trial(block=0.4)]
    with judging(config, ArmChoice(), float(FPS), 1.0) as judge:
        reasons = [replay.failure for replay in judge(given)]
    assert reasons == [
        "",
        f"{here('Pushing')} reported no success",
        "the block is beyond the goal",
    ]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("silent", r"silent: step returns neither info\['is_success'\] nor info\['success'\]"),
        (
            "blind",
            r"returns \{'observation.state': 1\}, but observation.environment_state has 3",
        ),
        ("slow", r"takes 80 actions per second .* the dataset has 20: choose"),
        ("nothing_made", r"nothing_made makes a NoneType without the method reset"),
        ("nothing", r"judge.scene='.*:nothing' is not a MODULE:FUNCTION or FILE.py:FUNCTION"),
    ],
)
def test_an_environment_that_does_not_fit_is_named(name, message):
    given = trial()
    with pytest.raises(ValueError, match=message):
        EnvironmentJudge(here(name), float(FPS)).replay(given)


def test_a_file_may_have_the_name_of_a_module_and_import_its_neighbours(tmp_path):
    (tmp_path / "neighbour_of_judge.py").write_text("def step(action): pass\n")
    for name in ("json.py", "my-task.py"):
        (tmp_path / name).write_text(
            "from __future__ import annotations\n"
            "from dataclasses import dataclass\n"
            "import neighbour_of_judge\n"
            "@dataclass\n"
            "class Task:\n"
            "    size: float = 1.0\n"
            "    def reset(self): pass\n"
            "    step = staticmethod(neighbour_of_judge.step)\n"
        )
        judge = EnvironmentJudge(f"{tmp_path / name}:Task", float(FPS))
        assert judge._env.size == 1.0
    import json

    assert json.loads("1") == 1


def test_a_file_that_is_missing_or_imports_too_much_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"absent.py:make' is not .*No such file"):
        EnvironmentJudge(f"{tmp_path / 'absent.py'}:make", float(FPS))
    (tmp_path / "task.py").write_text("import not_installed_here\n")
    with pytest.raises(ValueError, match=r"task.py:make' is not .*not_installed_here"):
        EnvironmentJudge(f"{tmp_path / 'task.py'}:make", float(FPS))


def test_a_file_leaves_the_import_path_as_it_was():
    before = [*sys.path]
    EnvironmentJudge(here("Pushing"), float(FPS))
    assert sys.path == before
