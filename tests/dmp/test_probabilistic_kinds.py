"""Distributions over orientations, poses and limited joints: the kinds beyond `JointDMP`."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from demo_motions import arm_motion
from scipy.stats import multivariate_normal
from torch.autograd import gradcheck
from unchecked import shapes_unchecked

from hrc_learn.dmp import OrientationDMP, PoseDMP, ProbabilisticDMP
from hrc_learn.dmp.orientation_error import nearest_turn, to_error
from hrc_learn.geometry import Pose, quaternion

NAN = torch.nan
S = torch.linspace(0, 1, 200, dtype=torch.float64)


def turns(n=6, seed=0):
    """Orientations over 2 s that differ in start, goal and the way between."""
    rng = torch.Generator().manual_seed(seed)
    start, goal, bump = 0.3 * torch.randn(3, n, 1, 3, generator=rng, dtype=torch.float64)
    s = S[:, None]
    way = s**3 * (10 - 15 * s + 6 * s**2)
    middle = torch.tensor([1.0, -0.6, 0.8], dtype=torch.float64)
    vector = (1 - way) * start + way * (middle + goal) + bump * torch.sin(torch.pi * s) ** 2
    return 2 * S, quaternion.exp(vector)


def orientation(*vector):
    return quaternion.exp(torch.tensor(vector, dtype=torch.float64))


@pytest.fixture(scope="module")
def distribution():
    return ProbabilisticDMP.fit(OrientationDMP.fit(*turns(), n_basis=15))


def test_goals_of_their_own_are_taken_about_one_reference(distribution):
    """Moments are those of the rotation vectors from the demonstrations to that."""
    time, q = turns()
    error = to_error(q, distribution.primitive.reference)
    mean, deviation = distribution.position(time)
    torch.testing.assert_close(mean, error.mean(0), rtol=0, atol=1e-3)
    torch.testing.assert_close(deviation, error.std(0), rtol=0, atol=1e-3)


def test_demonstrations_may_differ_in_length(distribution):
    """Ten samples more or less of the same motions; timestamps are padded."""
    _, q = turns()
    kept = [torch.linspace(0, 199, 200 - 10 * i).round().long() for i in range(len(q))]
    ragged = OrientationDMP.fit(
        [2 * S[k] for k in kept], [x[k] for x, k in zip(q, kept, strict=True)], n_basis=15
    )
    found = ProbabilisticDMP.fit(ragged)
    for own, other in zip(found.position(2 * S), distribution.position(2 * S), strict=True):
        torch.testing.assert_close(own, other, rtol=0, atol=1e-3)


def test_via_orientations_are_passed_by_either_sign_and_velocities_too():
    distribution = ProbabilisticDMP.fit(OrientationDMP.fit(*turns(), n_basis=15), slack=0.3)
    via = orientation(0.4, -0.2, 0.1)[None]
    omega = torch.tensor([[0.3, 0.1, -0.2]], dtype=torch.float64)
    one, other = (
        distribution.condition([0.8], q, omega).mean_primitive().rollout(time=[0.8, 1.5])
        for q in (via, -via)
    )
    assert quaternion.angle(one.orientation[:1], via) < 1e-5
    torch.testing.assert_close(one.angular_velocity[:1], omega, rtol=0, atol=1e-4)
    torch.testing.assert_close(one.orientation, other.orientation)


def test_demonstrations_with_other_signs_are_the_same(distribution):
    time, q = turns()
    sign = torch.where(torch.arange(6) % 2 == 0, 1.0, -1.0)[:, None, None]
    flipped = ProbabilisticDMP.fit(OrientationDMP.fit(time, sign * q, n_basis=15))
    one, other = (d.mean_primitive().rollout().orientation for d in (distribution, flipped))
    assert quaternion.angle(one, other).max() < 1e-6


def test_samples_vary_like_the_demonstrations(distribution):
    samples = distribution.sample(3000, torch.Generator().manual_seed(0))
    ends = samples.rollout(time=[2.0]).orientation[:, 0]
    error = to_error(ends, distribution.primitive.reference)
    mean, deviation = distribution.position([2.0])
    torch.testing.assert_close(error.mean(0), mean[0], rtol=0, atol=0.02)
    torch.testing.assert_close(error.std(0), deviation[0], rtol=0.06, atol=0)
    assert quaternion.angle(ends, samples.goal).max() < 0.01


def test_log_prob_is_that_of_the_gaussian_of_errors(distribution):
    time, q = turns(seed=1)
    times, seen = time[::50], q[0, ::50].clone()
    seen[1] = NAN
    got = distribution.log_prob(times, -seen, noise=0.1)
    mean, _ = distribution.position(times)
    H = distribution.primitive.motion.response.evaluate(times / 2)[:, 0]
    rows = torch.stack([torch.kron(d, h) for h in H for d in torch.eye(3).double()])
    root = rows @ distribution.spread
    cov = (root @ root.mT).numpy() + 0.01 * np.eye(len(rows))
    keep = np.r_[0:3, 6:12]
    error = to_error(q[0, ::50], distribution.primitive.reference)
    expected = multivariate_normal(mean.flatten()[keep], cov[np.ix_(keep, keep)])
    assert got.item() == pytest.approx(expected.logpdf(error.flatten()[keep]), rel=1e-6)


def poses(n=5):
    time, q = turns(n)
    columns = torch.stack([arm_motion(200, 5, seed=seed)[1] for seed in range(n)])
    return time, 0.2 * columns[..., :3], q, columns[..., 3:]


def test_any_of_position_orientation_and_twist_can_be_given():
    time, position, q, body = poses()
    pose = PoseDMP.fit(time, position, q, body=body, n_basis=15)
    distribution = ProbabilisticDMP.fit(pose, slack=0.3)
    where = Pose(torch.tensor([[0.1, NAN, 0.2], [NAN] * 3]).double(), torch.full((2, 4), NAN))
    turn = Pose(torch.full((1, 3), NAN), orientation(0.5, 0.0, -0.1)[None])
    twist = torch.tensor([[NAN, 0.5, NAN, 0.1, 0.2, 0.3]]).double()
    given = distribution.condition([0.7, 1.2], where)
    # An angular velocity is taken at the orientation of the mean: that comes first.
    given = given.condition([1.6], turn).condition([1.6], velocity=twist)
    there = given.mean_primitive().rollout(time=[0.7, 1.2, 1.6])
    torch.testing.assert_close(there.position[0, [0, 2]], where.position[0, [0, 2]])
    assert quaternion.angle(there.orientation[2], turn.orientation[0]) < 1e-6
    seen = ~twist[0].isnan()
    torch.testing.assert_close(there.twist[2, seen], twist[0, seen], rtol=0, atol=1e-4)


def test_one_pose_bends_through_via_points_and_keeps_its_ends():
    time, position, q, body = (column[0] if column.ndim > 1 else column for column in poses())
    dmp = PoseDMP.fit(time, position, q, body=body)
    via = Pose(torch.tensor([[0.3, 0.1, 0.0]]).double(), orientation(0.9, 0.3, 0.0)[None])
    bent = ProbabilisticDMP.around(dmp).condition([1.0], via).mean_primitive()
    there = bent.rollout(time=[1.0])
    torch.testing.assert_close(there.position, via.position, rtol=0, atol=1e-5)
    assert quaternion.angle(there.orientation, via.orientation) < 1e-5
    torch.testing.assert_close(bent.goal.vector(), dmp.goal.vector())
    torch.testing.assert_close(bent.rollout().body, dmp.rollout().body)


def test_a_via_orientation_is_on_the_branch_of_the_motion():
    axis = torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)
    dmp = OrientationDMP.fit(S, quaternion.exp(9 * S[:, None] * axis))
    around = ProbabilisticDMP.around(dmp)
    via = quaternion.exp(4.6 * axis)[None]
    error = to_error(via, dmp.reference)
    expected = nearest_turn(error, dmp.motion.rollout(time=[0.5]).position)
    got = around.condition([0.5], via, noise=1e-5).position([0.5])[0]
    torch.testing.assert_close(got, expected.detach(), rtol=0, atol=1e-3)


def random_inputs(*widths):
    rng = torch.Generator().manual_seed(0)
    return [0.3 * torch.randn(1, n, generator=rng, dtype=torch.float64) for n in widths]


def test_conditioning_has_exact_gradients():
    """With respect to time, via orientation and velocity, prior mean and spread."""
    time, q = turns(3)
    prior = ProbabilisticDMP.fit(OrientationDMP.fit(time[::10], q[:, ::10], n_basis=2))

    def conditioned(at, vector, omega, mean, spread):
        given = replace(prior, mean=mean, spread=spread)
        given = given.condition(at, quaternion.exp(vector), omega, noise=0.05)
        return given.mean_primitive().rollout(time=[1.4]).orientation

    at = torch.tensor([0.9], dtype=torch.float64)
    inputs = (at, *random_inputs(3, 3), prior.mean, prior.spread)
    inputs = [x.clone().requires_grad_() for x in inputs]
    with shapes_unchecked():
        assert gradcheck(conditioned, inputs, atol=1e-6, rtol=1e-5)


def test_conditioning_of_poses_has_exact_gradients():
    time, position, q, _ = poses(3)
    fitted = PoseDMP.fit(time[::10], position[:, ::10], q[:, ::10], n_basis=4)
    prior = ProbabilisticDMP.fit(fitted)

    def conditioned(at, where, vector, twist):
        via = Pose(where, quaternion.exp(vector))
        late = prior.condition(at, via, twist, noise=0.05).mean_primitive().rollout(time=[1.4])
        return late.position, late.orientation

    at = torch.tensor([0.9], dtype=torch.float64)
    inputs = [x.clone().requires_grad_() for x in (at, *random_inputs(3, 3, 6))]
    with shapes_unchecked():
        assert gradcheck(conditioned, inputs, atol=1e-6, rtol=1e-5)
