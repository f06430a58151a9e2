import pytest
import torch

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import UnreachableError, clear_posture, comfortable_posture, panda


def test_a_comfortable_posture_reaches_the_pose_far_from_trouble():
    pose = Pose(
        torch.tensor([0.3, 0.4, 0.3], dtype=torch.float64),
        quaternion.normalize(torch.tensor([0.0, 1.0, 0.2, 0.0], dtype=torch.float64)),
    )
    q = comfortable_posture(panda, pose)
    reached = panda.forward(q)
    assert (reached.position - pose.position).norm() < 1e-9
    assert quaternion.angle(reached.orientation, pose.orientation) < 1e-9
    distance = torch.minimum(q - panda.limits.lower, panda.limits.upper - q)
    assert distance.min() > 0.3
    assert torch.linalg.svdvals(panda.jacobian(q))[-1] > 0.1


def test_a_clear_posture_is_the_first_with_a_free_path():
    """In a plane with a wall at 1 that has a door between 2 and 3."""

    def clearance(q: torch.Tensor) -> torch.Tensor:
        wall = (q[..., 0] - 1).abs()
        return torch.where((q[..., 1] - 2.5).abs() < 0.5, 1.0, wall) - 0.1

    postures = torch.tensor([[2.0, 0.0], [2.0, 5.0], [0.0, 9.0]], dtype=torch.float64)
    start = torch.tensor([[1.5, 0.0], [0.5, 1.5], [0.5, 0.0]], dtype=torch.float64)
    chosen = clear_posture(postures, start, clearance)
    assert chosen.tolist() == postures.tolist()
    # Through the wall whichever it is: what comes least near.
    walled = clear_posture(postures[:1], start[2], clearance)
    assert walled.tolist() == [2.0, 0.0]


def test_a_pose_out_of_reach_is_refused():
    far = Pose(
        torch.tensor([2.0, 0.0, 0.3], dtype=torch.float64),
        torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64),
    )
    with pytest.raises(UnreachableError, match="move the pose"):
        comfortable_posture(panda, far)
