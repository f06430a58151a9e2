"""Limits for smoothing, of small datasets on disk, against loops over their differences."""

import itertools
import json
import runpy
from pathlib import Path

import numpy as np
import pytest

from hrc_learn.demos import DatasetWriter
from hrc_learn.kinematics import panda
from hrc_learn.lerobot.arm_values import ArmValues
from hrc_learn.lerobot.smoothing import (
    ActionLimits,
    demonstrated_limits,
    gathered_limits,
)
from hrc_learn.lerobot.smoothing.action_limits import calibrated_ranges, urdf_limits

FPS = 20.0


def write(folder, episodes, names=("a", "b", "c")):
    """A dataset of a robot that was sent along paths, (frames, values) each."""
    with DatasetWriter(folder, fps=FPS, robot_type="point", joint_names=names) as writer:
        for path in episodes:
            writer.start_episode("move")
            for row in path:
                writer.add_frame(joint_position=row[::-1], command_position=row)
            writer.save_episode()
    return folder


def describe_anew(folder, change):
    """Change the features that the dataset declares."""
    file = folder / "meta" / "info.json"
    info = json.loads(file.read_text())
    change(info["features"])
    file.write_text(json.dumps(info))


def paths(width=3, frames=(70, 4, 60), seed=0):
    """Walks that start far apart: a step from one to the next would be the largest."""
    rng = np.random.default_rng(seed)
    scale = np.linspace(1, 3, width)
    walks = [scale * rng.normal(size=(n, width)).cumsum(0) / 10 for n in frames]
    # As exact as a dataset keeps them.
    return [(walk + 100 * k).astype(np.float32).astype(float) for k, walk in enumerate(walks)]


def largest(episodes, order):
    """The 99.9th percentile of the absolute differences, linearly between the two nearest."""
    columns = []
    for j in range(episodes[0].shape[1]):
        found = []
        for x in (e[:, j].tolist() for e in episodes):
            for _ in range(order):
                x = [(b - a) * FPS for a, b in itertools.pairwise(x)]
            found += [abs(value) for value in x]
        found.sort()
        at = 0.999 * (len(found) - 1)
        low = int(at)
        high = min(low + 1, len(found) - 1)
        columns.append(found[low] + (at - low) * (found[high] - found[low]))
    return columns


@pytest.mark.parametrize("scale", [None, 0.5])
def test_limits_are_what_was_demonstrated_within_episodes(tmp_path, scale):
    shown = paths()
    dataset = write(tmp_path / "set", shown)
    limits = demonstrated_limits(dataset, **({} if scale is None else {"scale": scale}))
    for name, order in (("velocity", 1), ("acceleration", 2), ("jerk", 3)):
        expected = [(scale or 1.0) * value for value in largest(shown, order)]
        assert getattr(limits, name) == pytest.approx(expected, rel=1e-9)
    assert limits.names == ["a.pos", "b.pos", "c.pos"]
    assert limits.fps == FPS
    assert limits.state_columns == [0, 1, 2]
    assert limits.lower == limits.upper == [None, None, None]


def test_what_holds_still_has_a_thousandth_of_the_largest_limit(tmp_path):
    shown = paths()
    for path in shown:
        path[:, 1] = 0.25
    limits = demonstrated_limits(write(tmp_path / "set", shown))
    for values in (limits.velocity, limits.acceleration, limits.jerk):
        assert values[1] == pytest.approx(max(values) / 1000)


def test_names_may_be_missing_or_grouped(tmp_path):
    dataset = write(tmp_path / "set", paths())
    describe_anew(dataset, lambda f: f["action"].update(names={"motors": ["x", "y", "z"]}))
    limits = demonstrated_limits(dataset)
    assert limits.names == ["x", "y", "z"]
    assert limits.state_columns == [-1, -1, -1]
    describe_anew(dataset, lambda f: f["action"].update(names=[["x", "y", "z"]]))
    assert demonstrated_limits(dataset).names == ["x", "y", "z"]
    describe_anew(dataset, lambda f: f["action"].update(names=["x", "y"]))
    assert demonstrated_limits(dataset).names == ["action.0", "action.1", "action.2"]
    for feature in ("action", "observation.state"):
        describe_anew(dataset, lambda f, feature=feature: f[feature].update(names=None))
    limits = demonstrated_limits(dataset)
    assert limits.names == ["action.0", "action.1", "action.2"]
    describe_anew(dataset, lambda f: f.pop("observation.state"))
    assert demonstrated_limits(dataset).state_columns == [-1, -1, -1]


@pytest.mark.parametrize(
    ("shown", "message"),
    [
        ([np.zeros((9, 2))], "are constant"),
        ([np.arange(6.0).reshape(3, 2) ** 2], "too short"),
    ],
)
def test_what_shows_no_motion_is_refused(tmp_path, shown, message):
    with pytest.raises(ValueError, match=message):
        demonstrated_limits(write(tmp_path / "set", shown, ("a", "b")))


@pytest.mark.parametrize("slope", [1.0, 0.1, 0.01])
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_a_constant_velocity_is_reached_within_one_action(tmp_path, slope, scale):
    """Also next to columns of constant acceleration and jerk, in single precision."""
    k = np.arange(40.0)
    ramp = 1 + slope * k
    shown = [np.stack([ramp, k**2 / 64, k**3 / 4096], axis=1)]
    found = demonstrated_limits(write(tmp_path / "set", shown, ("a", "b", "c")), scale)
    limits = np.array([found.velocity, found.acceleration, found.jerk])
    assert limits[:, 0] == pytest.approx(scale * slope * FPS ** np.arange(1, 4), rel=1e-3)
    assert limits[1:, 1] == pytest.approx(scale / 32 * FPS ** np.arange(2, 4), rel=1e-5)
    for order in (1, 2, 3):
        expected = scale * largest(shown, order)[2]
        assert limits[order - 1, 2] == pytest.approx(expected, rel=1e-5)
    only = demonstrated_limits(write(tmp_path / "one", [ramp[:, None]], ("a",)), scale)
    assert [only.velocity, only.acceleration, only.jerk] == [[x] for x in limits[:, 0]]


def test_a_dataset_without_actions_is_refused(tmp_path):
    dataset = write(tmp_path / "set", paths())
    describe_anew(dataset, lambda f: f.pop("action"))
    with pytest.raises(ValueError, match="has no actions"):
        demonstrated_limits(dataset)


URDF = """<?xml version="1.0"?>
<robot name="arm">
  <link name="l0"/><link name="l1"/><link name="l2"/><link name="l3"/><link name="l4"/>
  <joint name="a" type="revolute"><parent link="l0"/><child link="l1"/>
    <limit lower="-1.5" upper="2" velocity="0.25"/></joint>
  <joint name="b" type="continuous"><parent link="l1"/><child link="l2"/>
    <limit velocity="3" effort="1"/></joint>
  <joint name="c" type="prismatic"><parent link="l2"/><child link="l3"/>
    <limit lower="0" upper="0.1" velocity="0"/></joint>
  <joint name="d" type="fixed"><parent link="l3"/><child link="l4"/></joint>
</robot>
"""


def test_a_urdf_tells_positions_and_velocities(tmp_path):
    file = tmp_path / "arm.urdf"
    file.write_text(URDF)
    ranges, velocities = urdf_limits(file)
    assert ranges == {"a.pos": (-1.5, 2.0), "c.pos": (0.0, 0.1)}
    assert velocities == {"a.pos": 0.25, "b.pos": 3.0}
    ranges, velocities = urdf_limits(file, degrees=True)
    assert ranges["a.pos"] == pytest.approx((-85.94367, 114.59156))
    assert velocities["b.pos"] == pytest.approx(171.88734)
    assert ranges["c.pos"] == (0.0, 0.1)  # metres stay


CALIBRATION = {
    "a": {"id": 1, "drive_mode": 0, "homing_offset": 5, "range_min": 1000, "range_max": 3047},
    "gripper": {"id": 2, "drive_mode": 0, "homing_offset": 5, "range_min": 9, "range_max": 99},
}


def test_a_calibration_tells_positions_as_lerobot_does(tmp_path):
    """Against LeRobot's own normalisation of the ends, of a bus that is never opened."""
    from lerobot.motors import Motor, MotorCalibration, MotorNormMode
    from lerobot.motors.feetech import FeetechMotorsBus

    file = tmp_path / "me.json"
    file.write_text(json.dumps(CALIBRATION))
    for degrees, mode in ((True, MotorNormMode.DEGREES), (False, MotorNormMode.RANGE_M100_100)):
        motors = {
            "a": Motor(1, "sts3215", mode),
            "gripper": Motor(2, "sts3215", MotorNormMode.RANGE_0_100),
        }
        calibration = {k: MotorCalibration(**v) for k, v in CALIBRATION.items()}
        bus = object.__new__(FeetechMotorsBus)  # its driver need not be installed
        bus.motors, bus.calibration = motors, calibration
        bus._id_to_name_dict = {m.id: name for name, m in motors.items()}
        bus._id_to_model_dict = {m.id: m.model for m in motors.values()}
        ranges = calibrated_ranges(file, degrees=degrees)
        assert (ranges == calibrated_ranges(file)) != degrees
        for side, end in enumerate(("range_min", "range_max")):
            expected = bus._normalize({m["id"]: m[end] for m in CALIBRATION.values()})
            found = [ranges["a.pos"][side], ranges["gripper.pos"][side]]
            assert found == pytest.approx(list(expected.values()))


def test_what_is_known_is_put_together(tmp_path):
    shown = paths()
    dataset = write(tmp_path / "set", shown)
    (tmp_path / "arm.urdf").write_text(URDF)
    (tmp_path / "me.json").write_text(json.dumps({"a": CALIBRATION["a"]}))
    plain = demonstrated_limits(dataset, 0.5)
    limits = gathered_limits(
        dataset, scale=0.5, urdf=tmp_path / "arm.urdf", calibration=tmp_path / "me.json"
    )
    assert (limits.lower, limits.upper) == ([-100.0, None, 0.0], [100.0, None, 0.1])
    assert limits.velocity == [0.25, min(3.0, plain.velocity[1]), plain.velocity[2]]
    assert limits.jerk == plain.jerk


def test_the_calibration_of_another_robot_is_refused(tmp_path):
    dataset = write(tmp_path / "set", paths())
    (tmp_path / "me.json").write_text(json.dumps(dict.fromkeys(("a", "z"), CALIBRATION["a"])))
    with pytest.raises(ValueError, match=r"has z\.pos in place of b\.pos, c\.pos"):
        gathered_limits(dataset, calibration=tmp_path / "me.json")


@pytest.mark.parametrize(
    ("read", "content", "message"),
    [
        (urdf_limits, "<robot", "is no XML"),
        (urdf_limits, "<mujoco/>", "neither URDF nor MJCF"),
        (urdf_limits, '<robot><link name="a"/></robot>', "has no joints with limits"),
        (calibrated_ranges, "{}", "it has no motors"),
        (calibrated_ranges, '{"a": {"range_min": 5, "range_max": 5}}', "a has no range_min"),
        (calibrated_ranges, '{"a": 3}', "a has no range_min"),
        (
            calibrated_ranges,
            '{"a": {"range_min": 0, "range_max": "nan"}}',
            "a has no range_min",
        ),
        (calibrated_ranges, "nonsense", "not valid JSON"),
    ],
)
def test_files_that_tell_no_limits_are_refused(tmp_path, read, content, message):
    (tmp_path / "file").write_text(content)
    with pytest.raises(ValueError, match=message):
        read(tmp_path / "file")
    with pytest.raises(FileNotFoundError, match="none"):
        read(tmp_path / "none")


PLUGIN = Path(__file__).parents[2] / "plugins/lerobot_smooth/src/lerobot_smooth"


def test_the_command_says_what_is_wrong_and_writes_what_it_found(tmp_path, capsys):
    main = runpy.run_path(str(PLUGIN / "command.py"))["main"]
    dataset, out = write(tmp_path / "set", paths()), tmp_path / "limits.json"
    arguments = ["limits", "--dataset", str(dataset), "--out", str(out)]
    assert main([*arguments, "--scale", "0"]) == 1
    assert "scale must be positive" in capsys.readouterr().err
    (tmp_path / "me.json").write_text(json.dumps({"z": CALIBRATION["a"]}))
    assert main([*arguments, "--calibration", str(tmp_path / "me.json")]) == 1
    assert "names z.pos, but the actions of the dataset are a.pos" in capsys.readouterr().err
    assert not out.exists()
    assert main(arguments) == 0
    assert ActionLimits.load(out) == demonstrated_limits(dataset)
    assert out.stat().st_mode & 0o044
    assert main(["add", "--checkpoint", str(tmp_path), "--limits", str(out)]) == 1
    assert "pretrained_model" in capsys.readouterr().err


def test_hrc_smooth_writes_limits_with_the_positions_that_are_known(tmp_path):
    from hrc_learn.cli.arguments import Smooth
    from hrc_learn.cli.model_commands import smooth

    dataset = write(tmp_path / "set", paths(7), panda.joint_names)
    file = tmp_path / "limits.json"
    smooth(Smooth(dataset=dataset, limits=file))
    limits = ActionLimits.load(file)
    assert limits.names == list(ArmValues(panda).joints)
    assert limits.lower == panda.limits.lower.tolist()
    assert limits.upper == panda.limits.upper.tolist()
    urdf = URDF.replace('name="a"', f'name="{panda.joint_names[0]}"')
    (tmp_path / "arm.urdf").write_text(urdf)
    smooth(Smooth(dataset=dataset, limits=file, urdf=tmp_path / "arm.urdf"))
    limits = ActionLimits.load(file)
    assert limits.lower == [-1.5, *[None] * 6]
    assert limits.velocity[0] == 0.25
    for arguments in ({"dataset": dataset}, {"limits": file, "remove": True}):
        with pytest.raises(ValueError, match="give --checkpoint"):
            smooth(Smooth(**arguments))
    for scale in (0.0, float("inf")):
        with pytest.raises(ValueError, match="scale must be positive"):
            smooth(Smooth(dataset=dataset, limits=file, scale=scale))


def test_a_damaged_file_is_to_be_written_again(tmp_path):
    file = tmp_path / "limits.json"
    file.write_text("{}", encoding="utf-8")
    with pytest.raises(ValueError, match="write the limits of actions again by hrc smooth"):
        ActionLimits.load(file)
