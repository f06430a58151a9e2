"""Local polynomials and time warping against oracles that share no code with them."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import savgol_filter

from hrc_learn.demos.preprocessing import local_polynomial, warp


def jittered(frames, step=0.02, seed=0):
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.uniform(0.6, 1.4, frames)) * step


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_polynomials_pass_unchanged_at_any_stamps(degree):
    time = jittered(80)
    polynomials = [
        np.polynomial.Polynomial(c)
        for c in np.random.default_rng(1).normal(size=(3, degree + 1))
    ]
    values = np.stack([p(time) for p in polynomials], axis=1)
    rates = np.stack([p.deriv()(time) for p in polynomials], axis=1)
    smooth, slope = local_polynomial(time, values, window=0.2, degree=degree)
    np.testing.assert_allclose(smooth, values, atol=1e-11)
    np.testing.assert_allclose(slope, rates, atol=1e-9)


@pytest.mark.parametrize(("window", "degree"), [(0.1, 2), (0.22, 3), (0.5, 4)])
def test_on_even_stamps_it_is_the_filter_of_savitzky_and_golay(window, degree):
    values = np.random.default_rng(2).normal(size=(100, 2))
    taps = round(window / 0.02) | 1
    smooth, slope = local_polynomial(
        np.arange(100) * 0.02, values, window=window, degree=degree
    )
    for derivative, result in ((0, smooth), (1, slope)):
        expected = savgol_filter(
            values, taps, degree, deriv=derivative, delta=0.02, axis=0, mode="interp"
        )
        np.testing.assert_allclose(result, expected, rtol=1e-9, atol=1e-9)


def test_rates_of_a_jittered_and_noisy_motion_beat_differences():
    time = jittered(500)
    rng = np.random.default_rng(3)
    values = np.sin(3 * time)[:, None] + 1e-3 * rng.normal(size=(500, 1))
    truth = 3 * np.cos(3 * time)
    _, slope = local_polynomial(time, values, window=0.2)
    estimated = np.sqrt(np.mean((slope[:, 0] - truth) ** 2))
    differenced = np.sqrt(np.mean((np.gradient(values[:, 0], time) - truth) ** 2))
    assert estimated < differenced / 3


def test_too_few_samples_are_refused():
    with pytest.raises(ValueError, match="3 samples do not determine"):
        local_polynomial(np.arange(3.0), np.zeros((3, 1)), window=1, degree=3)
    with pytest.raises(ValueError, match="must be positive"):
        local_polynomial(np.arange(9.0), np.zeros((9, 1)), window=0)
    with pytest.raises(ValueError, match="must be positive, got inf s"):
        local_polynomial(np.arange(9.0), np.zeros((9, 1)), window=np.inf)


def cheapest(cost: np.ndarray) -> float:
    """Cost of the best path by trying every one."""

    @cache
    def best(i, j):
        if i < 0 or j < 0:
            return np.inf
        if i == j == 0:
            return cost[0, 0]
        return cost[i, j] + min(best(i - 1, j - 1), best(i - 1, j), best(i, j - 1))

    return best(cost.shape[0] - 1, cost.shape[1] - 1)


@settings(max_examples=60)
@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 2**32 - 1))
def test_the_path_is_a_cheapest_one(rows, columns, seed):
    cost = np.random.default_rng(seed).uniform(size=(rows, columns)).round(1)
    first, second = warp(cost)
    assert cost[first, second].sum() == pytest.approx(cheapest(cost))
    assert (first[0], second[0]) == (0, 0)
    assert (first[-1], second[-1]) == (rows - 1, columns - 1)
    steps = np.stack([np.diff(first), np.diff(second)], axis=1)
    assert set(map(tuple, steps)) <= {(1, 1), (1, 0), (0, 1)}


def test_sequences_without_an_allowed_path_are_refused():
    cost = np.zeros((3, 5))
    cost[1] = np.inf
    with pytest.raises(ValueError, match="no path of finite cost"):
        warp(cost)
