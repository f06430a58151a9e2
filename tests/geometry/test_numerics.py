"""Small matrices written out for compilers, against LAPACK, and constants."""

import pytest
import sampling
import torch
from graphs import library_calls
from torch import Tensor
from unchecked import shapes_unchecked

from hrc_learn.geometry.numerics import (
    Constant,
    inverse_norm,
    matmul,
    null_projection,
    solve_positive,
    unrolled_inverse_norm,
    unrolled_matmul,
    unrolled_null_projection,
    unrolled_solve,
)

DOUBLE = torch.float64
BATCHES = [(), (1,), (3, 1, 2), (50,)]


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=sampling.generator(seed), dtype=DOUBLE)


def positive(*shape: int, smallest: float = 0.1) -> Tensor:
    """Random symmetric positive definite matrices; the last of `shape` is their size."""
    root = normal(*shape, shape[-1])
    return root @ root.mT + smallest * torch.eye(shape[-1], dtype=DOUBLE)


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("size", [1, 2, 6])
def test_solutions_are_those_of_a_general_solver(batch, size):
    A, B = positive(*batch, size), normal(*batch, size, 3, seed=1)
    expected = torch.linalg.solve(A, B)
    for solve in (unrolled_solve, solve_positive):
        assert (A @ solve(A, B) - B).abs().max() < 1e-12
        torch.testing.assert_close(solve(A, B), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("size", [1, 2, 6])
def test_the_norm_of_the_inverse_is_that_of_singular_values(batch, size):
    A = positive(*batch, size)
    expected = (1 / torch.linalg.svdvals(A)).square().sum(-1).sqrt()
    for norm in (unrolled_inverse_norm, inverse_norm):
        torch.testing.assert_close(norm(A), expected, rtol=1e-12, atol=0)


def test_a_nearly_singular_matrix_loses_no_more_digits_than_it_must():
    root = normal(20, 6, 5)  # rank 5, as the Jacobian of an arm that is stretched out
    A = root @ root.mT + 1e-9 * torch.eye(6, dtype=DOUBLE)
    expected = (1 / torch.linalg.eigvalsh(A)).square().sum(-1).sqrt()
    error = (unrolled_inverse_norm(A) / expected - 1).abs()
    assert (error <= 10 * torch.finfo(DOUBLE).eps * torch.linalg.cond(A)).all()


PROJECTIONS = [null_projection, unrolled_null_projection]


@pytest.mark.parametrize("project", PROJECTIONS)
@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize(("m", "n"), [(6, 7), (3, 7), (6, 6), (1, 2)])
def test_the_projection_is_that_of_the_svd(project, batch, m, n):
    J, w = normal(*batch, m, n), normal(*batch, n, seed=1)
    basis = torch.linalg.svd(J).Vh[..., m:, :]
    expected = (basis.mT @ (basis @ w[..., None]))[..., 0]
    torch.testing.assert_close(project(J, w), expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("project", PROJECTIONS)
@pytest.mark.parametrize("rank", [0, 1, 4, 5])
def test_a_singular_matrix_maps_its_null_space_to_zero_all_the_same(project, rank):
    J, w = normal(50, 6, rank) @ normal(50, rank, 7, seed=1), normal(50, 7, seed=2)
    left = project(J, w)
    assert (J @ left[..., None]).abs().max() < 1e-12
    assert (left.norm(dim=-1) <= w.norm(dim=-1) * (1 + 1e-12)).all()
    torch.testing.assert_close(project(J, left), left, rtol=0, atol=1e-12)
    assert left.norm(dim=-1).min() > 1e-4  # something of it is left


@pytest.mark.parametrize("batch", BATCHES)
def test_products_are_those_of_blas_and_broadcast(batch):
    A, B = normal(*batch, 3, 4), normal(4, 2, seed=1)
    for product in (unrolled_matmul, matmul):
        torch.testing.assert_close(product(A, B), A @ B, rtol=1e-12, atol=1e-14)


def test_gradients_are_exact_to_second_order():
    root, B = normal(2, 3, 3).requires_grad_(), normal(2, 3, 2, seed=1).requires_grad_()

    def both(root: Tensor, B: Tensor) -> tuple[Tensor, Tensor]:
        A = root @ root.mT + torch.eye(3, dtype=DOUBLE)
        return unrolled_solve(A, B), unrolled_inverse_norm(A)

    assert torch.autograd.gradcheck(both, (root, B))
    assert torch.autograd.gradgradcheck(both, (root, B))


def test_what_is_traced_is_written_out():
    class All(torch.nn.Module):
        def forward(self, A: Tensor, B: Tensor) -> tuple[Tensor, ...]:
            null = null_projection(A[:3], B[:, 0])
            return matmul(A, B), solve_positive(A, B), inverse_norm(A), null

    A, B = positive(6), normal(6, 2)
    with shapes_unchecked():
        program = torch.export.export(All(), (A, B), strict=False)
        traced, eager = program.module()(A, B), All()(A, B)
    assert not library_calls(program)
    torch.testing.assert_close(traced, eager, rtol=1e-12, atol=1e-12)


def test_a_value_first_met_in_a_control_loop_serves_autograd_later():
    constant = Constant(torch.tensor([2.0, 3.0], dtype=torch.float64))
    x = torch.ones(2)
    with torch.inference_mode():
        constant.like(x)
    x.requires_grad_()
    (constant.like(x) * x * x).sum().backward()
    assert x.grad is not None
    assert x.grad.tolist() == [4.0, 6.0]


def test_it_is_converted_once():
    constant = Constant(torch.ones(3, dtype=torch.float64))
    x = torch.zeros(1)
    assert constant.like(x) is constant.like(x)
    assert constant.like(x).dtype == torch.float32
    assert Constant(torch.arange(2)).like(x).dtype == torch.int64
