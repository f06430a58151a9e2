"""Units, order, signs and zeros of joints by kinematics and by the steps of encoders.

MuJoCo gives the positions of the tool from robosuite's descriptions of the arms.
"""

import json
from dataclasses import asdict
from importlib.metadata import distribution
from pathlib import Path

import mujoco
import numpy as np
import pyarrow.parquet as pq
import pytest
from commands import hrc
from lerobot_folders import read_info, write_folder, write_info

from hrc_learn.demos import (
    DatasetError,
    RepairOptions,
    check_dataset,
    load_demos,
    merge_datasets,
    open_demos,
    repair_dataset,
)
from hrc_learn.demos.read.contract import keep_contract
from hrc_learn.demos.read.kinematic_evidence import agreement, residual, zero_offsets
from hrc_learn.demos.read.unit_evidence import measure
from hrc_learn.kinematics import arm

# Whole datasets are written and read; shapes are checked in the other tests of this folder.
pytestmark = pytest.mark.simulation

STATE = "observation.state"
HOME = np.array([0.1, -1.4, 1.6, -1.7, -1.6, 0.3])
UNITS = {"rad": 1.0, "deg": np.pi / 180, "rev": 2 * np.pi}
SMALL = np.deg2rad(6.0)
"""Range of each joint whose unit its size does not tell [rad]."""


@pytest.fixture(scope="module")
def model():
    package = "robosuite/models/assets/robots/ur5e/robot.xml"
    try:
        file = Path(str(distribution("robosuite").locate_file(package)))
    except ModuleNotFoundError:
        pytest.skip("robosuite is not installed")
    return mujoco.MjModel.from_xml_path(str(file))


def motion(seed=0, span=1.0, frames=100):
    """Joint positions within a range [rad]."""
    rng, s = np.random.default_rng(seed), np.linspace(0, 1, frames)[:, None]
    path = rng.uniform(-1, 1, 6) * (0.5 - 0.5 * np.cos(4.4 * s))
    path += 0.4 * np.sin(5 * s * rng.uniform(0.7, 1.3, 6))
    return HOME + span * path / np.ptp(path, axis=0)


def tool(model, q, offset=(0.02, 0.0, 0.1), base=(0.5, -0.2, 0.9)):
    """Positions of a tool that is mounted anywhere, in a frame with another origin [m]."""
    data, hand, rows = mujoco.MjData(model), model.body("right_hand").id, []
    for row in q:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        rows.append(data.xpos[hand] + data.xmat[hand].reshape(3, 3) @ offset + base)
    return np.array(rows)


@pytest.mark.parametrize("span", [1.5, SMALL])
@pytest.mark.parametrize("unit", UNITS)
def test_the_unit_by_kinematics(model, span, unit):
    q = motion(span=span)
    found = agreement(arm("ur5e"), q / UNITS[unit], tool(model, q))
    assert (found.unit, found.change) == (unit, "")
    assert found.residual < 1e-6


def test_a_millimetre_and_a_tick_of_noise_do_not_matter(model):
    rng, q = np.random.default_rng(0), motion()
    noisy = q + 1e-3 * rng.standard_normal(q.shape)
    place = tool(model, q) + 1e-3 * rng.standard_normal((len(q), 3))
    found = agreement(arm("ur5e"), np.rad2deg(noisy), place)
    assert found.unit == "deg"
    assert 1e-3 < found.residual < 4e-3


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda q: q * [1, 1, -1, 1, 1, 1], "elbow_joint with opposite sign"),
        (
            lambda q: q * [1, -1, 1, -1, 1, 1],
            "shoulder_lift_joint, wrist_1_joint with opposite",
        ),
        (lambda q: q[:, [1, 0, 2, 3, 4, 5]], "shoulder_pan_joint and shoulder_lift_joint exch"),
    ],
)
@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_signs_and_order_by_kinematics(model, change, words, unit):
    q = motion(1)
    found = agreement(arm("ur5e"), change(q) / UNITS[unit], tool(model, q))
    assert found.unit == unit
    assert found.change.startswith(words)
    assert found.residual < 1e-6
    assert found.other > 0.01


def test_what_explains_nothing_tells_nothing(model):
    """Another arm's poses, a tool at rest, and poses of another motion."""
    q, ur5e = motion(), arm("ur5e")
    assert agreement(arm("panda"), np.pad(q, ((0, 0), (0, 1))), tool(model, q)) is None
    assert agreement(ur5e, q, np.zeros((len(q), 3))) is None
    assert agreement(ur5e, q, tool(model, motion(7))) is None


@pytest.mark.parametrize("offset", [(0, 2, 0, -3, 0, 0), (0, 0, 1.5, 0, 0, 0), (0,) * 6])
def test_zeros_by_kinematics(model, offset):
    offset, q, ur5e = np.deg2rad(offset), motion(2, 1.5), arm("ur5e")
    found = zero_offsets(ur5e, q - offset, tool(model, q))
    np.testing.assert_allclose(found, offset, atol=np.deg2rad(0.1))
    assert residual(ur5e, q - offset + found, tool(model, q)) < 1e-3


def test_zeros_explain_no_other_motion(model):
    q = motion()
    assert not zero_offsets(arm("ur5e"), q, tool(model, motion(7))).any()


def write(root, model, joints, spans=(1.0, 1.2, 0.9), robot="ur5e", per_metre=1.0):
    """A dataset of joints as recorded and of the tool's position."""
    episodes = [motion(k, span) for k, span in enumerate(spans)]
    rows = [{STATE: np.hstack([joints(q), per_metre * tool(model, q)])} for q in episodes]
    names = [*(f"joint_{i}.pos" for i in range(6)), "ee.x", "ee.y", "ee.z"]
    write_folder(root, rows, {STATE: names}, fps=20)
    write_info(root, read_info(root) | {"robot_type": robot})
    return root, episodes


@pytest.mark.parametrize("unit", ["deg", "rev"])
def test_a_dataset_of_six_degrees_in_all_is_read_by_kinematics(model, tmp_path, unit):
    # About a posture near zero: values within six degrees look like radians.
    rows = [(q, np.hstack([q / UNITS[unit], tool(model, q)])) for q in near_zero()]
    names = [*(f"joint_{i}.pos" for i in range(6)), "ee.x", "ee.y", "ee.z"]
    root = write_folder(tmp_path / "set", [{STATE: r} for _, r in rows], {STATE: names}, fps=20)
    write_info(root, read_info(root) | {"robot_type": "ur5e"})
    source = open_demos(root, refuse_doubt=True)
    np.testing.assert_allclose(source[0].joint_position, rows[0][0], atol=1e-6)
    line = next(note for note in source.notes if note.startswith("joint_position"))
    assert "forward kinematics of ur5e give the position within" in line
    assert f"taken for {unit};" in line


def near_zero():
    """Motions within six degrees of zero, which look like radians in either unit."""
    near = np.array([0.02, -0.05, 0.03, 0.04, -0.03, 0.05])
    return [motion(k, SMALL) - HOME + near for k in range(3)]


@pytest.mark.parametrize(("unit", "per_metre"), [("m", 1.0), ("cm", 100.0), ("mm", 1000.0)])
def test_the_unit_of_positions_by_kinematics(model, tmp_path, unit, per_metre):
    """Size alone leaves the question whether positions of 130 are in cm or mm."""
    root, episodes = write(tmp_path / "set", model, np.rad2deg, per_metre=per_metre)
    source = open_demos(root, refuse_doubt=True)
    assert (source.units["position"].unit, source.units["joint_position"].unit) == (unit, "deg")
    assert source.units["joint_position"].units == ()  # all columns have the same
    np.testing.assert_allclose(source[1].position, tool(model, episodes[1]), atol=1e-6)


def test_the_check_compares_with_an_arm_from_a_file(model, tmp_path):
    rows = [{STATE: np.hstack([np.rad2deg(q), tool(model, q)])} for q in near_zero()]
    names = [*(f"joint_{i}.pos" for i in range(6)), "ee.x", "ee.y", "ee.z"]
    root = str(write_folder(tmp_path / "set", rows, {STATE: names}, fps=20))
    file = distribution("robosuite").locate_file(
        "robosuite/models/assets/robots/ur5e/robot.xml"
    )
    status, text, _ = hrc("check", "--dataset", root, "--robot", file)
    assert "give the position within" in text
    assert "taken for deg;" in text
    assert "taken for rad" in hrc("check", "--dataset", root)[1]
    status, text, _ = hrc("check", "--dataset", root, "--robot", "panda")
    assert status == 1
    assert "are not those of panda" in text


def test_without_a_pose_the_unit_is_assumed_and_the_line_says_so(tmp_path):
    root = write_folder(
        tmp_path / "set",
        [{STATE: motion(k)} for k in range(3)],
        {STATE: [f"joint_{i}.pos" for i in range(6)]},
    )
    (line,) = [n for n in load_demos(root).notes if n.startswith("joint_position")]
    assert "taken for rad (assumed, not known); overrule with" in line


def test_a_joint_that_counts_the_other_way_is_asked_about(model, tmp_path):
    root, _ = write(tmp_path / "set", model, lambda q: q * [1, 1, -1, 1, 1, 1])
    with pytest.raises(DatasetError, match=r"mm only with elbow_joint with opposite sign"):
        open_demos(root, refuse_doubt=True)
    demos = open_demos(root, units={"joint_position": "rad"}, refuse_doubt=True)
    assert len(demos) == 3


def test_zeros_of_joints_are_not_judged_without_positions_of_the_tool(tmp_path):
    root = write_folder(
        tmp_path / "set",
        [{STATE: motion(k)} for k in range(3)],
        {STATE: [f"joint_{i}.pos" for i in range(6)]},
    )
    write_info(root, read_info(root) | {"robot_type": "ur5e"})
    report = check_dataset(root, units={"joint_position": "rad"})
    assert not [i for i in (*report.errors, *report.warnings) if "zeros" in str(i)]


def test_the_check_says_by_how_many_degrees_zeros_are_off(model, tmp_path):
    offset = np.deg2rad([0, 2.5, 0, -4, 0, 0])
    root, _ = write(tmp_path / "off", model, lambda q: q - offset)
    (line,) = [str(i) for i in check_dataset(root).warnings if "zeros of joints" in str(i)]
    assert "joint_1 +2.5 deg, joint_3 -4.0 deg" in line
    root, _ = write(tmp_path / "sound", model, lambda q: q)
    assert not [i for i in check_dataset(root).warnings if "zeros of joints" in str(i)]


@pytest.mark.parametrize("unit", [1.0, np.pi / 180], ids=["rad", "deg"])
def test_a_repair_moves_the_zeros_that_are_named_and_no_others(model, tmp_path, unit):
    offset = np.deg2rad([0, 2.5, 0, -4, 0, 0])
    root, episodes = write(tmp_path / "off", model, lambda q: (q - offset) / unit)
    options = RepairOptions(trim=False, offsets={"joint_1": 2.5, "joint_3": -4.0})
    report = repair_dataset(root, tmp_path / "out", options)
    assert "moved joint_1 by +2.5 deg; moved joint_3 by -4 deg" in str(report)
    for demo, q in zip(load_demos(tmp_path / "out"), episodes, strict=True):
        np.testing.assert_allclose(demo.joint_position, q, atol=1e-6)
    assert not [i for i in check_dataset(tmp_path / "out").warnings if "zeros" in str(i)]
    repair_dataset(root, tmp_path / "plain", RepairOptions(trim=False))
    for demo, q in zip(load_demos(tmp_path / "plain"), episodes, strict=True):
        np.testing.assert_allclose(demo.joint_position, q - offset, atol=1e-6)
    with pytest.raises(DatasetError, match="measured joints: joint_0"):
        repair_dataset(root, tmp_path / "no", RepairOptions(offsets={"elbow": 1.0}))
    assert not (tmp_path / "no").exists()


def test_an_unknown_arm_is_read_as_before(model, tmp_path):
    root, episodes = write(tmp_path / "set", model, lambda q: q, robot="mystery")
    demos = load_demos(root)
    np.testing.assert_allclose(demos[0].joint_position, episodes[0], atol=1e-6)
    assert any("assumed, not known" in note for note in demos.notes)


SO101 = [f"{j}.pos" for j in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex")]
SO101 += ["wrist_roll.pos", "gripper.pos"]


LOW, HIGH = [760, 830, 900, 870, 0, 1100], [3430, 3180, 3090, 3200, 4095, 2400]
"""Ranges of an SO-101's motors."""


def lerobot_positions(ticks, mode, low=LOW, high=HIGH, drive_mode=0):
    """Values of LeRobot for ticks of its Feetech bus, by its own rules, and the calibration."""
    motors = pytest.importorskip("lerobot.motors")
    feetech = pytest.importorskip("lerobot.motors.feetech")
    names = [name.removesuffix(".pos") for name in SO101]
    bus = feetech.FeetechMotorsBus(
        port="",
        motors={
            n: motors.Motor(k, "sts3215", mode if k < 5 else motors.MotorNormMode.RANGE_0_100)
            for k, n in enumerate(names)
        },
        calibration={
            n: motors.MotorCalibration(k, drive_mode, 0, low[k], high[k])
            for k, n in enumerate(names)
        },
    )
    rows = [bus._normalize(dict(enumerate(map(int, row)))) for row in ticks]
    values = np.array([[row[k] for k in range(6)] for row in rows])
    return values, {name: asdict(motor) for name, motor in bus.calibration.items()}


def so101_ticks(seed=0):
    """Ticks of the six motors in one episode."""
    return np.rint([1900, 2000, 1900, 2000, 2000, 1700] + motion(seed, 0.9) * 400).astype(int)


def so101_set(root, values, commands=True):
    """Dataset of an SO-101 that has these values as states and commands."""
    rows = [{STATE: v, "action": v} if commands else {STATE: v} for v in values]
    root = write_folder(
        root, rows, {STATE: SO101, "action": SO101} if commands else {STATE: SO101}
    )
    write_info(root, read_info(root) | {"robot_type": "so101_follower"})
    return root


@pytest.mark.parametrize("mode", ["DEGREES", "RANGE_M100_100"])
def test_steps_of_encoders_tell_degrees_from_fractions_of_a_range(tmp_path, mode):
    """The two units of LeRobot's hobby arms, of which size tells nothing."""
    motors = pytest.importorskip("lerobot.motors")
    mode_ = getattr(motors.MotorNormMode, mode)
    values = [lerobot_positions(so101_ticks(k), mode_)[0] for k in range(3)]
    root = so101_set(tmp_path / "set", values, commands=False)
    if mode == "DEGREES":
        source = open_demos(root, refuse_doubt=True)
        np.testing.assert_allclose(
            source[0].joint_position[:, :5], np.deg2rad(values[0][:, :5]), atol=1e-5
        )
        assert any("as an encoder of 4096 steps does in deg" in note for note in source.notes)
    else:
        source = open_demos(root, refuse_doubt=True)
        assert source.joint_unit == "1"
        np.testing.assert_allclose(
            source[0].joint_position[:, :5], values[0][:, :5] / 100, atol=1e-5
        )
        assert any("joints of different ranges step" in note for note in source.notes)


@pytest.mark.parametrize("step", [360 / 4096, 2 * np.pi / 4096, 0.5])
def test_the_step_of_an_encoder(step):
    smooth = motion()
    values = (np.rint(smooth / step * (20 if step == 0.5 else 1)) * step).astype(np.float32)
    found = measure(values.astype(float)).step
    levels = np.array([len(np.unique(column)) for column in values.T])
    np.testing.assert_allclose(found[levels > 15], step, rtol=1e-3)
    assert not measure(smooth).step.any()


class Calibrated:
    """One recording as -100..100 and as degrees of LeRobot, and the file of the calibration."""

    def __init__(self, folder, **calibration):
        modes = pytest.importorskip("lerobot.motors").MotorNormMode
        folder.mkdir()
        ticks = [so101_ticks(k) for k in range(3)]
        percent = [lerobot_positions(t, modes.RANGE_M100_100, **calibration) for t in ticks]
        degrees = [lerobot_positions(t, modes.DEGREES, **calibration)[0] for t in ticks]
        self.degrees, self.file = degrees, folder / "arm.json"
        self.file.write_text(json.dumps(percent[0][1]))
        self.percent = so101_set(folder / "percent", [values for values, _ in percent])
        self.in_degrees = so101_set(folder / "degrees", degrees)
        self.units = {"joint_position": str(self.file)}


@pytest.mark.parametrize("drive_mode", [0, 1])
def test_a_calibration_tells_the_angles_of_fractions(tmp_path, drive_mode):
    """LeRobot's degrees ignore `drive_mode`, which its fractions of the range obey."""
    one = Calibrated(tmp_path / "a", drive_mode=drive_mode)
    source = open_demos(one.percent, units=one.units, refuse_doubt=True)
    assert source.joint_unit == "rad"
    for demo, degrees in zip(source, one.degrees, strict=True):
        expected = np.deg2rad(degrees[:, :5])
        np.testing.assert_allclose(demo.joint_position, expected, atol=1e-5)
        np.testing.assert_allclose(demo.command_position, expected, atol=1e-5)


def test_a_kept_calibration_is_read_again(tmp_path):
    one = Calibrated(tmp_path / "a")
    report = check_dataset(one.percent, units=one.units)
    keep_contract(one.percent, report.contract.without_doubt()[0])
    demo = load_demos(one.percent)[0]
    np.testing.assert_allclose(
        demo.command_position, np.deg2rad(one.degrees[0][:, :5]), atol=1e-5
    )


def test_a_repair_applies_a_calibration(tmp_path):
    one, out = Calibrated(tmp_path / "a"), tmp_path / "out"
    options = RepairOptions(trim=False)
    report = repair_dataset(one.percent, out, options, units=one.units)
    assert "joint_position converted to deg; command_position converted to deg" in str(report)
    table = pq.read_table(out / "data")
    for key in (STATE, "action"):
        written = table[key].to_pylist()
        np.testing.assert_allclose(written, np.concatenate(one.degrees), atol=1e-4)
    source = open_demos(out, refuse_doubt=True)
    assert source.units["command_position"].unit == "deg"


def test_arms_of_two_calibrations_are_merged(tmp_path):
    one = Calibrated(tmp_path / "a")
    two = Calibrated(tmp_path / "b", low=[k + 60 for k in LOW[:4]] + LOW[4:])
    for arm_ in (one, two):
        contract = check_dataset(arm_.percent, units=arm_.units).contract
        keep_contract(arm_.percent, contract.without_doubt()[0])
    report = merge_datasets([one.percent, two.percent], tmp_path / "out")
    assert "action converted from" in str(report)
    expected = [np.deg2rad(d[:, :5]) for d in [*one.degrees, *two.degrees]]
    for demo, angles in zip(load_demos(tmp_path / "out"), expected, strict=True):
        np.testing.assert_allclose(demo.joint_position, angles, atol=1e-5)


def test_a_calibration_that_does_not_fit_is_refused(tmp_path):
    one = Calibrated(tmp_path / "a")
    other = Calibrated(tmp_path / "b", low=[k + 60 for k in LOW[:4]] + LOW[4:])
    for root, units, message in (
        (one.percent, other.units, "the steps of shoulder_pan, shoulder_lift.* another arm"),
        (one.in_degrees, one.units, "the steps of .* values in deg"),
    ):
        with pytest.raises(DatasetError, match=message):
            open_demos(root, units=units)
    content = json.loads(one.file.read_text())
    del content["elbow_flex"]
    one.file.write_text(json.dumps(content))
    with pytest.raises(DatasetError, match="has no elbow_flex; there are shoulder_pan"):
        open_demos(one.percent, units=one.units)
    far = so101_set(tmp_path / "far", [1.6 * np.rint(d) for d in one.degrees])
    with pytest.raises(DatasetError, match=r"reaches \d+.*: in deg, not %"):
        open_demos(far, units=other.units)
