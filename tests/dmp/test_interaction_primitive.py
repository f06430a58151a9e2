"""What a person is about, and what the robot does then."""

import math

import numpy as np
import pytest
import torch
from demo_motions import minimum_jerk
from torch.distributions import MultivariateNormal

from hrc_learn.dmp import InteractionPrimitive


def handover(place, side, duration, n=80):
    """A hand that goes to one side and a robot that meets it there, from another place."""
    s = torch.linspace(0, 1, n, dtype=torch.float64)
    m = minimum_jerk(s)
    # The way bends towards the place from its beginning: it gives away where it leads.
    hand = torch.stack([m * place + 0.1 * (torch.pi * s).sin() * place, side * m], -1)
    met = minimum_jerk(((s - 0.2) / 0.8).clamp(min=0))
    robot = torch.stack([1.0 + met * (place - 1.0), -0.5 + met * (side + 0.5)], -1)
    return duration * s, hand, robot


@pytest.fixture(scope="module")
def model():
    rng = torch.Generator().manual_seed(0)
    shown, kinds = [], []
    for side, name in ((1.0, "left"), (-1.0, "right")):
        for _ in range(12):
            place, stretch = torch.rand(2, generator=rng).tolist()
            shown.append(handover(0.3 + 0.4 * place, side, 1.6 + 0.8 * stretch))
            kinds.append(name)
    return InteractionPrimitive.fit(*(list(x) for x in zip(*shown, strict=True)), kinds)


NOISE = 2e-3


def seen(time, hand, share, seed=0):
    n = int(share * len(time))
    rng = torch.Generator().manual_seed(seed)
    return time[:n], hand[:n] + NOISE * torch.randn(n, 2, generator=rng, dtype=torch.float64)


@pytest.mark.parametrize(("side", "kind"), [(1.0, "left"), (-1.0, "right")])
@pytest.mark.parametrize("duration", [1.7, 2.2])
def test_tells_intent_duration_and_meeting_place(model, side, kind, duration):
    time, hand, robot = handover(0.42, side, duration)
    estimate = model.observe(*seen(time, hand, 0.5), NOISE)
    assert estimate.kind == kind
    assert estimate.probability.max() > 0.99
    assert estimate.duration == pytest.approx(duration, rel=0.05)
    assert estimate.phase == pytest.approx(0.5, abs=0.04)
    mean, deviation = estimate.robot(time[-1:])
    # Of the places that were shown the farthest is 0.2 m off their middle.
    assert (mean[0] - robot[-1]).norm() < 0.03
    assert (estimate.person(time[-1:])[0] - hand[-1]).norm() < 0.03
    assert (deviation < 0.1).all()


def test_the_more_is_seen_the_surer(model):
    time, hand, robot = handover(0.6, 1.0, 1.9)
    errors, spreads = [], []
    for share in (0.1, 0.4, 0.8):
        estimate = model.observe(*seen(time, hand, share), NOISE)
        mean, deviation = estimate.robot(time[-1:])
        errors.append((mean[0] - robot[-1]).norm().item())
        spreads.append(deviation.norm().item())
    assert spreads[0] > spreads[1] > spreads[2]
    assert errors[2] < errors[0]
    firm = estimate.stiffness(time[-1:], 500.0, 0.01)
    expected = 500 * 1e-4 / (1e-4 + estimate.robot(time[-1:])[1] ** 2)
    torch.testing.assert_close(firm, expected)


def test_probabilities_are_those_of_gaussians(model):
    """Against densities of the samples written out, over all kinds and durations."""
    time, hand, _ = handover(0.5, 1.0, 2.0)
    time, values = time[2:14:3], hand[2:14:3].clone()
    values[1, 0] = math.nan
    known = ~values.isnan().flatten()
    # Much noise, so that several kinds and durations are likely.
    noise = 0.3
    score, logarithm = torch.empty(2, 2, 31, dtype=torch.float64)
    for k, gaussian in enumerate(model.models):
        middle, spread = model.log_duration[k]
        for j, step in enumerate(torch.linspace(-3, 3, 31, dtype=torch.float64)):
            logarithm[k, j] = middle + spread * step
            tau = logarithm[k, j].exp()
            rows = gaussian.primitive.response.evaluate(time / tau)[:, 0]
            design = torch.zeros(len(time), 2, *gaussian.mean.shape, dtype=torch.float64)
            for column in range(2):
                design[:, column, column] = rows
            design = design.flatten(2).flatten(0, 1)[known]
            covariance = design @ gaussian.spread @ (design @ gaussian.spread).mT
            density = MultivariateNormal(
                design @ gaussian.mean.flatten(),
                covariance + noise**2 * torch.eye(int(known.sum()), dtype=torch.float64),
            )
            score[k, j] = density.log_prob(values.flatten()[known]) - step**2 / 2
    posterior = (score + model.prior.log()[:, None]).flatten().softmax(0).view(2, 31)
    estimate = model.observe(time, values, noise)
    torch.testing.assert_close(estimate.probability, posterior.sum(-1))
    assert 0.01 < estimate.probability.min() < 0.5
    # Of the likeliest kind, the mean of the logarithm.
    likely = int(posterior.sum(-1).argmax())
    within = posterior[likely] / posterior[likely].sum()
    expected = (within * logarithm[likely]).sum().exp()
    assert estimate.duration == pytest.approx(expected.item())
    assert estimate.phase == pytest.approx(float(time[-1] / expected))
    assert model.observe(time + 9.0, values, noise).phase == 1.0
    backwards = model.observe(time.flip(0), values.flip(0), noise)
    assert backwards.phase == pytest.approx(estimate.phase)
    assert backwards.duration == pytest.approx(estimate.duration)


def test_kinds_have_the_fractions_and_durations_of_their_demonstrations():
    """Durations vary by a twentieth at least; without names there is one kind."""
    durations = [2.0, 2.0, 2.4, 1.5, 3.0]
    shown = [handover(0.4 + 0.01 * k, 1.0, tau, 60) for k, tau in enumerate(durations)]
    given = [list(x) for x in zip(*shown, strict=True)]
    named = InteractionPrimitive.fit(*given, ["b", "b", "a", "a", "a"])
    assert named.kinds == ("b", "a")
    torch.testing.assert_close(named.prior, torch.tensor([0.4, 0.6], dtype=torch.float64))
    for found, own in zip(named.log_duration, (durations[:2], durations[2:]), strict=True):
        logarithm = np.log(own)
        expected = [logarithm.mean(), max(logarithm.std(ddof=1), 0.05)]
        np.testing.assert_allclose(found, expected)
    assert all(one.primitive.basis.count == 15 for one in named.models)
    one = InteractionPrimitive.fit(*given)
    assert (one.kinds, one.prior.tolist()) == (("interaction",), [1.0])
    assert one.observed == 2


def test_refuses_with_a_sentence(model):
    time, hand, robot = handover(0.5, 1.0, 2.0)
    both = torch.stack([hand, hand]), torch.stack([robot, robot])
    with pytest.raises(ValueError, match="kind 'a' has one"):
        InteractionPrimitive.fit(time, *both, ["a", "b"])
    with pytest.raises(ValueError, match="3 kinds for 2"):
        InteractionPrimitive.fit(time, *both, ["a", "b", "b"])
    with pytest.raises(ValueError, match="must be \\(B, T, columns\\)"):
        InteractionPrimitive.fit(time, hand, robot)
    with pytest.raises(ValueError, match="must be \\(B, T, columns\\)"):
        InteractionPrimitive.fit(time, both[0], robot[None].repeat(3, 1, 1))
    with pytest.raises(ValueError, match="must be \\(n,\\) and"):
        model.observe(time[:3], hand[:4], 0.1)
    with pytest.raises(ValueError, match="no value of the person"):
        model.observe(time[:3], hand[:3] * math.nan, 0.1)
    with pytest.raises(ValueError, match="person must be finite, but contains inf"):
        model.observe(time[:3], hand[:3].masked_fill(hand[:3] == hand[1, 0], math.inf), 0.1)
    with pytest.raises(ValueError, match="finite, non-negative seconds"):
        model.observe(time[:3] * math.nan, hand[:3], 0.1)
    with pytest.raises(ValueError, match="noise must be positive"):
        model.observe(time[:3], hand[:3], 0.0)
