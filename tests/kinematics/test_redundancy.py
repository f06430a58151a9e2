import pytest
import torch
from arm_samples import joint_positions
from sampling import generator
from torch.testing import assert_close

from hrc_learn.geometry import quaternion
from hrc_learn.kinematics import (
    arm_angle,
    arm_angle_and_motion,
    panda,
)


def regular_configurations(*batch, seed):
    """With the elbow and the wrist well away from where the angle loses its meaning."""
    q = joint_positions(4000, rng=generator(seed))
    points = panda.link_poses(q).position
    reach = points[:, 5] - points[:, 1]
    elbow = points[:, 3] - points[:, 1]
    aside = torch.linalg.cross(reach, elbow).norm(dim=-1) / reach.norm(dim=-1)
    level = reach[:, :2].norm(dim=-1)
    q = q[(aside > 0.1) & (level > 0.1)]
    return q[: torch.Size(batch).numel()].reshape(*batch, 7)


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2), (100,)])
def test_elbow_stands_upright_once_turned_back(batch):
    q = regular_configurations(*batch, seed=1)
    points = panda.link_poses(q).position
    shoulder, elbow, wrist = points[..., 1, :], points[..., 3, :], points[..., 5, :]
    axis = torch.nn.functional.normalize(wrist - shoulder, dim=-1)
    back = quaternion.exp(-arm_angle(panda, q)[..., None] * axis)
    upright = quaternion.rotate(back, elbow - shoulder)
    # In the vertical plane through the axis, on its upper side.
    side = torch.linalg.cross(axis, torch.tensor([0.0, 0, 1]).double().expand_as(axis))
    above = torch.linalg.cross(side, axis)
    assert_close((upright * side).sum(-1), torch.zeros(batch).double(), rtol=0, atol=1e-12)
    assert bool(((upright * above).sum(-1) > 0).all())


def test_elbow_is_up_at_the_ready_posture():
    assert_close(arm_angle(panda, panda.ready), torch.zeros(()).double(), rtol=0, atol=1e-12)


def test_motion_turns_the_arm_and_leaves_the_hand_alone():
    q = regular_configurations(100, seed=2)
    J = panda.jacobian(q)
    J_regular = torch.linalg.svdvals(J)[:, -1] > 0.05
    q, J = q[J_regular], J[J_regular]
    angle, motion = arm_angle_and_motion(panda, q, J)
    assert_close(angle, arm_angle(panda, q))
    assert float((J @ motion[..., None]).abs().max()) < 1e-9
    step = 1e-5
    after, before = arm_angle(panda, q + step * motion), arm_angle(panda, q - step * motion)
    rate = torch.remainder(after - before + torch.pi, 2 * torch.pi) - torch.pi
    rate = rate / (2 * step)
    # How far the arm turns for a unit of null-space motion; small gains are damped.
    gain = rate / motion.norm(dim=-1)
    assert_close(rate, gain**2 / (gain**2 + 1e-2), rtol=1e-6, atol=1e-6)
    assert float(rate.median()) > 0.9
