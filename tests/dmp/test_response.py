"""The response against an adaptive solver of the differential equation it claims to solve."""

import numpy as np
import pytest
import torch
from dmp_oracle import forcing, gaussians, solve
from unchecked import shapes_unchecked

from hrc_learn.dmp import ExponentialPhase, GaussianBasis, Response, SpringDamper

SPRINGS = {
    "critical": SpringDamper(),
    "overdamped": SpringDamper(alpha=30.0, beta=2.0),
    "underdamped": SpringDamper(alpha=12.0, beta=20.0),
    "nearly critical": SpringDamper(alpha=25.0, beta=6.25 * (1 + 1e-9)),
}


@pytest.mark.parametrize("domain", ["time", "phase"])
@pytest.mark.parametrize("spring", SPRINGS.values(), ids=SPRINGS)
def test_response_solves_the_differential_equation(spring, domain):
    basis = GaussianBasis(count=12, domain=domain, phase=ExponentialPhase(decay=3.0))
    rng = np.random.default_rng(0)
    weights = 300 * rng.standard_normal(12)
    times = np.append(0.0, np.sort(rng.uniform(0, 1.4, 40)))
    expected = solve(spring, basis, weights, 0.3, -2.0, 1.1, times)

    H = Response(spring, basis).evaluate(torch.tensor(times))
    rows = H.numpy() @ np.concatenate([weights, [-2.0, 0.3, 1.1]])
    np.testing.assert_allclose(rows[:, :2].T, expected, atol=1e-8)
    acceleration = spring.alpha * (spring.beta * (1.1 - rows[:, 0]) - rows[:, 1])
    forces = np.array([forcing(basis, s) @ weights for s in times])
    np.testing.assert_allclose(rows[:, 2], acceleration + forces, atol=1e-8)


def test_response_does_not_depend_on_the_grid():
    response = Response(SpringDamper(), GaussianBasis(count=50))
    fine = response.evaluate(torch.linspace(0, 1, 1001, dtype=torch.float64))
    coarse = response.evaluate(torch.linspace(0, 1, 21, dtype=torch.float64))
    torch.testing.assert_close(coarse, fine[::50], rtol=0, atol=1e-13)


def test_response_rests_at_the_goal_long_after_the_end():
    response = Response(SpringDamper(), GaussianBasis(count=10))
    H = response.evaluate(torch.tensor([9.4, 9.6, 50.0, 1e4], dtype=torch.float64))
    expected = torch.zeros_like(H)
    expected[:, 0, -1] = 1.0
    torch.testing.assert_close(H, expected, rtol=0, atol=1e-12)


def test_derivatives_by_time_are_exact():
    response = Response(SpringDamper(), GaussianBasis(count=4))
    s = torch.tensor([0.01, 0.2, 0.71, 1.3], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(response.evaluate, (s,), atol=1e-7)
    assert torch.autograd.gradgradcheck(lambda s: response.evaluate(s)[..., 0, :], (s,))


@pytest.mark.parametrize("spring", SPRINGS.values(), ids=SPRINGS)
def test_an_unforced_motion_is_smooth_over_the_time_of_its_fastest_mode(spring):
    A = np.array([[0, 1], [-spring.alpha * spring.beta, -spring.alpha]])
    assert spring.stiffness == spring.alpha * spring.beta
    expected = 1 / np.abs(np.linalg.eigvals(A)).max()
    assert spring.smooth_interval == pytest.approx(expected, rel=1e-3)


def test_propagator_composes():
    s = torch.tensor(0.3, dtype=torch.float64)
    for spring in SPRINGS.values():
        E = spring.propagator(s)
        torch.testing.assert_close(E @ E @ E, spring.propagator(3 * s), rtol=1e-9, atol=1e-12)


def test_gaussians_are_the_papers_in_the_phase_domain():
    basis = GaussianBasis(count=9, domain="phase")
    s = torch.linspace(0, 1, 7, dtype=torch.float64)
    expected = np.stack([gaussians(basis, x) for x in s.numpy()])
    np.testing.assert_allclose(basis.kernels(s).numpy(), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda: SpringDamper(alpha=-1.0), "alpha must be positive"),
        (lambda: SpringDamper(beta=0.0), "beta must be positive"),
        (lambda: SpringDamper(alpha=float("nan")), "alpha must be positive"),
        (lambda: ExponentialPhase(decay=0.0), "decay must be positive"),
        (lambda: GaussianBasis(count=1), "at least 2"),
        (lambda: GaussianBasis(width=0.0), "width must be positive"),
        (lambda: GaussianBasis(domain="space"), "domain must be time or phase, but is 'space'"),
    ],
)
def test_impossible_parts_are_refused(make, complaint):
    with pytest.raises(ValueError, match=complaint), shapes_unchecked():
        make()


@pytest.mark.parametrize("count", [10.5, float("nan"), float("inf")])
def test_counts_are_whole_numbers(count):
    with (
        shapes_unchecked(),
        pytest.raises(ValueError, match=f"whole number of at least 2 functions, got {count}"),
    ):
        GaussianBasis(count=count)
