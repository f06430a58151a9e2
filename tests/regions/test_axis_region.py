"""The cone round an axis, against angles between vectors."""

import numpy as np
import pytest
import sampling
import torch
from scipy.spatial.transform import Rotation

from hrc_learn.geometry import quaternion
from hrc_learn.regions import AxisRegion, OrientationRegion


def axes(q: torch.Tensor) -> np.ndarray:
    return Rotation.from_quat(q.numpy(), scalar_first=True).as_matrix()[..., 2]


def test_its_function_is_that_of_the_angle_between_axes():
    rng = sampling.generator(1)
    goal, x = (sampling.quaternions(500, rng=rng) for _ in range(2))
    region = AxisRegion(goal=goal, sharpness=4.0)
    a, b = axes(goal), axes(x)
    angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1))
    assert region.value(x).numpy() == pytest.approx(4.0 * angle / 2 - 1, abs=1e-12)
    assert region.tolerance == 0.5


def test_turns_about_the_axis_of_the_goal_or_of_the_tool_change_nothing():
    rng = sampling.generator(2)
    goal, x = (sampling.quaternions(100, rng=rng) for _ in range(2))
    turn = quaternion.exp(torch.randn(2, 100, 3, generator=rng).double() * torch.eye(3)[2])
    turned = AxisRegion(goal=quaternion.multiply(goal, turn[0]))
    P, gradient = AxisRegion(goal=goal).feedback(x)
    P_turned, gradient_turned = turned.feedback(quaternion.multiply(x, turn[1]))
    torch.testing.assert_close(P, P_turned, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(gradient, gradient_turned, rtol=1e-9, atol=1e-12)
    assert np.abs((gradient.numpy() * axes(x)).sum(-1)).max() < 1e-12


def test_a_tilt_is_as_of_the_orientation_region():
    rng = sampling.generator(3)
    goal = sampling.quaternions(100, rng=rng)
    tilt = torch.randn(100, 3, generator=rng).double() * torch.tensor([1.0, 1.0, 0.0])
    x = quaternion.multiply(goal, quaternion.exp(tilt))
    ours, all_ = AxisRegion(goal=goal).feedback(x), OrientationRegion(goal=goal).feedback(x)
    for one, other in zip(ours, all_, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-12)


def test_opposite_axes_are_left():
    """Half a turn away there is no direction across both axes, but one is taken."""
    region = AxisRegion(goal=torch.tensor([1.0, 0, 0, 0], dtype=torch.float64))
    P, gradient = region.feedback(torch.tensor([0.0, 0.6, 0.8, 0], dtype=torch.float64))
    assert pytest.approx(0.01 * (15 * np.pi / 2 - 1) ** 2) == P
    assert gradient.norm() == pytest.approx(0.15 * (15 * np.pi / 2 - 1))
    assert gradient[2] == 0
