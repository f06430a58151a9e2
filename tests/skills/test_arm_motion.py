import pytest
import torch

from hrc_learn.geometry import Pose, minimum_jerk, quaternion
from hrc_learn.kinematics import panda
from hrc_learn.skills.arm_motion import (
    joint_line,
    resolved_rate,
    straight_line,
)


def random_configurations(n, seed):
    rng = torch.Generator().manual_seed(seed)
    lower, upper = panda.limits.lower, panda.limits.upper
    return lower + (upper - lower) * torch.rand(n, 7, generator=rng, dtype=torch.float64)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_the_hand_moves_as_asked_and_the_body_as_far_as_it_can(batch):
    q = panda.ready.expand(*batch, 7)
    rng = torch.Generator().manual_seed(0)
    twist = torch.randn(*batch, 6, generator=rng, dtype=torch.float64)
    wanted = torch.randn(*batch, 7, generator=rng, dtype=torch.float64)
    J = panda.jacobian(q)
    u = resolved_rate(J, twist, wanted)
    torch.testing.assert_close((J @ u[..., None])[..., 0], twist, atol=1e-9, rtol=0)
    # Of all motions with that twist it is the nearest to the wanted one (normal equations).
    null = torch.eye(7, dtype=torch.float64) - torch.linalg.pinv(J) @ J
    torch.testing.assert_close((null @ (wanted - u)[..., None])[..., 0], torch.zeros_like(u))


def test_the_body_moves_without_the_hand_near_singularities_too():
    J = panda.jacobian(random_configurations(500, seed=1))
    assert (torch.linalg.svdvals(J)[:, -1] < 0.05).sum() > 50
    u = resolved_rate(J, torch.zeros(500, 6, dtype=torch.float64), torch.ones_like(J[:, 0]))
    assert (J @ u[..., None]).abs().max() < 1e-12
    assert u.norm(dim=-1).median() > 0.1


def test_near_a_singularity_velocities_stay_bounded():
    stretched = torch.tensor([0.0, 0.0, 0.0, -0.07, 0.0, 0.07, 0.0], dtype=torch.float64)
    pull = torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    u = resolved_rate(panda.jacobian(stretched), pull, torch.zeros(7, dtype=torch.float64))
    assert u.abs().max() < 50.0


def test_minimum_jerk_starts_and_ends_at_rest():
    assert minimum_jerk(-1.0) == (0.0, 0.0)
    assert minimum_jerk(2.0) == (1.0, 0.0)
    x, h = 0.37, 1e-6
    slope = (minimum_jerk(x + h)[0] - minimum_jerk(x - h)[0]) / (2 * h)
    assert minimum_jerk(x)[1] == pytest.approx(slope, abs=1e-8)


def test_a_straight_line_ends_at_its_goal_and_its_twists_integrate_to_it():
    start = panda.forward(panda.ready)
    turn = quaternion.exp(torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64))
    goal = Pose(
        start.position + torch.tensor([0.1, -0.2, 0.05], dtype=torch.float64),
        quaternion.multiply(turn, start.orientation),
    )
    dt = 0.005
    samples = list(straight_line(start, goal, speed=0.2, dt=dt))
    last, twist = samples[-1]
    torch.testing.assert_close(last.position, goal.position, atol=1e-4, rtol=0)
    assert float(quaternion.angle(last.orientation, goal.orientation)) < 1e-3
    assert float(twist.norm()) < 1e-2
    travelled = dt * torch.stack([twist[:3] for _, twist in samples]).sum(dim=0)
    torch.testing.assert_close(travelled, goal.position - start.position, atol=1e-4, rtol=0)
    for pose, _ in samples:
        offset = pose.position - start.position
        along = goal.position - start.position
        assert float(torch.linalg.cross(offset, along).norm()) < 1e-12


def test_a_line_in_joint_space_keeps_its_speed():
    start, goal = random_configurations(2, seed=1)
    path = joint_line(start, goal, speed=0.5, dt=0.01)
    torch.testing.assert_close(path[0], start)
    torch.testing.assert_close(path[-1], goal)
    speed = path.diff(dim=0).abs().max() / 0.01
    assert 0.45 < float(speed) < 0.51
    same = joint_line(start, start, speed=0.5, dt=0.01)
    torch.testing.assert_close(same, start.expand_as(same))
