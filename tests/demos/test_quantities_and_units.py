"""Meaning of names, and units guessed from values."""

import math

import numpy as np
import pytest

from hrc_learn.demos.read.columns import ColumnSelection, map_columns
from hrc_learn.demos.read.dataset_folder import EpisodeEntry
from hrc_learn.demos.read.metadata import Feature
from hrc_learn.demos.read.naming import (
    ComponentMeaning,
    is_hand,
    meaning_of_component,
    role_of_key,
    without_unit,
)
from hrc_learn.demos.read.unit_evidence import Sizes
from hrc_learn.demos.read.units import UnitDecision, decide_units, units_from_episodes


@pytest.mark.parametrize(
    ("name", "role", "slot"),
    [
        ("panda_joint1.pos", "joint_position", "panda_joint1"),
        ("left.arm.joint_2.vel", "joint_velocity", "left.arm.joint_2"),
        ("joint_1.obs_external_torque", "joint_effort", "joint_1"),
        ("joint_1.cmd_pos", "joint_position", "joint_1"),
        ("joint_3_vel", "joint_velocity", "joint_3"),
        ("motor_a_torque", "joint_effort", "motor_a"),
        ("qpos_3", "joint_position", "joint_3"),
        ("gripper.pos", "gripper", "gripper.pos"),
        ("ee.gripper_pos", "gripper", "ee.gripper_pos"),
        ("gripper", "gripper", "gripper"),
        ("ee.y", "position", 1),
        ("ee.wz", "rotation_vector", 2),
        ("ee_pose.07", "pose_matrix", 7),
        ("eef_quat_w", "quaternion_wxyz", 0),
        ("TCP.qx", "quaternion_wxyz", 1),
        ("yaw", "euler_xyz", 2),
        ("eef_pos_2", "position", 2),
        ("eef_quat_3", "quaternion", 3),
        ("pose.position.x", "position", 0),
        ("tool0_pose.orientation.w", "rotation", "w"),
        ("robot0_eef_rot_axis_angle_1", "rotation_vector", 1),
        ("end_effector_position_x", "position", 0),
        ("eef.rot6d_5", "rotation_6d", 5),
        ("x_mm", "position", 0),
    ],
)
def test_names_that_speak(name, role, slot):
    assert meaning_of_component(name) == ComponentMeaning(role, slot)


@pytest.mark.parametrize(
    "name",
    [
        *(
            "joint_1",
            "motor_7",
            "gripper.vel",
            "gripper.torque",
            "gripper_current",
            "ee.gripper_force",
            "ee.vx",
            "left_waist",
            "reward",
        ),
        *("wrist_roll", "left_shoulder_pitch", "q_0", "pos_0", "joint_pos_0", "hand.x"),
    ],
)
def test_names_that_say_nothing(name):
    assert meaning_of_component(name) is None


@pytest.mark.parametrize(
    ("key", "role"),
    [
        ("observation.velocity", "joint_velocity"),
        ("observation.state.joint_position", "joint_position"),
        ("observation.states.eef_euler", "euler_xyz"),
        ("action.joint_velocity", "joint_velocity"),
        ("observation.image_feature", "feature"),
        ("time_stamp", "time"),
        ("observation.robot0_eef_pos", "position"),
        ("observation.robot0_eef_quat", "quaternion_xyzw"),
        ("obs.robot0_joint_pos", "joint_position"),
        ("robot0_gripper_qpos", "gripper"),
        ("observation.joint_position_deg", "joint_position"),
        ("observation.state", None),
        ("observation.position", None),  # of what?
        ("observation.environment_state", None),
    ],
)
def test_keys(key, role):
    assert role_of_key(key) == role


def decided(peaks, stated=None, step=1.0):
    """Decisions on quantities of one component, of which only the largest value is known."""
    no, sizes = np.zeros(1, bool), {}
    for role, peak in peaks.items():
        sizes[role] = Sizes(np.array([peak]), np.zeros(1), no, no, no)
    selections = {
        role: ColumnSelection(role=role, columns=((role, 0),), labels=("a",)) for role in peaks
    }
    guessed = {r: s for r, s in sizes.items() if "velocity" not in r and r != "time"}
    return decide_units(selections, guessed, stated or {}, step)


@pytest.mark.parametrize(
    ("role", "largest", "unit"),
    [
        # Two turns [rad], then more degrees than a turn has, with some room.
        ("joint_position", 12.56, "rad"),
        ("joint_position", 12.57, "deg"),
        ("joint_position", 400.0, "deg"),
        ("joint_position", 400.1, "tick"),
        ("command_position", 400.0, "deg"),
        ("command_position", 400.1, "tick"),
        # No arm reaches further than 5 m.
        ("position", 5.0, "m"),
        ("position", 5.01, "cm"),
        # Arms reach 1.5 m.
        ("position", 150.0, "cm"),
        ("position", 150.1, "mm"),
        # A turn, or two of a vector that was unwrapped.
        ("euler_xyz", 6.38, "rad"),
        ("euler_xyz", 6.39, "deg"),
        ("euler_intrinsic_xyz", 6.38, "rad"),
        ("euler_intrinsic_xyz", 6.39, "deg"),
        ("rotation_vector", 12.56, "rad"),
        ("rotation_vector", 12.57, "deg"),
    ],
)
def test_units_are_guessed_by_how_far_values_reach(role, largest, unit):
    decision = decided({role: largest})[role]
    assert decision.unit == unit
    assert decision.converts == (unit not in ("rad", "m"))
    assert f"taken for {unit}" in str(decision.note)


@pytest.mark.parametrize(
    ("role", "unit"), [("joint_velocity", "deg/s"), ("command_velocity", "deg/s")]
)
def test_velocities_follow_the_unit_of_positions(role, unit):
    decisions = decided({role: 1.0, "joint_position": 90.0})
    assert decisions[role].unit == unit
    assert decisions[role].factor == pytest.approx(math.pi / 180)


@pytest.mark.parametrize(
    ("unit", "factor", "si_unit"),
    [("%", 1e-2, "1/s"), ("1", 1.0, "1/s"), ("1.5 deg", 1.5 * math.pi / 180, "rad/s")],
)
@pytest.mark.parametrize("role", ["joint_velocity", "command_velocity"])
def test_velocities_of_joints_given_as_a_share_are_shares_per_second(
    role, unit, factor, si_unit
):
    decision = decided({role: 1.0, "joint_position": 90.0}, {"joint_position": unit})[role]
    assert (decision.unit, decision.si_unit) == (f"{unit}/s", si_unit)
    assert decision.factor == pytest.approx(factor)


def test_velocities_follow_each_joint_and_finger():
    joints = ColumnSelection(
        role="joint_position", columns=(("q", 0), ("q", 1)), labels=("a", "b")
    )
    rates = ColumnSelection(
        role="joint_velocity", columns=(("v", 0), ("v", 1)), labels=("a", "b")
    )
    stated = {"joint_position": ("deg", "%")}
    decision = decide_units({"joint_position": joints, "joint_velocity": rates}, {}, stated)
    np.testing.assert_allclose(decision["joint_velocity"].factor, [math.pi / 180, 1e-2])


def test_commands_of_joints_given_as_a_share_are_shares():
    peaks = {"command_position": 1.0, "joint_position": 1.0}
    assert decided(peaks, {"joint_position": "1"})["command_position"].si_unit == "1"


@pytest.mark.parametrize(("unit", "factor"), [("deg", math.pi / 180), ("rad", 1.0)])
def test_a_gripper_that_names_an_angle_keeps_its_unit(unit, factor):
    selection = ColumnSelection(
        role="gripper", columns=(("s", 0),), labels=("gripper",), units=(unit,)
    )
    decision = decide_units({"gripper": selection}, {}, {})["gripper"]
    assert (decision.unit, decision.si_unit) == (unit, "rad")
    assert decision.factor == pytest.approx(factor)


@pytest.mark.parametrize(
    ("step", "unit", "factor"),
    [
        (1.0, "s", 1.0),
        (1e3, "ms", 1e-3),
        (1e6, "us", 1e-6),
        (1e9, "ns", 1e-9),
        (20.0, "s", 1.0),
    ],
)
def test_the_unit_of_stamps_is_the_nearest_to_the_frame_rate(step, unit, factor):
    decision = decided({"time": 1.0}, step=step)["time"]
    assert (decision.unit, decision.factor) == (unit, factor)


@pytest.mark.parametrize(
    ("name", "hand"),
    [
        ("kRightHandIndex", True),
        ("leftHand1", True),
        ("left_hand.joint_3", True),
        ("right_ring_2", True),
        ("gripper", True),
        ("kRightShoulderPitch", False),
        ("handle_joint", False),
        ("Shorthand", False),
    ],
)
def test_joints_of_hands_by_their_names(name, hand):
    assert is_hand(name) == hand


@pytest.mark.parametrize(
    ("name", "stem", "unit"),
    [
        ("joint0_deg", "joint0", "deg"),
        ("elbow (deg)", "elbow", "deg"),
        ("elbow [rad]", "elbow", "rad"),
        ("q_deg_3", "q_3", "deg"),
        ("lift_mm", "lift", "mm"),
        ("x_m", "x", "m"),
        ("joint1.vel_deg/s", "joint1.vel", "deg/s"),
        ("motor_m", "motor_m", ""),
        ("deg", "deg", ""),
        ("radius", "radius", ""),
    ],
)
def test_units_in_names(name, stem, unit):
    assert without_unit(name) == (stem, unit)


def test_side_of_an_arm_of_two():
    assert meaning_of_component("left_eef_x") == ComponentMeaning("position", 0, "left")


SO101 = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")


def joint_decision(values, labels=SO101, robot_type="", units=()):
    """Decision on joints from the values of one episode, (frames, joints)."""
    columns = tuple(("observation.state", i) for i in range(len(labels)))
    selection = ColumnSelection(
        role="joint_position", columns=columns, labels=tuple(labels), units=tuple(units)
    )
    entry = EpisodeEntry(index=0, length=len(values), tasks=(), file="data", start=0)
    decisions, _ = units_from_episodes(
        {"joint_position": selection},
        [(entry, {"joint_position": np.asarray(values, float)})],
        30.0,
        {},
        {},
        robot_type=robot_type,
    )
    return decisions["joint_position"]


def swept(*reach):
    """Motion of each joint between -reach and reach."""
    return np.sin(np.linspace(0, 6.2, 200))[:, None] * np.asarray(reach)


def test_joints_clipped_at_100_are_fractions_of_their_range():
    values = np.clip(swept(80, 160, 70, 60, 90, 50), -100, 100)
    decision = joint_decision(values, robot_type="so101_follower")
    assert (decision.unit, decision.doubt) == ("%", None)
    assert decision.si_unit == "1"


@pytest.mark.parametrize("robot_type", ["so101_follower", ""])
def test_a_hobby_arm_within_100_is_asked_about(robot_type):
    decision = joint_decision(swept(80, 95, 70, 60, 90, 50), robot_type=robot_type)
    assert "--units joint_position deg or --units joint_position %" in decision.doubt


def test_a_hobby_arm_beyond_100_is_in_degrees_and_its_gripper_in_percent():
    decision = joint_decision(swept(80, 140, 70, 60, 90, 50), robot_type="so100")
    assert decision.doubt is None
    assert decision.units == ("deg",) * 5 + ("%",)


def test_names_from_before_fractions_were_introduced_are_of_degrees():
    labels = [f"main_{name}" for name in SO101]
    decision = joint_decision(swept(80, 95, 70, 60, 90, 50), labels, robot_type="so100")
    assert (decision.unit, decision.doubt) == ("deg", None)
    assert "older than -100..100" in decision.evidence


def test_commands_of_fewer_joints_tell_nothing_of_the_others():
    """Commands are clipped at 100 where joints stop before, if they are of the same joints."""
    near = np.array([95.0, 95.0])
    no = np.zeros(2, bool)
    joints = Sizes(near, np.zeros(2), no, no, no)

    def unit(clipped):
        count = len(clipped)
        command = Sizes(near[:count], np.array(clipped), no[:count], no[:count], no[:count])
        selections = {
            role: ColumnSelection(
                role=role,
                columns=tuple((role, i) for i in range(n)),
                labels=("wrist_roll", "elbow_flex")[:n],
            )
            for role, n in (("joint_position", 2), ("command_position", count))
        }
        sizes = {"joint_position": joints, "command_position": command}
        return decide_units(selections, sizes, {}, 1.0)["joint_position"].unit

    assert unit([0.4, 0.0]) == "%"
    assert unit([0.4]) == "deg"


def test_names_decide_whatever_the_values_reach():
    decision = joint_decision(swept(3, 2, 1), ("a", "b", "c"), units=("deg",) * 3)
    assert (decision.unit, decision.doubt) == ("deg", None)


def test_one_large_component_does_not_decide_the_unit_of_the_others():
    labels = [f"joint{i}" for i in range(7)] + ["mystery"]
    decision = joint_decision(swept(1, 2, 1, 2.5, 1, 2, 1, 640), labels)
    assert decision.unit == "rad"
    assert "mystery 640" in decision.doubt


def test_a_hand_that_counts_to_255_does_not_decide_the_unit_of_the_arm():
    values = swept(1, 2, 1, 2.5, 1, 2, 255)
    values[:, -1] = np.rint(np.abs(values[:, -1]))
    decision = joint_decision(values, [*(f"joint{i}" for i in range(6)), "gripper"])
    assert decision.units == ("rad",) * 6 + ("byte",)
    assert decision.factor[-1] == pytest.approx(1 / 255)


def test_a_quaternion_among_numbered_joints_is_noticed():
    angle = np.linspace(0.2, 1.4, 100)
    turn = np.stack([np.sin(angle), 0 * angle, 0.2 + 0 * angle, np.cos(angle)], 1)
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    values = np.hstack([np.linspace(0, 0.4, 100)[:, None] * [1, 2, 1.5], turn])
    decision = joint_decision(values, [f"joint_{i}" for i in range(1, 8)])
    assert "joint_4 .. joint_7 always have unit length" in decision.doubt


def test_lengths_of_a_few_ten_are_asked_about():
    decision = decided({"position": 45.0})["position"]
    assert "--units position cm or --units position mm" in decision.doubt


def mapped(state, action):
    """Joints and notes of a dataset whose state and action have these component names."""
    features = {
        key: Feature(key=key, dtype="float32", shape=(len(names),), names=tuple(names))
        for key, names in (("observation.state", state), ("action", action))
    }
    columns = map_columns(features)
    return columns.joint_names, " ".join(columns.notes)


@pytest.mark.parametrize("suffix", ["", ".pos"])
def test_what_no_action_has_is_no_joint_of_the_arm(suffix):
    joints, notes = mapped([f"{n}{suffix}" for n in ("a", "b", "mystery")], ["a", "b"])
    assert joints == ("a", "b")
    assert f"mystery{suffix}): no joint of the arm, no action has it" in notes


def test_actions_that_move_tool_and_gripper_name_no_joints():
    tool = ["ee.x", "ee.y", "ee.z"]
    joints, _ = mapped(["a.pos", "b.pos", *tool, "gripper.pos"], [*tool, "gripper.pos"])
    assert joints == ("a", "b")


@pytest.mark.parametrize("name", ["object.u", "object_v.pos", "lift_mm", "pixel_3", "base_x"])
def test_names_of_no_joint(name):
    joints, _ = mapped(["a.pos" if "pos" in name else "a", name], ["ee.x", "ee.y", "ee.z"])
    assert joints == ("a",)


@pytest.mark.parametrize("name", [*SO101[:5], "base", "base_joint", "joint_1", "panda_joint1"])
def test_names_of_joints(name):
    joints, _ = mapped([name, "another"], ["ee.x", "ee.y", "ee.z"])
    assert joints == (name, "another")


def test_poses_of_two_arms_are_one_pose_and_a_note():
    names = [f"{side}_eef_{part}" for side in ("left", "right") for part in "xyz"]
    _, notes = mapped(names, ["a", "b"])
    assert "one pose is read, that of the left arm" in notes


@pytest.mark.parametrize(
    ("units", "unit", "each"),
    [
        (("1.1 deg",), "deg", ()),
        (("-0.5 rad/step",), "rad/step", ()),
        (("m",), "m", ()),
        (("1.1 deg", "deg", "-2e-3 deg"), "deg", ()),
        (("rad", "0.9 deg"), "rad", ("rad", "deg")),
        (("1 deg/step", "deg"), "deg/step", ("deg/step", "deg")),
    ],
)
def test_a_plain_unit_is_that_without_its_factor(units, unit, each):
    """Units of the components stay only if they differ."""
    decision = UnitDecision(
        role="joint_position", unit=units[0], units=units if len(units) > 1 else ()
    ).plain
    assert (decision.unit, decision.units) == (unit, each)
