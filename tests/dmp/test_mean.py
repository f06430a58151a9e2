import pytest
import torch

from hrc_learn.dmp import JointDMP, OrientationDMP, PoseDMP, mean_primitive
from hrc_learn.geometry import quaternion


def demonstrations(n=3, seed=0):
    rng = torch.Generator().manual_seed(seed)
    time = torch.linspace(0, 2, 200, dtype=torch.float64)
    wave = torch.randn(n, 1, 4, generator=rng, dtype=torch.float64)
    s = (time / 2)[:, None]
    return time, wave * (10 * s**3 - 15 * s**4 + 6 * s**5) + 0.1 * torch.sin(3 * time)[:, None]


def test_the_mean_rolls_out_to_the_mean():
    time, position = demonstrations()
    each = JointDMP.fit(time.expand(3, -1), position, n_basis=20)
    mean = mean_primitive(each)
    torch.testing.assert_close(
        mean.rollout(time).position,
        each.rollout(time).position.mean(dim=0),
        atol=1e-9,
        rtol=0,
    )


def test_the_mean_of_one_is_itself():
    time, position = demonstrations(1)
    single = JointDMP.fit(time, position[0], n_basis=20, joint_names=("a", "b", "c", "d"))
    mean = mean_primitive(single)
    torch.testing.assert_close(mean.rollout(time).position, single.rollout(time).position)
    assert mean.joint_names == ("a", "b", "c", "d")


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_sign_of_a_quaternion_does_not_matter(sign):
    time, position = demonstrations(2)
    orientation = quaternion.exp(0.5 * position[..., :3])
    plain = PoseDMP.fit(time.expand(2, -1), position[..., :3], orientation, n_basis=20)
    flips = torch.tensor([1.0, sign], dtype=torch.float64)[:, None, None]
    flipped = PoseDMP.fit(
        time.expand(2, -1), position[..., :3], flips * orientation, n_basis=20
    )
    a, b = mean_primitive(plain), mean_primitive(flipped)
    assert float(quaternion.angle(a.goal.orientation, b.goal.orientation)) < 1e-9
    middle = quaternion.slerp(
        orientation[0, -1], orientation[1, -1], torch.tensor(0.5).double()
    )
    assert float(quaternion.angle(a.goal.orientation, middle)) < 1e-9


def test_the_mean_of_orientations_is_that_of_their_poses():
    """A pose that stands still and turns has the mean of its turns."""
    time = torch.linspace(0, 1, 60, dtype=torch.float64)
    reach = torch.tensor([0.8, 1.0, 1.3], dtype=torch.float64)[:, None, None]
    axis = torch.tensor([0.2, -0.5, 1.0], dtype=torch.float64)
    turn = quaternion.exp(reach * (time**2)[:, None] * axis)
    mean = mean_primitive(OrientationDMP.fit(time, turn, 15))
    still = torch.zeros(3, 60, 3, dtype=torch.float64)
    pose = mean_primitive(PoseDMP.fit(time, still, turn, 15))
    torch.testing.assert_close(
        mean.rollout(time).orientation, pose.rollout(time).orientation, rtol=0, atol=1e-12
    )
    assert mean.goal.shape == (4,)
