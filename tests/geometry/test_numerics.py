"""Small matrices written out for compilers, against LAPACK, and constants."""

import dataclasses
import math
from types import SimpleNamespace
from typing import Literal

import numpy as np
import pytest
import sampling
import torch
from graphs import library_calls
from torch import Tensor
from unchecked import shapes_unchecked

from hrc_learn.geometry.numerics import (
    Constant,
    as_tensor,
    check_settings,
    everywhere,
    has_numbers,
    inverse_norm,
    is_number,
    matmul,
    minimum_jerk,
    null_projection,
    solve_positive,
)

DOUBLE = torch.float64
BATCHES = [(), (1,), (3, 1, 2), (50,)]


@pytest.fixture(params=["eager", "written out"])
def form(request, monkeypatch):
    """Both forms of each function: calls of LAPACK, and what a compiler is given."""
    if request.param != "eager":
        monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=sampling.generator(seed), dtype=DOUBLE)


def positive(*shape: int, smallest: float = 0.1) -> Tensor:
    """Random symmetric positive definite matrices; the last of `shape` is their size."""
    root = normal(*shape, shape[-1])
    return root @ root.mT + smallest * torch.eye(shape[-1], dtype=DOUBLE)


@pytest.mark.usefixtures("form")
@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("size", [1, 2, 6])
def test_solutions_are_those_of_a_general_solver(batch, size):
    A, B = positive(*batch, size), normal(*batch, size, 3, seed=1)
    expected = torch.linalg.solve(A, B)
    assert (A @ solve_positive(A, B) - B).abs().max() < 1e-12
    torch.testing.assert_close(solve_positive(A, B), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.usefixtures("form")
@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("size", [1, 2, 6])
def test_the_norm_of_the_inverse_is_that_of_singular_values(batch, size):
    A = positive(*batch, size)
    expected = (1 / torch.linalg.svdvals(A)).square().sum(-1).sqrt()
    torch.testing.assert_close(inverse_norm(A), expected, rtol=1e-12, atol=0)


@pytest.mark.usefixtures("form")
def test_nearly_singular_matrices_lose_no_more_digits_than_they_must():
    root = normal(20, 6, 5)  # rank 5, as the Jacobian of an arm that is stretched out
    A = root @ root.mT + 1e-9 * torch.eye(6, dtype=DOUBLE)
    expected = (1 / torch.linalg.eigvalsh(A)).square().sum(-1).sqrt()
    error = (inverse_norm(A) / expected - 1).abs()
    assert (error <= 10 * torch.finfo(DOUBLE).eps * torch.linalg.cond(A)).all()


@pytest.mark.usefixtures("form")
@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize(("m", "n"), [(6, 7), (3, 7), (6, 6), (1, 2)])
def test_the_projection_is_that_of_the_svd(batch, m, n):
    J, w = normal(*batch, m, n), normal(*batch, n, seed=1)
    basis = torch.linalg.svd(J).Vh[..., m:, :]
    expected = (basis.mT @ (basis @ w[..., None]))[..., 0]
    torch.testing.assert_close(null_projection(J, w), expected, rtol=0, atol=1e-11)


@pytest.mark.usefixtures("form")
@pytest.mark.parametrize("rank", [0, 1, 4, 5])
def test_a_singular_matrix_maps_its_null_space_to_zero_all_the_same(rank):
    J, w = normal(50, 6, rank) @ normal(50, rank, 7, seed=1), normal(50, 7, seed=2)
    left = null_projection(J, w)
    assert (J @ left[..., None]).abs().max() < 1e-12
    assert (left.norm(dim=-1) <= w.norm(dim=-1) * (1 + 1e-12)).all()
    torch.testing.assert_close(null_projection(J, left), left, rtol=0, atol=1e-12)
    assert left.norm(dim=-1).min() > 1e-4  # something of it is left


@pytest.mark.usefixtures("form")
@pytest.mark.parametrize("batch", BATCHES)
def test_products_are_those_of_blas_and_broadcast(batch):
    A, B = normal(*batch, 3, 4), normal(4, 2, seed=1)
    torch.testing.assert_close(matmul(A, B), A @ B, rtol=1e-12, atol=1e-14)


@pytest.mark.usefixtures("form")
def test_gradients_are_exact_to_second_order():
    root, B = normal(2, 3, 3).requires_grad_(), normal(2, 3, 2, seed=1).requires_grad_()

    def both(root: Tensor, B: Tensor) -> tuple[Tensor, Tensor]:
        A = root @ root.mT + torch.eye(3, dtype=DOUBLE)
        return solve_positive(A, B), inverse_norm(A)

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


def test_a_constant_made_in_inference_mode_serves_autograd_later():
    with torch.inference_mode():
        constant = Constant(torch.tensor([2.0, 3.0], dtype=torch.float64))
    x = torch.ones(2, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad((constant.like(x) * x * x).sum(), x)
    assert gradient.tolist() == [4.0, 6.0]


def test_it_is_converted_once():
    constant = Constant(torch.ones(3, dtype=torch.float64))
    x = torch.zeros(1)
    assert constant.like(x) is constant.like(x)
    assert constant.like(x).dtype == torch.float32
    assert Constant(torch.arange(2)).like(x).dtype == torch.int64


@pytest.mark.parametrize(
    ("rule", "good", "bad", "words"),
    [
        ("positive", [1e-9, 2.0], [0.0, -1.0], "x must be positive, but is"),
        ("not_negative", [0.0, 2.0], [-1e-9], "x must not be negative, but is"),
        ("below_one", [0.0, 0.99], [-1e-9, 1.0], r"x must be in \[0, 1\), but is"),
        ("fraction", [1e-9, 1.0], [0.0, 1.01], r"x must be in \(0, 1\], but is"),
    ],
)
def test_settings_are_held_to_their_range(rule, good, bad, words):
    for value in good:
        check_settings(SimpleNamespace(x=value), **{rule: ["x"]})
    for value in (*bad, math.nan):
        with pytest.raises(ValueError, match=f"{words} {value}"):
            check_settings(SimpleNamespace(x=value), **{rule: ["x"]})


def test_complex_values_are_refused():
    for values in (torch.ones(2) * 1j, np.ones(2) * 1j, [1j]):
        with pytest.raises(ValueError, match="must be real"), shapes_unchecked():
            as_tensor(values)


@dataclasses.dataclass
class Settings:
    """Settings without ranges of their own."""

    kind: Literal["", "one"] = ""
    size: tuple[float, float] = (1.0, 2.0)
    cap: float = 1.0
    unbounded = ("cap",)

    __post_init__ = check_settings


def test_all_settings_are_finite_and_names_are_known():
    assert Settings(kind="one", cap=math.inf).cap == math.inf
    for wrong, words in (
        ({"cap": math.nan}, "cap must be finite, but is nan"),
        ({"size": (1.0, math.inf)}, r"size must be finite, but is \(1.0, inf\)"),
        ({"kind": "two"}, "kind must be '' or one, but is 'two'"),
    ):
        with pytest.raises(ValueError, match=words), shapes_unchecked():
            Settings(**wrong)


def frozen(array):
    array.flags.writeable = False
    return array


def test_whole_numbers_and_lists_become_float64_and_floats_stay():
    for values in (3, [1, 2], torch.arange(3), np.arange(3, dtype=np.int32), [[1.5]]):
        assert as_tensor(values).dtype == torch.float64
    assert as_tensor(np.zeros(2, np.float32)).dtype == torch.float32
    assert as_tensor([1.0, 2.0], torch.zeros(1)).dtype == torch.float32


@pytest.mark.parametrize(
    "laid_out",
    [lambda a: a[::-1], lambda a: a.astype(">f8"), lambda a: a[::-1].astype(">f4"), frozen],
)
def test_arrays_of_any_layout_become_the_same_tensor(laid_out):
    """Reversed motions, columns of HDF5 files from other machines, read-only views."""
    array = laid_out(np.arange(8.0).reshape(4, 2))
    tensor = as_tensor(array)
    np.testing.assert_array_equal(tensor.numpy(), array)
    assert tensor.element_size() == array.itemsize


def test_numbers_in_si_units_are_no_larger_than_a_million_millions():
    x = torch.tensor([0.0, -9e11, 1.1e12, -1.1e12, math.inf, math.nan])
    assert is_number(x).tolist() == [True, True, False, False, False, False]


@pytest.mark.parametrize("bad", [math.nan, -math.inf, 1.1e12])
def test_one_value_that_is_no_number_spoils_a_tree(bad):
    counts, tree = torch.tensor([2**50]), {"a": torch.ones(2, 3), "b": [torch.zeros(())]}
    assert has_numbers((counts, tree))
    tree["a"][1, 2] = bad
    assert not has_numbers((counts, tree))


def test_steps_skip_work_only_where_they_may_branch(monkeypatch):
    mask = torch.tensor([True, True])
    assert everywhere(mask)
    assert not everywhere(torch.tensor([True, False]))
    found = []

    def inside(x: Tensor) -> Tensor:
        found.extend([everywhere(x == x), has_numbers(x)])
        return x

    torch.func.vmap(inside)(torch.zeros(2))
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    assert found == [False, False]
    assert not everywhere(mask)
    assert not has_numbers(torch.zeros(2))


@pytest.mark.parametrize("x", [-0.5, 0.0, 0.3, 1.0, 1.5])
def test_a_minimum_jerk_motion_rests_before_and_after_it(x):
    """Against NumPy's polynomial and its derivative."""
    value, slope = minimum_jerk(torch.tensor([x], dtype=torch.float64))
    inside = min(max(x, 0.0), 1.0)
    curve = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
    assert float(value) == pytest.approx(curve(inside))
    assert float(slope) == pytest.approx(curve.deriv()(inside), abs=1e-12)
    assert minimum_jerk(x) == pytest.approx((float(value), float(slope)))
