import pytest
import torch
from arm_samples import joint_positions
from sampling import generator
from torch.testing import assert_close

from hrc_learn.kinematics import (
    null_space_projector,
    panda,
    pseudo_inverse,
    singularity_damping,
)


def regular_jacobians(*batch, seed=1):
    """Jacobians of configurations away from singularities, where identities hold tightly."""
    q = joint_positions(400, rng=generator(seed))
    J = panda.jacobian(q)
    J = J[torch.linalg.svdvals(J)[:, -1] > 0.05]
    count = torch.Size(batch).numel()
    return J[:count].reshape(*batch, 6, 7)


def singular_jacobian():
    """Arm stretched straight up: rank below 6."""
    J = panda.jacobian(torch.zeros(7, dtype=torch.float64))
    assert int(torch.linalg.matrix_rank(J)) < 6
    return J


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2), (100,)])
def test_agrees_with_the_svd(batch):
    J = regular_jacobians(*batch)
    assert_close(pseudo_inverse(J), torch.linalg.pinv(J), rtol=0, atol=1e-10)


def test_projector_identities():
    J = regular_jacobians(150)
    J_plus, N = pseudo_inverse(J), null_space_projector(J)
    zero = {"rtol": 0, "atol": 1e-12}
    assert_close(J @ N, torch.zeros_like(J), **zero)
    assert_close(N @ J_plus, torch.zeros_like(J_plus), **zero)
    assert_close(N @ N, N, **zero)
    assert_close(N, N.mT, **zero)
    rank = N.diagonal(dim1=-2, dim2=-1).sum(-1)
    assert_close(rank, torch.ones_like(rank), **zero)


@pytest.mark.parametrize("damping", [0.02, 0.3])
def test_damping_filters_singular_values(damping):
    J = regular_jacobians(20)
    U, S, Vh = torch.linalg.svd(J, full_matrices=False)
    expected = Vh.mT @ torch.diag_embed(S / (S**2 + damping**2)) @ U.mT
    assert_close(pseudo_inverse(J, damping), expected)
    assert_close(pseudo_inverse(J, torch.full((20,), damping, dtype=J.dtype)), expected)
    assert_close(null_space_projector(J, damping), torch.eye(7, dtype=J.dtype) - expected @ J)


def test_damping_is_exactly_zero_away_from_singularities():
    assert bool((singularity_damping(regular_jacobians(200)) == 0).all())


def scaled_to(sigma_min):
    U, S, Vh = torch.linalg.svd(regular_jacobians(), full_matrices=False)
    S = torch.cat([S[:5], torch.tensor([sigma_min], dtype=S.dtype)])
    return U @ torch.diag(S) @ Vh


def test_damping_grows_smoothly_towards_a_singularity():
    sigma = [0.0, 0.01, 0.02, 0.03, 0.04, 0.0499]
    damping = torch.stack([singularity_damping(scaled_to(s)) for s in sigma])
    expected = 0.05 * (1 - (torch.tensor(sigma, dtype=torch.float64) / 0.05) ** 2).sqrt()
    assert_close(damping, expected, rtol=0, atol=1e-12)


def test_gain_of_the_damped_inverse_falls_to_zero_at_a_singularity():
    for sigma in (0.0, 1e-6, 0.01, 0.03, 0.049, 0.06):
        J = scaled_to(sigma)
        gains = torch.linalg.svdvals(pseudo_inverse(J, singularity_damping(J)))
        largest = torch.linalg.svdvals(J)[:-1].reciprocal()
        expected = sigma / 0.05**2 if sigma < 0.05 else 1 / sigma
        expected = torch.cat([largest, torch.tensor([expected], dtype=J.dtype)])
        # Damping takes a little from the other gains as well: at most 0.05^2 / sigma_5^2.
        assert float(gains[0]) <= 1.001 * float(expected.max())
        assert float((gains - expected[-1]).abs().min()) < 1e-6 * (1 + float(expected[-1]))


def test_damped_inverse_survives_a_real_singularity():
    J = singular_jacobian()
    gain = torch.linalg.svdvals(pseudo_inverse(J, singularity_damping(J)))[0]
    assert float(gain) < 20


@pytest.mark.parametrize("sigma_min", [0.0, 0.03, 0.05, 0.4])
def test_gradients_are_finite(sigma_min):
    J = scaled_to(sigma_min).requires_grad_()
    pseudo_inverse(J, singularity_damping(J)).sum().backward()
    assert bool(J.grad.isfinite().all())
