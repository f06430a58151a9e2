"""The small quadratic programs against conditions of optimality and a general solver."""

import numpy as np
import pytest
import sampling
import torch
from scipy.optimize import nnls
from torch import Tensor
from unchecked import shapes_unchecked

from hrc_learn.controller.constraint_layer import least_change

DOUBLE = torch.float64


def programs(
    *batch: int, p: int, rows: int, seed: int = 0, stretch: float = 1.0
) -> tuple[Tensor, Tensor, Tensor]:
    """Programs that have a solution, most of them with several limits that bind."""
    rng = sampling.generator(seed)
    C = torch.randn(*batch, p, rows, generator=rng, dtype=DOUBLE)
    C = C * torch.logspace(0, -torch.tensor(stretch).log10(), p, dtype=DOUBLE).unsqueeze(-1)
    inside = 3 * torch.randn(*batch, p, generator=rng, dtype=DOUBLE)
    value = (inside.unsqueeze(-1) * C).sum(-2)
    below, above = torch.rand(2, *batch, rows, generator=rng, dtype=DOUBLE)
    one_sided = torch.rand(*batch, rows, generator=rng) < 0.4
    lower = torch.where(one_sided, -torch.inf, value - 2 * below * C.norm(dim=-2))
    return C, lower, value + above * C.norm(dim=-2)


def nearest(C: np.ndarray, lower: np.ndarray, upper: np.ndarray, size: float) -> np.ndarray:
    """The same by non-negative least squares (Lawson and Hanson 1974, chapter 23).

    Args:
        C: One column for each limit.
        lower: Of the limits.
        upper: Of the limits.
        size: Of the solution, by which it is scaled: it divides by what is small otherwise.
    """
    G, h = np.hstack([C, -C]).T, np.concatenate([lower, -upper]) / size
    G, h = G[np.isfinite(h)], h[np.isfinite(h)]
    E, f = np.vstack([G.T, h]), np.append(np.zeros(len(C)), 1.0)
    x, _ = nnls(E, f, maxiter=1000)
    r = E @ x - f
    return -size * r[:-1] / r[-1]


@pytest.mark.parametrize(("p", "rows"), [(2, 5), (4, 12), (9, 16), (10, 20)])
def test_the_point_is_that_of_a_general_solver(p: int, rows: int):
    C, lower, upper = programs(60, p=p, rows=rows, seed=p)
    found = least_change(C, lower, upper, 60)
    assert found.solved.all()
    assert (found.multipliers != 0).sum(-1).double().mean() > 1
    for k in range(60):
        size = max(1.0, float(found.point[k].norm()))
        other = nearest(C[k].numpy(), lower[k].numpy(), upper[k].numpy(), size)
        np.testing.assert_allclose(found.point[k].numpy(), other, atol=1e-9)


@pytest.mark.parametrize("stretch", [1.0, 1e7])
def test_conditions_of_optimality_hold(stretch: float):
    """Of a strictly convex program they have one solution (Karush, Kuhn and Tucker)."""
    C, lower, upper = programs(500, p=9, rows=15, seed=1, stretch=stretch)
    y, multipliers, solved = least_change(C, lower, upper, 60)
    assert solved.all()
    value = (y.unsqueeze(-1) * C).sum(-2)
    assert (value <= upper + 1e-9).all()
    assert (value >= lower - 1e-9).all()
    gradient = y + (C * multipliers.unsqueeze(-2)).sum(-1)
    size = y.norm(dim=-1) + 1
    assert (gradient.norm(dim=-1) <= 1e-12 * stretch * size).all()
    at_upper, at_lower = multipliers > 0, multipliers < 0
    torch.testing.assert_close(value[at_upper], upper[at_upper], rtol=0, atol=1e-9)
    torch.testing.assert_close(value[at_lower], lower[at_lower], rtol=0, atol=1e-9)


def test_nothing_changes_where_zero_is_allowed():
    C, lower, upper = programs(50, p=5, rows=9)
    found = least_change(C, lower.clamp(max=0), upper.clamp(min=0), 3)
    assert found.solved.all()
    assert (found.point == 0).all()


def test_limits_that_repeat_or_touch_are_one():
    """Rows twice, rows of zeros, and upper limits that are the lower ones."""
    C, _, upper = programs(100, p=6, rows=5, seed=2)
    value = upper - 0.1
    twice = torch.cat([C, C, torch.zeros_like(C[..., :1])], dim=-1)
    end = torch.zeros_like(value[..., :1])
    found = least_change(
        twice, torch.cat([value, value, end], -1), torch.cat([value, value, end], -1), 30
    )
    assert found.solved.all()
    exact = torch.linalg.lstsq(C.mT, value.unsqueeze(-1), driver="gelsd").solution.squeeze(-1)
    torch.testing.assert_close(found.point, exact, rtol=1e-8, atol=1e-8)


def test_what_has_no_solution_or_too_few_steps_is_not_called_solved():
    C = torch.tensor([[1.0, 1.0]], dtype=DOUBLE)
    bounds = torch.tensor([-torch.inf, 2.0], dtype=DOUBLE), torch.tensor([1.0, 3.0]).double()
    assert not least_change(C, *bounds, 20).solved
    hard = programs(100, p=9, rows=15, seed=3)
    few, enough = least_change(*hard, 4), least_change(*hard, 60)
    assert enough.solved.all()
    assert 0 < few.solved.double().mean() < 1
    torch.testing.assert_close(few.point[few.solved], enough.point[few.solved])


def test_elements_of_a_batch_do_not_know_each_other():
    C, lower, upper = programs(2, 3, p=5, rows=8, seed=4)
    together = least_change(C, lower, upper, 30)
    with shapes_unchecked():
        mapped = torch.vmap(torch.vmap(lambda *x: least_change(*x, 30)))(C, lower, upper)
    for i in range(2):
        for k in range(3):
            alone = least_change(C[i, k], lower[i, k], upper[i, k], 30)
            for one, other, third in zip(alone, together, mapped, strict=True):
                torch.testing.assert_close(one, other[i, k], rtol=1e-12, atol=1e-12)
                torch.testing.assert_close(one, third[i, k], rtol=1e-12, atol=1e-12)
