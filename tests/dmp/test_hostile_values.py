"""Values that users give by mistake: refused with the field's name, or computed correctly."""

import math
import warnings

import numpy as np
import pytest
import torch
from unchecked import shapes_unchecked

from hrc_learn.dmp import FramedDMP, Frames, JointDMP, OrientationDMP, ProbabilisticDMP, stack
from hrc_learn.geometry import quaternion

TIME = torch.linspace(0, 2, 100, dtype=torch.float64)
CURVE = torch.sin(TIME[:, None] * torch.tensor([0.8, 1.2, -0.5], dtype=torch.float64))


@pytest.fixture(scope="module")
def dmp():
    return JointDMP.fit(TIME, CURVE, 15)


@pytest.mark.parametrize("values", [None, [None] * 3, ["a"], "0.5", object()])
def test_values_that_are_no_numbers_are_quoted(dmp, values):
    with shapes_unchecked(), pytest.raises(ValueError, match=r"expected (real )?numbers"):
        dmp.with_boundary(duration=[1.0, values])
    with shapes_unchecked(), pytest.raises(ValueError, match=r"expected (real )?numbers"):
        JointDMP.fit(TIME, [[values]] * 100)


@pytest.mark.parametrize("dt", [0, -1.0, math.nan, math.inf, 1e-12])
def test_an_interval_must_give_a_motion_that_fits_in_memory(dmp, dt):
    with pytest.raises(ValueError, match="dt must be positive and finite, above 2e-09 s"):
        dmp.rollout(dt=dt)


def test_names_are_a_list(dmp):
    with pytest.raises(ValueError, match="must be a list of names, got 'abc'"):
        JointDMP.fit(TIME, CURVE, 15, joint_names="abc")


def test_values_too_large_for_float32_are_refused():
    large = (1e37 * CURVE).float()
    with pytest.raises(ValueError, match=r"weights in torch.float32 must be finite"):
        JointDMP.fit(TIME, large, 15)
    assert JointDMP.fit(TIME, large.double(), 15).rollout().position.isfinite().all()


@pytest.mark.parametrize("tolerance", [-1.0, math.nan, math.inf])
def test_a_tolerance_of_frames_must_be_finite_and_not_negative(tolerance):
    frames = Frames(torch.eye(3).expand(2, 1, 3, 3), torch.zeros(2, 1, 3))
    with pytest.raises(ValueError, match="tolerance must be finite and not negative"):
        FramedDMP.fit(TIME, torch.stack([CURVE, 1.1 * CURVE]), frames, 15, tolerance=tolerance)


@pytest.mark.parametrize("scale", [1.0, 10.0, 1e3, 1e300])
def test_times_long_after_the_end_rest_at_the_goal_of_ude(scale):
    """The integration ends where the motion has settled, instead of taking steps for hours."""
    dmp = OrientationDMP.fit(TIME, quaternion.exp(0.5 * CURVE), 15, formulation="ude")
    with torch.no_grad(), shapes_unchecked():
        late = dmp.rollout([20.0 * scale])
    torch.testing.assert_close(late.orientation[0], dmp.goal, rtol=0, atol=1e-14)
    assert late.angular_velocity.abs().max() < 1e-13


@pytest.fixture(scope="module")
def varied(dmp):
    paths = [CURVE, 1.1 * CURVE + 0.05, 0.9 * CURVE - 0.1 * TIME[:, None], CURVE + 0.02]
    return ProbabilisticDMP.fit(JointDMP.fit(TIME, torch.stack(paths), 15))


@pytest.mark.parametrize("noise", [1e-3, 1e-7, 1e-9, 1e-12])
def test_via_points_of_any_precision_are_conditioned_like_a_dense_gaussian(varied, noise):
    """Oracle: the gain in the space of observations, in long double where digits cancel."""
    wanted = torch.tensor([[0.9, 0.8, math.nan]], dtype=torch.float64)
    found = varied.condition([1.0], wanted, noise=noise)
    rows = varied.primitive.response.evaluate(torch.tensor([0.5]).double())[:, 0]
    S = varied.spread.view(*varied.mean.shape, -1).detach().numpy().astype(np.longdouble)
    R = np.einsum("m,dmr->dr", rows[0].numpy(), S)[:2]
    missing = (wanted[0, :2] - (varied.mean @ rows[0])[:2]).numpy().astype(np.longdouble)
    C = R @ R.T + np.longdouble(noise) ** 2 * np.eye(2)
    inverse = np.array([[C[1, 1], -C[0, 1]], [-C[1, 0], C[0, 0]]]) / (
        C[0, 0] * C[1, 1] - C[0, 1] * C[1, 0]
    )
    change = np.einsum("dmr,r->dm", S, R.T @ inverse @ missing)
    size = float(np.abs(change).max())
    made = (found.mean - varied.mean).detach().numpy()
    assert np.abs(made - change).max() < 1e-9 * size


def test_equal_demonstrations_say_why_a_via_point_is_missed(dmp):
    same = ProbabilisticDMP.fit(stack([dmp, dmp, dmp]))
    with pytest.warns(UserWarning, match="all demonstrations agree on other values"):
        missed = same.condition([1.0], dmp.goal[None])
    torch.testing.assert_close(missed.mean, same.mean)
    free = ProbabilisticDMP.fit(stack([dmp, dmp, dmp]), slack=0.1)
    passed = free.condition([1.0], dmp.goal[None], noise=1e-4).position([1.0])[0]
    assert (passed[0] - dmp.goal).abs().max() < 1e-4


def test_a_via_point_on_the_motion_is_no_reason_to_warn(dmp, varied):
    same = ProbabilisticDMP.fit(stack([dmp, dmp]))
    on_path = dmp.rollout([1.0]).position.detach()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        same.condition([1.0], on_path)
        varied.condition([1.0], on_path + 0.1)


@pytest.mark.parametrize("A", [torch.zeros(3, 3), torch.ones(3, 3)])
def test_frames_that_lose_a_direction_are_refused(A):
    with pytest.raises(ValueError, match="inverse of A of frames must be finite"):
        Frames(torch.stack([torch.eye(3), A]), torch.zeros(2, 3))


def test_kl_compares_motions_of_one_kind_and_reference(varied):
    paths = torch.stack([CURVE, 1.1 * CURVE, 0.9 * CURVE - 0.1 * TIME[:, None]])
    turned = [quaternion.exp(0.5 * paths), quaternion.exp(0.5 * paths + 0.3)]
    here, there = (ProbabilisticDMP.fit(OrientationDMP.fit(TIME, q, 15)) for q in turned)
    fewer = ProbabilisticDMP.fit(JointDMP.fit(TIME, paths[..., :2], 15))
    for one, other in ((varied, here), (here, varied), (varied, fewer), (here, there)):
        with pytest.raises(ValueError, match="kl needs motions of one kind"):
            one.kl(other, 0.1)
    assert here.kl(here, 0.1).abs() < 1e-6


def test_batches_that_do_not_broadcast_are_listed():
    dmps = JointDMP.fit(TIME, torch.stack([CURVE, 1.1 * CURVE]), 15)
    message = r"batches must broadcast, but the primitive has \(2,\), rate \(2,\), start \(3,\)"
    for made in (dmps.rollout, dmps.initial_state):
        with pytest.raises(ValueError, match=message):
            made(start=torch.zeros(3, 3))
