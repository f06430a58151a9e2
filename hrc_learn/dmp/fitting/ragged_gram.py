"""Normal equations of demonstrations that are each sampled at times of their own.

No design matrix H is formed. The sums of Chebyshev polynomials T_k over the samples of each
piece, up to twice the degree, determine H'H, because T_i T_j = (T_i+j + T_|i-j|) / 2.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.dmp._system.bases import balanced_units
from hrc_learn.dmp._system.ragged_times import chunks
from hrc_learn.dmp._system.response import Response
from hrc_learn.dmp.fitting.samples import Samples

GRAM_TOLERANCE = 1e-9
"""Error allowed in a column, relative to its largest value: what remains of it in a motion is
well below the accuracy of the response itself."""
MAXIMUM_TERMS = 20
"""Terms of a Chebyshev series: a few dozen samples per piece, which is fastest to fit."""
MAXIMUM_TABLE = 2**22
"""Entries of `ColumnPieces.table`, 32 MB: 50 functions take 1.3 million, 100 take ten."""
SAMPLES_PER_FUNCTION = 20
"""Samples per basis function of the even grid on which columns are orthonormal."""
WELL_POSED = 1e-3
"""Bound on the ratio of the smallest to the largest diagonal entry of a Cholesky factor; at
1e-8, half of the digits of float64 are lost."""
NORM_ITERATIONS = 4
"""Iterations for the largest singular value. The next one is a third of it, so the error falls
to a percent within two iterations."""


def fit_ragged(
    response: Response,
    samples: Samples,
    position: Float[Tensor, "B D T"],
    rate: Float[Tensor, "B D T"] | None,
    regularization: float,
) -> tuple[Float[Tensor, "B D N"], Float[Tensor, "B D"], Bool[Tensor, "B"]]:
    """Least squares on the trajectory for all demonstrations at once, on ragged times.

    The normal equations are written in columns that are orthonormal on an even grid: if the
    samples determine all functions, squaring them loses no digits.

    Returns:
        Weights, start velocity dy/ds, and a flag for each demonstration that leaves functions
        undetermined; its other results must not be used.
    """
    N, fit_rate = response.basis.count, rate is None
    n = N + fit_rate
    mixing, sigma, directions, pieces = _orthonormal_columns(response, n, samples.s.device)
    mask = samples.mask.to(mixing)
    if not samples.complete:
        position = torch.where(samples.mask[:, None], position, 0.0)
    gram, right = pieces.products(samples.s, position, mask)
    known = [samples.first.double(), samples.last.double()]
    if rate is not None:
        known.insert(0, rate[..., 0] if samples.complete else _first_valid(rate, samples.mask))
    right = right[:, :n] - gram[:, :n, n:] @ torch.stack(known, 1)
    A = gram[:, :n, :n]
    # The ridge is relative to the largest singular value of the balanced weights, found by
    # power iteration from that of the even grid.
    v, norm = directions[:1].expand(len(A), -1), A.new_zeros(len(A), 1)
    for _ in range(NORM_ITERATIONS):
        v = (A @ (v @ directions.mT * sigma)[..., None])[..., 0] * sigma @ directions
        norm = v.norm(dim=-1, keepdim=True)
        v = v / norm
    A = A + torch.diag_embed(regularization**2 * norm / sigma**2)
    factor, failed = torch.linalg.cholesky_ex(A)
    diagonal = factor.diagonal(dim1=-2, dim2=-1)
    undetermined = (failed > 0) | ~(diagonal.amin(-1) > WELL_POSED * diagonal.amax(-1))
    unknown = (mixing[:n, :n] @ torch.cholesky_solve(right, factor)).mT
    if rate is None:
        return unknown[..., :-1], unknown[..., -1], undetermined
    return unknown, known[0], undetermined


@dataclass(frozen=True, eq=False)
class ColumnPieces:
    """Columns H(s) @ mixing as Chebyshev series on pieces of equal length."""

    interval: float
    coefficients: Float[Tensor, "P K n"]
    table: Float[Tensor, "P_moments pairs"] | None
    """Maps the sums of T_0 ... T_2K-2 over the samples of each piece to the upper triangle of
    H'H; None if it would be larger than `MAXIMUM_TABLE`."""

    @classmethod
    def of(cls, response: Response, mixing: Float[Tensor, "M n"]) -> "ColumnPieces":
        """Fit as few pieces from s = 0 to 1 as series of `MAXIMUM_TERMS` allow.

        Args:
            response: Without approach, and with a basis that is not periodic.
            mixing: Coordinates of each column.
        """
        angle = torch.pi * torch.arange(4 * MAXIMUM_TERMS + 1).to(mixing) / (4 * MAXIMUM_TERMS)
        series = torch.cos(angle[:, None] * torch.arange(MAXIMUM_TERMS).to(mixing))
        fit = torch.linalg.pinv(series)
        for merged in (8, 4, 2, 1):
            # Whole pieces of the forcing are merged, because a spline has knots between them.
            interval = merged * response.forced.interval
            knots = interval * torch.arange(math.ceil(1 / interval - 1e-9)).to(mixing)
            s = knots[:, None] + interval * (1 + torch.cos(angle)) / 2
            values = response.evaluate(s)[..., 0, :] @ mixing
            coefficients, size = fit @ values, values.abs().amax((0, 1))
            error = (series @ coefficients - values).abs().amax((0, 1))
            if merged == 1 or (error <= GRAM_TOLERANCE * size).all():
                break
        # The error of dropped terms is at most the sum of their coefficients.
        left = coefficients.abs().flip(1).cumsum(1).flip(1).amax(0)
        terms = int((left > GRAM_TOLERANCE * size).any(-1).sum())
        coefficients = coefficients[:, :terms].contiguous()
        return cls(interval, coefficients, _moments_to_gram(coefficients))

    def products(
        self,
        s: Float[Tensor, "B T"],
        y: Float[Tensor, "B D T"],
        mask: Float[Tensor, "B T"],
    ) -> tuple[Float[Tensor, "B n n"], Float[Tensor, "B n D"]]:
        """Products H'H and H'y of the columns over the valid samples (float64).

        Args:
            s: Normalised times from 0 to 1, non-decreasing.
            y: Samples.
            mask: 1 at valid samples, 0 elsewhere.
        """
        (P, K, n), D = self.coefficients.shape, y.shape[1]
        edges = torch.arange(P + 1, dtype=s.dtype, device=s.device)
        # Samples at the very end belong to the last piece.
        edges[-1] = math.inf
        moments, right = s.new_empty(len(s), P, 2 * K - 1), s.new_empty(len(s), n, D)
        flat = self.coefficients.reshape(P * K, n).mT
        for part in chunks(s):
            x, B = s[part] / self.interval, len(s[part])
            first = torch.searchsorted(x.contiguous(), edges.expand(B, -1).contiguous())
            most = int(first.diff(dim=-1).amax())
            index = first[:, :-1, None] + torch.arange(most, device=s.device)
            inside = index < first[:, 1:, None]
            index = index.clamp(max=s.shape[1] - 1).flatten(1)
            u = 2 * (x.gather(1, index).view(B, P, most) - edges[:P, None]) - 1
            valid = mask[part].gather(1, index).view(B, P, most) * inside
            rows = _chebyshev(u, valid, K)
            # Besides the samples: T_0, and the highest T_k, from which the upper half follows.
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
        # Series times series, in an order that leaves one flat product.
        inner = sums.permute(1, 2, 0, 3).reshape(P, K * B, K) @ self.coefficients
        flat = self.coefficients.reshape(P * K, n).mT
        return (flat @ inner.view(P * K, B * n)).view(n, B, n).movedim(1, 0)


def _chebyshev(
    u: Float[Tensor, "B P most"], valid: Float[Tensor, "B P most"], K: int
) -> Float[Tensor, "B P K most"]:
    """Chebyshev polynomials T_0 ... T_K-1 by their recurrence, zero at invalid samples."""
    B, P, most = u.shape
    rows = u.new_empty(B, P, K, most)
    rows[:, :, 0] = valid
    torch.mul(rows[:, :, 0], u, out=rows[:, :, 1])
    u = 2 * u
    for k in range(2, K):
        torch.mul(u, rows[:, :, k - 1], out=rows[:, :, k])
        rows[:, :, k] -= rows[:, :, k - 2]
    return rows


def _moments_to_gram(
    coefficients: Float[Tensor, "P K n"],
) -> Float[Tensor, "P_moments pairs"] | None:
    """`ColumnPieces.table` of Chebyshev series."""
    P, K, n = coefficients.shape
    i, j = torch.triu_indices(n, n, device=coefficients.device)
    if P * (2 * K - 1) * len(i) > MAXIMUM_TABLE:
        return None
    table = coefficients.new_zeros(P, 2 * K - 1, len(i))
    right, k = coefficients[..., j], torch.arange(K, device=coefficients.device)
    for degree in range(K):
        halves = coefficients[:, degree, None, i] * right / 2
        table[:, degree : degree + K] += halves
        table.index_add_(1, (k - degree).abs(), halves)
    return table.flatten(0, 1)


@lru_cache(maxsize=16)
def _orthonormal_columns(
    response: Response, n: int, device: torch.device
) -> tuple[Float[Tensor, "M M"], Float[Tensor, "n"], Float[Tensor, "n n"], ColumnPieces]:
    """Replacement of the first n columns by ones that are orthonormal on an even grid.

    Returns:
        Coordinates of each column, those after n unchanged; singular values of the balanced
        design matrix; its right singular vectors in rows; and the columns along the motion.
    """
    N = response.basis.count
    count = SAMPLES_PER_FUNCTION * N + 1
    even = torch.linspace(0, 1, count, dtype=torch.float64, device=device)
    H = response.evaluate(even)[:, 0]
    unit = balanced_units(response.basis, H, n - N)
    _, sigma, Vh = torch.linalg.svd(H[:, :n] * unit, full_matrices=False)
    mixing = torch.eye(H.shape[1]).to(H)
    mixing[:n, :n] = unit[:, None] * Vh.mT / sigma
    return mixing, sigma, Vh, ColumnPieces.of(response, mixing)


def _first_valid(
    values: Float[Tensor, "B D T"], mask: Bool[Tensor, "B T"]
) -> Float[Tensor, "B D"]:
    index = mask.long().argmax(-1)[:, None, None].expand(-1, values.shape[1], 1)
    return values.gather(-1, index)[..., 0]
