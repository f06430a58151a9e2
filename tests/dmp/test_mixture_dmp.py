"""Demonstrations of several ways: parted, told by context or values, and not mixed up."""

import math

import pytest
import torch
from demo_motions import minimum_jerk
from torch.distributions import MultivariateNormal

from hrc_learn.dmp import JointDMP, MixtureDMP, OrientationDMP, mean_primitive
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
