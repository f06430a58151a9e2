"""Small quadratic programs, batched, in a fixed number of steps and without branches.

The dual active-set method of Goldfarb and Idnani (1983). It begins at the optimum without
limits and takes in one limit at a time, so a program of which few limits bind is solved in as
few steps, and exactly. Each step takes a limit in or lets one go, for each element of a batch
by itself: the same operations whatever the data, which compile and export.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# Violations of a limit that count as rounding.
_TOLERANCE = 1e-10
# Length of what the rows that bind leave of another row, relative to it, below which it depends
# on them: projecting leaves 1e-16 by rounding, and weights of 1e7 make 1e-7 of a row count.
_DEPENDENT = 1e-12


class LeastChange(NamedTuple):
    """The point nearest to the origin within some limits."""

    point: Float[Tensor, "*batch p"]
    multipliers: Float[Tensor, "*batch rows"]
    """Of the limits: positive where the upper one binds, negative where the lower one does."""
    solved: Bool[Tensor, "*batch"]
    """Whether it was found within the steps that were allowed."""


@dataclass(frozen=True, kw_only=True)
class _Step:
    """Where the method is: the nearest point within those limits that are taken in."""

    y: Tensor
    dual: Tensor
    """Multipliers, not negative."""
    side: Tensor
    """Of the limits taken in: 1 the upper, -1 the lower; 0 of the others."""
    operators: Tensor
    """Side by side, the projector on the directions that keep them (p, p), and the
    pseudo-inverse of their rows, each times its side (p, rows), zero of the others."""
    pending: Tensor
    """Whether a limit is being taken in (1): it had to wait for another one to go."""
    index: Tensor
    """Number of that limit (1)."""
    share: Tensor
    """Its multiplier so far (1)."""


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
        rows: C^T, a column for each limit: sums then run over the first axis, and what is
            compiled is vectors of limits.
        lower: Not above `upper`; minus infinity where there is none.
        upper: Infinity where there is none.
        steps: To be made. It takes one for each limit that binds, and two for each that is
            taken in on the way and let go again.
        early_exit: Make no more steps than it takes, by a branch on the data, which neither
            compiles nor maps over batches.
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
        share=nothing[..., :1],
    )
    if early_exit:
        now = _as_far_as_needed(now, rows, lower, upper, steps)
    else:
        for _ in range(steps):
            now = _next(now, rows, lower, upper)
    return LeastChange(now.y, now.side * now.dual, _solved(now, rows, lower, upper))


def none_binds(
    lower: Float[Tensor, "*batch rows"], upper: Float[Tensor, "*batch rows"]
) -> Bool[Tensor, "*batch"]:
    """Whether the origin is within the limits of `least_change`, whatever their rows are."""
    return torch.maximum(lower, -upper).amax(-1) <= _TOLERANCE


def _as_far_as_needed(
    now: _Step, rows: Tensor, lower: Tensor, upper: Tensor, steps: int
) -> _Step:
    """Steps of those elements of a batch that are not solved yet."""
    if steps == 0:
        return now
    waiting = ~_solved(now, rows, lower, upper)
    if not bool(waiting.any()):
        return now
    if bool(waiting.all()):
        return _as_far_as_needed(_next(now, rows, lower, upper), rows, lower, upper, steps - 1)
    # A mask of the whole batch, so that of few elements that wait only those are computed.
    part = _Step(**{name: value[waiting] for name, value in vars(now).items()})
    limits = rows.expand(*now.operators.shape[:-1], -1)[waiting], lower[waiting], upper[waiting]
    part = _as_far_as_needed(part, *limits, steps)
    merged = {}
    for name, value in vars(now).items():
        merged[name] = value.clone()
        merged[name][waiting] = getattr(part, name)
    return _Step(**merged)


def _solved(now: _Step, rows: Tensor, lower: Tensor, upper: Tensor) -> Bool[Tensor, "*batch"]:
    below, above = _violations(now, rows, lower, upper)
    # A limit that is still being taken in is one that is violated.
    violation = torch.where(now.side == 0, torch.maximum(below, above), 0.0).amax(-1)
    return violation <= _TOLERANCE


def _violations(
    now: _Step, rows: Tensor, lower: Tensor, upper: Tensor
) -> tuple[Tensor, Tensor]:
    value = _combine(now.y, rows)
    return lower - value, value - upper


def _next(now: _Step, rows: Tensor, lower: Tensor, upper: Tensor) -> _Step:
    below, above = _violations(now, rows, lower, upper)
    violation = torch.where(now.side == 0, torch.maximum(below, above), -1.0)
    index = torch.where(now.pending, now.index, violation.argmax(-1, keepdim=True))
    a, b = above.gather(-1, index), below.gather(-1, index)
    side = torch.where(a > b, 1.0, -1.0).to(a.dtype)
    excess = torch.maximum(a, b)
    wanted = now.pending | (excess > _TOLERANCE)

    # Direction in which the limit is reached while the others are kept, and what their
    # multipliers lose on the way.
    p = rows.shape[-2]
    c = side * _column(rows, index)
    passed = _combine(c, now.operators)
    # Projected twice, or too little of a short rest is right.
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
    # The projector loses the direction of a limit that enters, and gains that of one that
    # leaves; both make the pseudo-inverse orthogonal to it.
    entering = torch.cat([z, lost - enters.to(c.dtype)], dim=-1)
    exiting = torch.cat([-v, _combine(v, now.operators[..., p:])], dim=-1)
    turn = scale * torch.where(adds, entering, exiting)
    share = now.share + length
    return _Step(
        y=now.y - torch.where(independent, length, 0.0) * z,
        dual=torch.where(
            enters, share, torch.where(leaves, 0.0, (now.dual - length * lost).clamp(min=0))
        ),
        side=torch.where(enters, side, torch.where(leaves, 0.0, now.side)),
        operators=now.operators - direction.unsqueeze(-1) * turn.unsqueeze(-2),
        pending=drops,
        index=index,
        share=torch.where(drops, share, 0.0),
    )


def _combine(weights: Tensor, rows: Tensor) -> Tensor:
    """Sum of the rows of a matrix, weighted."""
    return (weights.unsqueeze(-1) * rows).sum(-2)


def _column(matrix: Tensor, index: Tensor) -> Tensor:
    shape = (*matrix.shape[:-1], 1)
    return matrix.gather(-1, index.unsqueeze(-2).expand(shape)).squeeze(-1)
