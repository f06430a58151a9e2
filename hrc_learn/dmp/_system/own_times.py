"""Motions at times of their own: each of a batch another duration, or other timestamps.

On one time grid a batch is one product with a matrix of responses. On many grids that matrix
would be another one for each motion, fifty times as large as the motion. Here the polynomials
of the response are multiplied by the coordinates first: what is left is a piecewise polynomial
for each column, whose value at any time is a sum of a few rows weighted by powers.

That is linear in the coordinates, and its derivative by time is the motion of the next order.
So a motion, its adjoint, and the derivatives of both of any order are the same two functions.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hrc_learn.dmp._system.products import in_large_pages, product, without_subnormals

if TYPE_CHECKING:
    from hrc_learn.dmp._system.response import Response

NEGLIGIBLE = 4
"""Epsilons of a dtype, relative to the largest value of a column, by which polynomials of a
lower degree may differ: a sum of fifty products rounds off as much."""
UNSEEN = 1e-9
"""Likewise, of columns whose products are solved for weights: what is left of it in a motion is
well below what the response itself is exact to."""
MOST_TERMS = 20
"""Of a Chebyshev series on a piece: a few dozen samples on each, fitted the fastest."""
AT_ONCE = {"cpu": 2**16, "cuda": 2**22}
"""Samples by device: whose indices and powers a core keeps in its cache, where a million takes
twice as long; that keep a GPU busy within a gigabyte."""


def motion(
    response: "Response",
    s: Float[Tensor, "B T"],
    coordinates: Float[Tensor, "B D M"],
    order: int,
) -> Float[Tensor, "B T D"]:
    """A derivative of y by s at times of its own; differentiable in times and coordinates.

    Args:
        response: Of the primitive.
        s: Normalised times, >= 0 (float64).
        coordinates: As `Response` takes them.
        order: 0 for y itself, 1 for y', and so on.
    """
    if torch.compiler.is_compiling():
        return _gathered(_table(response, order, coordinates), s, coordinates)
    return _Motion.apply(s, coordinates, response, order)  # pyright: ignore[reportReturnType]


@dataclass(frozen=True, eq=False)
class OwnTimesTable:
    """Coordinates to the coefficients of a motion, or of one of its derivatives by s.

    Piece p has K coefficients, of 1, u, u^2 ... with u from -1 to 1 along it. Where the
    forcing ends, one more piece stands for all times after that: there the state at its end,
    seen from the goal, goes back as the unforced spring has it.
    """

    response: "Response"
    order: int
    """Of the derivative."""
    matrix: Float[Tensor, "M rows"]
    """To the coefficients of all pieces, in turn."""
    size: int
    """K."""
    others: Float[Tensor, "M extra"] | None
    """To what is multiplied by functions that are no polynomials on a piece; see `extra`."""

    @property
    def pieces(self) -> int:
        """Pieces of a motion, that after the end among them."""
        return self.matrix.shape[1] // self.size

    def place(
        self, s: Float[Tensor, "B T"], dtype: torch.dtype
    ) -> tuple[Int[Tensor, "B T"], Float[Tensor, "B T K"]]:
        """The piece that each time lies on, and what its coefficients are multiplied by."""
        forced = self.response.forced
        pieces, periodic = len(forced.coefficients), forced.periodic
        x = s / forced.interval
        x = x % pieces if periodic else x.clamp(0, pieces)
        piece = x.detach().to(torch.int32)
        if periodic:  # a remainder may round up to what it is taken of
            piece = piece.clamp(max=pieces - 1)
        u = 2 * (x - piece if periodic else x.frac()).to(dtype) - 1
        powers = u.new_ones(*s.shape, self.size)
        # Column by column: along rows of six a product takes more than twice as long. Written
        # where they belong, unless something derives or traces.
        in_place = not (torch.compiler.is_compiling() or u.requires_grad)
        for k in range(1, self.size):
            if in_place:
                torch.mul(powers[..., k - 1], u, out=powers[..., k])
            else:
                powers[..., k] = powers[..., k - 1] * u
        if periodic or not (torch.compiler.is_compiling() or piece.max() == pieces):
            return piece, powers
        back = spring_rows(self.response, (s - forced.end).clamp(min=0), self.order)
        goal = torch.full_like(s, float(self.order == 0))[..., None]
        back = torch.cat([back, goal], dim=-1).to(dtype)
        back = torch.nn.functional.pad(back, (0, self.size - back.shape[-1]))
        return piece, torch.where((piece == pieces)[..., None], back, powers)

    def extra(self, s: Float[Tensor, "B T"], dtype: torch.dtype) -> Float[Tensor, "B T extra"]:
        """What the columns of `others` are multiplied by."""
        if self.response.forced.periodic:
            return spring_rows(self.response, s, self.order).to(dtype)
        return _approach(s, self.response.approach, self.order).to(dtype)[..., None]


def spring_rows(response: "Response", s: Tensor, order: int) -> Float[Tensor, "*batch 2"]:
    """The row of exp(A s) A^order that gives y of (y - g, y') at s = 0."""
    spring = response.spring
    C, S = spring.modes(s, torch)
    first, second = C + S * (spring.alpha / 2), S
    for _ in range(order):
        first, second = -spring.stiffness * second, first - spring.alpha * second
    return torch.stack([first, second], dim=-1)


def _approach(s: Tensor, share: float, order: int) -> Tensor:
    """m(s) - 1 of the minimum-jerk curve of an approach, or a derivative of it by s."""
    # Of numbers alone: a compiler does not look into NumPy's polynomials.
    coefficients = [-1.0, 0.0, 0.0, 10.0, -15.0, 6.0]
    for _ in range(order):
        coefficients = [k * c for k, c in enumerate(coefficients)][1:]
    u = (s / share).clamp(0, 1)
    value = torch.zeros_like(u)
    for c in reversed(coefficients):
        value = value * u + c
    return torch.where((s < share) | (order == 0), value / share**order, 0.0)


def _table(response: "Response", order: int, like: Tensor) -> OwnTimesTable:
    """The table of one order, in dtype and on the device of `like`; made once."""
    key = order, like.dtype, like.device
    if key not in response.own_times:
        if torch.compiler.is_compiling():
            # What is made while a program is traced cannot be kept: it makes it every time.
            return _tabulate(response, *key)
        with torch.inference_mode(False), torch.no_grad():
            response.own_times[key] = _tabulate(response, *key)
    return response.own_times[key]


def _tabulate(
    response: "Response", order: int, dtype: torch.dtype, device: torch.device
) -> OwnTimesTable:
    forced, N = response.forced, response.basis.count
    row = forced.coefficients[:, :, min(order, 1)]
    for _ in range(order - 1):
        # F' is as exact as F is: so that is differentiated, not F.
        exponents = torch.arange(row.shape[1], dtype=row.dtype, device=row.device)
        row = row * (2 / forced.interval * exponents)[:, None]
        row = torch.nn.functional.pad(row[:, 1:], (0, 0, 0, 1))
    free, goal = _spring_pieces(response, order), torch.zeros_like(row[..., :1])
    goal[:, 0] = float(order == 0)
    rate, start = free[..., 1:], free[..., :1]
    others = row.new_zeros(N + 3, 2)
    if forced.periodic:
        # The motion is the limit cycle, and what it takes to be off it at first dies out.
        others[:N] = -forced(0.0).mT
        others[N, 1] = others[N + 1, 0] = 1.0
        others[N + 2, 0] = -1.0
        coefficients = torch.cat([row, 0 * free, goal], dim=-1)
    else:
        if response.approach:
            start = torch.zeros_like(start)
            others = others[:, :1]
            others[N + 1], others[N + 2] = -1.0, 1.0
        coefficients = torch.cat([row, rate, start, goal - start], dim=-1)
        E = response.spring.propagator(forced.end).to(row)
        after = torch.zeros_like(coefficients[:1])
        after[0, :2, :N] = forced(forced.end)
        after[0, :2, N] = E[:, 1]
        if not response.approach:
            after[0, :2, N + 1], after[0, :2, N + 2] = E[:, 0], -E[:, 0]
        after[0, 2, N + 2] = 1.0
        coefficients = torch.cat([coefficients, after])
    if not torch.compiler.is_compiling():
        coefficients = _of_least_degree(coefficients, NEGLIGIBLE * torch.finfo(dtype).eps)
    matrix = without_subnormals(coefficients.flatten(0, 1).mT.to(device, dtype)).contiguous()
    needed = forced.periodic or response.approach
    return OwnTimesTable(
        response,
        order,
        matrix,
        coefficients.shape[1],
        others.to(device, dtype) if needed else None,
    )


@dataclass(frozen=True, eq=False)
class ColumnPieces:
    """Columns H(s) mixing along the motion, as Chebyshev series on pieces of one length."""

    interval: float
    coefficients: Float[Tensor, "P K n"]
    table: Float[Tensor, "P_moments pairs"] | None
    """What the sums of T_0 ... T_2K-2 over the samples of each piece add to H'H, one half of
    it; None if that took more memory than `MOST_IN_TABLE`."""

    @classmethod
    def of(cls, response: "Response", mixing: Float[Tensor, "M n"]) -> "ColumnPieces":
        """As few pieces as series of `MOST_TERMS` can do with, from s = 0 to 1.

        Args:
            response: Without approach, of a basis that is not periodic.
            mixing: What coordinates each column stands for.
        """
        angle = torch.pi * torch.arange(4 * MOST_TERMS + 1).to(mixing) / (4 * MOST_TERMS)
        series = torch.cos(angle[:, None] * torch.arange(MOST_TERMS).to(mixing))
        fit = torch.linalg.pinv(series)
        for merged in (8, 4, 2, 1):
            # Of whole pieces of the forcing: a spline has its knots between them.
            interval = merged * response.forced.interval
            knots = interval * torch.arange(math.ceil(1 / interval - 1e-9)).to(mixing)
            s = knots[:, None] + interval * (1 + torch.cos(angle)) / 2
            values = response.evaluate(s)[..., 0, :] @ mixing
            coefficients, size = fit @ values, values.abs().amax((0, 1))
            off = (series @ coefficients - values).abs().amax((0, 1))
            if merged == 1 or (off <= UNSEEN * size).all():
                break
        # What terms leave out is at most the sum of their coefficients.
        left = coefficients.abs().flip(1).cumsum(1).flip(1).amax(0)
        terms = int((left > UNSEEN * size).any(-1).sum())
        coefficients = coefficients[:, :terms].contiguous()
        return cls(interval, coefficients, _moments_to_gram(coefficients))

    def products(
        self,
        s: Float[Tensor, "B T"],
        y: Float[Tensor, "B D T"],
        mask: Float[Tensor, "B T"],
    ) -> tuple[Float[Tensor, "B n n"], Float[Tensor, "B n D"]]:
        """H'H and H'y of the columns, over the samples that count (float64).

        No H is made: sums over the samples of a piece, of Chebyshev polynomials T_k up to
        twice the degree, say all about them, for T_i T_j = (T_i+j + T_|i-j|) / 2.

        Args:
            s: Normalised times from 0 to 1, never falling.
            y: Samples.
            mask: 1 where one counts, 0 elsewhere.
        """
        (P, K, n), D = self.coefficients.shape, y.shape[1]
        edges = torch.arange(P + 1, dtype=s.dtype, device=s.device)
        # Samples at the very end belong to the last piece.
        edges[-1] = math.inf
        moments, right = s.new_empty(len(s), P, 2 * K - 1), s.new_empty(len(s), n, D)
        flat = self.coefficients.reshape(P * K, n).mT
        for part in _parts(s):
            x, B = s[part] / self.interval, len(s[part])
            first = torch.searchsorted(x.contiguous(), edges.expand(B, -1).contiguous())
            most = int(first.diff(dim=-1).amax())
            index = first[:, :-1, None] + torch.arange(most, device=s.device)
            there = index < first[:, 1:, None]
            index = index.clamp(max=s.shape[1] - 1).flatten(1)
            u = 2 * (x.gather(1, index).view(B, P, most) - edges[:P, None]) - 1
            rows = s.new_empty(B, P, K, most)
            rows[:, :, 0] = mask[part].gather(1, index).view(B, P, most) * there
            torch.mul(rows[:, :, 0], u, out=rows[:, :, 1])
            u = 2 * u
            for k in range(2, K):
                torch.mul(u, rows[:, :, k - 1], out=rows[:, :, k])
                rows[:, :, k] -= rows[:, :, k - 2]
            # Beside the samples, 1 and the highest polynomial: that one gives the other half.
            others = s.new_empty(B, P, D + 2, most)
            samples = y[part].gather(2, index[:, None].expand(-1, D, -1))
            others[:, :, :D] = samples.view(B, D, P, most).transpose(1, 2)
            others[:, :, D] = rows[:, :, 0]
            others[:, :, D + 1] = rows[:, :, -1]
            sums = rows @ others.mT
            moments[part, :, :K] = sums[..., D]
            moments[part, :, K - 1 :] = 2 * sums[..., D + 1] - sums[..., D].flip(-1)
            outer = sums[..., :D].permute(1, 2, 0, 3).reshape(P * K, B * D)
            right[part] = (flat @ outer).view(n, B, D).movedim(1, 0)
        return self._gram(moments), right

    def _gram(self, moments: Float[Tensor, "B P moments"]) -> Float[Tensor, "B n n"]:
        """H'H from the sums of Chebyshev polynomials."""
        (P, K, n), B = self.coefficients.shape, len(moments)
        if self.table is not None:
            i, j = torch.triu_indices(n, n, device=moments.device)
            half = torch.empty(n, n, dtype=torch.long, device=moments.device)
            half[i, j] = half[j, i] = torch.arange(len(i), device=moments.device)
            return (moments.flatten(1) @ self.table)[:, half]
        k = torch.arange(K, device=moments.device)
        sums = (moments[..., k + k[:, None]] + moments[..., (k - k[:, None]).abs()]) / 2
        # Of series times series, in an order that leaves one flat product.
        inner = sums.permute(1, 2, 0, 3).reshape(P, K * B, K) @ self.coefficients
        flat = self.coefficients.reshape(P * K, n).mT
        return (flat @ inner.view(P * K, B * n)).view(n, B, n).movedim(1, 0)


MOST_IN_TABLE = 2**22
"""Entries of a `ColumnPieces.table`, 32 MB: 50 functions take 1.3 million, 100 take ten."""


def _moments_to_gram(
    coefficients: Float[Tensor, "P K n"],
) -> Float[Tensor, "P_moments pairs"] | None:
    """`ColumnPieces.table` of series."""
    P, K, n = coefficients.shape
    i, j = torch.triu_indices(n, n, device=coefficients.device)
    if P * (2 * K - 1) * len(i) > MOST_IN_TABLE:
        return None
    table = coefficients.new_zeros(P, 2 * K - 1, len(i))
    right, k = coefficients[..., j], torch.arange(K, device=coefficients.device)
    for degree in range(K):
        halves = coefficients[:, degree, None, i] * right / 2
        table[:, degree : degree + K] += halves
        table.index_add_(1, (k - degree).abs(), halves)
    return table.flatten(0, 1)


def _spring_pieces(response: "Response", order: int) -> Float[Tensor, "pieces P 2"]:
    """Coefficients of `spring_rows` on the pieces of the forcing."""
    forced = response.forced
    u = forced.points.to(forced.coefficients)
    knots = torch.arange(len(forced.coefficients), dtype=u.dtype, device=u.device)
    values = spring_rows(response, forced.interval * (knots[:, None] + u), order)
    return forced.interpolate(values[..., None, :], forced.interval).coefficients[..., 0, :]


def _of_least_degree(
    coefficients: Float[Tensor, "pieces P M"], tolerance: float
) -> Float[Tensor, "pieces K M"]:
    """Polynomials of the lowest degree that differ by no more than a share of the largest."""
    P = coefficients.shape[1]
    exponents = torch.arange(P, device=coefficients.device)
    watched = torch.linspace(-1, 1, 4 * P).to(coefficients)[:, None] ** exponents
    size = (watched @ coefficients).abs().amax((0, 1))
    for degree in range(2, P - 1):
        k = torch.arange(degree + 1).to(coefficients)
        u = -torch.cos(torch.pi * k / degree)[:, None]
        # The polynomial through its Chebyshev points, the ends among them.
        lower = torch.linalg.solve(u ** exponents[: degree + 1], u**exponents)
        lower = torch.nn.functional.pad(lower, (0, 0, 0, P - degree - 1))
        off = (watched @ (lower @ coefficients - coefficients)).abs().amax((0, 1))
        if (off <= tolerance * size).all():
            return (lower @ coefficients)[:, : degree + 1]
    return coefficients


def _rows(
    table: OwnTimesTable, coordinates: Float[Tensor, "B D M"], pieces: int | None = None
) -> Tensor:
    """Coefficients of each motion, (B, pieces, K, D), of the first pieces or of all."""
    B, D, _ = coordinates.shape
    matrix = table.matrix if pieces is None else table.matrix[:, : pieces * table.size]
    rows = product(coordinates, matrix)
    return rows.view(B, D, -1, table.size).permute(0, 2, 3, 1)


def _in_turn(piece: Int[Tensor, "B T"]) -> tuple[Int[Tensor, "BT"], int]:
    """Pieces of a batch of motions, those of one after those of another, and how many each.

    Those past the latest that a time lies on are left out: often they are a quarter.
    """
    pieces = int(piece.max()) + 1
    first = torch.arange(len(piece), dtype=piece.dtype, device=piece.device)
    return (piece + pieces * first[:, None]).view(-1), pieces


def power_by_power(
    rows: Float[Tensor, "B pieces K D"], flat: Int[Tensor, "BT"], powers: Float[Tensor, "B T K"]
) -> Float[Tensor, "B T D"]:
    """Sums of rows weighted by powers: 2.6 times as fast as bags of them on a GPU (H200).

    Args:
        rows: Coefficients of each motion.
        flat: Pieces, those of one motion after those of another.
        powers: What the coefficients are multiplied by.
    """
    (B, T, K), D = powers.shape, rows.shape[-1]
    terms = rows.movedim(2, 0).reshape(K, -1, D)
    y = terms[0].index_select(0, flat) * powers[..., 0].view(-1, 1)
    for k in range(1, K):
        y.addcmul_(terms[k].index_select(0, flat), powers[..., k].view(-1, 1))
    return y.view(B, T, D)


def _gathered(table: OwnTimesTable, s: Tensor, coordinates: Tensor) -> Float[Tensor, "B T D"]:
    """`motion` of plain operations, as a compiler joins them."""
    piece, powers = table.place(s, coordinates.dtype)
    rows = _rows(table, coordinates)
    index = piece.long()[..., None, None].expand(-1, -1, *rows.shape[2:])
    y = (rows.gather(1, index) * powers[..., None]).sum(-2)
    if table.others is not None:
        y = y + table.extra(s, y.dtype) @ (coordinates @ table.others).mT
    return y


def _parts(s: Float[Tensor, "B T"]) -> Iterator[slice]:
    """The batch in parts of `AT_ONCE` samples."""
    most = AT_ONCE.get(s.device.type, AT_ONCE["cpu"])
    size = max(1, most // max(s.shape[1], 1))
    return (slice(i, i + size) for i in range(0, s.shape[0], size))


class _Motion(torch.autograd.Function):
    """`motion` in one pass over the samples."""

    @staticmethod
    def forward(s, coordinates, response, order):
        table = _table(response, order, coordinates)
        B, D, _ = coordinates.shape
        y = in_large_pages(coordinates, B, s.shape[1], D)
        bags = None
        for part in _parts(s):
            x = coordinates[part]
            piece, powers = table.place(s[part], y.dtype)
            flat, pieces = _in_turn(piece)
            rows = _rows(table, x, pieces)
            if y.is_cpu and bags is None:
                # Looked up: to add up the indices of each sample takes twice as long.
                count = len(x) * table.pieces * table.size
                bags = torch.arange(count, dtype=torch.int32).view(-1, table.size)
            if bags is None:
                y[part] = power_by_power(rows, flat, powers)
            else:
                # A weighted sum of rows for each sample: the one operation that does not write
                # the rows down first.
                y[part] = torch.nn.functional.embedding_bag(
                    bags.index_select(0, flat),
                    rows.contiguous().view(-1, D),
                    mode="sum",
                    per_sample_weights=powers.view(-1, table.size),
                ).view(len(x), -1, D)
            if table.others is not None:
                y[part] += table.extra(s[part], y.dtype) @ (x @ table.others).mT
        return y

    @staticmethod
    def setup_context(ctx, inputs, output):
        s, coordinates, ctx.response, ctx.order = inputs
        ctx.save_for_backward(s, coordinates)
        ctx.save_for_forward(s, coordinates)

    @staticmethod
    def backward(ctx, grad):
        s, x = ctx.saved_tensors
        by_s = by_x = None
        if _wanted(ctx, 0):
            by_s = _along(grad, _Motion.apply(s, x, ctx.response, ctx.order + 1), s)
        if _wanted(ctx, 1):
            by_x = _Adjoint.apply(s, grad, ctx.response, ctx.order)
        return by_s, by_x, None, None

    @staticmethod
    def jvp(ctx, ds, dx, *_):
        s, x = ctx.saved_tensors
        change = 0.0
        if dx is not None:
            change = _Motion.apply(s, dx, ctx.response, ctx.order)
        if ds is not None:
            rate = _Motion.apply(s, x, ctx.response, ctx.order + 1)
            change = change + rate * ds.to(rate)[..., None]
        return change

    @staticmethod
    def vmap(info, in_dims, s, coordinates, response, order):
        return _batched(_Motion, info, in_dims, s, coordinates, response, order)


class _Adjoint(torch.autograd.Function):
    """Gradient of `_Motion` by its coordinates, which is linear in that by the motion."""

    @staticmethod
    def forward(s, grad, response, order):
        table = _table(response, order, grad)
        B, _, D = grad.shape
        by_x = grad.new_empty(B, D, len(table.matrix))
        for part in _parts(s):
            g = grad[part]
            piece, powers = table.place(s[part], g.dtype)
            (flat, pieces), powers = _in_turn(piece), powers.view(-1, table.size)
            # Sums over the samples of each piece are bags of them, one beside the other.
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
            if table.others is not None:
                by_x[part] += (g.mT @ table.extra(s[part], g.dtype)) @ table.others.mT
        return by_x

    @staticmethod
    def setup_context(ctx, inputs, output):
        s, grad, ctx.response, ctx.order = inputs
        ctx.save_for_backward(s, grad)
        ctx.save_for_forward(s, grad)

    @staticmethod
    def backward(ctx, weight):
        s, grad = ctx.saved_tensors
        by_s = by_grad = None
        if _wanted(ctx, 0):
            by_s = _along(grad, _Motion.apply(s, weight, ctx.response, ctx.order + 1), s)
        if _wanted(ctx, 1):
            by_grad = _Motion.apply(s, weight, ctx.response, ctx.order)
        return by_s, by_grad, None, None

    @staticmethod
    def jvp(ctx, ds, dgrad, *_):
        s, grad = ctx.saved_tensors
        change = 0.0
        if dgrad is not None:
            change = _Adjoint.apply(s, dgrad, ctx.response, ctx.order)
        if ds is not None:
            moved = grad * ds.to(grad)[..., None]
            change = change + _Adjoint.apply(s, moved, ctx.response, ctx.order + 1)
        return change

    @staticmethod
    def vmap(info, in_dims, s, grad, response, order):
        return _batched(_Adjoint, info, in_dims, s, grad, response, order)


def _wanted(ctx: Any, index: int) -> bool:
    """Whether a backward pass goes on to an input.

    `needs_input_grad` says only whether it could: for the gradient by times alone, that by the
    coordinates would be made too, and take most of the time.
    """
    if not ctx.needs_input_grad[index]:
        return False
    try:
        return torch._C._will_engine_execute_node(ctx.next_functions[index][0])
    except (AttributeError, IndexError, RuntimeError, TypeError):
        # A leaf, a function of `torch.func`, or a PyTorch that does not tell.
        return True


def _along(grad: Any, rate: Any, s: Tensor) -> Tensor:
    """What a gradient by the motion comes to by its times."""
    return (grad * rate).sum(-1).to(s.dtype)


def _batched(function: Any, info: Any, in_dims: Any, s: Tensor, x: Tensor, *others: Any) -> Any:
    """One batch of what `torch.vmap` maps over."""
    s, x = (
        value.expand(info.batch_size, *value.shape) if dim is None else value.movedim(dim, 0)
        for value, dim in zip((s, x), in_dims, strict=False)
    )
    result = function.apply(s.flatten(0, 1), x.flatten(0, 1), *others)
    return result.unflatten(0, s.shape[:2]), 0
