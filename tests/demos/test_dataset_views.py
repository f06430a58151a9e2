"""The arm of a dataset, and its configuration from the dataset's own units."""

import json

import numpy as np
import pytest
from lerobot_folders import joint_path, write_folder

from hrc_learn.demos import DatasetError, open_demos
from hrc_learn.demos.dataset_views import arm_of_dataset
from hrc_learn.demos.read.dataset_files import INFO_PATH
from hrc_learn.kinematics import panda
from hrc_learn.kinematics.registry import arm_of_robot

SO101 = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]


def dataset(root, names, robot_type, values):
    write_folder(root, [{"observation.state": values}], {"observation.state": names})
    info = root / INFO_PATH
    content = json.loads(info.read_text())
    info.write_text(json.dumps(content | {"robot_type": robot_type}))
    return root


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("robot_type", ["so101_follower", "so101", "so100_follower"])
def test_a_follower_is_found_by_its_type_and_its_shares_become_angles(tmp_path, robot_type):
    if arm_of_robot("so101") is None:
        pytest.skip("example-robot-data is not installed")
    values = 100 * np.sin(np.linspace(0, 6, 60))[:, None] * np.ones(6)
    root = dataset(tmp_path / "set", [f"{n}.pos" for n in SO101], robot_type, values)
    source = open_demos(root, units={"joint_position": "%", "gripper": "%"})
    found = arm_of_dataset(source)
    assert found.arm.name == "so101"
    (demo,) = source
    limits = found.arm.limits
    middle, half = limits.middle.numpy(), (limits.upper - limits.lower).numpy() / 2
    expected = middle + half * values[:, :1] / 100
    np.testing.assert_allclose(found.positions(demo.joint_position), expected, atol=1e-6)
    np.testing.assert_allclose(found.opening(demo), values[:, 5].clip(0) / 100, atol=1e-6)


def test_joints_are_found_by_name_in_any_order_or_by_their_number(tmp_path):
    values = joint_path(60, 7)
    order = [3, 0, 6, 1, 5, 2, 4]
    named = [f"{panda.joint_names[k]}.pos" for k in order]
    source = open_demos(dataset(tmp_path / "named", named, "panda", values))
    found = arm_of_dataset(source)
    q = found.positions(source[0].joint_position)
    np.testing.assert_allclose(q, values[:, np.argsort(order)], atol=1e-6)
    plain = [f"motor_{k}" for k in range(7)]
    source = open_demos(dataset(tmp_path / "plain", plain, "Franka", values))
    found = arm_of_dataset(source)
    assert found.arm is panda
    np.testing.assert_allclose(found.positions(source[0].joint_position), values, atol=1e-6)


def test_an_unknown_robot_and_another_number_of_joints_are_named(tmp_path):
    source = open_demos(dataset(tmp_path / "set", ["a", "b", "c"], "heron", joint_path(60, 3)))
    with pytest.raises(DatasetError, match=r"robot type 'heron' .*--robot NAME\|FILE"):
        arm_of_dataset(source)
    with pytest.raises(DatasetError, match=r"joints \(a, b, c\) are not those of panda"):
        arm_of_dataset(source, "panda")


def test_ticks_count_from_the_middle_of_a_turn(tmp_path):
    """4096 ticks are a turn, so 2048 are no angle."""
    names = [f"{name}.pos" for name in panda.joint_names]
    values = 2048 + 4096 / (2 * np.pi) * joint_path(60, 7)
    source = open_demos(
        dataset(tmp_path / "set", names, "panda", values), units={"joint_position": "tick"}
    )
    found = arm_of_dataset(source).positions(source[0].joint_position)
    np.testing.assert_allclose(found, joint_path(60, 7), atol=1e-6)


@pytest.mark.parametrize(
    ("robot", "widest", "opened"),
    # The hand of a Franka opens by 80 mm; of an arm without a hand the data tell.
    [("panda", 0.04, 0.5), ("panda", 0.08, 1.0), ("panda", 0.1, 1.0), ("iiwa7", 0.05, 1.0)],
)
def test_a_gripper_in_metres_opens_by_its_width(tmp_path, robot, widest, opened):
    names = [*(f"joint_{k}.pos" for k in range(7)), "gripper.pos"]
    values = np.hstack([joint_path(60, 7), np.linspace(0, widest, 60)[:, None]])
    if arm_of_robot(robot) is None:
        pytest.skip("example-robot-data is not installed")
    root = dataset(tmp_path / "set", names, robot, values)
    source = open_demos(root, units={"joint_position": "rad", "gripper": "m"})
    found = arm_of_dataset(source)
    opening = found.opening(source[0])
    np.testing.assert_allclose(opening[[0, -1]], [0, opened], atol=1e-6)
    assert (np.diff(opening) >= 0).all()
