"""Losses and distances against plain formulas."""

import numpy as np
import pytest
import torch
from demo_motions import arm_motion

from hrc_learn.dmp import JointDMP
from hrc_learn.dmp.training import Bounds, Box, Clearance, Jerk, Sphere, Tracking, Via


@pytest.fixture
def motion():
    """A batch of motions, on times closer together at the end."""
    time, position = arm_motion(n_samples=100, n_joints=3)
    dmp = JointDMP.fit(time, torch.stack([position, 2 * position]))
    grid = 3 * torch.linspace(0, 1, 50, dtype=torch.float64) ** 0.5
    return dmp.rollout(time=grid)


def test_each_is_what_it_says(motion):
    y, t = motion.position.detach().numpy(), motion.time.numpy()
    acceleration = motion.acceleration.detach().numpy()
    wanted = np.linspace(0, 1, 150).reshape(50, 3)
    jerk = np.diff(acceleration, axis=1) / np.diff(t, axis=1)[..., None]
    at = np.stack([[np.interp(1.3, t[i], y[i, :, j]) for j in range(3)] for i in range(2)])
    beyond = np.maximum(np.maximum(-0.5 - y, y - 0.4), 0) / 0.9
    depth = np.maximum(3.3 - np.linalg.norm(y - [0.1, 0.2, 0.3], axis=-1), 0)
    expected = {
        Tracking(wanted): ((y - wanted) ** 2).sum(-1).mean(-1),
        Tracking(wanted[:, :1], task=lambda q: q.sum(-1, keepdim=True)): (
            (y.sum(-1) - wanted[:, 0]) ** 2
        ).mean(-1),
        Jerk(): (jerk**2).sum(-1).mean(-1),
        Via([0.1, 0.2, 0.3], time=1.3): ((at - [0.1, 0.2, 0.3]) ** 2).sum(-1),
        Via([0.1, 0.2, 0.3]): ((y[:, -1] - [0.1, 0.2, 0.3]) ** 2).sum(-1),
        Bounds([-0.5] * 3, [0.4] * 3): (beyond**2).sum(-1).mean(-1),
        Clearance([Sphere(centre=(0.1, 0.2, 0.3), radius=0.3)], margin=3.0): (depth**2).mean(
            -1
        ),
    }
    for loss, value in expected.items():
        assert (value > 0).all(), loss
        np.testing.assert_allclose(loss(motion).detach().numpy(), value, err_msg=str(loss))


def test_losses_add_up(motion):
    a, b, c = Jerk(), Via([0.0, 0.0, 0.0]), Via([1.0, 0.0, 0.0], time=0.5)
    loss = 2.0 * (a + 3.0 * b) + c
    expected = 2 * a(motion) + 6 * b(motion) + c(motion)
    torch.testing.assert_close(loss(motion), expected)


def test_obstacles_of_several_points_count_each(motion):
    ball = Sphere(centre=(0.1, 0.2, 0.3), radius=0.3)
    one = Clearance([ball], margin=1.0)(motion)
    both = Clearance([ball, ball], margin=1.0, task=lambda q: torch.stack([q, q, q], dim=-2))(
        motion
    )
    torch.testing.assert_close(both, 6 * one)


@pytest.mark.parametrize(
    "obstacle",
    [
        Sphere(centre=(0.1, -0.2, 0.3), radius=0.4),
        Box(centre=(0.1, -0.2, 0.3), half_size=(0.3, 0.1, 0.2)),
    ],
)
def test_signed_distance(obstacle):
    """Against the nearest of many points on the surface, and its gradient has length one."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (50, 3)) + obstacle.centre
    if isinstance(obstacle, Sphere):
        surface = rng.standard_normal((50_000, 3))
        surface *= obstacle.radius / np.linalg.norm(surface, axis=1, keepdims=True)
        inside = np.linalg.norm(points - obstacle.centre, axis=1) < obstacle.radius
    else:
        surface = rng.uniform(-1, 1, (50_000, 3))
        side = rng.integers(0, 3, len(surface))
        surface[np.arange(len(surface)), side] = np.sign(surface[np.arange(len(surface)), side])
        surface *= obstacle.half_size
        inside = (np.abs(points - obstacle.centre) < obstacle.half_size).all(1)
    surface += obstacle.centre
    nearest = np.array([np.linalg.norm(surface - p, axis=1).min() for p in points])
    x = torch.tensor(points, requires_grad=True)
    distance = obstacle.distance(x)
    assert inside.any()
    assert not inside.all()
    signed = np.where(inside, -nearest, nearest)
    np.testing.assert_allclose(distance.detach().numpy(), signed, atol=1e-2)
    (gradient,) = torch.autograd.grad(distance.sum(), x)
    torch.testing.assert_close(gradient.norm(dim=-1), torch.ones(50, dtype=torch.float64))
