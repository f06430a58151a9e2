"""All arms are of one type, take arrays of any kind, and have one continuous inverse."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close
from unchecked import shapes_unchecked

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import Arm, arm, panda


def path_of(robot: Arm) -> Pose:
    """Thirty-one poses from the ready posture, 15 cm along and 0.6 rad about the vertical."""
    ready, s = (
        robot.forward(robot.ready),
        torch.linspace(0, 1, 31, dtype=torch.float64)[:, None],
    )
    turn = quaternion.exp(s * torch.tensor([0.0, 0.0, 0.6], dtype=torch.float64))
    shift = s * torch.tensor([-0.03, 0.14, -0.05], dtype=torch.float64)
    return Pose(ready.position + shift, quaternion.multiply(turn, ready.orientation))


def test_ready_made_and_described_arms_are_of_one_type():
    assert type(panda) is type(arm("ur5e")) is Arm


@pytest.mark.parametrize("kind", [torch.Tensor, np.ndarray, list])
def test_arrays_of_any_kind_are_taken(kind):
    convert = {
        torch.Tensor: lambda x: x,
        np.ndarray: torch.Tensor.numpy,
        list: torch.Tensor.tolist,
    }
    given = convert[kind]
    q = panda.ready
    expected, J = panda.forward_and_jacobian(q)
    with shapes_unchecked():  # fields are declared as the tensors that they become
        pose = Pose(given(expected.position), given(expected.orientation))
    assert_close(panda.forward(given(q)).matrix(), expected.matrix())
    assert_close(panda.jacobian(given(q)), J)
    assert_close(panda.inverse(pose, near=given(q)), q)
    assert_close(panda.inverse(pose, given(q[6]), near=given(q)), q)
    assert_close(Pose.from_matrix(given(expected.matrix())).matrix(), expected.matrix())
    assert_close(Pose.from_vector(given(expected.vector())).matrix(), expected.matrix())
    assert_close(
        pose.apply(given(torch.ones(3).double())), expected.apply(torch.ones(3).double())
    )


@pytest.mark.parametrize("use", ["forward", "jacobian", "link_poses", "joint_origins"])
@pytest.mark.parametrize("q", [np.zeros(6), torch.zeros(2, 8), [0.0], 1.0])
def test_a_wrong_number_of_joints_is_one_clear_line(use, q):
    with pytest.raises(ValueError, match=r"has 7 joints .* last dimension must be 7"):
        getattr(panda, use)(q)


@pytest.mark.parametrize("name", ["panda", "ur5e", "xarm7"])
def test_the_inverse_of_a_path_does_not_jump(name):
    robot = arm(name)
    path = path_of(robot)
    q = robot.inverse(path)
    assert_close(robot.forward(q).position, path.position, rtol=0, atol=1e-4)
    assert float(q.diff(dim=0).abs().max()) < 0.1  # [rad], for steps of 5 mm


@pytest.mark.parametrize("name", ["panda", "ur5e"])
def test_frames_are_named_after_the_arm(name):
    assert arm(name).frame_names == {
        "base": f"{name} base",
        "ee": f"{name} tool centre point",
    }
