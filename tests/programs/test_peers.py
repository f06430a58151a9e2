"""Task-parameterized mixtures and kernelized primitives of the benchmark of peers."""

import bench_peers
import numpy as np
import pytest
from bench_peers import Measured, predict, predict_set, resamples, spread, tuned
from motion_peers import Peer
from prepare_recordings import resampled
from scipy.stats import multivariate_normal
from task_mixtures import KernelPrimitive, TaskMixture


def walks(n=4, T=60, seed=0):
    """Time and position (n T, 1, 3) of curves in a plane, with noise."""
    rng = np.random.default_rng(seed)
    t = np.tile(np.linspace(0, 1, T), n)
    path = np.stack([t**2, np.sin(4 * t)], axis=1) + 0.05 * rng.standard_normal((n * T, 2))
    return np.concatenate([t[:, None], path], axis=1)[:, None]


def test_one_component_in_one_frame_is_linear_regression():
    samples = walks()
    t, x = samples[:, 0, 0], samples[:, 0, 1:]
    at = np.linspace(-0.2, 1.3, 7)
    mean, covariance = TaskMixture.fit(samples, 1, 0.0).regress(at)
    line = np.polyfit(t, x, 1)
    np.testing.assert_allclose(mean, at[:, None] * line[0] + line[1], atol=1e-12)
    left = x - t[:, None] * line[0] - line[1]
    np.testing.assert_allclose(covariance, np.broadcast_to(left.T @ left / len(x), (7, 2, 2)))


def test_frames_are_fused_by_their_precision():
    """One component: the product of the two densities, found on a grid of positions."""
    rng = np.random.default_rng(1)
    t = np.tile(np.linspace(0, 1, 40), 3)
    first = t + 0.1 * rng.standard_normal(len(t))
    second = t**2 - 1 + 0.3 * rng.standard_normal(len(t))
    samples = np.stack([np.stack([t, first], 1), np.stack([t, second], 1)], axis=1)
    origins = np.array([[0.4], [1.5]])
    mixture = TaskMixture.fit(samples, 1, 1e-4)
    x = np.linspace(-3, 4, 20001)
    for at in (0.0, 0.35, 1.0):
        density = np.ones_like(x)
        for p in range(2):
            mean = mixture.mean[0, p] + [0, origins[p, 0]]
            joint = multivariate_normal(mean, mixture.covariance[0, p])
            density = density * joint.pdf(np.stack([np.full_like(x, at), x], 1))
        expected = (density * x).sum() / density.sum()
        assert mixture.at(origins).regress(np.array([at]))[0].item() == pytest.approx(expected)


def test_a_mixture_moves_with_its_frames():
    samples = np.repeat(walks(), 2, axis=1)
    samples[:, 1, 1:] -= [1.0, 2.0]
    mixture, t = TaskMixture.fit(samples, 5, 1e-5), np.linspace(0, 1, 9)
    origins = np.array([[0.0, 0.0], [1.0, 2.0]])
    still, step = mixture.at(origins).regress(t)[0], np.array([3.0, -1.0])
    moved = mixture.at(origins + step).regress(t)[0]
    np.testing.assert_allclose(moved, still + step, atol=1e-9)


def test_more_components_follow_a_curve():
    samples = walks(n=30)
    t = np.linspace(0, 1, 60)
    truth = np.stack([t**2, np.sin(4 * t)], axis=1)
    off = [
        np.abs(TaskMixture.fit(samples, k, 1e-6).regress(t)[0] - truth).max() for k in (1, 3, 6)
    ]
    assert off[0] > off[1] > off[2]
    assert off[2] < 0.05


def test_a_kernel_primitive_of_one_reference_point_has_a_closed_form():
    spread_ = np.array([[[0.3, 0.1], [0.1, 0.2]]])
    mean = np.array([[1.0, -2.0]])
    one = KernelPrimitive(np.array([0.4]), mean, spread_, 0.3, 2.0)
    t = np.linspace(0, 1, 5)
    k = np.exp(-(((t - 0.4) / 0.3) ** 2) / 2)
    expected = k[:, None] * np.linalg.solve(np.eye(2) + 2.0 * spread_[0], mean[0])
    np.testing.assert_allclose(one.position(t), expected, atol=1e-12)


def test_a_kernel_primitive_passes_through_what_is_given():
    t = np.linspace(0, 1, 15)
    mean = np.stack([np.sin(3 * t), t], axis=1)
    covariance = np.tile(0.01 * np.eye(2), (15, 1, 1))
    reference = KernelPrimitive(t, mean, covariance, 0.2, 1.0)
    ends, given = np.array([0.0, 1.0]), np.array([[0.5, 0.5], [1.0, -1.0]])
    path = reference.through(ends, given, 1e-9).position(ends)
    np.testing.assert_allclose(path, given, atol=1e-6)
    assert np.abs(reference.position(ends) - given).max() > 0.1


def linear(shown, settings):
    """Straight lines that end a given distance beyond the goal."""
    t = np.linspace(0, 1, shown.shape[1])[:, None]
    return [
        lambda start, goal, over=setting["over"]: start + t * (goal + over - start)
        for setting in settings
    ]


def test_settings_are_chosen_and_figures_measured_on_held_out_motions():
    t = np.linspace(0, 1, 50)[:, None]
    rng = np.random.default_rng(0)
    start, goal = rng.standard_normal((2, 5, 1, 3))
    motions = start + t * (goal - start)
    peer = Peer(linear, [{"over": 0.5}, {"over": 0.0}, {"over": -0.1}])
    assert tuned(peer, motions, 3) == {"over": 0.0}
    measured = Measured()
    predict(peer, motions + 0.01 * np.sin(np.pi * t), 2, 3, measured)
    assert measured.chosen == [{"over": 0.0}]
    span = np.ptp(motions[2], axis=0).max()
    assert measured.rmse[0] == pytest.approx(0.01 / 2**0.5 / span, rel=0.05)
    assert measured.miss[0] < 1e-12
    assert measured.acceleration[0] < 1e-6


def test_only_new_settings_are_predicted_again(monkeypatch):
    calls = []

    def counted(shown, settings):
        calls.append(len(settings))
        return linear(shown, settings)

    rng = np.random.default_rng(0)
    tasks = {"a": rng.standard_normal((5, 30, 2)), "b": rng.standard_normal((4, 20, 2))}
    options = {"predicted": 6, "inner": 2}
    peers = {"learn": Peer(counted, [{"over": 0.0}])}
    monkeypatch.setattr(bench_peers, "PEERS", peers)
    first = predict_set("set", tasks, options, {})
    assert first.task == ["a"] * 3 + ["b"] * 3
    assert calls == [1] * 6
    peers["new"] = Peer(counted, [{"over": 0.0}, {"over": 0.1}])
    second = predict_set("set", tasks, options, first.peers)
    assert second.peers["learn"] is first.peers["learn"]
    assert calls[6:] == [2, 2, 1] * 6


def test_the_bootstrap_draws_whole_tasks():
    tasks = [name for name in "abcdef" for _ in range(3)]
    for rows in resamples(tasks, np.random.default_rng(0))[:50]:
        assert len(rows) == 18
        assert (rows.reshape(-1, 3) // 3 == rows[::3, None] // 3).all()


def test_demonstrations_are_spread_and_resampled_evenly():
    assert spread(9, 4) == [0, 3, 5, 8]
    assert spread(3, 9) == [0, 1, 2]
    line = np.stack([np.linspace(0, 2, 11), np.linspace(1, 0, 11)], axis=1)
    expected = np.stack([np.linspace(0, 2, 6), np.linspace(1, 0, 6)], axis=1)
    np.testing.assert_allclose(resampled(line, 6), expected, atol=1e-12)
