"""`hrc play`: models of a Panda and of an SO-101 carried out to goals, judged by Pinocchio."""

import csv
import json
import re
from importlib.metadata import distribution

import numpy as np
import pytest
import torch
from commands import done, hrc

from hrc_learn.demos import DatasetWriter, open_demos
from hrc_learn.geometry import minimum_jerk
from hrc_learn.kinematics import panda
from hrc_learn.kinematics.registry import arm
from hrc_learn.learning.fitted_model import FittedModel, Target, arm_for
from hrc_learn.learning.motion_playing import play_on_arm

pin = pytest.importorskip("pinocchio")

DESCRIPTIONS = {
    "panda": ("panda_description/urdf/panda.urdf", "panda_hand_tcp"),
    "so101": ("so_arm_description/urdf/so101.urdf", "gripper_frame_link"),
}
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


def tool_by_pinocchio(name, joints):
    """Position of the tool by Pinocchio, from the maker's description [m]."""
    file, frame = DESCRIPTIONS[name]
    share = "cmeel.prefix/share/example-robot-data/robots"
    path = str(distribution("example-robot-data").locate_file(f"{share}/{file}"))
    model = pin.buildModelFromUrdf(path)
    q = pin.neutral(model)
    for joint, value in zip(arm(name).chain.joint_names, joints, strict=True):
        q[model.joints[model.getJointId(joint)].idx_q] = value
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return data.oMf[model.getFrameId(frame)].translation


def beyond(name, joints):
    """Largest ratio of a motion at 50 Hz to the limits of velocity, acceleration and jerk."""
    limits, padded = arm(name).limits, np.concatenate([joints[:1]] * 3 + [joints])
    ratios = [
        np.abs(np.diff(padded, n, axis=0) * 50.0**n).max(0) / getattr(limits, kind).numpy()
        for n, kind in enumerate(("velocity", "acceleration", "jerk"), 1)
    ]
    assert (joints >= limits.lower.numpy()).all()
    assert (joints <= limits.upper.numpy()).all()
    return float(np.max(ratios))


def moved(models, name, goal, start=None, duration=None):
    """Motion of an arm by the model of its demonstrations."""
    model = FittedModel.load(models[name])
    return play_on_arm(model, arm_for(model, name), start, goal, duration)


GOALS = {"panda": (0.5, -0.1, 0.4), "so101": (0.25, 0.1, 0.15)}


@pytest.mark.parametrize("name", GOALS)
def test_an_arm_reaches_a_position_within_its_limits(name, models):
    goal = GOALS[name]
    joints = moved(models, name, Target(position=torch.tensor(goal).double())).joints
    assert tool_by_pinocchio(name, joints[-1]) == pytest.approx(goal, abs=1e-3)
    assert beyond(name, joints) <= 1 + 1e-6
    assert np.abs(np.diff(joints, axis=0)).max() < 0.1  # continuous


def test_a_motion_is_written_as_table_film_recording_and_episode(models, tmp_path):
    out, values = tmp_path / "out", tmp_path / "values.json"
    goal = ("--goal", *GOALS["panda"], "--robot", "panda")
    done("play", models["panda"], *goal, "--out", out, "--json", values)
    names, rows = played(out)
    joints = rows[:, 1:8]
    assert names[1:8] == [f"{n} [rad]" for n in panda.chain.joint_names]
    expected = moved(models, "panda", Target(position=torch.tensor(GOALS["panda"]).double()))
    assert joints == pytest.approx(expected.joints, abs=1e-6)
    measured = json.loads(values.read_text())
    assert measured["goal_position_error_mm"] < 1
    assert measured["duration_s"] == pytest.approx(rows[-1, 0])
    assert {"film.mp4", "run.rrd", "motion.csv"} <= {file.name for file in out.iterdir()}
    (episode,) = open_demos(out / "episode")
    assert episode.joint_position == pytest.approx(joints, abs=1e-5)
    assert episode.command_position[:-1] == pytest.approx(joints[1:], abs=1e-5)


def test_a_pose_is_reached_with_its_orientation(models):
    turned = panda.forward(panda.ready + 0.1)
    goal = Target(position=turned.position + 0.05, orientation=turned.orientation)
    end = panda.forward(torch.from_numpy(moved(models, "panda", goal).joints[-1]))
    assert end.position.tolist() == pytest.approx(goal.position.tolist(), abs=1e-3)
    assert abs(float(end.orientation @ turned.orientation)) == pytest.approx(1, abs=1e-5)


def test_what_is_too_fast_takes_longer_and_says_why(models):
    goal = (0.6, 0.4, 0.3, -2.0, 0.2, 1.9, 1.2)
    motion = moved(models, "panda", Target(joints=torch.tensor(goal).double()), duration=0.3)
    assert re.fullmatch(r"\w+ of panda_joint\d", motion.slowed_by)
    assert motion.planned_duration == 0.3
    assert motion.joints[-1] == pytest.approx(goal, abs=1e-3)
    assert 0.9 * 0.3 < beyond("panda", motion.joints) <= 1 + 1e-6
    # Its spring pulls it towards a distant goal: 1.2 rad take 4.4 s at 7.5 rad/s^2.
    assert 0.5 < motion.time[-1] < 6.0


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
    assert "no limits were checked" in asked.output
    names, rows = played(out)
    assert names == ["time [s]", "x [m]", "y [m]", "z [m]", "qw", "qx", "qy", "qz"]
    assert rows[-1, 1:4] == pytest.approx((0.45, 0.1, 0.5), abs=1e-4)
    assert np.linalg.norm(rows[:, 4:], axis=1) == pytest.approx(1)


@pytest.mark.parametrize(
    ("words", "said", "status"),
    [
        (["--goal", 0.5, 0.1], "--goal 0.5 0.1: ", 2),
        (["--goal", *range(7)], "7 numbers may be joints or pose", 2),
        (["--goal", "pose", 0.4, 0, 0.4, 1, 1, 0, 0], "a quaternion has 1", 2),
        (["--goal", "there"], "takes 7 numbers (joints), 3 numbers (position)", 2),
        (["--goal", "nan", 0.1, 0.2], "all finite", 2),
        (["--goal", "episode", "last"], "needs the number of one", 2),
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
    assert "holds joints in shares of their ranges, of which no angle is known" in asked.error
