"""Motions out of noisy recordings: how rough, how close, and where nothing is to be done."""

import numpy as np
import pytest
import torch
from demo_motions import arm_motion
from scipy.interpolate import CubicHermiteSpline

from hrc_learn.dmp import GaussianBasis, JointDMP


def recorded(n_samples, noise, seed):
    """A reach of seven joints with some shape of its own; and the same on a fine grid."""
    rng = np.random.default_rng(seed)
    way, bend, knock = rng.standard_normal((3, 7))

    def motion(s):
        s = s[:, None]
        window = (4 * s * (1 - s)) ** 2
        y = way * s**3 * (10 - 15 * s + 6 * s**2)
        return y + window * (0.3 * bend * np.sin(2 * np.pi * s) + 0.1 * knock * np.sin(15 * s))

    s, fine = np.linspace(0, 1, n_samples), np.linspace(0, 1, 2001)
    samples = motion(s) + noise * rng.standard_normal((n_samples, 7))
    return s, samples, fine, motion(fine)


def judged(dmp, fine, truth, duration):
    motion = dmp.rollout(fine * duration).numpy()
    dt = duration * (fine[1] - fine[0])
    peak = np.abs(np.diff(truth, n=2, axis=0)).max() / dt**2
    return np.abs(motion["acceleration"]).max() / peak, np.sqrt(
        ((motion["position"] - truth) ** 2).mean()
    )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("fps", "duration", "noise"), [(30, 3.0, 2e-3), (30, 6.0, 2e-3), (100, 4.0, 5e-3)]
)
def test_noise_is_left_out(fps, duration, noise, seed):
    s, samples, fine, truth = recorded(int(fps * duration) + 1, noise, seed)
    chosen = JointDMP.fit(s * duration, samples)
    rough, error = judged(chosen, fine, truth, duration)
    assert rough < 1.5
    for count in (10, 20, 50):
        fixed = JointDMP.fit(s * duration, samples, count)
        assert error < judged(fixed, fine, truth, duration)[1]
    assert chosen.fit_report.noise.numpy() == pytest.approx(noise, rel=0.35)
    assert chosen.fit_report.rmse.numpy() == pytest.approx(noise, rel=0.35)


def test_without_noise_nothing_changes():
    time, position = arm_motion(200, n_joints=3)
    chosen, fixed = JointDMP.fit(time, position), JointDMP.fit(time, position, 50)
    torch.testing.assert_close(chosen.weights, fixed.weights, rtol=0, atol=0)
    torch.testing.assert_close(chosen.start, position[0], rtol=0, atol=0)


def test_each_column_and_demonstration_by_itself():
    """Alike whether alone, in a batch on one grid, or padded; a joint at rest stays at rest."""
    s, samples, *_ = recorded(91, 2e-3, 0)
    samples[:, 3] = 0.7
    other = recorded(91, 2e-3, 1)[1]
    alone = JointDMP.fit(3 * s, samples)
    np.testing.assert_allclose(alone.rollout().numpy()["position"][:, 3], 0.7, atol=1e-12)
    both = JointDMP.fit(3 * s, np.stack([samples, other]))
    ragged = JointDMP.fit([3 * s, 3 * s[:70]], [samples, other[:70]])
    for batch in (both, ragged):
        np.testing.assert_allclose(
            batch[0].rollout().numpy()["position"][:91],
            alone.rollout().numpy()["position"],
            atol=1e-8,
        )


def test_encoder_steps_are_noise_too():
    s, _, fine, truth = recorded(121, 0.0, 2)
    step = 5e-3
    samples = step * np.round(recorded(121, 0.0, 2)[1] / step)
    rough, error = judged(JointDMP.fit(4 * s, samples), fine, truth, 4.0)
    assert rough < 1.5
    assert error < step / np.sqrt(12)


@pytest.mark.parametrize("count", [3, 4, 5, 8, 20, 60])
@pytest.mark.parametrize("n_basis", [None, 60])
@pytest.mark.parametrize("velocity", [False, True])
def test_few_samples_leave_the_motion_between_them_smooth(count, n_basis, velocity):
    t, fine = (torch.linspace(0, 2, n, dtype=torch.float64) for n in (count, 1001))
    y, rate = t**2 - t, (2 * t - 1 if velocity else None)
    dmp = JointDMP.fit(t, y, n_basis, velocity=rate)
    made = dmp.rollout(fine)
    truth = (fine**2 - fine)[:, None]
    assert (made.position - truth).abs().max() < 2e-3
    # At its very end a motion that has not come to rest brakes, with any number of samples.
    inner = (fine > 0.4) & (fine < 1.6)
    assert (made.acceleration[inner] - 2).abs().max() < 0.15


@pytest.mark.parametrize("count", [3, 5, 9])
def test_few_samples_are_joined_by_cubics_with_slopes_of_second_order(count):
    s = np.sort(np.random.default_rng(0).uniform(0.05, 0.95, count))
    s[[0, -1]] = 0, 1
    y = np.cos(5 * s)
    fine = np.linspace(0, 1, 101)
    made = JointDMP.fit(s, y, smooth=False).rollout(fine).numpy()["position"][:, 0]
    joined = CubicHermiteSpline(s, y, np.gradient(y, s, edge_order=2))(fine)
    np.testing.assert_allclose(made, joined, atol=2e-3)


@pytest.mark.parametrize(
    ("given", "removed"),
    [
        ({}, True),
        ({"n_basis": 30}, False),
        ({"basis": GaussianBasis(count=30)}, False),
        ({"n_basis": 30, "smooth": True}, True),
        ({"smooth": False}, False),
    ],
)
def test_noise_is_removed_unless_basis_functions_are_chosen(given, removed):
    s, samples, *_ = recorded(80, 0.01, 0)
    report = JointDMP.fit(s, samples, **given).fit_report
    assert (report.noise is not None) == removed
    if removed:
        np.testing.assert_allclose(report.noise, 0.01, rtol=0.4)


def test_the_shortest_admissible_duration():
    time, position = arm_motion(150, n_joints=3)
    dmp = JointDMP.fit(time, position, 30)
    for limits in ({"velocity": [0.3, 0.5, 2.0]}, {"acceleration": 0.8}):
        tau = dmp.admissible_duration(**limits)
        (name, limit), fine = next(iter(limits.items())), np.linspace(0, 1, 3001)
        made = np.abs(dmp.rollout(fine * tau.item(), duration=tau).numpy()[name]).max(0)
        assert (made / np.asarray(limit)).max() == pytest.approx(1.0, abs=2e-3)


def test_durations_of_a_batch_keep_both_limits_towards_another_goal():
    time, position = arm_motion(150, n_joints=2)
    dmp = JointDMP.fit(time, torch.stack([position, 0.2 * position]), 30)
    goal, velocity, acceleration = dmp.goal + 0.4, [0.3, 0.5], [0.6, 2.0]
    tau = dmp.admissible_duration(velocity, acceleration, goal=goal)
    fine = torch.linspace(0, 1, 2001, dtype=torch.float64)
    made = dmp.rollout(fine * dmp.duration[:, None], goal=goal)
    for k in range(2):
        v, a = (x[k].detach().abs().amax(0).numpy() for x in (made.velocity, made.acceleration))
        factor = max((v / velocity).max(), np.sqrt((a / acceleration).max()))
        assert tau[k].item() == pytest.approx(factor * dmp.duration[k].item(), rel=2e-3)
    with pytest.raises(ValueError, match="velocity must be positive"):
        dmp.admissible_duration(velocity=0.0)
    with pytest.raises(ValueError, match=r"acceleration must have shape \(\.\.\., 2\), got"):
        dmp.admissible_duration(acceleration=[1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="give velocity or acceleration, or both"):
        dmp.admissible_duration(goal=goal)
