"""Meaning of names, and units guessed from values."""

import math

import pytest

from hrc_learn.demos.read.naming import (
    ComponentMeaning,
    is_hand,
    meaning_of_component,
    role_of_key,
)
from hrc_learn.demos.read.units import decide_units


@pytest.mark.parametrize(
    ("name", "role", "slot"),
    [
        ("panda_joint1.pos", "joint_position", "panda_joint1"),
        ("left.arm.joint_2.vel", "joint_velocity", "left.arm.joint_2"),
        ("joint_1.obs_external_torque", "joint_effort", "joint_1"),
        ("joint_1.cmd_pos", "joint_position", "joint_1"),
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
    ],
)
def test_names_that_speak(name, role, slot):
    assert meaning_of_component(name) == ComponentMeaning(role, slot)


@pytest.mark.parametrize(
    "name",
    ["joint_1", "motor_7", "gripper.vel", "gripper.torque", "ee.vx", "left_waist", "reward"],
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
        ("observation.state", None),
        ("observation.position", None),  # of what?
        ("observation.environment_state", None),
    ],
)
def test_keys(key, role):
    assert role_of_key(key) == role


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
        ("position", 500.0, "cm"),
        ("position", 500.1, "mm"),
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
    decision = decide_units({role: largest}, {}, {})[role]
    assert decision.unit == unit
    assert decision.converts == (unit not in ("rad", "m"))
    assert f"taken for {unit}" in str(decision.note)


@pytest.mark.parametrize(
    ("role", "unit"), [("joint_velocity", "deg/s"), ("command_velocity", "deg/s")]
)
def test_velocities_follow_the_unit_of_positions(role, unit):
    decisions = decide_units({role: 1.0, "joint_position": 90.0}, {}, {})
    assert decisions[role].unit == unit
    assert decisions[role].factor == pytest.approx(math.pi / 180)


@pytest.mark.parametrize("unit", ["%", "1"])
@pytest.mark.parametrize("role", ["joint_velocity", "command_velocity"])
def test_velocities_of_joints_given_as_a_share_keep_their_own_unit(role, unit):
    decisions = decide_units({role: 1.0, "joint_position": 90.0}, {}, {"joint_position": unit})
    assert decisions[role].unit == "rad/s"
    assert decisions[role].evidence == ""


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
    decision = decide_units({"time": 1.0}, {}, {}, step)["time"]
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
