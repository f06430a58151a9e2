"""Fits that do not follow samples that lie far off."""

import pytest
import torch
from demo_motions import arm_motion, turning_motion

from hrc_learn.dmp import GaussianBasis, JointDMP, OrientationDMP, SpringDamper, response_of
from hrc_learn.dmp.fitting.noise import without_outliers
from hrc_learn.dmp.fitting.samples import check_samples
from hrc_learn.geometry import quaternion


def spiked(position, share=0.05, size=0.5, seed=0):
    """Positions with some samples of each coordinate thrown off, and which."""
    rng = torch.Generator().manual_seed(seed)
    hit = torch.rand(position.shape, generator=rng) < share
    noise = torch.randn(position.shape, generator=rng, dtype=position.dtype)
    return position + size * hit * noise, hit


def rms(error):
    return error.square().mean().sqrt().item()


@pytest.mark.parametrize("robust", ["huber", "tukey"])
@pytest.mark.parametrize("method", ["trajectory", "ridge", "lwr"])
def test_spikes_are_not_followed(method, robust):
    time, clean = arm_motion(moving_start=True)
    position, _ = spiked(clean)
    clear, plain, tamed = (
        rms(JointDMP.fit(time, y, 50, method=method, **options).rollout().position - clean)
        for y, options in ((clean, {}), (position, {}), (position, {"robust": robust}))
    )
    assert plain > 0.03
    assert tamed < clear + 1e-4


@pytest.mark.parametrize("robust", ["huber", "tukey"])
def test_noise_and_spikes_give_what_noise_alone_gives(robust):
    time, clean = arm_motion(moving_start=True)
    rng = torch.Generator().manual_seed(3)
    noisy = clean + 1e-3 * torch.randn(clean.shape, generator=rng, dtype=clean.dtype)
    position, _ = spiked(noisy)
    alone = rms(JointDMP.fit(time, noisy, 20).rollout().position - clean)
    tamed = rms(JointDMP.fit(time, position, 20, robust=robust).rollout().position - clean)
    assert tamed < 1.5 * alone


def test_ends_may_be_hit_too():
    time, clean = arm_motion(moving_start=True)
    position = clean.clone()
    position[0, 0] += 0.5
    position[-1, 1] -= 0.5
    dmp = JointDMP.fit(time, position, robust="huber")
    torch.testing.assert_close(dmp.start, clean[0], rtol=0, atol=1e-3)
    torch.testing.assert_close(dmp.goal, clean[-1], rtol=0, atol=1e-3)
    assert rms(dmp.rollout().position - clean) < 1e-3


def test_samples_are_taken_back_as_far_as_they_are_not_trusted():
    """All the way where there is no trust, not at all where it is whole."""
    time, clean = arm_motion(moving_start=True)
    position, hit = spiked(clean)
    samples = check_samples(time, position)
    response = response_of(SpringDamper(), GaussianBasis(count=20))
    for loss in ("huber", "tukey"):
        tamed, trust = without_outliers(loss, response, samples, 1e-7)
        whole = trust == 1
        assert whole.any() == (loss == "huber")
        torch.testing.assert_close(tamed.position[whole], samples.position[whole])
        none = trust == 0
        assert none.any() == (loss == "tukey")
        # Between its recorded and its fitted place, which is near the clean one.
        back = (tamed.position - samples.position)[0].mT
        wanted = (1 - trust[0].mT) * (clean - position)
        assert (back - wanted)[hit].abs().max() < 0.05 * back[hit].abs().max()


def test_the_report_says_which_samples_were_not_trusted():
    time, clean = arm_motion()
    position, hit = spiked(clean)
    report = JointDMP.fit(time, position, robust="tukey").fit_report
    assert report.trust.shape == position.shape
    far = (position - clean).abs() > 0.01
    assert report.trust[far].max() < 1e-3
    assert report.trust[~hit].median() > 0.7
    assert report.rmse.max() < 1e-4
    torch.testing.assert_close(report.span, clean.amax(0) - clean.amin(0), rtol=0, atol=1e-3)


def test_a_robust_fit_is_the_weighted_least_squares_fit_of_its_trust():
    """Against a solver that minimises the sum of Huber's function of the residuals."""
    time, clean = arm_motion(n_samples=120, n_joints=1)
    rng = torch.Generator().manual_seed(1)
    noisy = clean + 0.01 * torch.randn(clean.shape, generator=rng, dtype=clean.dtype)
    position, _ = spiked(noisy)
    dmp = JointDMP.fit(time, position, 10, robust="huber")
    residual = (position - dmp.rollout().position.detach())[:, 0]
    spread = 1.4826 * residual.abs().median()
    H = dmp.response.evaluate(dmp.timestamps)[:, 0]
    # At the minimum no weight, no start velocity can lower it: its gradient is zero.
    influence = residual.clamp(-1.345 * spread, 1.345 * spread)
    gradient = H[:, :11].mT @ influence
    scale = H[:, :11].abs().mT @ influence.abs()
    assert (gradient.abs() / scale).max() < 0.02


def test_masked_and_batched_demonstrations_fit_as_if_alone():
    demos = [arm_motion(n, duration=n / 100, n_joints=2, seed=n) for n in (200, 150)]
    time = torch.full((2, 200), torch.nan, dtype=torch.float64)
    position = torch.full((2, 200, 2), torch.nan, dtype=torch.float64)
    mask = torch.zeros(2, 200, dtype=torch.bool)
    for i, (t, y) in enumerate(demos):
        time[i, : len(t)], position[i, : len(t)], mask[i, : len(t)] = t, spiked(y)[0], True
    dmp = JointDMP.fit(time, position, 20, mask=mask, robust="huber")
    for i, (t, y) in enumerate(demos):
        alone = JointDMP.fit(t, spiked(y)[0], 20, robust="huber")
        torch.testing.assert_close(dmp.weights[i], alone.weights)
        torch.testing.assert_close(dmp.fit_report.trust[i, : len(t)], alone.fit_report.trust)
    shared = torch.stack([spiked(demos[0][1], seed=seed)[0] for seed in (0, 1)])
    both = JointDMP.fit(demos[0][0], shared, 20, robust="huber")
    alone = JointDMP.fit(demos[0][0], shared[1], 20, robust="huber")
    torch.testing.assert_close(both.weights[1], alone.weights)


@pytest.mark.parametrize("formulation", ["log", "ude"])
def test_orientations_too(formulation):
    time, clean = turning_motion(n_samples=200)
    orientation = clean.clone()
    spike = quaternion.exp(torch.tensor([0.4, 0.0, -0.2], dtype=torch.float64))
    orientation[40:180:20] = quaternion.multiply(spike, orientation[40:180:20])
    options = {"n_basis": 20, "robust": "tukey", "formulation": formulation}
    dmp = OrientationDMP.fit(time, orientation, **options)
    assert quaternion.angle(dmp.rollout().orientation, clean).max() < 5e-3


def test_trust_is_saved(tmp_path):
    time, clean = arm_motion(n_samples=60, n_joints=2)
    dmp = JointDMP.fit(time, spiked(clean)[0], 10, robust="huber")
    dmp.save(tmp_path / "saved")
    loaded = JointDMP.load(tmp_path / "saved")
    torch.testing.assert_close(loaded.fit_report.trust, dmp.fit_report.trust)


def test_a_loss_that_there_is_not_is_refused():
    with pytest.raises(ValueError, match="choose from huber, tukey"):
        JointDMP.fit(*arm_motion(n_samples=30), 5, robust="cauchy")
