import numpy as np
import pytest
import torch

from hrc_learn.demos import Demonstration, DemonstrationSet
from hrc_learn.kinematics import panda
from hrc_learn.kinematics.drawing import arm_bodies
from hrc_learn.learning.primitive_fitting import CHANNELS, Motions


@pytest.fixture
def joints():
    rng = np.random.default_rng(0)
    return panda.ready.numpy() + 0.3 * rng.normal(size=(6, 7))


def demonstration(joints, **changes) -> Demonstration:
    values = {"joint_names": panda.joint_names, "fps": 50, "time": np.arange(6) / 50}
    return Demonstration(**(values | {"joint_position": joints} | changes))


def test_the_arm_is_drawn_where_planning_takes_it_to_be(joints):
    bodies = arm_bodies(panda, joints)
    drawn = [
        body.position + rotated(body.orientation, np.array(end))
        for body in bodies
        for capsule in body.capsules
        for end in (capsule.start, capsule.end)
    ]
    expected = panda.whole.segments(torch.from_numpy(joints)).flatten(1, 2).numpy()
    np.testing.assert_allclose(np.stack(drawn, axis=1), expected, atol=1e-12)


def rotated(orientation, point):
    w, v = orientation[:, :1], orientation[:, 1:]
    turned = np.cross(v, point)
    return point + 2 * (w * turned + np.cross(v, turned))


def test_a_recorded_position_is_learned_as_it_is_and_no_pose_of_two_frames(joints):
    hand = panda.forward(torch.from_numpy(joints))
    recorded = hand.position.numpy() + np.array([0.0, 0.0, 0.5])  # the arm stands on a table
    motions = Motions.of(DemonstrationSet([demonstration(joints, position=recorded)]))
    np.testing.assert_array_equal(motions.position("position")[0], recorded)
    assert [c for c in CHANNELS if not motions.missing(c)] == ["joint", "position"]
    with pytest.raises(ValueError, match=r"no orientation, .* hrc check"):
        motions.require("pose")
    found = Motions.of(DemonstrationSet([demonstration(joints)]))
    np.testing.assert_allclose(found.position("pose")[0], hand.position, atol=1e-12)
