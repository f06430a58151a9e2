"""Straight lines of the end effector and of the joints."""

import pytest
import torch

from hrc_learn.geometry import Pose, minimum_jerk, quaternion
from hrc_learn.kinematics import panda
from hrc_learn.skills.arm_motion import StraightLine, joint_line


def random_configurations(n, seed):
    rng = torch.Generator().manual_seed(seed)
    lower, upper = panda.limits.lower, panda.limits.upper
    return lower + (upper - lower) * torch.rand(n, 7, generator=rng, dtype=torch.float64)


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
    line = StraightLine(start, goal, speed=0.2)
    steps = round(line.duration / dt)
    assert 0.2 * line.duration == pytest.approx(float((goal.position - start.position).norm()))
    samples = [line.at(k * dt) for k in range(1, steps + 1)]
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
