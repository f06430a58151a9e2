"""What names say, and what they must not be taken to say."""

import pytest

from hrc_learn.demos.read.roles import ComponentMeaning, meaning_of_component, role_of_key


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
