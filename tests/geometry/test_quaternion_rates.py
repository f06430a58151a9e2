import pytest
import sampling
import torch

from hrc_learn.geometry import quaternion
from hrc_learn.geometry.quaternion import (
    axis_drift,
    drift_free_rate,
    drift_free_slope,
)

TURN = 2 * torch.pi
# On both sides of where series end, at half turns and past whole ones.
ANGLES = (0.0, 1e-9, 1e-4, 0.315, 0.317, torch.pi, TURN - 0.01, TURN, 7.0, 2 * TURN, 20.0)


def vectors(angle: float, n: int = 20):
    """Rotation vectors of that length, and two arbitrary vectors each."""
    rng = sampling.generator()
    e = angle * sampling.directions(n, rng=rng)
    return e, *torch.randn(2, n, 3, generator=rng, dtype=torch.float64)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 0.3, 2.0, torch.pi, 5.0])
def test_it_is_the_rotation_that_a_step_of_the_vector_makes(angle: float):
    """exp(phi + h v) = exp(h J_l(phi) v) exp(phi), by central differences."""
    rng = sampling.generator()
    phi = angle * sampling.directions(20, rng=rng)
    v = torch.randn(20, 3, generator=rng, dtype=torch.float64)
    h = 1e-5
    before = quaternion.conjugate(quaternion.exp(phi - h * v))
    turned = quaternion.multiply(quaternion.exp(phi + h * v), before)
    expected = quaternion.log(quaternion.canonical(turned)) / (2 * h)
    torch.testing.assert_close(drift_free_rate(-phi, v), expected, rtol=0, atol=1e-8)


def test_the_transposed_is_the_transpose():
    rng = sampling.generator(1)
    phi, v, g = (torch.randn(50, 3, generator=rng, dtype=torch.float64) for _ in range(3))
    forth = (drift_free_rate(-phi, v) * g).sum(-1)
    back = (v * drift_free_rate(phi, g)).sum(-1)
    torch.testing.assert_close(forth, back)


@pytest.mark.parametrize("angle", ANGLES)
def test_the_slope_is_the_derivative_by_time(angle: float):
    e, rate, curvature = vectors(angle)
    _, expected = torch.func.jvp(drift_free_rate, (e, rate), (rate, curvature))
    slope = drift_free_slope(e, rate, curvature)
    torch.testing.assert_close(slope, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("angle", ANGLES)
def test_the_drift_inverts_the_map_and_drops_what_whole_turns_lose(angle: float):
    """As the pseudo-inverse does, of a matrix with the singular values 1, s, s."""
    e, v, _ = vectors(angle)
    columns = drift_free_rate(
        e[:, None].expand(-1, 3, 3), torch.eye(3).double().expand(20, 3, 3)
    )
    expected = torch.linalg.pinv(columns.mT, rtol=1e-3) @ v[..., None]
    torch.testing.assert_close(v + axis_drift(e, v), expected[..., 0], rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.317, TURN - 0.1, 7.0])
def test_first_and_second_derivatives_exist(angle: float):
    e, rate, curvature = (x.requires_grad_() for x in vectors(angle, 1))
    for function, inputs in (
        (drift_free_slope, (e, rate, curvature)),
        (axis_drift, (e, rate)),
    ):
        assert torch.autograd.gradcheck(function, inputs, fast_mode=True)
        assert torch.autograd.gradgradcheck(function, inputs, fast_mode=True)


def test_gradients_at_a_whole_turn_are_finite():
    e, v, _ = (x.requires_grad_() for x in vectors(TURN))
    axis_drift(e, v).square().sum().backward()
    assert e.grad.isfinite().all()
    assert v.grad.isfinite().all()
