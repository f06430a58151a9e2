import pytest
import sampling
import torch

from hrc_learn.geometry import quaternion
from hrc_learn.geometry.left_jacobian import left_jacobian, left_jacobian_transposed


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
    torch.testing.assert_close(left_jacobian(phi, v), expected, rtol=0, atol=1e-8)


def test_the_transposed_is_the_transpose():
    rng = sampling.generator(1)
    phi, v, g = (torch.randn(50, 3, generator=rng, dtype=torch.float64) for _ in range(3))
    forth = (left_jacobian(phi, v) * g).sum(-1)
    back = (v * left_jacobian_transposed(phi, g)).sum(-1)
    torch.testing.assert_close(forth, back)
