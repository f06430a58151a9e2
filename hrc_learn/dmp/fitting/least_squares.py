"""Least squares over any number of rows, in memory for a few of them.

Rows [A B] of min |A X - B|^2 enter as the triangular factor R of their QR decomposition, for
R'R = [A B]'[A B] is all a solution depends on. Factors of different rows are stacked and
factored anew, in any order and from any process (TSQR; Demmel et al. 2012,
"Communication-optimal parallel and sequential QR and LU factorizations"). The products A'A
would be summed as easily, but square the condition number, and with it the rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn import distributed


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """What is known of min |A X - B|^2."""

    factor: Float[Tensor, "n_and_k n_and_k"]
    """R, upper triangular up to the signs of its rows (float64)."""
    unknowns: int
    """n: columns of A; the others are those of B."""
    rows: int
    """Of A and B so far."""

    @staticmethod
    def empty(unknowns: int, targets: int) -> LeastSquares:
        """No rows yet, of n unknowns and k columns of B."""
        size = unknowns + targets
        return LeastSquares(torch.zeros(size, size, dtype=torch.float64), unknowns, 0)

    def with_rows(self, A: Float[Tensor, "rows n"], B: Float[Tensor, "rows k"]) -> LeastSquares:
        """Some rows more."""
        new = torch.cat([A, B], dim=1).double()
        return self._with_factor(new, len(new))

    def __add__(self, other: LeastSquares) -> LeastSquares:
        """The rows of both."""
        return self._with_factor(other.factor, other.rows)

    def over_processes(self) -> LeastSquares:
        """The rows of all processes, the same in each of them."""
        if distributed.count() == 1:
            return self
        rows = distributed.sum_over_processes(torch.tensor(self.rows))
        factor = _triangle(torch.cat(distributed.gather(self.factor)))
        return LeastSquares(factor, self.unknowns, int(rows))

    @property
    def design(self) -> Float[Tensor, "n n"]:
        """Square root of A'A: as far as singular values and norms go, it is A."""
        return self.factor[: self.unknowns, : self.unknowns]

    def solve(
        self, regularization: float, unit: Float[Tensor, "n"] | None = None
    ) -> Float[Tensor, "n k"]:
        """Minimise |A X - B|^2 + (r sigma)^2 |X / unit|^2.

        Args:
            regularization: r, relative to sigma, the largest singular value of A times unit.
            unit: Size in which each unknown is counted; 1 if None.
        """
        n = self.unknowns
        unit = torch.ones(n, dtype=torch.float64) if unit is None else unit
        U, sigma, Vh = torch.linalg.svd(self.design * unit)
        gain = sigma / (sigma**2 + (regularization * sigma[0]) ** 2)
        return unit[:, None] * (Vh.mT @ (gain[:, None] * (U.mT @ self.factor[:n, n:])))

    def residual(self, X: Float[Tensor, "n k"]) -> Float[Tensor, "k"]:
        """Root mean square of A X - B over all rows, column by column."""
        n = self.unknowns
        error = self.factor[:, :n] @ X - self.factor[:, n:]
        return error.norm(dim=0) / max(self.rows, 1) ** 0.5

    def _with_factor(self, more: Tensor, rows: int) -> LeastSquares:
        factor = _triangle(torch.cat([self.factor, more]))
        return LeastSquares(factor, self.unknowns, self.rows + rows)


def _triangle(rows: Float[Tensor, "rows n"]) -> Float[Tensor, "n n"]:
    return torch.linalg.qr(rows, mode="r").R
