"""Demonstrations of several ways: parted, told by context or values, and not mixed up."""

import math

import numpy as np
import pytest
import torch
from demo_motions import minimum_jerk
from scipy.special import logsumexp
from scipy.stats import norm
from torch.distributions import MultivariateNormal

from hrc_learn.dmp import JointDMP, MixtureDMP, OrientationDMP, mean_primitive
from hrc_learn.dmp.mixture_dmp import (
    _expectation_maximisation,
    _responsibilities,
    principal_components,
)
from hrc_learn.geometry import quaternion

S = torch.linspace(0, 1, 80, dtype=torch.float64)


def around_an_obstacle(sides, seed=0, apart=0.3):
    """Ways to one place that pass it on one side or the other, from places side by side."""
    rng = torch.Generator().manual_seed(seed)
    times, paths = [], []
    for side in sides:
        start = apart * side + 0.03 * torch.randn(2, generator=rng).double()
        wide = side * (0.4 + 0.05 * torch.randn(1, generator=rng).double())
        m = minimum_jerk(S)[:, None]
        path = (1 - m) * start + m * torch.tensor([1.0, 0.0])
        path[:, 1] += wide * (torch.pi * S).sin() ** 2
        times.append((2.0 + 0.5 * torch.rand(1, generator=rng).double() + (side < 0)) * S)
        paths.append(path)
    return torch.stack(times), torch.stack(paths)


@pytest.fixture(scope="module")
def shown():
    return JointDMP.fit(*around_an_obstacle([1, -1] * 4 + [1]), 15)


@pytest.fixture(scope="module")
def mixture(shown):
    return MixtureDMP.fit(shown)


def test_parts_the_demonstrations(mixture):
    assert len(mixture.modes) == 2
    first = mixture.responsibilities.argmax(-1)
    assert (first[::2] == first[0]).all()
    assert (first[1::2] == 1 - first[0]).all()
    assert mixture.probability[first[0]].item() == pytest.approx(5 / 9, abs=1e-6)
    # The ways of one side take a second longer.
    slow, fast = mixture.modes[1 - first[0]], mixture.modes[first[0]]
    assert slow.primitive.duration - fast.primitive.duration > 0.5


@pytest.mark.parametrize("seed", range(3))
def test_one_way_is_one_mode(seed):
    shown = JointDMP.fit(*around_an_obstacle([1] * 8, seed), 15)
    mixture = MixtureDMP.fit(shown)
    assert len(mixture.modes) == 1
    torch.testing.assert_close(
        mixture.mean_primitive().rollout(S).position, mean_primitive(shown).rollout(S).position
    )


def test_a_mode_is_the_mean_of_its_demonstrations(shown, mixture):
    first = mixture.responsibilities.argmax(-1)
    for k, mode in enumerate(mixture.modes):
        expected = mean_primitive(shown[first == k])
        torch.testing.assert_close(
            mode.mean, expected.coordinates().detach(), atol=1e-3, rtol=0
        )
        # Never through the obstacle, as the mean of all goes.
        lateral = mode.mean_primitive().rollout().position[:, 1].abs().max()
        assert lateral > 0.35
    assert mean_primitive(shown).rollout().position[:, 1].abs().max() < 0.2


def test_the_start_tells_which_way(shown, mixture):
    for i in (0, 1):
        context = torch.stack([shown.start[i], shown.goal[i]], -1).flatten()
        told = mixture.at(context)
        expected = mixture.responsibilities[i].argmax()
        assert told.probability.argmax() == expected
        assert told.probability.max() > 0.99
        assert told.most_likely is mixture.modes[expected]


def test_probabilities_given_a_context_are_bayes(shown):
    context = torch.tensor([[0.1], [-0.3], [0.2], [0.1], [0.3], [-0.2], [0.2], [0.0], [0.1]])
    mixture = MixtureDMP.fit(shown, context, 2)
    r, c = mixture.responsibilities, context.double()
    means = r.mT @ c / r.sum(0)[:, None]
    off = c[:, None] - means
    variance = (r[..., None] * off.square()).sum() / (9 - 2) + 0.01 * c.var(correction=0)
    for x in (-0.2, 0.05, 0.4):
        density = torch.distributions.Normal(means[:, 0], variance.sqrt()).log_prob(
            torch.tensor(x, dtype=torch.float64)
        )
        expected = torch.softmax(density + r.mean(0).log(), 0)
        torch.testing.assert_close(mixture.at([x]).probability, expected)


def density_of(mode, time, value, noise):
    """Written out: mean and covariance of all samples together."""
    rows = mode.primitive.response.evaluate(time / mode.primitive.duration.double())[:, 0]
    D, M = mode.mean.shape
    design = torch.zeros(len(time), D, D, M, dtype=torch.float64)
    for d in range(D):
        design[:, d, d] = rows
    design = design.view(len(time) * D, D * M)
    root = design @ mode.spread
    covariance = root @ root.mT + noise**2 * torch.eye(len(root), dtype=torch.float64)
    return MultivariateNormal(design @ mode.mean.flatten(), covariance).log_prob(
        value.flatten()
    )


def test_densities_and_what_was_seen_are_bayes(mixture):
    time = torch.tensor([0.3, 0.7], dtype=torch.float64)
    value = torch.tensor([[0.2, 0.1], [0.4, 0.2]], dtype=torch.float64)
    noise = 0.6
    each = torch.stack([density_of(mode, time, value, noise) for mode in mixture.modes])
    joint = each + mixture.probability.log()
    seen = mixture.condition(time, value, noise=noise)
    torch.testing.assert_close(seen.probability, joint.softmax(0))
    assert 1e-3 < seen.probability.min() < 0.5
    one = mixture.modes[0].condition(time, value, noise=noise)
    torch.testing.assert_close(seen.modes[0].mean, one.mean)


def test_orientations_have_modes():
    turn = torch.stack([0 * S, 0 * S, minimum_jerk(S)], -1)
    bend = torch.stack([(torch.pi * S).sin() ** 2, 0 * S, 0 * S], -1)
    ways = [turn + (side * 0.5 + 0.01 * k) * bend for k, side in enumerate([1, 1, -1, -1, 1])]
    shown = OrientationDMP.fit(2 * S, quaternion.exp(torch.stack(ways)), 12)
    mixture = MixtureDMP.fit(shown)
    assert len(mixture.modes) == 2
    tilted = mixture.condition([1.0], quaternion.exp(ways[2][40:41]), noise=0.05)
    motion = tilted.mean_primitive().rollout([1.0])
    assert quaternion.angle(motion.orientation, quaternion.exp(ways[2][40:41])) < 0.03


def test_held_out_ways_are_predicted():
    """As well as by the nearest demonstration in bad cases, as by the mean in usual ones."""
    errors = {"nearest": [], "mean": [], "mixture": []}
    for seed, sides in enumerate(([1, -1] * 4, [1] * 7, [1, 1, -1] * 3)):
        time, position = around_an_obstacle(sides, 10 + seed)
        every = JointDMP.fit(time, position, 15)
        for i in range(len(sides)):
            others = every[[j for j in range(len(sides)) if j != i]]
            start, goal = position[i, 0], position[i, -1]
            away = (others.start - start).norm(dim=-1) + (others.goal - goal).norm(dim=-1)
            told = MixtureDMP.fit(others).at(torch.stack([start, goal], -1).flatten())
            predictions = {
                "nearest": others[int(away.argmin())],
                "mean": mean_primitive(others),
                "mixture": told.mean_primitive(),
            }
            for name, dmp in predictions.items():
                path = dmp.with_boundary(start, goal).rollout(S * dmp.duration).position
                errors[name].append((path - position[i]).square().mean().sqrt().item())
    worst = {name: torch.tensor(values).quantile(0.9) for name, values in errors.items()}
    usual = {name: torch.tensor(values).median() for name, values in errors.items()}
    assert worst["mixture"] <= worst["nearest"]
    assert usual["mixture"] <= usual["mean"]


def test_refuses_with_a_sentence(shown, mixture):
    with pytest.raises(ValueError, match="9 primitives have 1 to 9 modes, not 10"):
        MixtureDMP.fit(shown, n_modes=10)
    with pytest.raises(ValueError, match="batch of at least 2"):
        MixtureDMP.fit(shown[0])
    with pytest.raises(ValueError, match="context must be"):
        mixture.at([math.pi])
    for context, fault in (
        (torch.zeros(3, 6), r"one row for each of 9 demonstrations, got \(3, 6\)"),
        (torch.zeros(8, 1), "one row for each of 9"),
        (torch.zeros(9, 0), "one row for each of 9"),
        (torch.full((9, 1), math.nan), "context must be finite"),
    ):
        with pytest.raises(ValueError, match=fault):
            MixtureDMP.fit(shown, context)


@pytest.mark.parametrize(
    ("deviations", "count"),
    [
        ((2.0, 0.5, 0.1), 1),
        ((1.0, 0.9, 0.3), 2),
        ((1.0, 0.9, 0.8, 0.2), 3),
        ((1.0, 0.9, 0.8, 0.7, 0.6), 3),
    ],
)
def test_principal_components_explain_nine_tenths_of_the_variance(deviations, count):
    """Coordinates in the directions of largest variance: eigenvectors of the covariance."""
    rng = np.random.default_rng(0)
    white = rng.normal(size=(40, len(deviations)))
    white = np.linalg.qr(white - white.mean(0))[0]
    directions = np.linalg.qr(rng.normal(size=(9, len(deviations))))[0]
    paths = white * deviations @ directions.T + rng.normal(size=9)
    found = principal_components(torch.from_numpy(paths)).numpy()
    assert found.shape == (40, count)
    expected = white[:, :count] * deviations[:count]
    np.testing.assert_allclose(np.abs(found), np.abs(expected), atol=1e-9)
    for a, b in zip(found.T, expected.T, strict=True):
        np.testing.assert_allclose(np.abs(a @ b), b @ b)


def test_equal_paths_have_no_components():
    z = principal_components(torch.ones(4, 6).double())
    assert (z == 0).all()


def clusters(counts, middles, spread, seed=0):
    rng = np.random.default_rng(seed)
    return torch.from_numpy(
        np.concatenate(
            [rng.normal(m, spread, (n, len(m))) for n, m in zip(counts, middles, strict=True)]
        )
    )


def log_density(z, r):
    """Log of weight times density of each mode, from responsibilities of the modes."""
    z, r = z.numpy(), r.numpy()
    weight, K = r.sum(0), r.shape[1]
    means = r.T @ z / weight[:, None]
    variance = sum(r[:, k] @ (z - means[k]) ** 2 for k in range(K)) / max(len(z) - K, 1)
    deviation = np.maximum(variance, (0.1 * z.std(0)) ** 2) ** 0.5
    densities = [norm.logpdf(z, mean, deviation).sum(1) for mean in means]
    return np.log(weight / len(z)) + np.stack(densities, 1)


OVERLAPPING = clusters((9, 5, 6), ((0.0, 0.0), (2.5, 0.5), (0.5, 3.0)), 0.8)
TIGHT = clusters((4, 3), ((0.0, 0.0), (1.0, 2.0)), 1e-3)


@pytest.mark.parametrize("K", [1, 2, 3])
@pytest.mark.parametrize("z", [OVERLAPPING, TIGHT], ids=["overlapping", "tight"])
def test_responsibilities_are_a_fixed_point_of_bayes_rule(z, K):
    r, log_likelihood = _expectation_maximisation(z, K)
    joint = log_density(z, r)
    total = logsumexp(joint, axis=1, keepdims=True)
    np.testing.assert_allclose(r, np.exp(joint - total), atol=1e-5)
    assert log_likelihood == pytest.approx(total.sum(), rel=1e-6, abs=1e-3)


def test_expectation_maximisation_starts_far_apart():
    """Three clusters on a line are found in any order of the samples."""
    middles = ((0.0,), (10.0,), (-30.0,))
    z = clusters((5, 4, 3), middles, 0.5)
    order = torch.from_numpy(np.random.default_rng(1).permutation(12))
    for samples in (z, z[order], z.flip(0)):
        r, _ = _expectation_maximisation(samples, 3)
        means = (r / r.sum(0)).mT @ samples
        assert means.flatten().sort().values.round(decimals=-1).tolist() == [-30, 0, 10]
        # The first is the farthest from the mean, the next the farthest from that.
        assert means.round(decimals=-1).flatten().tolist() == [-30, 10, 0]


def test_a_single_sample_a_mode_has_the_least_spread():
    """As many modes as samples: no degree of freedom is left."""
    z = torch.tensor([[0.0], [1.0], [5.0]]).double()
    r, log_likelihood = _expectation_maximisation(z, 3)
    np.testing.assert_allclose(r.sum(0), 1, atol=1e-4)
    deviation = 0.1 * z.std(correction=0).item()
    expected = 3 * (norm.logpdf(0, 0, deviation) - math.log(3))
    assert log_likelihood == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    ("counts", "apart", "expected"),
    [
        ((8,), 0.0, 1),
        ((6, 6), 1.0, 1),
        ((6, 6), 12.0, 2),
        ((5, 5, 5), 12.0, 3),
        ((3, 2), 40.0, 2),
        ((1, 1), 12.0, 1),
        ((1, 1, 1, 1), 50.0, 1),
    ],
)
def test_modes_are_as_few_as_the_evidence_allows(counts, apart, expected):
    """Without strong evidence, 10 of the Bayesian criterion, against the smaller number."""
    middles = [(apart * k, apart * k * (k - 1)) for k in range(len(counts))]
    z = clusters(counts, middles, 1.0)
    n, d = z.shape
    criteria = []
    for K in range(1, n // 2 + 1):
        r, _ = _expectation_maximisation(z, K)
        likelihood = logsumexp(log_density(z, r), axis=1).sum()
        free = (K - 1) + K * d + d
        criteria.append(free * math.log(n) - 2 * likelihood)
    within = np.array(criteria) <= min(criteria) + 10
    assert int(np.argmax(within)) + 1 == expected
    r = _responsibilities(z, None)
    assert r.shape == (n, expected)
    assert torch.equal(r, _expectation_maximisation(z, expected)[0])
    assert _responsibilities(z, n).shape == (n, n)


def test_contexts_of_two_numbers_have_one_covariance_within_the_modes(shown):
    """Its diagonal is at least 0.01 of the mean variance of the contexts."""
    rng = np.random.default_rng(2)
    for noise in (0.4, 1e-4):
        context = noise * rng.normal(size=(9, 2)) + np.array([[1, 3]] * 9)
        context[1::2] += (0.5, -1.0)
        mixture = MixtureDMP.fit(shown, context, 2)
        r = mixture.responsibilities.numpy()
        means = np.stack([np.average(context, axis=0, weights=w) for w in r.T])
        np.testing.assert_allclose(mixture.contexts, means)
        within = sum(
            np.einsum("n,ni,nj->ij", w, context - m, context - m)
            for w, m in zip(r.T, means, strict=True)
        ) / (9 - 2)
        floor = 0.01 * context.var(0).mean() * np.eye(2)
        np.testing.assert_allclose(mixture.precision, np.linalg.inv(within + floor), rtol=1e-6)
        np.testing.assert_allclose(mixture.probability, r.mean(0))


def test_as_many_modes_as_demonstrations_and_one_are_allowed(shown):
    for K in (1, 9):
        mixture = MixtureDMP.fit(shown, n_modes=K)
        assert len(mixture.modes) == len(mixture.contexts) == K
    pair = MixtureDMP.fit(shown[:2])
    assert len(pair.modes) == 1
    with pytest.raises(ValueError, match="9 primitives have 1 to 9 modes, not 0"):
        MixtureDMP.fit(shown, n_modes=0)


def test_values_are_nearly_exact_unless_noise_is_given(mixture):
    time, value = [0.3, 0.5], torch.tensor([[0.2, 0.1], [0.4, 0.2]]).double()
    rate = torch.tensor([[0.4, -0.1], [0.3, 0.0]]).double()
    found = mixture.condition(time, value, rate)
    densities = [mode.log_prob(time, value, noise=1e-6) for mode in mixture.modes]
    joint = torch.stack(densities) + mixture.probability.log()
    torch.testing.assert_close(found.probability, joint.softmax(0), rtol=0, atol=0)
    for mode, before in zip(found.modes, mixture.modes, strict=True):
        expected = before.condition(time, value, rate, noise=1e-6)
        torch.testing.assert_close(mode.mean, expected.mean, rtol=0, atol=0)


def test_parallel_ways_are_apart_by_their_positions():
    """Their velocities are the same."""
    offset = torch.tensor([1.0, 1.1, 0.9, -1.0, -1.1, -0.9]).double()
    ways = minimum_jerk(S)[:, None] + offset[:, None, None]
    mixture = MixtureDMP.fit(JointDMP.fit(2 * S, ways, 10))
    assert mixture.probability.tolist() == pytest.approx([0.5, 0.5])
    assert mixture.responsibilities[:3].argmax(1).unique().numel() == 1


def test_slack_is_that_of_each_mode(shown):
    tight, loose = (MixtureDMP.fit(shown, slack=slack) for slack in (0.0, 0.5))
    for a, b in zip(tight.modes, loose.modes, strict=True):
        assert (b.position([0.7])[1] > a.position([0.7])[1]).all()
