"""Motions on ragged time grids: each element of a batch has its own duration or timestamps.

On one shared grid, a batch is one product with a response matrix. On many grids, each motion
would need such a matrix, with N + 3 numbers per sample. Here the polynomials of the response
are multiplied by the coordinates first. The result is a piecewise polynomial per column, whose
value at any time is a sum of a few coefficients weighted by powers.

This sum is linear in the coordinates, and its time derivative is a sum of the same form. Two
functions, `_motion` and `_adjoint`, therefore compute motions, gradients with respect to
coordinates, and derivatives of both of any order.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hrc_learn.dmp._arguments import refuse_nested_forward
from hrc_learn.dmp.dynamics import approach_curve
from hrc_learn.dmp.response import (
    Response,
    chebyshev_points,
    empty_in_large_pages,
    powers_of,
    without_subnormals,
)

NEGLIGIBLE = 4
"""Error allowed when the degree of polynomials is reduced, in machine epsilons relative to the
largest value of a column. The rounding error of a sum of fifty products is as large."""
CHUNK = {"cpu": 2**16, "cuda": 2**22}
"""Samples processed at a time. On a CPU, their indices and powers fit the cache, which halves
the time for a million samples; on a GPU, they keep all cores busy in less than a gigabyte."""
LONG = 2**14
"""Longest shared time grid, in samples, for which response matrices are used. On longer grids,
the matrices would cost more memory and time than the polynomials, if there are few columns."""


def motion(
    response: Response, s: Float[Tensor, "B T"], coordinates: Float[Tensor, "B D M"], order: int
) -> Float[Tensor, "B T D"]:
    """Motion or a derivative of it on ragged times; differentiable in times and coordinates.

    Args:
        response: Response of the primitive.
        s: Normalised times, >= 0 (float64).
        coordinates: Coordinates of each column, as `Response` defines them.
        order: 0 for y itself, 1 for y', and so on.

    Raises:
        NotImplementedError: Two nested forward derivatives (`refuse_nested_forward`).
    """
    if torch.compiler.is_compiling():
        # Plain operations, which a compiler fuses.
        table = _table(response, order, coordinates)
        piece, powers = table.locate(s, coordinates.dtype)
        rows = _rows(table, coordinates)
        index = piece.long()[..., None, None].expand(-1, -1, *rows.shape[2:])
        return (rows.gather(1, index) * powers[..., None]).sum(-2)
    refuse_nested_forward(s)
    result: Any = _Linear.apply(s, coordinates, response, order, False)
    return result


@dataclass(frozen=True, eq=False)
class CoefficientTable:
    """Map from coordinates to the coefficients of a motion, or of one of its derivatives.

    Each piece has K coefficients: of the powers 1, u, u^2 ... with u from -1 to 1 along the
    piece, and of functions of time that are not polynomial. One more piece covers all times
    after the forcing. The state at the end of the forcing, relative to the goal, decays there
    like the unforced spring.
    """

    response: Response
    order: int
    """Order of the derivative."""
    matrix: Float[Tensor, "M rows"]
    """Maps coordinates to the coefficients of all pieces, one piece after another."""
    size: int
    """K, the number of coefficients of a piece."""
    others: int
    """Number of functions that are not polynomial."""

    @property
    def pieces(self) -> int:
        """Number of pieces, the one after the end included."""
        return self.matrix.shape[1] // self.size

    def locate(
        self, s: Float[Tensor, "B T"], dtype: torch.dtype
    ) -> tuple[Int[Tensor, "B T"], Float[Tensor, "B T K"]]:
        """Piece that contains each time, and values that multiply its K coefficients there."""
        forced = self.response.forced
        pieces, periodic = len(forced.coefficients), forced.periodic
        x = s / forced.interval
        x = x % pieces if periodic else x.clamp(0, pieces)
        piece = x.detach().to(torch.int32)
        if periodic:  # the remainder may round up to the divisor
            piece = piece.clamp(max=pieces - 1)
        u = 2 * (x - piece if periodic else x.frac()).to(dtype) - 1
        degree, others = self.size - self.others, []
        if periodic:
            others = spring_rows(self.response, s, self.order).to(dtype).unbind(-1)
        elif self.others:
            others = [approach_curve(s, self.response.approach, self.order).to(dtype)]
        powers = powers_of(u, degree, others)
        if periodic or not (torch.compiler.is_compiling() or piece.max() == pieces):
            return piece, powers
        back = spring_rows(self.response, (s - forced.end).clamp(min=0), self.order)
        # The third value multiplies the goal.
        back = torch.nn.functional.pad(back, (0, 1), value=float(self.order == 0)).to(dtype)
        back = torch.nn.functional.pad(back, (0, degree - back.shape[-1]))
        back = torch.cat([back, powers[..., degree:]], dim=-1)
        return piece, torch.where((piece == pieces)[..., None], back, powers)


def spring_rows(response: Response, s: Tensor, order: int) -> Float[Tensor, "*batch 2"]:
    """First row of exp(A s) A^order: maps (y - g, y') at 0 to the derivative of y at `s`."""
    spring = response.spring
    C, S = spring.modes(s, torch)
    first, second = C + S * (spring.alpha / 2), S
    for _ in range(order):
        first, second = -spring.stiffness * second, first - spring.alpha * second
    return torch.stack([first, second], dim=-1)


def _table(response: Response, order: int, like: Tensor) -> CoefficientTable:
    """Table of one order in the dtype and on the device of `like`, cached."""
    key = "ragged times", order, like.dtype, like.device
    if key not in response.tables:
        if torch.compiler.is_compiling():
            # A table made while a program is traced cannot be kept, so each call makes it.
            return _tabulate(response, *key[1:])
        with torch.inference_mode(False), torch.no_grad():
            response.tables[key] = _tabulate(response, *key[1:])
    return response.tables[key]


def _tabulate(
    response: Response, order: int, dtype: torch.dtype, device: torch.device
) -> CoefficientTable:
    forced, N = response.forced, response.basis.count
    row = forced.coefficients[:, :, min(order, 1)]
    knots = torch.arange(len(row), dtype=row.dtype)[:, None]
    points = forced.interval * (knots + chebyshev_points())
    # An approach that ends where a piece ends is a polynomial on each piece.
    pieces = response.approach / forced.interval
    on_pieces = 0 < pieces < len(row) + 1e-9 and abs(pieces - round(pieces)) < 1e-9
    if on_pieces:
        curve = approach_curve(points, response.approach, min(order, 1))[..., None, None]
        curve = forced.interpolate(curve, forced.interval).coefficients[..., 0, :]
        row = torch.cat([row, curve], dim=-1)
    for _ in range(order - 1):
        # The table of y' is as exact as the table of y, so differentiate y' for higher orders.
        exponents = torch.arange(row.shape[1], dtype=row.dtype, device=row.device)
        row = row * (2 / forced.interval * exponents)[:, None]
        row = torch.nn.functional.pad(row[:, 1:], (0, 0, 0, 1))
    free = spring_rows(response, points, order)
    free = forced.interpolate(free[..., None, :], forced.interval).coefficients[..., 0, :]
    goal = torch.zeros_like(row[..., :1])
    goal[:, 0] = float(order == 0)
    rate, start = free[..., 1:], free[..., :1]
    if on_pieces:
        row, start = row[..., :N], -row[..., N:]
    others = row.new_zeros(N + 3, 2)
    if forced.periodic:
        # The motion is the limit cycle plus the initial distance to it, which decays.
        others[:N] = -forced(row.new_zeros(())).mT
        others[N, 1] = others[N + 1, 0] = 1.0
        others[N + 2, 0] = -1.0
        coefficients = torch.cat([row, 0 * free, goal], dim=-1)
    else:
        others = others[:, : int(pieces > 0 and not on_pieces)]
        if others.numel():
            start = torch.zeros_like(start)
            others[N + 1], others[N + 2] = -1.0, 1.0
        coefficients = torch.cat([row, rate, start, goal - start], dim=-1)
        # One more piece: the state at the end, relative to the goal, and the goal.
        after = torch.zeros_like(coefficients[:1])
        after[0, :2] = response.state(row.new_tensor(forced.end))
        after[0, 0, -1] -= 1.0
        if response.approach:
            after[0, :2, N + 1 :] = 0.0
        after[0, 2, -1] = 1.0
        coefficients = torch.cat([coefficients, after])
    if not torch.compiler.is_compiling():
        coefficients = _lowest_degree(coefficients, NEGLIGIBLE * torch.finfo(dtype).eps)
    coefficients = torch.cat([coefficients, others.mT.expand(len(coefficients), -1, -1)], dim=1)
    matrix = without_subnormals(coefficients.flatten(0, 1).mT.to(device, dtype)).contiguous()
    return CoefficientTable(response, order, matrix, coefficients.shape[1], others.shape[1])


def _lowest_degree(
    coefficients: Float[Tensor, "pieces P M"], tolerance: float
) -> Float[Tensor, "pieces K M"]:
    """Polynomials of the lowest degree within a tolerance, relative to the largest value."""
    k = torch.arange(coefficients.shape[1]).to(coefficients)
    angle = torch.pi * (k[:, None] + 0.5) / len(k)
    # In Chebyshev polynomials, the sum of the last coefficients bounds the error of omitting
    # them.
    powers, chebyshev = torch.cos(angle) ** k, torch.cos(angle * k)
    terms = torch.linalg.solve(chebyshev, powers) @ coefficients
    rest = terms.abs().flip(1).cumsum(1).flip(1).amax(0)
    needed = max(int((rest > tolerance * rest[0]).any(-1).sum()), 3)
    return torch.linalg.solve(powers, chebyshev)[:needed, :needed] @ terms[:, :needed]


def _rows(
    table: CoefficientTable, coordinates: Float[Tensor, "B D M"], pieces: int | None = None
) -> Float[Tensor, "B pieces K D"]:
    """Coefficients of each motion, on the first `pieces` pieces; None: on all."""
    B, D, _ = coordinates.shape
    matrix = table.matrix if pieces is None else table.matrix[:, : pieces * table.size]
    # In this order of products, the coefficients of a piece are neighbours in memory.
    rows = torch.bmm(matrix.mT.expand(B, -1, -1), coordinates.mT)
    return rows.view(B, -1, table.size, D)


def _flat_pieces(piece: Int[Tensor, "B T"]) -> tuple[Int[Tensor, "BT"], int]:
    """Piece numbers over the whole batch, and the number of pieces per motion.

    Pieces after the latest time are left out; these are often a quarter of all pieces.
    """
    pieces = int(piece.max()) + 1
    first = torch.arange(len(piece), dtype=piece.dtype, device=piece.device)
    return (piece + pieces * first[:, None]).view(-1), pieces


def power_by_power(
    rows: Float[Tensor, "B pieces K D"], flat: Int[Tensor, "BT"], powers: Float[Tensor, "B T K"]
) -> Float[Tensor, "B T D"]:
    """Sum of rows weighted by powers, 2.6 times as fast as `embedding_bag` on a GPU (H200).

    Args:
        rows: Coefficients of each motion.
        flat: Piece numbers over the whole batch.
        powers: Values that multiply the coefficients.
    """
    (B, T, K), D = powers.shape, rows.shape[-1]
    terms = rows.movedim(2, 0).reshape(K, -1, D)
    y = terms[0].index_select(0, flat) * powers[..., 0].view(-1, 1)
    for k in range(1, K):
        y.addcmul_(terms[k].index_select(0, flat), powers[..., k].view(-1, 1))
    return y.view(B, T, D)


def blocks(s: Float[Tensor, "B T"], most: int) -> Iterator[tuple[slice, slice]]:
    """Slices of the batch and of time with at most `most` samples each."""
    for part in chunks(s, most):
        for first in range(0, s.shape[1], most):
            yield part, slice(first, first + most)


def chunks(s: Float[Tensor, "B T"], most: int | None = None) -> Iterator[slice]:
    """Slices of the batch with about `most` samples each (None: `CHUNK`).

    There are no slices if there are no samples.
    """
    most = most or CHUNK.get(s.device.type, CHUNK["cpu"])
    size = max(1, most // max(s.shape[1], 1))
    return (slice(i, i + size) for i in range(0, s.shape[0] if s.numel() else 0, size))


def _motion(s: Tensor, coordinates: Tensor, response: Response, order: int) -> Tensor:
    """`motion` in one pass over the samples."""
    table = _table(response, order, coordinates)
    B, D, _ = coordinates.shape
    y, bags = empty_in_large_pages(coordinates, B, s.shape[1], D), None
    for part in chunks(s):
        x = coordinates[part]
        piece, powers = table.locate(s[part], x.dtype)
        flat, pieces = _flat_pieces(piece)
        rows = _rows(table, x, pieces)
        if x.is_cpu and bags is None:
            # A table of indices: computing them for each sample would take twice as long.
            count = len(x) * table.pieces * table.size
            bags = torch.arange(count, dtype=torch.int32).view(-1, table.size)
        if bags is None:
            values = power_by_power(rows, flat, powers)
        else:
            # A weighted sum of rows per sample: the only operation that does not write
            # the gathered rows to memory first.
            values = torch.nn.functional.embedding_bag(
                bags.index_select(0, flat),
                rows.view(-1, D),
                mode="sum",
                per_sample_weights=powers.view(-1, table.size),
            ).view(len(x), -1, D)
        if len(x) == B:
            return values
        y[part] = values
    return y


def _adjoint(s: Tensor, grad: Tensor, response: Response, order: int) -> Tensor:
    """Gradient with respect to coordinates, from the gradient with respect to the motion."""
    table = _table(response, order, grad)
    B, _, D = grad.shape
    by_x = grad.new_zeros(B, D, len(table.matrix))
    for part in chunks(s):
        g = grad[part]
        piece, powers = table.locate(s[part], g.dtype)
        (flat, pieces), powers = _flat_pieces(piece), powers.view(-1, table.size)
        # The samples of each piece form one bag.
        rising = bool((flat[1:] >= flat[:-1]).all())
        sample = torch.arange(len(flat), device=s.device) if rising else flat.argsort()
        counts = torch.bincount(flat, minlength=len(g) * pieces)
        sums = [
            torch.nn.functional.embedding_bag(
                sample,
                g.reshape(-1, D),
                counts.cumsum(0) - counts,
                mode="sum",
                per_sample_weights=power.contiguous() if rising else power[sample],
            )
            for power in powers.unbind(-1)
        ]
        rows = torch.stack(sums, dim=-1).view(len(g), -1, D, table.size).movedim(2, 1)
        rows = rows.reshape(len(g) * D, -1)
        matrix = table.matrix[:, : rows.shape[-1]]
        by_x[part] = (rows @ matrix.mT).view(len(g), D, -1)
    return by_x


class _Linear(torch.autograd.Function):
    """`_motion` or `_adjoint`: each is linear in `values`, and each is the other's adjoint."""

    @staticmethod
    def forward(s, values, response, order, adjoint):
        return (_adjoint if adjoint else _motion)(s, values, response, order)

    @staticmethod
    def setup_context(ctx, inputs, output):
        s, values, *ctx.others = inputs
        ctx.save_for_backward(s, values)
        ctx.save_for_forward(s, values)

    @staticmethod
    def backward(ctx, grad):
        (s, values), (response, order, adjoint) = ctx.saved_tensors, ctx.others
        by_s = by_values = None
        if ctx.needs_input_grad[0]:
            by_motion, coordinates = (values, grad) if adjoint else (grad, values)
            rate: Any = _Linear.apply(s, coordinates, response, order + 1, False)
            by_s = (by_motion * rate).sum(-1).to(s.dtype)
        if ctx.needs_input_grad[1]:
            by_values = _Linear.apply(s, grad, response, order, not adjoint)
        return by_s, by_values, None, None, None

    @staticmethod
    def jvp(ctx, ds, dvalues, *_):
        (s, values), (response, order, adjoint) = ctx.saved_tensors, ctx.others
        change = 0.0
        if dvalues is not None:
            change = _Linear.apply(s, dvalues, response, order, adjoint)
        if ds is not None:
            ds = ds.to(values)[..., None]
            moved = values * ds if adjoint else values
            rate: Any = _Linear.apply(s, moved, response, order + 1, adjoint)
            change = change + (rate if adjoint else rate * ds)
        return change

    @staticmethod
    def vmap(info, in_dims, s, values, *others):
        # The mapped axis is merged with the batch axis.
        s, values = (
            x.expand(info.batch_size, *x.shape) if dim is None else x.movedim(dim, 0)
            for x, dim in zip((s, values), in_dims, strict=False)
        )
        result: Any = _Linear.apply(s.flatten(0, 1), values.flatten(0, 1), *others)
        return result.unflatten(0, s.shape[:2]), 0
