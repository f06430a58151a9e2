"""`hrc multiply`: what it writes, what it leaves out, and how it goes on after a kill."""

import json

import numpy as np
import panda_environment
import pyarrow.parquet as pq
import pytest
import torch
from commands import hrc
from multiply_samples import END, write_dataset

from hrc_learn.cli import multiply_command
from hrc_learn.demos import check_dataset, load_demos
from hrc_learn.kinematics import arm, panda
from hrc_learn.learning import multiply_dataset


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    """Few motions are made at a time, and few failures end the work."""
    monkeypatch.setattr(multiply_command, "_CHUNK", 8)
    monkeypatch.setattr(multiply_command, "_ENOUGH", 12)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("multiply") / "three"
    write_dataset(folder)
    return folder


def origins(folder):
    table = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet")
    return [json.loads(text) for text in table.column("provenance").to_pylist()]


def multiplied(dataset, out, *more, episodes=6):
    return hrc("multiply", dataset, "--episodes", episodes, "--out", out, *more)


@pytest.mark.long
def test_new_episodes_have_the_columns_of_the_demonstrations(dataset, tmp_path):
    out, figures = tmp_path / "out", tmp_path / "figures.json"
    wide = "objects.block.yaw=[-0.4,0.4]"
    done = multiplied(dataset, out, "--json", figures, "--config", wide)
    assert done.status == 0
    assert "without physics" in done.output
    before, after = (json.loads((p / "meta/info.json").read_text()) for p in (dataset, out))
    assert {k: v for k, v in before["features"].items() if k != "time"} == after["features"]
    assert after["total_episodes"] == 6
    assert after["robot_type"] == "panda"
    assert not check_dataset(out).errors
    assert json.loads(figures.read_text())["success_rate"] > 0.5
    for demo, origin in zip(load_demos(out), origins(out), strict=True):
        q = torch.from_numpy(demo.joint_position)
        shown = demo.extra["observation.block"]
        place = np.array(origin["scene"]["block"])
        assert np.abs(shown[0, :3] - place[:3]).max() < 1e-6
        # Held, the block moves with the tool; it ends 8 cm higher, below the tool.
        assert shown[-1, 2] - shown[0, 2] == pytest.approx(0.08, abs=2e-3)
        tool = panda.forward(q[-1]).position.numpy()
        assert np.abs(tool - shown[-1, :3]).max() < 2e-3
        # The command is the position of the next frame; other columns are carried along.
        assert np.abs(demo.command_position[:-1] - demo.joint_position[1:]).max() < 1e-6
        mood = demo.extra["observation.mood"][:, 0]
        assert mood[0] == 0
        assert mood[-1] == pytest.approx((END - 1) / END)
        assert (np.diff(mood) >= 0).all()


@pytest.mark.long
@pytest.mark.parametrize("judge", ["", f"{panda_environment.__file__}:Taking"])
def test_it_goes_on_where_it_was_killed(tmp_path, monkeypatch, judge):
    whole, broken, dataset = (tmp_path / name for name in ("whole", "broken", "three"))
    write_dataset(dataset, gripper=True)
    settings = ["--config", "judge.processes=1", "objects.block.z=[0.05,0.05]"]
    settings += ["--judge", judge] * bool(judge)
    multiplied(dataset, whole, *settings)
    write = multiply_dataset.MultipliedWriter.write

    def killed(self, *given):
        write(self, *given)
        if len(self.provenance) == 4:
            raise KeyboardInterrupt

    monkeypatch.setattr(multiply_dataset.MultipliedWriter, "write", killed)
    assert multiplied(dataset, broken, *settings).status == 1
    assert not broken.exists()
    other = multiplied(dataset, broken, *settings, "--config", "multiply.seed=1")
    assert other.status == 2
    assert "other settings" in other.error
    monkeypatch.undo()
    assert multiplied(dataset, broken, *settings).status == 0
    assert origins(broken) == origins(whole)
    for one, two in zip(load_demos(broken), load_demos(whole), strict=True):
        assert np.array_equal(one.joint_position, two.joint_position)


def test_an_environment_shows_what_it_did_with_the_actions(tmp_path):
    """A simulator of the user decides; its observations and executed actions are written."""
    demos, out = tmp_path / "three", tmp_path / "out"
    write_dataset(demos, gripper=True)
    judge = f"{panda_environment.__file__}:Taking"
    settings = ("--config", "judge.processes=1", "objects.block.z=[0.05,0.05]")
    done = multiplied(demos, out, "--judge", judge, *settings, episodes=3)
    assert done.status == 0, done.error
    assert f"judged by physics: {judge}" in done.output
    assert not check_dataset(out).errors
    env = panda_environment.Taking()
    for demo, origin in zip(load_demos(out), origins(out), strict=True):
        assert origin["judged_by"] == f"physics: {judge}"
        pose, q = np.array(origin["scene"]["block"]), demo.joint_position
        seen = env.reset(seed=0, options={"objects": {"block": pose}, "joint_position": q[0]})
        for k in range(len(demo)):
            np.testing.assert_allclose(q[k], seen[0]["agent_pos"][:7], atol=1e-3)
            shown = demo.extra["observation.block"][k]
            np.testing.assert_allclose(shown, seen[0]["observation.block"], atol=2e-3)
            opening = demo.extra["action.gripper"][k]
            seen = env.step({"action": demo.command_position[k], "action.gripper": opening})
        assert seen[-1]["is_success"]
        assert (demo.extra["observation.mood"] == 0.5).all()


def test_another_arm_gets_its_own_joints(dataset, tmp_path):
    out = tmp_path / "ur"
    done = multiplied(dataset, out, "--robot", "ur5e", episodes=3)
    assert done.status == 0, done.error
    ur5e = arm("ur5e")
    demos = load_demos(out)
    assert demos.joint_names == ur5e.joint_names
    info = json.loads((out / "meta/info.json").read_text())
    assert info["robot_type"] == "ur5e"
    for demo, origin in zip(demos, origins(out), strict=True):
        grasp = int(np.flatnonzero(np.diff(demo.gripper) < 0)[0])
        tool = ur5e.forward(torch.from_numpy(demo.joint_position[grasp])).position
        assert np.abs(tool.numpy() - np.array(origin["scene"]["block"])[:3]).max() < 3e-3


def test_segments_are_listed_without_a_folder(dataset):
    done = hrc("multiply", dataset, "--episodes", 0)
    assert done.status == 0
    assert "block" in done.output
    assert not dataset.with_name(f"{dataset.name}_multiplied").exists()


def test_segments_are_listed_and_may_be_corrected(dataset, tmp_path):
    file, out = tmp_path / "segments.json", tmp_path / "out"
    option = ("--config", f"multiply.segments={file}")
    done = multiplied(dataset, out, *option, episodes=0)
    assert done.status == 0
    assert not out.exists()
    assert "block" in done.output
    content = json.loads(file.read_text())
    content["frames"][1] = "lid"
    file.write_text(json.dumps(content))
    done = multiplied(dataset, out, *option)
    assert done.status == 2
    assert "no frame 'lid'" in done.error


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (("--config", "objects.cup.columns=observation.state[0:4]"), "3, 6 or 7"),
        (("--config", "judge.scene=nowhere.xml"), "no scene 'nowhere.xml'"),
        (("--config", "objects.cup.x=[0.1,0.2]"), "the pose of the object 'cup' is unknown"),
        (("--config", "multiply.style=2"), "from 0 to 1"),
        (("--config", "multiply.speed=[0.0,1.0]"), "range above 0"),
        (("--config", "objects.block.x=[2.0,2.1]"), "hardly any motion"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(dataset, tmp_path, given, message):
    done = multiplied(dataset, tmp_path / "out", *given)
    assert done.status in (1, 2)
    assert message in done.error
    assert len(done.error.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())
