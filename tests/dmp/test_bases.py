"""Every basis and phase: what the response makes of it, its laws, and its files."""

import json
from dataclasses import fields
from functools import cache

import numpy as np
import pytest
import torch
from demo_motions import arm_motion
from scipy.integrate import solve_ivp
from scipy.interpolate import BSpline
from unchecked import shapes_unchecked

from hrc_learn.dmp import (
    ExponentialPhase,
    GaussianBasis,
    JointDMP,
    PeriodicBasis,
    Response,
    SplineBasis,
    SpringDamper,
    Stepper,
)
from hrc_learn.dmp.dynamics import (
    approach_curve,
    approach_state,
    balanced_units,
    basis_config,
    restored_basis,
)

BASES = {
    "gaussian": GaussianBasis(count=12),
    "gaussian, fades early": GaussianBasis(count=12, phase=ExponentialPhase(decay=20.0)),
    "spline": SplineBasis(count=12),
    "spline, few": SplineBasis(count=3),
    "spline, fades early": SplineBasis(count=20, phase=ExponentialPhase(decay=20.0)),
}


@cache
def splines(N):
    """All splines at once; padded by ones without a weight, as SciPy's need full support."""
    knots = (np.arange(N + 12) - 7) / (N - 1)
    return BSpline(knots, np.eye(N + 8)[:, 4:-4], 3, extrapolate=False)


def shares(basis, s):
    """What the docstrings of the bases state, by another route than the code's."""
    N = basis.count
    if isinstance(basis, SplineBasis):
        return np.nan_to_num(splines(N)(s))
    c = np.arange(N + 1) / (N - 1)
    sigma = basis.width / (N - 1)
    exponent = -((s - c) ** 2) / (2 * sigma**2)
    psi = np.exp(exponent - exponent.max())
    return psi[:N] / psi.sum()


@pytest.mark.parametrize("basis", BASES.values(), ids=BASES)
def test_response_solves_the_differential_equation(basis):
    """Against an adaptive solver, to well after the forcing has ended."""
    spring = SpringDamper(alpha=20.0, beta=4.0)
    weights = 300 * np.random.default_rng(0).standard_normal(basis.count)
    times = np.append(0.0, np.sort(np.random.default_rng(1).uniform(0, 1.6, 40)))

    def rhs(s, x):
        force = shares(basis, s) @ weights * np.exp(-basis.phase.decay * s)
        return [x[1], spring.alpha * (spring.beta * (1.1 - x[0]) - x[1]) + force]

    span, start = (0.0, times[-1]), [0.3, -2.0]
    expected = solve_ivp(
        rhs, span, start, "DOP853", times, rtol=1e-12, atol=1e-12, max_step=0.02
    ).y
    H = Response(spring, basis).evaluate(torch.tensor(times)).numpy()
    rows = H @ np.concatenate([weights, [-2.0, 0.3, 1.1]])
    np.testing.assert_allclose(rows[:, :2].T, expected, atol=1e-8)


@pytest.mark.parametrize("basis", BASES.values(), ids=BASES)
def test_forcing_ends_where_the_basis_says(basis):
    after = basis.horizon * torch.tensor([1 + 1e-9, 1.01, 1.5, 10.0], dtype=torch.float64)
    assert basis.forcing(after).abs().max() < 1e-15
    assert (basis.kernels(basis.centre_times()).argmax(-1) == torch.arange(basis.count)).all()


@pytest.mark.parametrize("width", [0.2, 0.35, 0.5])
@pytest.mark.parametrize("count", [5, 40])
def test_forcing_of_gaussians_is_lost_behind_their_follower_and_smooth_in_between(width, count):
    """Past the end the last of them is exp(-39) of the next one, whose weight is none."""
    basis = GaussianBasis(count=count, width=width, phase=ExponentialPhase(decay=1.0))
    x = (basis.horizon - 1) * (count - 1)
    own, follower = -(x**2) / (2 * width**2), -((x - 1) ** 2) / (2 * width**2)
    assert own - follower == pytest.approx(-39)
    # The logistic ratio of two neighbours has its nearest pole at pi width^2 spacings.
    reach = basis.smooth_interval * (count - 1) / (np.pi * width**2)
    assert 0.44 < reach < 0.45 or basis.smooth_interval == 0.5 / (count - 1)
    assert GaussianBasis(count=count, domain="phase").horizon == ExponentialPhase().horizon


def test_a_weight_of_a_spline_acts_on_its_support_alone():
    """Before it nothing changes to the last bit; after it the spring alone goes on."""
    basis = SplineBasis(count=30)
    h, c = basis.knot_spacing, basis.centre_times()
    s = torch.linspace(0, 1.2, 997, dtype=torch.float64)
    support = (s[:, None] - c).abs() < 2 * h
    forcing = basis.forcing(s)
    assert ((forcing > 0) == support).all()
    moved = Response(SpringDamper(), basis).evaluate(s)[:, 0, :30]
    assert (moved[s[:, None] < c - 2 * h - 1e-9] == 0).all()


def test_splines_add_up_to_one_until_they_fade():
    basis = SplineBasis(count=30)
    s = torch.linspace(0, 1 - 2 * basis.knot_spacing, 300, dtype=torch.float64)
    torch.testing.assert_close(basis.kernels(s).sum(-1), torch.ones_like(s))


def finer(basis):
    """The same basis, that asks for a table of a third of the interval."""

    class Finer(type(basis)):
        @property
        def smooth_interval(self):
            return super().smooth_interval / 3

    return Finer(**{field.name: getattr(basis, field.name) for field in fields(basis)})


@pytest.mark.parametrize(
    "basis",
    [
        GaussianBasis(count=6, width=0.35),
        GaussianBasis(count=6, width=1.0),
        PeriodicBasis(count=6, width=0.35),
        PeriodicBasis(count=6, width=0.9),
        SplineBasis(count=8),
    ],
)
def test_a_table_of_the_response_is_exact_to_rounding(basis):
    """With a spring so slow that the basis alone says how fine it has to be."""
    s, spring = torch.linspace(0, 1.4, 700, dtype=torch.float64), SpringDamper(alpha=5.0)
    table, exact = (
        Response(spring, b).evaluate(s)[:, :2, : basis.count] for b in (basis, finer(basis))
    )
    assert ((table - exact).abs().amax(0) / exact.abs().amax(0)).max() < 1e-12


@pytest.mark.parametrize("method", ["trajectory", "ridge", "lwr"])
@pytest.mark.parametrize(
    "basis", [SplineBasis(), GaussianBasis(phase=ExponentialPhase(decay=3.0))]
)
def test_a_fit_steps_and_saves_on_it(basis, method, tmp_path):
    time, position = arm_motion(moving_start=True)
    dmp = JointDMP.fit(time, position, basis=basis, method=method)
    assert dmp.fit_report.nrmse < (0.1 if method == "lwr" else 1e-4)
    state, stepper = dmp.initial_state(), Stepper(dmp)
    numpy_state = stepper.initial_state()
    for dt in [0.05] * 20 + [0.4] * 8:
        state, numpy_state = dmp.step(state, dt), stepper.step(numpy_state, dt)
        np.testing.assert_allclose(
            numpy_state.position, state.position.detach().numpy(), atol=1e-9
        )
    there = dmp.rollout(time=[20 * 0.05 + 8 * 0.4]).position[0]
    torch.testing.assert_close(state.position, there, rtol=0, atol=1e-9)
    dmp.save(tmp_path / "dmp")
    loaded = JointDMP.load(tmp_path / "dmp")
    assert loaded.basis == basis
    assert torch.equal(loaded.rollout().position, dmp.rollout().position)


def test_files_with_another_phase_or_basis_are_refused(tmp_path):
    time, position = arm_motion()
    JointDMP.fit(time, position).save(tmp_path)
    (tmp_path / ".manifest.json").unlink()
    file = tmp_path / "config.json"
    content = json.loads(file.read_text())
    for basis, complaint in (
        ({"type": "GaussianBasis", "phase": {"slope": 4.0}}, ".*unexpected .*'slope'"),
        ({"type": "WaveletBasis"}, "unknown type 'WaveletBasis'; choose from GaussianBasis"),
    ):
        file.write_text(json.dumps(content | {"basis": basis}))
        with pytest.raises(ValueError, match=rf"config\.json: field 'basis': {complaint}"):
            JointDMP.load(tmp_path)


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda: SplineBasis(count=1), "at least 2"),
    ],
)
def test_impossible_parts_are_refused(make, complaint):
    with pytest.raises(ValueError, match=complaint):
        make()


FAST = ExponentialPhase(decay=100.0)


@pytest.mark.parametrize(
    ("basis", "interval", "horizon"),
    [
        (GaussianBasis(count=11, width=0.5), 0.035, 1 + (0.5 + 39 * 0.25) / 10),
        (GaussianBasis(count=21, width=1.0), 0.5 / 20, 1 + 39.5 / 20),
        (GaussianBasis(count=3, phase=FAST), 0.01, FAST.horizon),
        (PeriodicBasis(count=10, width=0.5), 0.035, 1.0),
        (PeriodicBasis(count=10, width=1.0), 0.05, 1.0),
        (SplineBasis(count=11), 0.1, 1.1),
        (SplineBasis(count=5), 0.25, 1.25),
        (SplineBasis(count=11, phase=FAST), 0.01, 1.1),
    ],
)
def test_forcing_is_smooth_over_part_of_a_spacing_or_of_the_fading(basis, interval, horizon):
    assert basis.smooth_interval == pytest.approx(interval)
    assert basis.horizon == pytest.approx(horizon)
    # After this time the phase is below the rounding of one.
    assert np.exp(-FAST.decay * FAST.horizon) < 2.3e-16
    assert np.exp(-FAST.decay * 0.9 * FAST.horizon) > 1e-18


def test_kernels_are_as_printed():
    s = np.linspace(-0.1, 1.2, 27)
    gaussian, bells = GaussianBasis(count=6, width=0.7), PeriodicBasis(count=6, width=0.7)
    x = s[:, None] - np.linspace(0, 1, 6)
    expected = np.exp(-(x**2) / (2 * (0.7 / 5) ** 2))
    np.testing.assert_allclose(gaussian.kernels(torch.from_numpy(s)), expected, atol=1e-12)
    h = (6 / (2 * np.pi * 0.7)) ** 2
    x = s[:, None] - np.arange(6) / 6
    expected = np.exp(h * (np.cos(2 * np.pi * x) - 1))
    np.testing.assert_allclose(bells.kernels(torch.from_numpy(s)), expected, rtol=1e-9)
    phased = GaussianBasis(count=6, width=0.7, domain="phase")
    centres = np.exp(-4 * np.linspace(0, 1, 6))
    gaps = -np.diff(centres)
    x = np.exp(-4 * s)[:, None] - centres
    expected = np.exp(-(x**2) / (2 * (0.7 * np.append(gaps, gaps[-1])) ** 2))
    np.testing.assert_allclose(phased.kernels(torch.from_numpy(s)), expected, atol=1e-12)


@pytest.mark.parametrize("order", [0, 1, 2, 3])
@pytest.mark.parametrize("fraction", [1.0, 0.6])
def test_an_approach_is_a_minimum_jerk_curve_over_its_fraction(fraction, order):
    s = np.linspace(0, 1.5, 31)
    curve = np.polynomial.Polynomial([-1, 0, 0, 10, -15, 6]).deriv(order)
    expected = np.where(s < fraction, curve(s / fraction) / fraction**order, 0)
    found = approach_curve(torch.from_numpy(s), fraction, order)
    np.testing.assert_allclose(found, expected, atol=1e-10)
    if order == 0:
        state = approach_state(torch.from_numpy(s), fraction)
        np.testing.assert_allclose(state[:, 0], expected, atol=1e-12)
        rate = approach_curve(torch.from_numpy(s), fraction, 1)
        np.testing.assert_array_equal(state[:, 1], rate)


@pytest.mark.parametrize("basis", [*BASES.values(), PeriodicBasis(count=5)], ids=str)
def test_units_undo_the_fading_and_make_other_columns_as_large(basis):
    rng = np.random.default_rng(0)
    A = rng.normal(size=(40, basis.count + 3))
    unit = 1 / basis.phase(basis.centre_times()).numpy()
    norm = np.linalg.norm(A, axis=0)
    largest = (norm[: basis.count] * unit).max()
    for others in (0, 1, 3):
        found = balanced_units(basis, torch.from_numpy(A), others)
        last = largest / norm[basis.count : basis.count + others]
        np.testing.assert_allclose(found, np.append(unit, last))


def test_descriptions_of_bases_make_them_again():
    for basis in (*BASES.values(), PeriodicBasis(count=7, width=0.4)):
        config = json.loads(json.dumps(basis_config(basis)))
        assert restored_basis(config) == basis
        assert config["type"] == type(basis).__name__
    with pytest.raises(ValueError, match="unknown type 'Fourier'; choose from GaussianBasis"):
        restored_basis({"type": "Fourier"})


@pytest.mark.parametrize("kind", [GaussianBasis, PeriodicBasis, SplineBasis])
@pytest.mark.parametrize("count", [np.int64(8), 8.0, torch.tensor(8)])
def test_a_whole_count_of_any_type_is_an_integer(kind, count):
    with shapes_unchecked():
        basis = kind(count=count)
    assert type(basis.count) is int
    assert basis == kind(count=8)
    assert restored_basis(json.loads(json.dumps(basis_config(basis)))) == basis
