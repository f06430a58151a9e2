"""What LeRobot's names for the values of a Panda stand for."""

import numpy as np
import pytest
import torch
from lerobot.utils.errors import DeviceNotConnectedError

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import panda
from hrc_learn.lerobot.panda_robot import (
    GRIPPER,
    HAND,
    JOINTS,
    VELOCITIES,
    action_of,
    hand_vector,
    observed,
    robot_registry,
    target_of,
)
from hrc_learn.lerobot.robots import FrankaPandaConfig, MujocoPandaConfig

READY = panda.ready.numpy()


@pytest.mark.parametrize("space", ["joint", "ee"])
def test_an_action_says_where_it_came_from(space):
    joints = READY + 0.1
    where, width = target_of(action_of(space, joints, 0.05))
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
    vectors = [hand_vector(turned[0])[3:]]
    for joints in turned[1:]:
        vectors.append(hand_vector(joints, vectors[-1])[3:])
    assert np.abs(np.diff(vectors, axis=0)).max() < 0.1


def test_an_action_without_joints_is_refused():
    with pytest.raises(ValueError, match=r"lacks panda_joint2\.pos"):
        target_of({JOINTS[0]: 0.0})


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


def test_a_robot_is_found_by_its_name_or_where_it_is_the_only_one(simulated):
    registry = robot_registry()
    with pytest.raises(DeviceNotConnectedError, match=r"a robot of hrc.*: none"):
        registry.find(None)
    left = simulated(scenario="grasping", id="left")
    assert registry.find(None) is registry.find("left") is left
    with pytest.raises(DeviceNotConnectedError, match=r"one robot with id 'right' .* 'left'"):
        registry.find("right")
    right = simulated(scenario="grasping", id="right")
    assert registry.find("right") is right
    with pytest.raises(DeviceNotConnectedError, match="'left', 'right'"):
        registry.find(None)
    assert list(registry) == [left, right]
    left.disconnect()
    assert registry.find(None) is right


def test_an_action_of_the_hand_in_part_is_none_of_it():
    action = dict.fromkeys(HAND[:5], 0.1) | dict.fromkeys(JOINTS, 0.2)
    where, width = target_of(action)
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
        (MujocoPandaConfig, {"fps": 5.0}, {"fps": 4.9}),
        (MujocoPandaConfig, {"fps": 500.0}, {"fps": 500.5}),
        (MujocoPandaConfig, {"episode_time": 0.5}, {"episode_time": -0.5}),
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
    everything = observed(state, names)
    assert list(everything) == list(names)
    for name in names:
        assert observed(state, [name]) == {name: everything[name]}
