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


@pytest.mark.parametrize("place", [(0.3, 0.4, 0.3), (0.6, 0.0, 0.2), (0.75, 0.0, 0.4)])
def test_no_posture_is_further_from_both_limits_and_singularities(place):
    down = torch.tensor([0.0, 1.0, 0.2, 0.0], dtype=torch.float64)
    pose = Pose(torch.tensor(place, dtype=torch.float64), quaternion.normalize(down))
    q = panda.postures(pose)
    limits = torch.minimum(q - panda.limits.lower, panda.limits.upper - q).amin(-1)
    singular = torch.linalg.svdvals(panda.jacobian(q))[:, -1]
    assert len(q) > 1
    assert not ((limits > limits[0] + 1e-9) & (singular > singular[0] + 1e-9)).any()


def test_a_pose_out_of_reach_is_refused():
    far = Pose(
        torch.tensor([2.0, 0.0, 0.3], dtype=torch.float64),
        torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64),
    )
    with pytest.raises(UnreachableError, match="move the pose"):
        comfortable_posture(panda, far)
