"""What LeRobot's names for the values of an arm stand for."""

from functools import cache
from io import StringIO

import numpy as np
import pytest
import torch
from bare_arm import bare
from lerobot.utils.errors import DeviceNotConnectedError

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import panda
from hrc_learn.lerobot.arm_robot import ArmRobot, connected_robots, the_robot
from hrc_learn.lerobot.arm_values import GRIPPER, HAND, ArmValues
from hrc_learn.lerobot.driven_arms import FrankaPandaConfig
from hrc_learn.lerobot.episode_recording import observation_features
from hrc_learn.lerobot.mujoco_arm import MujocoArmRobot, MujocoArmRobotConfig
from hrc_learn.lerobot.person import PersonConfig

READY = panda.ready.numpy()
VALUES = ArmValues(panda)
JOINTS, VELOCITIES = VALUES.joints, VALUES.velocities


@pytest.mark.parametrize("space", ["joint", "ee"])
def test_an_action_says_where_it_came_from(space):
    joints = READY + 0.1
    where, width = VALUES.target_of(VALUES.action_of(space, joints, 0.05))
    assert width == 0.05
    if isinstance(where, Pose):
        assert space == "ee"
        expected = panda.forward(torch.from_numpy(joints))
        assert float(where.twist_to(expected).abs().max()) < 1e-9
    else:
        assert space == "joint"
        np.testing.assert_array_equal(where, joints)


def test_rotation_vectors_go_on_past_half_a_turn():
    turned = [READY + np.array([0, 0, 0, 0, 0, d, 0]) for d in np.linspace(-0.2, 0.2, 9)]
    vectors = [VALUES.hand_vector(turned[0])[3:]]
    for joints in turned[1:]:
        vectors.append(VALUES.hand_vector(joints, vectors[-1])[3:])
    assert np.abs(np.diff(vectors, axis=0)).max() < 0.1


def test_an_action_without_joints_is_refused():
    with pytest.raises(ValueError, match=r"lacks panda_joint2\.pos"):
        VALUES.target_of({JOINTS[0]: 0.0})


@cache
def _arm_of_six_joints():
    return bare().with_hand()


@pytest.fixture
def six(monkeypatch):
    """Lets every simulated arm be one of six joints, a Panda's without the third."""
    arm = _arm_of_six_joints()
    monkeypatch.setattr(MujocoArmRobotConfig, "work_arm", lambda config: arm)
    return arm


@pytest.mark.long
@pytest.mark.parametrize("space", ["joint", "ee"])
def test_names_are_those_of_the_arms_joints(six, simulated, space):
    robot = simulated(scenario="grasping", action_space=space, velocity=True, hand=True)
    assert robot.name == "mujoco_cut"
    joints = [f"cut_{i}.pos" for i in (0, 1, 3, 4, 5, 6)]
    velocities = [name.replace(".pos", ".vel") for name in joints]
    values = robot.get_observation()
    assert list(values) == [*joints, *velocities, *HAND, GRIPPER]
    actions = [*(joints if space == "joint" else HAND), GRIPPER]
    assert list(robot.action_features) == actions
    q = torch.tensor([values[name] for name in joints], dtype=torch.float64)
    tool = six.chain.forward(q)
    assert [values[name] for name in HAND[:3]] == pytest.approx(tool.position.tolist())
    state = robot.read_state()
    assert values[GRIPPER] == state.gripper_width > 0.05
    # What a real arm knows of itself, too.
    itself = ArmRobot.clearance(robot, q)
    assert float(itself) == float(six.whole.self_distance(q))
    # It goes where it is sent, by either kind of actions.
    sent = q + 0.005
    goal = six.chain.forward(sent)
    action = ArmValues(six.chain).action_of(space, sent.numpy(), 0.06)
    for _ in range(20):
        robot.send_action(action)
    there = six.chain.forward(torch.from_numpy(robot.read_state().joint_position))
    assert float(there.twist_to(goal).abs().max()) < 1e-3


def test_nobody_can_lead_the_body_of_six_joints(six, simulated):
    with pytest.raises(ValueError, match=r"a cut has no null space to guide"):
        simulated(scenario="grasping", person=PersonConfig(kind="scripted"))


def test_what_the_person_does_is_named_after_the_joints_too(simulated):
    settings = {"arm": "fr3", "scenario": "grasping"}
    who = PersonConfig(kind="scripted", record=True)
    robot = simulated(person=who, **settings)
    names = [f"fr3_joint{i}" for i in range(1, 8)]
    asked = [f"{name}.human_torque" for name in names]
    aside = [f"{name}.pushed_aside" for name in names]
    values = robot.get_observation()
    joints = [f"{name}.pos" for name in names]
    assert list(values) == [*joints, GRIPPER, *asked, *aside]
    features = observation_features(robot)
    assert features["observation.human_effort"]["names"] == asked
    assert features["observation.pushed_aside"]["names"] == aside
    assert robot.world.config.arm.robot.name == "fr3"


@pytest.mark.parametrize("space", ["joint", "ee"])
def test_what_is_observed_goes_by_the_settings(simulated, space):
    for velocity, hand in ((False, False), (True, False), (False, True)):
        robot = simulated(scenario="grasping", action_space=space, velocity=velocity, hand=hand)
        wanted = [*JOINTS, *(VELOCITIES if velocity else ())]
        wanted += [*(HAND if hand or space == "ee" else ()), GRIPPER]
        assert list(robot.observation_features) == wanted
        assert list(robot.action_features) == [*(JOINTS if space == "joint" else HAND), GRIPPER]
        assert list(robot.get_observation()) == wanted
        robot.disconnect()


def test_the_hand_is_observed_on_the_side_where_it_was(simulated):
    robot = simulated(scenario="grasping", fps=10.0, hand=True)
    vectors = []
    for turn in np.linspace(-0.2, 0.2, 9):
        robot.run.world.reset(READY + np.array([0, 0, 0, 0, 0, turn, 0]))
        values = robot.get_observation()
        vectors.append([values[name] for name in HAND[3:]])
    assert np.abs(np.diff(vectors, axis=0)).max() < 0.1


def test_a_robot_is_found_where_it_is_the_only_one(simulated):
    with pytest.raises(DeviceNotConnectedError, match=r"connected: none"):
        the_robot()
    left = simulated(scenario="grasping", id="left")
    assert the_robot() is left
    right = simulated(scenario="grasping", id="right")
    with pytest.raises(DeviceNotConnectedError, match=r"left.*right"):
        the_robot()
    assert connected_robots == [left, right]
    left.disconnect()
    assert the_robot() is right


@pytest.mark.parametrize(
    ("kind", "message"), [("keyboard", "needs a terminal"), ("webcam", "one of none, scripted")]
)
def test_a_robot_whose_person_cannot_be_reached_is_disconnected(
    tmp_path, monkeypatch, kind, message
):
    monkeypatch.setattr("sys.stdin", StringIO())
    config = MujocoArmRobotConfig(calibration_dir=tmp_path, action_space="ee")
    config.person.kind = kind
    robot = MujocoArmRobot(config)
    for _ in range(2):
        with pytest.raises(ValueError, match=message):
            robot.connect()
        assert not robot.is_connected
        assert connected_robots == []


@pytest.mark.long
def test_a_page_that_has_failed_does_not_leave_the_arm_connected(simulated):
    pytest.importorskip("viser", reason="the extra `ui` is not installed")
    robot = simulated(action_space="ee", person=PersonConfig(kind="page"))

    class Failed:
        def close(self):
            raise RuntimeError("the page does not follow the arm any more")

    page, robot._page = robot._page, Failed()
    page.close()
    with pytest.raises(RuntimeError, match="does not follow"):
        robot.disconnect()
    assert not robot.is_connected


def test_an_action_of_the_hand_in_part_is_none_of_it():
    action = dict.fromkeys(HAND[:5], 0.1) | dict.fromkeys(JOINTS, 0.2)
    where, width = VALUES.target_of(action)
    np.testing.assert_array_equal(where, np.full(7, 0.2))
    assert np.isnan(width)


@pytest.mark.parametrize(
    ("config", "good", "bad"),
    [
        (FrankaPandaConfig, {"fps": 5.0, "timeout": 1.0}, {"fps": 4.9, "timeout": 1.0}),
        (FrankaPandaConfig, {"fps": 1000.0}, {"fps": 1000.5}),
        (FrankaPandaConfig, {"dynamics": 1.0}, {"dynamics": 1.01}),
        (FrankaPandaConfig, {"dynamics": 0.01}, {"dynamics": 0.0}),
        (FrankaPandaConfig, {"fps": 20.0, "timeout": 0.076}, {"fps": 20.0, "timeout": 0.075}),
        (MujocoArmRobotConfig, {"fps": 5.0}, {"fps": 4.9}),
        (MujocoArmRobotConfig, {"fps": 500.0}, {"fps": 500.5}),
        (MujocoArmRobotConfig, {"episode_time": 0.5}, {"episode_time": -0.5}),
    ],
)
def test_settings_have_bounds(config, good, bad):
    base = {"ip": "x"} if config is FrankaPandaConfig else {}
    config(**base | good)
    (wrong, *_) = (name for name in bad if bad[name] != good[name])
    with pytest.raises(ValueError, match=wrong):
        config(**base | bad)


def test_one_value_alone_is_observed_as_among_others(simulated):
    state = simulated(scenario="grasping").read_state()
    names = (*JOINTS, *VELOCITIES, *HAND, GRIPPER)
    everything = VALUES.observed(state, names)
    assert list(everything) == list(names)
    for name in names:
        assert VALUES.observed(state, [name]) == {name: everything[name]}
