"""Components of motions on cubics, which splines hold exactly, against NumPy and SciPy."""

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline

from hrc_learn.dmp.motion_components import MotionComponents
from hrc_learn.dmp.samples import check_samples

pytestmark = pytest.mark.simulation

N, D, T = 24, 2, 31
SCALE = np.array([2.0, 0.5])
UNITS = {
    "centre": torch.tensor([0.3, -0.2], dtype=torch.float64),
    "scale": torch.from_numpy(SCALE),
    "low": torch.full((D,), -100.0, dtype=torch.float64),
    "high": torch.full((D,), 100.0, dtype=torch.float64),
}
S = np.linspace(0, 1, T)
DURATIONS = {"equal": np.full(N, 1.6), "varying": np.exp(np.linspace(-0.4, 0.5, N))}


def cubics(seed=0):
    """Coefficients of N motions of D columns over normalised time, the constant first."""
    return np.random.default_rng(seed).normal(size=(N, 4, D))


def curve(coefficients, s, order=0):
    powers = [np.polynomial.Polynomial(np.eye(4)[k]).deriv(order)(s) for k in range(4)]
    return np.einsum("kt,nkd->ntd", np.array(powers), coefficients)


def learned(durations, known):
    tau, motions = DURATIONS[durations], cubics()
    samples = check_samples(tau[:, None] * S, curve(motions, S))
    rate = motions[:, 1] / tau[:, None]
    velocity = torch.from_numpy(rate) if known == 2 else None
    found = MotionComponents.fit(samples, UNITS, velocity, known > 0, 1e-3)
    start = torch.from_numpy(motions[:, 0]) if known else None
    return found, samples, motions, start, velocity


@pytest.mark.parametrize("known", [0, 1, 2])
@pytest.mark.parametrize("durations", DURATIONS)
def test_motions_come_back_from_all_of_their_parameters(durations, known):
    found, samples, motions, start, velocity = learned(durations, known)
    tau = DURATIONS[durations]
    z = found.encode(samples, velocity)
    assert z.shape == (N, (6 - known) * D + (durations == "varying"))
    for order in range(3):
        time = torch.from_numpy(tau[:, None] * S)
        made = found(z, time, start, velocity, order=order)
        expected = curve(motions, S, order) / tau[:, None, None] ** order
        # Second differences of control points are penalised a little. The last sample may be
        # after the end by rounding, where velocities are zero.
        last = T if order == 0 else T - 1
        near = 2e-4 * 30**order
        np.testing.assert_allclose(made[:, :last], expected[:, :last], atol=near)
    late = torch.from_numpy(tau[:, None] * [1.0, 1.5, 9.0])
    rest = found(z, late, start, velocity)
    torch.testing.assert_close(rest[:, 0], rest[:, 1])
    assert (found(z, late, start, velocity, order=1)[:, 1:] == 0).all()
    _, length = found.polygon(z, start, velocity)
    np.testing.assert_allclose(length, tau, rtol=1e-9)
    assert found.duration == pytest.approx(np.exp(np.log(tau).mean()))


@pytest.mark.parametrize("known", [0, 1, 2])
@pytest.mark.parametrize("durations", DURATIONS)
def test_squares_of_the_spread_add_up_to_the_deviation_from_the_prediction(durations, known):
    found, samples, motions, start, velocity = learned(durations, known)
    z = found.encode(samples, velocity)
    s = torch.linspace(0, 1, 10 * found.points, dtype=torch.float64)

    def drawn(z):
        _, length = found.polygon(z, start, velocity)
        # On normalised time, in units of the columns.
        made = found(z, s * length.expand(N)[:, None], start, velocity) / found.scale
        return made, length.expand(N).log()

    (own, length), (predicted, usual) = drawn(z), drawn(torch.zeros_like(z))
    deviation = (own - predicted).square().sum(-1).mean()
    if known < 2:
        rate = torch.from_numpy(curve(motions, s.numpy(), 1) / SCALE)
        deviation += rate.square().sum(-1).mean() * (length - usual).square().mean()
        torch.testing.assert_close(found.spread.square().sum(), deviation, rtol=1e-3, atol=0)
    assert (found.spread.diff() <= 0).all()
    # The prediction is that of a regression on features of the start.
    features = [np.ones((N, 1))]
    if known:
        features.append((motions[:, 0] - UNITS["centre"].numpy()) / SCALE)
    if known == 2:
        rate = motions[:, 1] / DURATIONS[durations][:, None] / SCALE
        features.append(rate * found.duration)
    features = np.hstack(features)
    ridge = 1e-3 * N * np.eye(features.shape[1])
    ridge[0, 0] = 0
    log = np.log(DURATIONS[durations] / found.duration)
    weights = np.linalg.solve(features.T @ features + ridge, features.T @ log)
    if durations == "varying":
        np.testing.assert_allclose(
            usual - np.log(found.duration), features @ weights, atol=1e-9
        )
    assert found.prediction.shape[0] == features.shape[1]


def test_parameters_left_out_are_zero():
    found, samples, _, start, _ = learned("equal", 1)
    z = found.encode(samples)
    cut = z.clone()
    cut[:, 3:] = 0
    for one, other in zip(
        found.polygon(z[:, :3], start), found.polygon(cut, start), strict=True
    ):
        torch.testing.assert_close(one, other)
    with pytest.raises(ValueError, match="there are 10 parameters, got 11"):
        found.polygon(torch.zeros(11), start)


def test_an_encoded_start_bends_towards_a_given_one():
    """By a spline whose control points fall with the square of what is left of the motion."""
    found, samples, motions, _, _ = learned("equal", 0)
    z, shift = found.encode(samples), np.array([0.3, -0.7])
    time = torch.from_numpy(1.6 * S)
    start = torch.from_numpy(motions[:, 0] + shift)
    moved = found(z, time, start) - found(z, time)
    n = found.points
    knots = np.r_[[0] * 3, np.linspace(0, 1, n - 2), [1] * 3]
    left = (1 - np.arange(n) / (n - 1)) ** 2
    expected = BSpline(knots, left, 3)(S)[:, None] * shift
    np.testing.assert_allclose(moved, np.broadcast_to(expected, moved.shape), atol=1e-3)


def test_samples_that_are_no_samples_change_nothing():
    motions = cubics()
    position = curve(motions, S)
    time = np.tile(1.6 * S, (N, 1))
    mask = np.random.default_rng(1).random((N, T)) < 0.8
    mask[:, [0, -1]] = True
    position[~mask] = np.nan
    samples = check_samples(time, position, mask=mask)
    found = MotionComponents.fit(samples, UNITS, None, True, 1e-3)
    start = torch.from_numpy(motions[:, 0])
    made = found(found.encode(samples), torch.from_numpy(1.6 * S), start)
    np.testing.assert_allclose(made, curve(motions, S), atol=1e-3)
