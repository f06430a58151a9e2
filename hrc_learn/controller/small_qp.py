"""Small quadratic programs, batched, in a fixed number of steps and without branches.

This is the dual active-set method of Goldfarb and Idnani (1983). It starts at the optimum
without limits and adds one limit at a time to the active set, so a program with few active
limits is solved exactly in as few steps. Each step adds or drops one limit, separately for each
element of a batch: the operations do not depend on the data, so they compile and export.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# Violations of a limit up to this are rounding.
_TOLERANCE = 1e-10
# A row depends linearly on the active ones if its projection on their null space is relatively
# shorter than this: rounding leaves 1e-16, and weights of 1e7 make 1e-7 of a row significant.
_DEPENDENT = 1e-12


class LeastChange(NamedTuple):
    """The point nearest to the origin within some limits."""

    point: Float[Tensor, "*batch p"]
    multipliers: Float[Tensor, "*batch rows"]
    """Lagrange multipliers: positive at active upper limits, negative at active lower ones."""
    solved: Bool[Tensor, "*batch"]
    """True where the solution was found within the allowed steps."""


@dataclass(frozen=True, kw_only=True)
class _Step:
    """Iterate of the method: the nearest point within the active limits."""

    y: Tensor
    """The point (p)."""
    dual: Tensor
    """Multipliers, not negative (rows)."""
    side: Tensor
    """1 for an active upper limit, -1 for an active lower one, 0 otherwise (rows)."""
    operators: Tensor
    """Projector on the null space of the active rows (p, p) and, to its right, their
    pseudo-inverse, each column times its side, zero for inactive limits (p, rows)."""
    pending: Tensor
    """True while a limit is only partly added: another one had to be dropped first (1)."""
    index: Tensor
    """Number of that limit (1)."""
    multiplier: Tensor
    """Multiplier of that limit so far (1)."""


def least_change(
    rows: Float[Tensor, "*batch p rows"],
    lower: Float[Tensor, "*batch rows"],
    upper: Float[Tensor, "*batch rows"],
    steps: int,
    *,
    early_exit: bool = False,
) -> LeastChange:
    """Solve  min |y|^2 / 2  subject to  lower <= C y <= upper.

    Any strictly convex program takes this form: with the Hessian L L^T its unknown is
    y = L^T (x - x_0), counted from the optimum x_0 without limits.

    Args:
        rows: C^T, a column for each limit: sums then run over the first axis, and compiled
            code works on vectors of limits.
        lower: Lower limits, not above `upper`; minus infinity: none.
        upper: Upper limits; infinity: none.
        steps: Number of steps. Each active limit takes one, and each limit added and dropped
            on the way takes two.
        early_exit: True: stop at the solution, by a branch on the data, which neither compiles
            nor maps over batches.
    """
    *batch, p, _ = rows.shape
    nothing = torch.zeros_like(lower)
    eye = torch.eye(p, dtype=rows.dtype, device=rows.device).expand(*batch, p, p)
    now = _Step(
        y=torch.zeros_like(rows[..., 0]),
        dual=nothing,
        side=nothing,
        operators=torch.cat([eye, torch.zeros_like(rows)], dim=-1),
        pending=torch.zeros_like(lower[..., :1], dtype=torch.bool),
        index=torch.zeros_like(lower[..., :1], dtype=torch.int64),
        multiplier=nothing[..., :1],
    )
    if early_exit:
        now = _solve_unfinished(now, rows, lower, upper, steps)
    else:
        for _ in range(steps):
            now = _next(now, rows, lower, upper)
    return LeastChange(now.y, now.side * now.dual, _solved(now, rows, lower, upper))


def none_binds(
    lower: Float[Tensor, "*batch rows"], upper: Float[Tensor, "*batch rows"]
) -> Bool[Tensor, "*batch"]:
    """True where the origin is within the limits of `least_change`, for any rows."""
    return torch.maximum(lower, -upper).amax(-1) <= _TOLERANCE


def _solve_unfinished(
    now: _Step, rows: Tensor, lower: Tensor, upper: Tensor, steps: int
) -> _Step:
    """Take steps with those elements of a batch that are not solved yet."""
    if steps == 0:
        return now
    waiting = ~_solved(now, rows, lower, upper)
    if not bool(waiting.any()):
        return now
    if bool(waiting.all()):
        return _solve_unfinished(_next(now, rows, lower, upper), rows, lower, upper, steps - 1)
    # Only the unsolved elements are computed.
    part = _Step(**{name: value[waiting] for name, value in vars(now).items()})
    limits = rows.expand(*now.operators.shape[:-1], -1)[waiting], lower[waiting], upper[waiting]
    part = _solve_unfinished(part, *limits, steps)
    merged = {}
    for name, value in vars(now).items():
        merged[name] = value.clone()
        merged[name][waiting] = getattr(part, name)
    return _Step(**merged)


def _solved(now: _Step, rows: Tensor, lower: Tensor, upper: Tensor) -> Bool[Tensor, "*batch"]:
    below, above = _violations(now, rows, lower, upper)
    # A pending limit is not active yet, so it counts as violated.
    violation = torch.where(now.side == 0, torch.maximum(below, above), 0.0).amax(-1)
    return violation <= _TOLERANCE


def _violations(
    now: _Step, rows: Tensor, lower: Tensor, upper: Tensor
) -> tuple[Tensor, Tensor]:
    """Violations of the lower and the upper limits, positive where violated."""
    value = _combine(now.y, rows)
    return lower - value, value - upper


def _next(now: _Step, rows: Tensor, lower: Tensor, upper: Tensor) -> _Step:
    """One step: add the most violated limit, or drop one that stands in its way."""
    below, above = _violations(now, rows, lower, upper)
    violation = torch.where(now.side == 0, torch.maximum(below, above), -1.0)
    index = torch.where(now.pending, now.index, violation.argmax(-1, keepdim=True))
    a, b = above.gather(-1, index), below.gather(-1, index)
    side = torch.where(a > b, 1.0, -1.0).to(a.dtype)
    excess = torch.maximum(a, b)
    wanted = now.pending | (excess > _TOLERANCE)

    # Direction towards the limit that keeps the active ones, and the rates at which their
    # multipliers fall on the way.
    p = rows.shape[-2]
    c = side * _column(rows, index)
    passed = _combine(c, now.operators)
    # Projected twice: one projection leaves too few correct digits of a short vector.
    z, lost = _combine(passed[..., :p], now.operators[..., :p]), passed[..., p:]
    zz = (z * z).sum(-1, keepdim=True)
    independent = zz > _DEPENDENT**2 * (c * c).sum(-1, keepdim=True)
    full = torch.where(independent, excess / torch.where(independent, zz, 1.0), math.inf)
    losing = (now.side != 0) & (lost > 0)
    ratio = torch.where(losing, now.dual / torch.where(losing, lost, 1.0), math.inf)
    leaving = ratio.argmin(-1, keepdim=True)
    partial = ratio.gather(-1, leaving)
    length = torch.minimum(full, partial)
    acts = wanted & (length < math.inf)
    length = torch.where(acts, length, 0.0)
    adds, drops = acts & (full <= partial), acts & (full > partial)

    number = torch.arange(rows.shape[-1], device=rows.device)
    enters, leaves = (number == index) & adds, (number == leaving) & drops
    v = _column(now.operators, leaving + p)
    direction = torch.where(adds, z, v)
    square = torch.where(adds, zz, (v * v).sum(-1, keepdim=True))
    scale = torch.where(acts, 1 / torch.where(acts, square, 1.0), 0.0)
    # A rank-one update: the projector loses the direction of an added limit and gains that of
    # a dropped one; both make the pseudo-inverse orthogonal to it.
    entering = torch.cat([z, lost - enters.to(c.dtype)], dim=-1)
    exiting = torch.cat([-v, _combine(v, now.operators[..., p:])], dim=-1)
    turn = scale * torch.where(adds, entering, exiting)
    multiplier = now.multiplier + length
    return _Step(
        y=now.y - torch.where(independent, length, 0.0) * z,
        dual=torch.where(
            enters,
            multiplier,
            torch.where(leaves, 0.0, (now.dual - length * lost).clamp(min=0)),
        ),
        side=torch.where(enters, side, torch.where(leaves, 0.0, now.side)),
        operators=now.operators - direction.unsqueeze(-1) * turn.unsqueeze(-2),
        pending=drops,
        index=index,
        multiplier=torch.where(drops, multiplier, 0.0),
    )


def _combine(weights: Tensor, rows: Tensor) -> Tensor:
    """Weighted sum of the rows of a matrix."""
    return (weights.unsqueeze(-1) * rows).sum(-2)


def _column(matrix: Tensor, index: Tensor) -> Tensor:
    """Column of a matrix at an index (1), for each element of a batch."""
    shape = (*matrix.shape[:-1], 1)
    return matrix.gather(-1, index.unsqueeze(-2).expand(shape)).squeeze(-1)
