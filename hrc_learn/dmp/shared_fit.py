"""One primitive fitted to any number of demonstrations, with one in memory at a time.

Least squares over any number of rows: the rows [A B] of min |A X - B|^2 enter through the
triangular factor R of their QR decomposition, because the solution depends on R'R = [A B]'[A B]
alone. Factors of different rows are stacked and factored again, in any order and from any
process (TSQR; Demmel et al. 2012, "Communication-optimal parallel and sequential QR and LU
factorizations"). Summing the products A'A would be as easy, but would square the condition
number and with it the rounding error.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn import distributed
from hrc_learn.dmp._arguments import Points, Times
from hrc_learn.dmp.dynamics import GaussianBasis, SpringDamper, balanced_units
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.response import Response, response_of
from hrc_learn.dmp.samples import Samples, check_samples
from hrc_learn.dmp.solvers import REGULARIZATION, ridge_inverse

TIMESTAMPS = 1000
"""Samples of the default rollout, because the demonstrations have no common grid."""


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Accumulated rows of min |A X - B|^2."""

    factor: Float[Tensor, "n_and_k n_and_k"]
    """R, upper triangular up to the signs of its rows (float64)."""
    unknowns: int
    """n, the number of columns of A; the remaining columns are those of B."""
    rows: int
    """Number of rows so far."""

    @staticmethod
    def empty(unknowns: int, targets: int) -> "LeastSquares":
        """Problem without rows, with n unknowns and k columns of B."""
        size = unknowns + targets
        return LeastSquares(torch.zeros(size, size, dtype=torch.float64), unknowns, 0)

    def with_rows(
        self, A: Float[Tensor, "rows n"], B: Float[Tensor, "rows k"]
    ) -> "LeastSquares":
        """Problem with additional rows."""
        new = torch.cat([A, B], dim=1).double()
        factor = _triangle(torch.cat([self.factor, new]))
        return LeastSquares(factor, self.unknowns, self.rows + len(new))

    def over_processes(self) -> "LeastSquares":
        """Problem with the rows of all processes, identical in each of them."""
        if distributed.count() == 1:
            return self
        rows = distributed.sum_over_processes(torch.tensor(self.rows))
        factor = _triangle(torch.cat(distributed.gather(self.factor)))
        return LeastSquares(factor, self.unknowns, int(rows))

    @property
    def design(self) -> Float[Tensor, "n n"]:
        """Square root of A'A, with the singular values and column norms of A."""
        return self.factor[: self.unknowns, : self.unknowns]

    def solve(self, unit: Float[Tensor, "n"]) -> Float[Tensor, "n k"]:
        """Minimise |A X - B|^2 + (r sigma)^2 |X / unit|^2, r the default ridge of a fit.

        Args:
            unit: Unit of each unknown; sigma is the largest singular value of A times unit.
        """
        n = self.unknowns
        inverse = ridge_inverse(self.design * unit, REGULARIZATION)
        return unit[:, None] * (inverse @ self.factor[:n, n:])

    def residual(self, X: Float[Tensor, "n k"]) -> Float[Tensor, "k"]:
        """Root mean square of A X - B over all rows, for each column."""
        n = self.unknowns
        error = self.factor[:, :n] @ X - self.factor[:, n:]
        # R'R equals the product over all rows, so norms are equal too.
        return error.norm(dim=0) / max(self.rows, 1) ** 0.5


def _triangle(rows: Float[Tensor, "rows n"]) -> Float[Tensor, "n n"]:
    return torch.linalg.qr(rows, mode="r").R


@dataclass(frozen=True, kw_only=True, eq=False)
class SharedFit:
    """Result of one pass over the demonstrations."""

    primitive: JointDMP
    demonstrations: int
    """Number of demonstrations."""
    samples: int
    """Number of samples in all demonstrations."""
    rmse: Float[Tensor, "D"]
    """RMSE over all samples, with the start, goal and duration of each demonstration."""


def fit_shared(
    demonstrations: Sequence[tuple[Times, Points]],
    n_basis: int = 50,
    *,
    joint_names: Sequence[str] | None = None,
    units: str = "rad",
) -> SharedFit:
    """Fit one primitive to all demonstrations, in one pass and bounded memory.

    Minimises the distance of all samples to one primitive that takes start, goal and duration
    from each demonstration; all have the same weights and start velocity (per duration).
    For demonstrations on one grid the result is the mean of a primitive each. With several
    processes, each reads its part of the demonstrations, and all return the same result.

    Args:
        demonstrations: Timestamps (T,) [s] and positions (T, D) of each. They are read one by
            one, so a sequence that loads them on demand is enough.
        n_basis: N.
        joint_names: D names, stored with the primitive.
        units: Units of the coordinates.

    Raises:
        ValueError: No demonstrations, or one that cannot be fitted; the message names it.
    """
    if not len(demonstrations):
        raise ValueError("there are no demonstrations to learn from")
    response = response_of(SpringDamper(), GaussianBasis(count=n_basis))
    problem, sums = _accumulate(demonstrations, response)
    mean = sums / len(demonstrations)
    # The start velocity is one more unknown after the weights.
    unit = balanced_units(response.basis, problem.design, others=1)
    X = problem.solve(unit)
    start, goal, amplitude, duration = mean[0], mean[1], mean[2], mean[3, 0]
    primitive = JointDMP(
        weights=X[:-1].mT.contiguous(),
        start=start,
        goal=goal,
        start_velocity=X[-1] / duration,
        duration=duration,
        amplitude=torch.where(amplitude > 0, amplitude, 1.0),
        timestamps=torch.linspace(0, 1, TIMESTAMPS, dtype=torch.float64),
        basis=response.basis,
        spring=response.spring,
        joint_names=joint_names,
        units=units,
    )
    return SharedFit(
        primitive=primitive,
        demonstrations=len(demonstrations),
        samples=problem.rows,
        rmse=problem.residual(X),
    )


def _accumulate(
    demonstrations: Sequence[tuple[Times, Points]], response: Response
) -> tuple[LeastSquares, Float[Tensor, "4 D"]]:
    """Rows of all processes, and sums of start, goal, range and duration."""
    N, D = response.basis.count, None
    problem, sums = None, None
    for i, (time, position) in distributed.local_items(demonstrations):
        samples = _checked(i, time, position)
        D = samples.position.shape[1]
        problem = problem or LeastSquares.empty(N + 1, D)
        sums = torch.zeros(4, D, dtype=torch.float64) if sums is None else sums
        problem = problem.with_rows(*_equations(samples, response))
        ends = [samples.first[0], samples.last[0], samples.span[0]]
        sums = sums + torch.stack([*ends, samples.duration.expand(D)]).double()
    # A process without demonstrations contributes zeros, for as many coordinates as the others.
    D = int(max(distributed.gather(torch.tensor(D or 0))))
    problem = problem or LeastSquares.empty(N + 1, D)
    sums = torch.zeros(4, D, dtype=torch.float64) if sums is None else sums
    return problem.over_processes(), distributed.sum_over_processes(sums)


def _checked(index: int, time: Times, position: Points) -> Samples:
    try:
        samples = check_samples(time, position)
    except ValueError as error:
        raise ValueError(f"demonstration {index}: {error}") from None
    if samples.batch:
        raise ValueError(f"demonstration {index}: position must be (T, D), without a batch")
    return samples


def _equations(
    samples: Samples, response: Response
) -> tuple[Float[Tensor, "T n"], Float[Tensor, "T D"]]:
    """Rows of A X = B for the weights and start velocity of one demonstration."""
    N = response.basis.count
    H = response.evaluate(samples.s[0])[:, 0]
    ends = torch.stack([samples.first[0], samples.last[0]]).double()
    return H[:, : N + 1], samples.position[0].mT.double() - H[:, N + 1 :] @ ends
