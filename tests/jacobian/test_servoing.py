"""A bare visual servo in closed loop: the use that the estimators are made for."""

import pytest
import torch
from pinhole import Pinhole
from sampling import generator
from unchecked import shapes_unchecked

from hrc_learn.geometry import Pose
from hrc_learn.jacobian import (
    BroydenEstimator,
    CompositeEstimator,
    FixedEstimator,
    KalmanEstimator,
    Measurement,
    RBFImageJacobian,
    paper_grid,
)

RUNS, FRAMES, RATE = 16, 300, 30
# (eq_js0): right for a camera overhead that is not turned.
J0 = torch.tensor(
    [[-1500, 0, 0, 0, -200, 60], [0, 2400, 170, -200, 0, 180]], dtype=torch.float64
)


def tool_at_random(rng, size):
    center = torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
    offset = torch.rand(RUNS, 3, generator=rng, dtype=torch.float64) - 0.5
    down = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64).expand(RUNS, 4)
    return Pose(center + offset * torch.tensor(size, dtype=torch.float64), down)


def servo(Estimator, roll):
    """Pixel error after ten seconds of v = -J_s_hat^+ (x - x_d), both capped."""
    rng = generator(1)
    camera = Pinhole.overhead(roll=roll)
    estimator = Estimator(RBFImageJacobian.from_jacobian(J0, paper_grid(), 0.1))
    state = estimator.initial_state(RUNS)
    pose = tool_at_random(rng, (0.3, 0.3, 0.1))
    target = camera.project(tool_at_random(rng, (0.3, 0.3, 0.0)))
    for _ in range(FRAMES):
        noise = 0.5 * torch.randn(RUNS, 2, generator=rng, dtype=torch.float64)
        x = camera.project(pose) + noise
        error = x - target
        xi_x = error * (100 / error.norm(dim=-1, keepdim=True)).clamp_max(1)
        J = estimator.jacobian(state, pose).detach()[..., :3]
        v = -2 * (torch.linalg.pinv(J) @ xi_x[..., None]).squeeze(-1)
        v = v * (0.25 / v.norm(dim=-1, keepdim=True)).clamp_max(1)
        still = torch.zeros(RUNS, 6, dtype=torch.float64)
        state = estimator.update(
            state,
            Measurement(
                pose=pose,
                feature=x,
                valid=torch.ones(RUNS, dtype=torch.bool),
                dt=1 / RATE,
                xi_x=0 * xi_x,  # prediction error alone
                xi_r=still,
            ),
        )
        pose = Pose(pose.position + v / RATE, pose.orientation)
    return (camera.project(pose) - target).norm(dim=-1)


@pytest.mark.long
@pytest.mark.parametrize("roll", [0.0, 1.5, 3.0])
@pytest.mark.parametrize(
    "Estimator",
    [BroydenEstimator, CompositeEstimator, KalmanEstimator],
)
def test_reaches_the_target_however_the_camera_is_turned(Estimator, roll):
    with shapes_unchecked():  # for speed
        assert float(servo(Estimator, roll).max()) < 5


def test_without_learning_a_turned_camera_is_hopeless():
    with shapes_unchecked():
        assert float(servo(FixedEstimator, 0.0).max()) < 5
        assert float(servo(FixedEstimator, 1.7).min()) > 20
