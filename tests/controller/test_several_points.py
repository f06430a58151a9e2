"""A feature of several points: the corners of the marker through camera, estimator and law."""

from dataclasses import replace

import pytest
import sampling
import torch
from closed_loop import Imperfections
from grasp_trials import CORNERS, TrialConfig, run_trials
from pinhole_camera import PinholeCamera

from hrc_learn.controller.resolved_rate import VisionBlending
from hrc_learn.geometry import Pose
from hrc_learn.jacobian import (
    BroydenEstimator,
    CompositeEstimator,
    KalmanEstimator,
    Measurement,
    PaperEstimator,
    RBFImageJacobian,
    paper_grid,
)
from hrc_learn.kinematics import panda

DOUBLE = torch.float64
J0 = torch.tensor([[-1500.0, 0, 0, 0, -200, 60], [0, 2400, 170, -200, 0, 180]], dtype=DOUBLE)


def camera(*batch: int) -> PinholeCamera:
    one = torch.ones(batch, dtype=DOUBLE)
    middle = torch.tensor([0.3, 0.4, 0.3], dtype=DOUBLE)
    return PinholeCamera.above(
        middle.expand(*batch, 3),
        height=one,
        roll=0.3 * one,
        tilt=0.2 * one,
        bearing=one,
        marker=middle.new_tensor([0.05, 0.0, -0.08]),
        corners=middle.new_tensor(CORNERS),
    )


def tools(*batch: int, seed: int = 0) -> Pose:
    rng = sampling.generator(seed)
    q = panda.ready + 0.1 * torch.randn(*batch, 7, generator=rng, dtype=DOUBLE)
    return panda.forward(q)


def test_corners_are_points_like_any_other():
    """Each corner is projected, and moves, as a marker there would."""
    eye, tool = camera(5), tools(5)
    pixels, seen = eye.project(tool)
    J = eye.image_jacobian(tool)
    assert pixels.shape == (5, 8)
    assert J.shape == (5, 8, 6)
    for k, corner in enumerate(eye.corners):
        alone = replace(eye, marker=eye.marker + corner, corners=None)
        torch.testing.assert_close(alone.project(tool)[0], pixels[:, 2 * k : 2 * k + 2])
        torch.testing.assert_close(alone.image_jacobian(tool), J[:, 2 * k : 2 * k + 2])
        assert (alone.project(tool)[1] >= seen).all()


@pytest.mark.parametrize(
    "Estimator",
    [
        PaperEstimator,
        BroydenEstimator,
        CompositeEstimator,
        KalmanEstimator,
    ],
)
def test_an_estimator_of_several_points_is_one_for_each(Estimator):
    """Their image rows are independent: the same answers as from estimators apart."""
    eye, points = camera(3), 4
    together = Estimator(
        RBFImageJacobian.from_jacobian(J0.repeat(points, 1), paper_grid(), 0.1)
    )
    apart = Estimator(RBFImageJacobian.from_jacobian(J0, paper_grid(), 0.1))
    state = together.initial_state(3)
    states = [apart.initial_state(3) for _ in range(points)]
    rng = sampling.generator(4)
    for k in range(6):
        tool = tools(3, seed=k)
        m = Measurement(
            pose=tool,
            feature=eye.project(tool)[0],
            valid=torch.ones(3, dtype=torch.bool),
            dt=0.03,
            xi_x=1e-3 * torch.randn(3, 8, generator=rng, dtype=DOUBLE),
            xi_r=torch.zeros(3, 6, dtype=DOUBLE),
        )
        if Estimator in (PaperEstimator, CompositeEstimator):
            # s couples the points in the paper's term: one point at a time pushes.
            m = replace(m, xi_x=torch.zeros_like(m.xi_x))
        state = together.update(state, m)
        for i in range(points):
            part = slice(2 * i, 2 * i + 2)
            one = replace(m, feature=m.feature[:, part], xi_x=m.xi_x[:, part])
            states[i] = apart.update(states[i], one)
    assert together.jacobian(state, tool).shape == (3, 8, 6)
    weight = torch.cat([one.weight for one in states], dim=-2)
    torch.testing.assert_close(state.weight, weight)


def test_a_feature_is_seen_where_all_of_its_points_are():
    blending = VisionBlending()
    state = blending.initial_state(torch.zeros(2, 7, dtype=DOUBLE), points=2)
    feature = torch.tensor([[700.0, 500, 710, 510], [700, 500, 1500, 510]], dtype=DOUBLE)
    state, seen, _ = blending.step(state, feature, torch.tensor([True, True]), 0.01)
    assert seen.tolist() == [True, False]
    assert state.feature[0].tolist() == feature[0].tolist()
    assert state.feature[1].tolist() == [719.5, 539.5] * 2


@pytest.mark.long
@pytest.mark.simulation
def test_corners_are_brought_to_their_targets():
    """Their mean within 5 px from any camera, though the first guess knows one point only."""
    config = TrialConfig(
        count=10,
        duration=6.0,
        dt=0.02,
        imperfections=Imperfections(frame_steps=2, noise=0.5),
        feature="corners",
    )
    result = run_trials(KalmanEstimator, config)
    assert result.success.double().mean() >= 0.9
    assert not result.violations.any()
