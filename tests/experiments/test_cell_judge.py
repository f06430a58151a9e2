"""Motions judged in our work cell: what is put where, read, commanded and called a failure."""

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from unchecked import shapes_unchecked

from hrc_learn.experiments import motion_judge
from hrc_learn.experiments.motion_judge import (
    CellJudge,
    JudgeConfig,
    Trial,
    judging,
    replay,
)
from hrc_learn.kinematics import ArmChoice
from hrc_learn.sim import PhysicsError
from hrc_learn.sim.workplace import Workplace

pytestmark = pytest.mark.simulation

WORKPLACE = Workplace()
HOME = WORKPLACE.home_joints().numpy()
FPS = 20.0


@pytest.fixture(scope="module", params=["grasping", "placing"])
def judge(request):
    config = JudgeConfig(scene=request.param, shelf="upper", processes=1)
    found = config.open(ArmChoice(), FPS, 0.08)
    assert isinstance(found, CellJudge)
    return found


@pytest.fixture(scope="module")
def grasping():
    return CellJudge(JudgeConfig(scene="grasping"), ArmChoice(), FPS)


def lying(x, y, **others):
    """A slow motion from home beside a box that lies somewhere, and other places."""
    pose = np.array([x, y, 0.025, np.cos(0.2), 0.0, 0.0, np.sin(0.2)])
    objects = {"box": pose} | others
    joints = HOME + 0.02 * np.arange(5)[:, None]
    return Trial(joints=joints, gripper=np.full(5, 0.08), objects=objects)


def test_the_object_is_in_the_gripper_for_placing_and_on_the_table_for_grasping(judge):
    x, y = WORKPLACE.table_centre
    given = lying(x, y + 0.05, shelf=np.arange(7.0))
    judge.begin(given)
    q, width, objects = judge.read()
    np.testing.assert_allclose(q, HOME, atol=1e-3)
    placing = judge.run.scenario.task.startswith("place")
    assert judge.run.world.holds("box") == placing
    assert set(objects) == {"box", "shelf"}
    np.testing.assert_array_equal(objects["shelf"], np.arange(7.0))
    if placing:
        assert judge.run.scenario.shelf == "upper"
        assert width < 0.08
        tool = judge.run.world.arm.tcp_pose()[:3, 3]
        np.testing.assert_allclose(objects["box"][:3], tool, atol=0.05)
    else:
        np.testing.assert_allclose(objects["box"], given.objects["box"], atol=1e-6)
    before = judge.run.world.time
    judge.command(HOME, 0.05)
    assert judge.run.world.time - before == pytest.approx(1 / FPS)


def test_a_motion_without_objects_begins_with_the_box_in_the_gripper(grasping):
    trial = lying(0.4, 0.3)
    grasping.begin(Trial(joints=trial.joints, gripper=trial.gripper, objects={}))
    assert grasping.run.world.holds("box")
    assert grasping.read()[2] == {}


def test_a_replay_that_does_nothing_fails_and_names_the_reason(grasping):
    made = replay(grasping, lying(*WORKPLACE.table_centre))
    assert made.failure == "the task was not done in simulation"
    assert made.gripper is not None
    assert made.joints.shape == made.sent.shape == (5, 7)
    assert made.objects["box"].shape == (5, 7)
    np.testing.assert_allclose(made.objects["box"][-1, :2], WORKPLACE.table_centre, atol=1e-3)


@pytest.mark.parametrize(
    ("touched", "done", "failure"),
    [
        ((), True, ""),
        ((), False, "the task was not done in simulation"),
        (("hand touched table", "hand touched box"), True, "hand touched table"),
        (("hand touched table",), False, "hand touched table"),
    ],
)
def test_an_unwanted_contact_counts_more_than_success(
    grasping, monkeypatch, touched, done, failure
):
    """Only contacts since the start of the motion count."""
    world = SimpleNamespace(touched_since=lambda time: touched if time == 0.0 else ())
    run = SimpleNamespace(world=world, succeeded=lambda: done)
    monkeypatch.setattr(grasping, "run", run)
    assert grasping.failure() == failure


class Falling:
    """A judge whose physics fails after some frames."""

    def __init__(self, frames):
        self.left = frames

    def begin(self, trial):
        pass

    def read(self):
        return np.zeros(2), np.nan, {}

    def command(self, joints, width):
        if not self.left:
            raise PhysicsError("it exploded", 0.25)
        self.left -= 1
        return joints

    def failure(self):
        return "not reached"


@pytest.mark.parametrize("frames", [0, 2])
def test_physics_that_fails_ends_the_replay_there(frames):
    joints = np.arange(8.0).reshape(4, 2)
    judge: Any = Falling(frames)
    trial = Trial(joints=joints, gripper=np.zeros(4), objects={})
    with shapes_unchecked():
        made = replay(judge, trial)
    assert made.failure.startswith("physics: ")
    assert "it exploded" in made.failure
    assert len(made.joints) == frames + 1
    expected = joints[1 : frames + 1] if frames else joints[1:2]
    np.testing.assert_array_equal(made.sent, expected)
    assert made.gripper is None


def test_a_scene_that_is_no_scenario_is_a_file():
    known = "there are placing, grasping, an MJCF file, or FILE.py"
    with pytest.raises(FileNotFoundError, match=re.escape(known)):
        JudgeConfig(scene="nothing.xml").open(ArmChoice(), FPS, 0.08)


@pytest.mark.parametrize(("processes", "forked"), [(0, False), (1, False), (2, True)])
def test_several_processes_judge_in_a_pool(monkeypatch, processes, forked):
    opened, pools = [], []
    monkeypatch.setattr(
        JudgeConfig, "open", lambda self, *given: opened.append(given) or "the judge"
    )
    monkeypatch.setattr(motion_judge, "replay", lambda judge, trial: (judge, trial))
    monkeypatch.setattr(motion_judge, "ByValue", lambda trial: trial)

    class Pool:
        def __init__(self, count, begin, *given):
            pools.append(count)
            begin(*given)

        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

        def map(self, function, trials):
            return map(function, trials)

    monkeypatch.setattr(motion_judge, "worker_pool", Pool)
    trials: Any = ["a", "b"]
    with (
        shapes_unchecked(),
        judging(JudgeConfig(processes=processes), ArmChoice(), FPS, 0.08) as judge,
    ):
        assert list(judge(trials)) == [("the judge", "a"), ("the judge", "b")]
    assert opened == [(ArmChoice(), FPS, 0.08)] * (1 + forked)
    assert pools == [processes] * forked
