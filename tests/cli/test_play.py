"""`hrc play`: its words, its files, and what it refuses."""

import csv
import json

import numpy as np
import pytest
import torch
from commands import done, hrc

from hrc_learn.cli import play_command
from hrc_learn.cli.arguments import Play
from hrc_learn.demos import DatasetWriter, open_demos
from hrc_learn.geometry import minimum_jerk
from hrc_learn.kinematics import panda
from hrc_learn.kinematics.registry import arm
from hrc_learn.learning.motion_playing import PlayedMotion

MOVES = {
    "panda": [(0.3, 0.1, -0.1, 0.2, 0.1, 0.0, 0.1), (-0.3, 0.2, 0.1, 0.1, 0.0, 0.2, 0.1)],
    "so101": [(0.3, 0.2, -0.2, 0.1, 0.3), (-0.3, 0.3, -0.2, -0.1, 0.2)],
}


def taught(name, folder):
    """Model of `hrc fit` from two demonstrations of an arm."""
    robot = arm(name)
    start = robot.ready.numpy()
    with DatasetWriter(
        folder / name, fps=50, robot_type=name, joint_names=robot.chain.joint_names
    ) as writer:
        for move in MOVES[name]:
            writer.start_episode("reach")
            for k in range(101):
                s, _ = minimum_jerk(k / 100)
                q = start + s * np.array(move) + 0.05 * np.sin(np.pi * s)
                tool = robot.forward(torch.from_numpy(q))
                writer.add_frame(
                    joint_position=q,
                    position=tool.position.numpy(),
                    orientation=tool.orientation.numpy(),
                )
            writer.save_episode()
    done("fit", folder / name, "--out", folder / f"{name}_model", "--n-basis", 20)
    return folder / f"{name}_model"


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("play")
    return {name: taught(name, folder) for name in MOVES}


def played(folder):
    """Names and values of the written table."""
    with (folder / "motion.csv").open(encoding="utf-8") as file:
        names, *rows = csv.reader(file)
    return names, np.array(rows, dtype=float)


GOAL = (0.5, -0.1, 0.4)


@pytest.mark.long
def test_a_motion_is_written_as_table_film_recording_and_episode(models, tmp_path):
    out, values = tmp_path / "out", tmp_path / "values.json"
    goal = ("--goal", *GOAL, "--robot", "panda")
    done("play", models["panda"], *goal, "--out", out, "--json", values)
    names, rows = played(out)
    joints = rows[:, 1:8]
    assert names[1:8] == [f"{n} [rad]" for n in panda.chain.joint_names]
    end = panda.forward(torch.from_numpy(joints[-1])).position.tolist()
    assert end == pytest.approx(GOAL, abs=1e-3)
    measured = json.loads(values.read_text())
    assert measured["goal_position_error_mm"] < 1
    assert measured["duration_s"] == pytest.approx(rows[-1, 0])
    assert {"film.mp4", "run.rrd", "motion.csv"} <= {file.name for file in out.iterdir()}
    (episode,) = open_demos(out / "episode")
    assert episode.joint_position == pytest.approx(joints, abs=1e-5)
    assert episode.command_position[:-1] == pytest.approx(joints[1:], abs=1e-5)


@pytest.mark.long
def test_a_demonstration_gives_start_and_goal(models, tmp_path):
    out = tmp_path / "out"
    words = ("--start", "episode", 1, "--goal", "episode", 0)
    done("play", models["so101"], *words, "--out", out)
    _, rows = played(out)
    ready = arm("so101").ready.numpy()
    assert rows[0, 1:6] == pytest.approx(ready, abs=1e-5)
    assert rows[-1, 1:6] == pytest.approx(ready + MOVES["so101"][0], abs=1e-3)


def test_without_an_arm_the_path_is_the_models_own(models, tmp_path):
    out = tmp_path / "out"
    asked = done("play", models["panda"], "--goal", 0.45, 0.1, 0.5, "--out", out)
    assert "no limits are checked" in asked.output
    names, rows = played(out)
    assert names == ["time [s]", "x [m]", "y [m]", "z [m]", "qw", "qx", "qy", "qz"]
    assert rows[-1, 1:4] == pytest.approx((0.45, 0.1, 0.5), abs=1e-4)
    assert np.linalg.norm(rows[:, 4:], axis=1) == pytest.approx(1)


@pytest.mark.parametrize(
    ("words", "said", "status"),
    [
        (["--goal", 0.5, 0.1], "--goal 0.5 0.1: ", 2),
        (["--goal", *range(7)], "7 numbers may be joints or pose", 2),
        (["--goal", "pose", 0.4, 0, 0.4, 1, 1, 0, 0], "the norm of w x y z is 1.414", 2),
        (["--goal", "there"], "accepts 7 numbers (joints), 3 numbers (position)", 2),
        (["--goal", "nan", 0.1, 0.2], "all finite", 2),
        (["--goal", "episode", "last"], "needs one number", 2),
        (["--goal", 0.4, 0, 0.4, "--robot", "so101"], "moves the joints panda_joint1", 2),
        (["--goal", 0.4, 0, 0.4, "--duration", 0], "--duration must be more than", 2),
        (["--goal", 1.5, 0, 0.4, "--robot", "panda"], "panda does not reach", 1),
        (
            ["--goal", "joints", 4, *[0] * 6, "--robot", "panda"],
            "panda_joint1 would be",
            1,
        ),
    ],
)
def test_what_cannot_be_played_is_one_line(words, said, status, models, tmp_path):
    asked = hrc("play", models["panda"], *words, "--out", tmp_path / "out")
    assert asked.status == status, asked.error
    assert said in asked.error
    assert asked.error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_shares_of_a_range_are_no_angles(models, tmp_path):
    from hrc_learn.dmp import JointDMP

    joint = JointDMP.load(models["panda"] / "joint")
    joint.units = "1"
    joint.save(tmp_path / "model" / "joint")
    words = ("--goal", "joints", *[0.1] * 7, "--out", tmp_path / "out")
    done("play", tmp_path / "model", *words)
    names, _ = played(tmp_path / "out")
    assert names[1] == "panda_joint1 [1]"
    asked = hrc("play", tmp_path / "model", *words, "--overwrite", "--robot", "panda")
    assert asked.status == 2
    assert "holds joints in fractions of their ranges, which have no known size" in asked.error


def test_the_action_of_each_frame_of_a_played_motion_is_the_next_position(tmp_path):
    """At the last one the arm is to stay."""
    robot = arm("panda")
    joints = robot.ready.numpy() + 0.01 * np.arange(5)[:, None]
    tool = robot.forward(torch.from_numpy(joints))
    motion = PlayedMotion(
        time=0.02 * np.arange(5),
        joints=joints,
        position=tool.position.numpy(),
        orientation=tool.orientation.numpy(),
        planned_duration=0.08,
        goal_errors={},
    )
    args = Play(model=tmp_path / "pour", goal=("0",), out=tmp_path)
    play_command._write_episode(tmp_path / "episode", args, robot, motion)
    (demo,) = open_demos(tmp_path / "episode")
    assert demo.fps == 50
    assert demo.task == "played pour"
    np.testing.assert_allclose(demo.joint_position, joints, atol=1e-6)
    np.testing.assert_allclose(demo.command_position[:-1], joints[1:], atol=1e-6)
    np.testing.assert_allclose(demo.command_position[-1], joints[-1], atol=1e-6)
