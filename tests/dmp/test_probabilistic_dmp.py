from dataclasses import replace

import numpy as np
import pytest
import torch
from demo_motions import arm_motion, minimum_jerk
from scipy.stats import multivariate_normal

from hrc_learn.dmp import JointDMP, OrientationDMP, PoseDMP, ProbabilisticDMP, mean_primitive
from hrc_learn.geometry import quaternion

S = torch.linspace(0, 1, 200, dtype=torch.float64)


def family(n=12, seed=0):
    """Motions of 2 s of two joints that differ in goal, bump and start velocity."""
    rng = torch.Generator().manual_seed(seed)
    goal, bump, lean = torch.randn(3, n, 1, 2, generator=rng, dtype=torch.float64)
    s = S[:, None]
    wave = 0.3 * bump * torch.sin(torch.pi * s) ** 2 + 0.1 * lean * torch.sin(4 * s)
    return 2 * S, minimum_jerk(s) * (1 + 0.2 * goal) + wave


def dense(rows):
    """Rows of H, for both joints at all times."""
    joints = torch.eye(2, dtype=torch.float64)
    return torch.stack([torch.kron(joint, row) for row in rows for joint in joints])


@pytest.fixture(scope="module")
def distribution():
    time, motions = family()
    return ProbabilisticDMP.fit(JointDMP.fit(time, motions, n_basis=15))


def test_moments_are_those_of_the_demonstrations(distribution):
    time, motions = family()
    mean, deviation = distribution.position(time)
    torch.testing.assert_close(mean, motions.mean(0), rtol=0, atol=1e-3)
    torch.testing.assert_close(deviation, motions.std(0), rtol=0, atol=1e-3)
    torch.testing.assert_close(
        distribution.mean_primitive().rollout(time=time).position, mean, rtol=0, atol=1e-9
    )


def test_samples_vary_like_the_demonstrations(distribution):
    time, _ = family()
    samples = distribution.sample(4000, torch.Generator().manual_seed(0))
    positions = samples.rollout(time=time).position
    mean, deviation = distribution.position(time)
    torch.testing.assert_close(positions.mean(0), mean, rtol=0, atol=0.02)
    torch.testing.assert_close(positions.std(0), deviation, rtol=0.05, atol=0.005)


def test_conditioning_agrees_with_the_textbook(distribution):
    """Bishop 2006, eqs. 2.116 and 2.117, on dense matrices."""
    value = torch.tensor([[0.3, 0.9], [0.8, 1.2]], dtype=torch.float64)
    given = distribution.condition([0.7, 1.5], value, noise=0.05)
    x, spread = distribution.mean.flatten(), distribution.spread
    H = distribution.primitive.response.evaluate(
        torch.tensor([0.35, 0.75], dtype=torch.float64)
    )[:, 0]
    observe = dense(H)
    cov = spread @ spread.mT
    noise = 0.05**2 * torch.eye(4, dtype=torch.float64)
    gain = cov @ observe.mT @ torch.linalg.inv(observe @ cov @ observe.mT + noise)
    expected = x + gain @ (value.flatten() - observe @ x)
    torch.testing.assert_close(given.mean.flatten(), expected)
    left = cov - gain @ observe @ cov
    torch.testing.assert_close(given.spread @ given.spread.mT, left, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("dependence", [0.0, 0.6, 1.0])
def test_given_ends_condition_by_the_dependence(distribution, dependence):
    """As on dense matrices, with the covariance of weights and ends times the factor."""
    some = replace(distribution, dependence=dependence)
    start, goal = torch.tensor([[0.2, -0.1], [1.1, 1.4]], dtype=torch.float64)
    given = some.at(start, goal)
    cov = (some.spread @ some.spread.mT).view(*some.mean.shape, *some.mean.shape)
    rest = cov[:, :-2, :, :-2].reshape(2 * 16, 2 * 16)
    cross = cov[:, :-2, :, -2:].reshape(2 * 16, 4)
    ends = cov[:, -2:, :, -2:].reshape(4, 4)
    gain = cross @ torch.linalg.pinv(ends, rtol=1e-12, hermitian=True)
    shift = (torch.stack([start, goal], 1) - some.mean[:, -2:]).flatten()
    moved = some.mean[:, :-2].flatten() + dependence * gain @ shift
    torch.testing.assert_close(given.mean[:, :-2].flatten(), moved, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(given.mean[:, -2:], torch.stack([start, goal], 1))
    left = (given.spread @ given.spread.mT).view_as(cov)
    expected = (rest - dependence**2 * gain @ cross.mT).view(2, 16, 2, 16)
    torch.testing.assert_close(left[:, :-2, :, :-2], expected, rtol=1e-5, atol=1e-6)
    assert (left[:, -2:] == 0).all()


@pytest.mark.parametrize("n", [3, 4, 7])
def test_the_dependence_is_what_predicts_held_out_paths_best(n):
    """Of fewer than four demonstrations it is one."""
    rng = np.random.default_rng(n)
    s = S.numpy()[:, None]
    ends = rng.normal(size=(n, 2, 1, 1))
    bend = 0.4 * (ends[:, 0] + ends[:, 1]) + 0.6 * rng.normal(size=(n, 1, 1))
    motions = ends[:, 0] + (ends[:, 1] - ends[:, 0]) * minimum_jerk(S)[:, None].numpy()
    motions = motions + bend * np.sin(np.pi * s) ** 2
    batch = JointDMP.fit(2 * S, motions, n_basis=10)
    found = ProbabilisticDMP.fit(batch).dependence
    if n < 4:
        assert found == 1
        return
    x = batch.motion.coordinates().detach()[:, 0].numpy()
    rows = batch.response.evaluate(torch.linspace(0, 1, 30).double())[:, 0, :-2].numpy()
    paths, ends = x[:, :-2] @ rows.T, x[:, -2:]
    agree = size = 0.0
    for i in range(n):
        rest = np.arange(n) != i
        design = np.hstack([np.ones((n - 1, 1)), ends[rest] - ends[rest].mean(0)])
        fit = np.linalg.lstsq(design, paths[rest], rcond=1e-6)[0]
        predicted = (ends[i] - ends[rest].mean(0)) @ fit[1:]
        agree += predicted @ (paths[i] - paths[rest].mean(0))
        size += predicted @ predicted
    assert found == pytest.approx(np.clip(agree / size, 0, 1), abs=1e-6)


def test_via_points_and_via_velocities_are_passed(distribution):
    via = torch.tensor([[0.6, 0.2]], dtype=torch.float64)
    given = distribution.condition([1.0], via)
    torch.testing.assert_close(given.mean_primitive().rollout(time=[1.0]).position, via)
    assert given.position([1.0])[1].max() < 1e-5
    slow = given.condition([1.0], velocity=[[0.0, 0.0]])
    there = slow.mean_primitive().rollout(time=[1.0])
    torch.testing.assert_close(there.position, via, rtol=0, atol=1e-5)
    assert there.velocity.abs().max() < 1e-4


def test_one_primitive_bends_through_via_points_and_keeps_its_ends():
    time, position = arm_motion(n_joints=2)
    dmp = JointDMP.fit(time, position)
    via = torch.tensor([[0.4, torch.nan]], dtype=torch.float64)
    bent = ProbabilisticDMP.around(dmp).condition([1.5], via).mean_primitive()
    plain, moved = dmp.rollout().position, bent.rollout().position
    assert bent.rollout(time=[1.5]).position[0, 0].item() == pytest.approx(0.4, abs=1e-6)
    torch.testing.assert_close(moved[:, 1], plain[:, 1])
    torch.testing.assert_close(moved[0], plain[0])
    # The bend is local: it has died out at the end, and is smooth in between.
    torch.testing.assert_close(moved[-1], plain[-1], rtol=0, atol=0.02)
    torch.testing.assert_close(bent.goal, dmp.goal)
    kink = (moved - plain).diff(n=2, dim=0).abs().max()
    assert kink < 1e-3


def test_slack_reaches_what_no_mixture_passes():
    time, motions = family(n=3)
    primitives = JointDMP.fit(time, motions, n_basis=15)
    via = torch.tensor([[2.0, -1.0], [-0.5, 1.5], [2.0, 0.0]], dtype=torch.float64)
    times = [0.5, 1.0, 1.6]

    def miss(slack):
        given = ProbabilisticDMP.fit(primitives, slack=slack).condition(times, via)
        return (given.mean_primitive().rollout(time=times).position - via).abs().max()

    assert miss(0.0) > 0.1
    assert miss(0.3) < 1e-5


def test_log_prob_is_that_of_the_gaussian(distribution):
    time, motions = family(seed=1)
    some = slice(None, None, 40)
    got = distribution.log_prob(time[some], motions[0, some], noise=0.1)
    rows = distribution.primitive.response.evaluate(S[some])[:, 0]
    cov = distribution.spread @ distribution.spread.mT
    observe = torch.stack(
        [torch.kron(torch.eye(2).double()[d], h) for h in rows for d in (0, 1)]
    )
    mean = (observe @ distribution.mean.flatten()).numpy()
    full = (observe @ cov @ observe.mT).numpy() + 0.01 * np.eye(len(mean))
    expected = multivariate_normal(mean, full).logpdf(motions[0, some].flatten().numpy())
    assert got.item() == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("batch", [(0,), (2, 0), (0, 2)])
def test_no_motions_have_no_densities(distribution, batch):
    values = torch.zeros(*batch, 3, 2)
    assert distribution.log_prob([0.1, 0.2, 0.3], values, noise=0.1).shape == batch


def test_conditioning_is_differentiable(distribution):
    def passed(value):
        return distribution.condition([0.7, 1.5], value, noise=0.05).mean

    value = torch.zeros(2, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(passed, (value,))


def test_what_cannot_be_is_refused(distribution):
    time, position = arm_motion()
    with pytest.raises(ValueError, match="at least 2"):
        ProbabilisticDMP.fit(JointDMP.fit(time, position))
    both = torch.stack([position, position])
    with pytest.raises(ValueError, match=r"needs one primitive, got a batch \(2,\)"):
        ProbabilisticDMP.around(JointDMP.fit(time, both))
    with pytest.raises(ValueError, match="not linear"):
        ProbabilisticDMP.fit(JointDMP.fit(time, both, scaling="amplitude"))
    with pytest.raises(ValueError, match=r"value must have shape \(1, 2\)"):
        distribution.condition([0.5], [0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="non-negative"):
        distribution.position([-1.0])
    with pytest.raises(ValueError, match=r"noise has shape \(3,\), .* must be \(1, 2\)"):
        distribution.condition([0.5], [[0.0, 0.0]], noise=[0.1, 0.1, 0.1])
    with pytest.raises(ValueError, match=r"one motion, got a batch \(3,\)"):
        distribution.at(goal=torch.zeros(3, 2))
    for duration in ([1.0, 2.0], torch.ones(1)):
        with pytest.raises(ValueError, match=r"duration must be one number, got \("):
            distribution.condition([], duration=duration)
    for slack in (float("nan"), -1.0):
        with pytest.raises(ValueError, match="slack must be finite and not negative"):
            ProbabilisticDMP.fit(JointDMP.fit(time, both), slack=slack)
        with pytest.raises(ValueError, match="slack must be finite and not negative"):
            ProbabilisticDMP.around(JointDMP.fit(time, position), slack=slack)


def test_a_known_duration_conditions_before_the_ends(distribution):
    start, goal = [0.1, 0.2], [0.9, 1.1]
    found = distribution.at(start, goal, duration=1.7).mean_primitive()
    expected = distribution.condition([], duration=1.7).at(start, goal).mean_primitive()
    torch.testing.assert_close(found.rollout().position, expected.rollout().position)
    assert float(found.duration) == pytest.approx(1.7)


def test_an_unknown_kind_of_primitive_in_a_file_is_named(distribution, tmp_path):
    distribution.save(tmp_path / "model")
    config = tmp_path / "model" / "config.json"
    config.write_text(config.read_text().replace('"JointDMP"', '"SpiralDMP"'))
    (tmp_path / "model" / ".manifest.json").unlink()
    with pytest.raises(ValueError, match=r"unknown primitive 'SpiralDMP'; choose from .*Joint"):
        ProbabilisticDMP.load(tmp_path / "model")


# Means


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
