"""Distributions over paths and durations, against PyTorch's own Gaussians and samples."""

import math

import pytest
import torch
from demo_motions import minimum_jerk, turning_motion
from torch.distributions import MultivariateNormal, kl_divergence

from hrc_learn.dmp import JointDMP, MotionHead, OrientationDMP, ProbabilisticDMP

S = torch.linspace(0, 1, 60, dtype=torch.float64)


def demonstrations(n=6, seed=0):
    """Slow motions bend far: path and duration depend on each other."""
    rng = torch.Generator().manual_seed(seed)
    slow = torch.randn(n, generator=rng).double()
    ends = torch.randn(n, 2, 2, generator=rng).double()
    way = ends[:, :1] + (ends[:, 1:] - ends[:, :1]) * minimum_jerk(S)[:, None]
    bump = (torch.sin(torch.pi * S) ** 2)[:, None] * slow[:, None, None]
    return 2 * torch.exp(0.3 * slow), way + bump


def fitted(n=6, **options):
    tau, way = demonstrations(n)
    return ProbabilisticDMP.fit(JointDMP.fit(tau[:, None] * S, way, 12), **options)


def test_sampled_durations_vary_as_the_demonstrated_ones():
    tau, _ = demonstrations()
    motion = fitted()
    assert motion.primitive.duration.log().item() == pytest.approx(tau.log().mean().item())
    sampled = motion.sample(4000, torch.Generator().manual_seed(1)).duration.log()
    assert sampled.mean().item() == pytest.approx(tau.log().mean().item(), abs=0.03)
    assert sampled.std().item() == pytest.approx(tau.log().std().item(), rel=0.05)
    one = ProbabilisticDMP.fit(JointDMP.fit(2 * S, demonstrations()[1], 12))
    assert (one.sample(5).duration == 2).all()


def test_a_known_duration_determines_what_depends_on_it():
    tau, way = demonstrations()
    slow = fitted().condition([], duration=tau[0].item())
    assert slow.primitive.duration.item() == pytest.approx(tau[0].item(), rel=1e-6)
    assert slow.sample(50).duration.std() < 1e-5
    # The regression of the path on the logarithm of the duration, by least squares.
    z = tau.log() - tau.log().mean()
    slope = torch.einsum("n,ntd->td", z, way - way.mean(0)) / z.square().sum()
    shown = slow.position(tau[0] * S)[0]
    expected = way.mean(0) + z[0] * slope
    assert (shown - expected).abs().max() < 5e-3 * way.abs().max()
    by_path = fitted().condition(fitted().primitive.duration * S[20:40:5], way[0, 20:40:5])
    nearer = (by_path.primitive.duration / tau[0]).log().abs()
    assert nearer < 0.5 * (fitted().primitive.duration / tau[0]).log().abs()


def test_entropy_divergence_and_density_are_those_of_dense_gaussians():
    one, other = fitted(), fitted().condition([], duration=2.5)
    dense = []
    for motion in (one, other):
        tau = motion.primitive.duration.double()
        time = torch.linspace(0, 1, 30).double() * tau
        rows = motion.primitive.response.evaluate(time / tau)[:, 0]
        root = torch.einsum("tm,dmr->tdr", rows, motion.spread.view(*motion.mean.shape, -1))
        root = torch.cat([root.flatten(0, 1), motion.timing[None]])
        mean = torch.cat([(rows @ motion.mean.mT).reshape(-1), tau.log().reshape(1)])
        dense.append(MultivariateNormal(mean, root @ root.mT + 1e-2 * torch.eye(61)))
    assert one.entropy(0.1).item() == pytest.approx(dense[0].entropy().item(), rel=1e-7)
    divergence = kl_divergence(*dense).item()
    assert one.kl(other, 0.1).item() == pytest.approx(divergence, rel=1e-6)
    assert one.kl(one, 0.1).abs() < 1e-6
    y = demonstrations()[1][:, ::10]
    time = one.primitive.duration * S[::10]
    alone = torch.stack([one.log_prob(time, way, noise=0.1) for way in y])
    torch.testing.assert_close(one.log_prob(time, y, noise=0.1), alone)


@torch.no_grad()
def test_given_start_and_goal_it_does_not_lose_to_the_mean():
    """Paths that depend on nothing: a regression on start and goal would follow chance."""
    rng = torch.Generator().manual_seed(4)
    ends = torch.randn(9, 2, 2, generator=rng).double()
    way = ends[:, :1] + (ends[:, 1:] - ends[:, :1]) * minimum_jerk(S)[:, None]
    bump = (torch.sin(torch.pi * S) ** 2)[:, None]
    way = way + bump * torch.randn(9, 1, 2, generator=rng).double()
    each = JointDMP.fit(S, way, 12)
    errors = []
    for i in range(9):
        rest = torch.arange(9) != i
        motion = ProbabilisticDMP.fit(each[rest])
        at_ends = motion.at(way[i, 0], way[i, -1])
        pair = at_ends.mean_primitive(), motion.mean_primitive()
        sampled = at_ends.sample(3, rng).rollout(time=[0.0, 1.0]).position
        torch.testing.assert_close(sampled, way[i, [0, -1]].expand(3, 2, 2), rtol=0, atol=2e-3)
        errors.append(
            [
                (d.rollout(S, way[i, 0], way[i, -1]).position - way[i]).square().mean()
                for d in pair
            ]
        )
    conditioned, mean = torch.tensor(errors).mean(0).sqrt()
    assert conditioned < 1.1 * mean


def test_a_path_that_follows_its_ends_does_so_given_start_and_goal():
    rng = torch.Generator().manual_seed(4)
    ends = torch.randn(9, 2, 1, generator=rng).double()
    bump = (torch.sin(torch.pi * S) ** 2)[:, None]
    way = ends[:, :1] + (ends[:, 1:] - ends[:, :1]) * (minimum_jerk(S)[:, None] + bump)
    motion = ProbabilisticDMP.fit(JointDMP.fit(S, way[:8], 12))
    made = motion.at(way[8, 0], way[8, -1]).mean_primitive().rollout(S).position
    assert (made - way[8]).abs().max() < 1e-2 * way[8].abs().max()


@pytest.mark.parametrize("kind", ["joint", "orientation"])
def test_a_saved_distribution_is_the_same(kind, tmp_path):
    if kind == "joint":
        motion = fitted()
    else:
        time, turned = turning_motion()
        batch = torch.stack([turned, turned.roll(1, 0), turned.flip(0)])
        motion = ProbabilisticDMP.fit(OrientationDMP.fit(time, batch, 10))
    motion.save(tmp_path / "model")
    loaded = ProbabilisticDMP.load(tmp_path / "model")
    for name in ("mean", "spread", "timing"):
        assert torch.equal(getattr(loaded, name), getattr(motion, name))
    a, b = (m.rollout(speed=1.5) for m in (motion, loaded))
    name = "position" if kind == "joint" else "orientation"
    torch.testing.assert_close(getattr(a, name), getattr(b, name))
    state = loaded.step(loaded.initial_state(), 0.1)
    assert state is not None
    assert loaded.to("cpu").mean.device.type == "cpu"


@pytest.mark.parametrize("noise", [0.0, -1.0, math.inf, math.nan])
def test_noise_that_is_none_is_refused(noise):
    motion = fitted()
    for use in (
        lambda: motion.condition([1.0], [[0.0, 0.0]], noise=noise),
        lambda: motion.log_prob([1.0], [[0.0, 0.0]], noise=noise),
        lambda: motion.entropy(noise),
    ):
        with pytest.raises(ValueError, match="noise must be positive and finite"):
            use()


def test_infinite_via_points_are_refused():
    motion = fitted()
    for use in (motion.condition, motion.mean_primitive().condition):
        with pytest.raises(ValueError, match="value must be finite, or NaN"):
            use([1.0], [[math.inf, 0.0]])


def test_a_heads_divergence_sees_start_and_timing():
    head = MotionHead(2, 4, duration=(1.0, 3.0)).double()
    z = torch.zeros(head.n_parameters).double()
    later = z.clone()
    later[-1] = 1.0
    factor = 0.1 * torch.eye(head.n_linear).double()
    start, other = torch.zeros(2).double(), torch.ones(2).double()
    one = head.distribution(z, factor, start)
    for another in (
        head.distribution(later, factor, start),
        head.distribution(z, factor, other),
    ):
        time = torch.linspace(0, 2, 10).double()
        assert one.kl(another, time, 0.1) > 0.1
    assert one.kl(one, time, 0.1).abs() < 1e-6
