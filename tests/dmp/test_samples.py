"""Recorded samples, checked, padded, made dense and smoothed, against NumPy and SciPy."""

import math

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline, CubicHermiteSpline

from hrc_learn.dmp import JointDMP
from hrc_learn.dmp import samples as recorded
from hrc_learn.dmp.samples import check_samples, densified, padded, smoothed

pytestmark = pytest.mark.simulation


def ragged(seed=0, lengths=(9, 6, 4)):
    """Demonstrations of three columns and of several lengths, each on its own grid."""
    rng = np.random.default_rng(seed)
    times = [5 + np.cumsum(rng.uniform(0.1, 0.3, n)) for n in lengths]
    return times, [rng.normal(size=(n, 3)) for n in lengths]


def test_lists_are_padded_to_a_batch():
    times, motions = ragged()
    time, mask, (position, none) = padded(times, None, motions, None)
    assert none is None
    assert mask.sum(-1).tolist() == [9, 6, 4]
    found = check_samples(time, position, mask=mask)
    assert (found.batch, found.complete, found.shared_grid) == ((3,), False, False)
    for k, (t, y) in enumerate(zip(times, motions, strict=True)):
        n = len(t)
        np.testing.assert_allclose(found.s[k, :n], (t - t[0]) / (t[-1] - t[0]))
        assert (found.s[k, n:] == 1).all()
        assert found.duration[k].item() == pytest.approx(t[-1] - t[0])
        np.testing.assert_array_equal(found.first[k], y[0])
        np.testing.assert_array_equal(found.last[k], y[-1])
        np.testing.assert_allclose(found.span[k], np.ptp(y, axis=0))
        np.testing.assert_array_equal(found.columns[k, :n], y)
    # Samples of a mask are left out as well, wherever they are.
    kept = [np.ones(n, bool) for n in (9, 6, 4)]
    kept[0][[0, 4, 8]] = False
    time, mask, (position,) = padded(times, kept, motions)
    found = check_samples(time, position, mask=mask)
    np.testing.assert_array_equal(found.first[0], motions[0][1])
    np.testing.assert_array_equal(found.last[0], motions[0][7])
    np.testing.assert_allclose(found.span[0], np.ptp(motions[0][[1, 2, 3, 5, 6, 7]], axis=0))
    assert found.duration[0].item() == pytest.approx(times[0][7] - times[0][1])


def test_what_is_no_list_of_arrays_stays():
    times, motions = ragged(lengths=(5, 5))
    _, mask, (position,) = padded(times, None, motions)
    assert mask is None
    assert position.shape == (2, 5, 3)
    one_grid, _, _ = padded(times[0], None, motions)
    np.testing.assert_array_equal(one_grid, np.stack([times[0]] * 2))
    listed, _, _ = padded([t.tolist() for t in times], None, motions)
    np.testing.assert_array_equal(listed, np.stack(times))
    for columns in ([], [1.0, 2.0], np.stack(motions), [np.float64(1), np.float64(2)]):
        assert padded(times, None, columns)[2][0] is columns
    with pytest.raises(ValueError, match=r"have \[5, 5\] samples, but time, mask or another"):
        padded(times, None, motions, [motions[0], motions[1][:4]])


def test_a_mask_that_is_too_short_is_refused():
    """Padded like a demonstration, it would silently leave out the last samples."""
    times, motions = ragged(lengths=(5, 8))
    with pytest.raises(ValueError, match=r"mask or another column has \[4, 8\]"):
        padded(times, [np.ones(4, bool), np.ones(8, bool)], motions)


@pytest.mark.parametrize("batch", [(), (4,), (2, 2)])
@pytest.mark.parametrize("masked", [False, True])
def test_residuals_are_those_of_numpy(batch, masked):
    rng = np.random.default_rng(2)
    made, position = rng.normal(size=(2, *batch, 20, 3))
    mask = np.ones((*batch, 20), bool)
    if masked:
        mask[..., 1::3] = False
        position[~mask] = np.nan
    found = check_samples(np.arange(20.0), position, mask=mask if masked else None)
    noise = torch.arange(float(3 * math.prod(batch))).view(-1, 3).double()
    report = found.compare(torch.from_numpy(made), noise)
    error, valid = (made - position)[..., mask.reshape(-1, 20)[0], :], mask.reshape(-1, 20)[0]
    np.testing.assert_allclose(report.rmse, np.sqrt(np.square(error).mean(-2)))
    np.testing.assert_allclose(report.peak, np.abs(error).max(-2))
    span = np.ptp(position[..., valid, :], axis=-2)
    np.testing.assert_allclose(report.span, span)
    nrmse = np.sqrt(np.square(error).mean((-1, -2))) / span.max(-1)
    np.testing.assert_allclose(report.nrmse, nrmse)
    assert report.noise.shape == (*batch, 3)
    assert [*report.tensors()] == ["rmse", "peak", "span", "noise"]
    assert found.compare(torch.from_numpy(made)).noise is None
    assert found.timestamps.shape == ((20,) if not masked else (*batch, 20))


def test_columns_that_never_move_have_an_amplitude_to_divide_by():
    found = check_samples(np.arange(4.0), np.stack([np.ones(4), np.arange(4.0)], 1))
    assert found.span.tolist() == [[0, 3]]
    assert found.amplitude.tolist() == [[1, 3]]


@pytest.mark.parametrize("apart", [1e-14, 1e-10])
def test_grids_that_differ_by_rounding_are_one(apart):
    time = np.stack([np.arange(5.0), np.arange(5.0) + 100])
    time[1, 2] += 4 * apart
    found = check_samples(time, np.zeros((2, 5, 1)) + np.arange(5)[:, None])
    assert found.shared_grid == (apart < 1e-12)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({(0, 1, 3): math.nan}, r"demonstration \(0, 1\): position is nan at sample 3, col"),
        ({(1, 0, 0): math.inf}, r"demonstration \(1, 0\): position is inf at sample 0, col"),
    ],
)
def test_values_that_are_not_finite_are_named_by_their_place(change, text):
    position = np.zeros((2, 2, 5, 2))
    for place, value in change.items():
        position[(*place, 1)] = value
    with pytest.raises(ValueError, match=text + "umn 1"):
        check_samples(np.arange(5.0), position)
    mask = np.isfinite(position).all(-1)
    assert check_samples(np.arange(5.0), position, mask=mask).position.isfinite().all()


@pytest.mark.parametrize(
    ("time", "mask", "text"),
    [
        ([0, 1, 1, 2], None, "is 1.000000 s at sample 2 after 1.000000 s"),
        ([3, 4, 3.5, 5], None, "is 3.500000 s at sample 2 after 4.000000 s"),
        ([0, 9, 1, 2], [1, 0, 1, 1], None),
        ([9, 0, 1, 2], [0, 1, 1, 1], None),
        ([1, 9, 2, 0.5], [1, 0, 1, 1], "is 0.500000 s at sample 3 after 2.000000 s"),
        ([0, 1, 2, 3], [1, 0, 0, 1], "at least 3 samples, got 2"),
        ([0, 1, math.nan, 3], None, "time is nan at sample 2"),
    ],
)
def test_time_increases_over_the_valid_samples(time, mask, text):
    position = np.arange(4.0)
    if text is None:
        found = check_samples(time, position, mask=mask)
        valid = np.asarray(time)[np.array(mask, bool)]
        s = found.s[0][torch.tensor(mask).bool()]
        np.testing.assert_allclose(s, (valid - valid[0]) / (valid[-1] - valid[0]))
        assert (found.s.diff() >= 0).all()
        return
    with pytest.raises(ValueError, match=text):
        check_samples(time, position, mask=mask)


@pytest.mark.parametrize("velocity", [False, True])
def test_sparse_demonstrations_follow_cubics(velocity):
    """Four basis functions need six samples: more stay as they are."""
    times, motions = ragged()
    rates = [np.cos(y) for y in motions]
    time, mask, (position, rate) = padded(times, None, motions, rates if velocity else None)
    samples = check_samples(time, position, rate, mask)
    dense = densified(samples, 4)
    fine = np.linspace(0, 1, 4 * 4 + 1)
    for k in (1, 2):
        s = (times[k] - times[k][0]) / (times[k][-1] - times[k][0])
        tau = times[k][-1] - times[k][0]
        slope = rates[k] * tau if velocity else np.gradient(motions[k], s, axis=0, edge_order=2)
        cubic = CubicHermiteSpline(s, motions[k], slope)
        assert dense.mask[k].sum() == 17
        np.testing.assert_allclose(dense.s[k, :17], fine)
        np.testing.assert_allclose(dense.position[k, :, :17].T, cubic(fine), atol=1e-12)
        if velocity:
            expected = cubic(fine, 1) / tau
            np.testing.assert_allclose(dense.velocity[k, :, :17].T, expected, atol=1e-9)
    assert dense.mask[0].sum() == 9
    np.testing.assert_allclose(dense.position[0, :, :9].T, motions[0])
    assert (dense.velocity is None) != velocity
    assert (dense.s.diff() >= 0).all()
    assert densified(samples, 2) is samples
    assert densified(samples, 3) is not samples
    both = check_samples(*(x[:2] for x in (time, position)), None, mask[:2])
    assert densified(both, 3) is both
    assert densified(both, 6).complete


def likeliest(s, y):
    """Dense penalised splines: the strongest penalty not significantly less likely."""
    count = max(4, min(120, len(s) // 2))
    knots = np.arange(-3, count + 4) / count
    B = BSpline.design_matrix(s, knots, 3).toarray()
    D = np.diff(np.eye(count + 3), n=3, axis=0)
    penalty = D.T @ D
    penalty *= np.trace(B.T @ B) / np.trace(penalty)
    middle, scores, fits = y.mean(), [], []
    for strength in np.logspace(-10, 6, 81):
        A = B.T @ B + strength * penalty
        c = np.linalg.solve(A, B.T @ (y - middle))
        misfit = (y - middle) @ (y - middle) - (y - middle) @ B @ c
        # Three polynomials are free of the penalty.
        n = len(s) - 3
        scores.append(n * np.log(misfit) + np.linalg.slogdet(A)[1] - count * np.log(strength))
        fits.append((B @ c + middle, np.sqrt(misfit / n)))
    return fits[np.flatnonzero(np.array(scores) <= min(scores) + 1)[-1]]


@pytest.mark.parametrize("length", [12, 60])
def test_smoothing_is_that_of_dense_penalised_splines(length):
    rng = np.random.default_rng(5)
    s = np.sort(rng.uniform(size=length))
    s = (s - s[0]) / (s[-1] - s[0])
    columns = [np.sin(5 * s) + 0.05 * rng.normal(size=length), 3 + rng.normal(size=length)]
    found, noise = smoothed(check_samples(2 * s, np.stack([*columns, 0 * s + 2], 1)))
    for k, y in enumerate(columns):
        expected, deviation = likeliest(s, y)
        np.testing.assert_allclose(found.position[0, k], expected, atol=1e-6)
        assert noise[0, k].item() == pytest.approx(deviation, rel=1e-6)
    assert (found.position[0, 2] == 2).all()


def test_each_demonstration_is_smoothed_on_its_own_grid():
    rng = np.random.default_rng(6)
    times = [np.linspace(0, 2, 40), np.linspace(0, 3, 25)]
    motions = [np.sin(t)[:, None] + 0.03 * rng.normal(size=(len(t), 1)) for t in times]
    time, mask, (position,) = padded(times, None, motions)
    found, noise = smoothed(check_samples(time, position, mask=mask))
    for k, (t, y) in enumerate(zip(times, motions, strict=True)):
        alone, own = smoothed(check_samples(t, y))
        torch.testing.assert_close(found.position[k, :, : len(t)], alone.position[0])
        torch.testing.assert_close(noise[k], own[0])


@pytest.mark.parametrize(("noise", "kept"), [(1e-5, True), (4e-5, False)])
def test_noise_of_less_than_the_accuracy_of_a_fit_stays(noise, kept):
    t = np.linspace(0, 1, 400)
    y = t**2 + noise * np.random.default_rng(7).normal(size=400)
    samples = check_samples(t, y)
    found, deviation = smoothed(samples)
    assert deviation.item() == pytest.approx(noise, rel=0.15)
    assert torch.equal(found.position, samples.position) == kept


@pytest.mark.parametrize(
    ("index", "batch", "label"),
    [(0, (), ""), (3, (5,), "demonstration 3: "), (5, (2, 3), "demonstration (1, 2): ")],
)
def test_demonstrations_are_named_by_their_place_in_the_batch(index, batch, label):
    assert recorded.demo_label(index, batch) == label


def test_by_default_a_short_demonstration_is_as_gentle_as_it_was(recwarn):
    """Two seconds at 30 Hz: fewer samples than the default of basis functions asks for."""
    s = torch.linspace(0, 1, 60, dtype=torch.float64)[:, None]
    reach = torch.tensor([0.5, -0.3, 1.2], dtype=torch.float64)
    made = JointDMP.fit(2 * s[:, 0], s**3 * (10 - 15 * s + 6 * s**2) * reach).rollout(dt=0.001)
    # The largest acceleration of a minimum-jerk motion: 10 / sqrt(3) D / T^2.
    peak = 10 / 3**0.5 * reach.abs() / 2**2
    assert (made.acceleration.abs().amax(0) < 1.05 * peak).all()
    assert not recwarn
