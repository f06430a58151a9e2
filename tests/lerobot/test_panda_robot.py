"""What LeRobot's names for the values of a Panda stand for."""

import numpy as np
import pytest
import torch

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import panda
from hrc_learn.lerobot.panda_robot import JOINTS, action_of, hand_vector, target_of

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
