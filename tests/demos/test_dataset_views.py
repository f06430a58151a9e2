"""The arm of a dataset, and its configuration from the dataset's own units."""

import json
from dataclasses import replace

import numpy as np
import pytest
from lerobot_folders import joint_path, write_folder

from hrc_learn.demos import DatasetError, Demonstration, open_demos
from hrc_learn.demos.dataset_views import arm_of_dataset, demonstration_charts
from hrc_learn.demos.read.dataset_files import INFO_PATH
from hrc_learn.demos.read.units import UnitDecision
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
    ("robot", "length", "widest", "opened"),
    # The hand of a Franka opens by 80 mm; of an arm without a hand, and of an angle, the data
    # tell.
    [
        ("panda", "m", 0.04, 0.5),
        ("panda", "m", 0.08, 1.0),
        ("panda", "m", 0.1, 1.0),
        ("iiwa7", "m", 0.05, 1.0),
        ("panda", "deg", 40.0, 1.0),
    ],
)
def test_a_gripper_opens_by_its_width(tmp_path, robot, length, widest, opened):
    names = [*(f"joint_{k}.pos" for k in range(7)), "gripper.pos"]
    values = np.hstack([joint_path(60, 7), np.linspace(0, widest, 60)[:, None]])
    if arm_of_robot(robot) is None:
        pytest.skip("example-robot-data is not installed")
    root = dataset(tmp_path / "set", names, robot, values)
    source = open_demos(root, units={"joint_position": "rad", "gripper": length})
    found = arm_of_dataset(source)
    opening = found.opening(source[0])
    np.testing.assert_allclose(opening[[0, -1]], [0, opened], atol=1e-6)
    assert (np.diff(opening) > 0).sum() > 40


def unit(role, name, *units):
    return UnitDecision(role=role, unit=name, units=units)


def test_charts_are_in_the_units_of_the_dataset():
    time = np.arange(5) / 10
    q, p = np.outer(time, [1.0, 2.0]), np.outer(time, [1.0, 2, 3])
    seen = np.array([True, False, True, True, False])
    demo = Demonstration(
        time=time,
        joint_names=("a", "b"),
        joint_position=q,
        command_position=q + 1,
        position=p,
        gripper=0.04 + time,
        feature=np.outer(time, [10.0, 20]),
        feature_visible=seen,
        human_effort=3 * q,
        fps=10,
    )
    units = {
        "joint_position": unit("joint_position", "deg", "deg", "rad"),
        "gripper": unit("gripper", "mm", "mm"),
    }
    charts = {chart.key: chart for chart in demonstration_charts(demo, units)}
    assert [(chart.key, chart.title, chart.unit) for chart in charts.values()] == [
        ("joint_0", "a", "deg"),
        ("joint_1", "b", "rad"),
        ("gripper", "Gripper", "mm"),
        ("position", "Tool centre point", "m"),
        ("feature", "Feature in the image", "px"),
        ("effort", "Effort of the person", "N m"),
    ]
    np.testing.assert_allclose(charts["joint_0"].lines["measured"], np.rad2deg(q[:, 0]))
    # Commands are shown in the unit of the joint, whatever theirs is on disk.
    np.testing.assert_allclose(charts["joint_0"].lines["commanded"], np.rad2deg(q[:, 0] + 1))
    own = units | {"command_position": unit("command_position", "0.5 rad")}
    (again, *_) = demonstration_charts(demo, own)
    assert again.unit == "deg"
    np.testing.assert_allclose(again.lines["commanded"], np.rad2deg(q[:, 0] + 1))
    # Fractions of a range, or changes, are another quantity.
    for other, factor in (("%", 100.0), ("deg/step", 180 / np.pi)):
        own["command_position"] = unit("command_position", other)
        joint, command, *_ = demonstration_charts(demo, own)
        assert (joint.key, command.key, command.unit) == ("joint_0", "command_0", other)
        assert ([*joint.lines], [*command.lines]) == (["measured"], ["commanded"])
        np.testing.assert_allclose(command.lines["commanded"], factor * (q[:, 0] + 1))
    np.testing.assert_allclose(charts["joint_1"].lines["measured"], q[:, 1])
    np.testing.assert_allclose(charts["gripper"].lines["opening"], 40 + 1000 * time)
    np.testing.assert_allclose(charts["position"].lines["z"], p[:, 2])
    assert [*charts["position"].lines] == ["x", "y", "z"]
    down = charts["feature"].lines["v (down)"]
    np.testing.assert_array_equal(np.isnan(down), ~seen)
    np.testing.assert_allclose(down[seen], 20 * time[seen])
    np.testing.assert_allclose(charts["effort"].lines["b"], 3 * q[:, 1])


def test_charts_show_what_was_recorded_only():
    time = np.arange(5) / 10
    bare = Demonstration(time=time, gripper=time, fps=10)
    (one,) = demonstration_charts(bare, {})
    assert (one.key, one.unit) == ("gripper", "m")
    (one,) = demonstration_charts(bare, {"gripper": unit("gripper", "1")})
    assert one.unit == ""
    (one,) = demonstration_charts(bare, {"gripper": unit("gripper", "%")})
    assert one.unit == "%"
    np.testing.assert_allclose(one.lines["opening"], 100 * time)
    feature = replace(bare, gripper=None, feature=np.outer(time, [1.0, 2]))
    (one,) = demonstration_charts(feature, {})
    assert np.isfinite(one.lines["u (right)"]).all()
    rates = Demonstration(
        time=time, joint_names=("a",), joint_velocity=time[:, None], fps=10, gripper=time
    )
    assert [chart.key for chart in demonstration_charts(rates, {})] == ["gripper"]
