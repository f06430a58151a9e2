import pytest
import torch

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import UnreachableError, comfortable_posture, panda


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


def test_a_pose_out_of_reach_is_refused():
    far = Pose(
        torch.tensor([2.0, 0.0, 0.3], dtype=torch.float64),
        torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64),
    )
    with pytest.raises(UnreachableError, match="move the pose"):
        comfortable_posture(panda, far)
