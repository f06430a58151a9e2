"""One primitive from any number of demonstrations, one of them in memory at a time.

Least squares over any number of rows: rows [A B] of min |A X - B|^2 enter as the triangular
factor R of their QR decomposition, for R'R = [A B]'[A B] is all a solution depends on. Factors
of different rows are stacked and factored anew, in any order and from any process (TSQR;
Demmel et al. 2012, "Communication-optimal parallel and sequential QR and LU factorizations").
The products A'A would be summed as easily, but square the condition number, and with it the
rounding.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn import distributed
from hrc_learn.dmp._arguments import Points, Samples, Times, check_samples
from hrc_learn.dmp._fitting import ridge_inverse
from hrc_learn.dmp._system.bases import Basis, GaussianBasis, balanced_units
from hrc_learn.dmp._system.closed_forms import SpringDamper
from hrc_learn.dmp._system.response import Response, response_of
from hrc_learn.dmp.joint_dmp import JointDMP


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
    def empty(unknowns: int, targets: int) -> "LeastSquares":
        """No rows yet, of n unknowns and k columns of B."""
        size = unknowns + targets
        return LeastSquares(torch.zeros(size, size, dtype=torch.float64), unknowns, 0)

    def with_rows(
        self, A: Float[Tensor, "rows n"], B: Float[Tensor, "rows k"]
    ) -> "LeastSquares":
        """Some rows more."""
        new = torch.cat([A, B], dim=1).double()
        return self._with_factor(new, len(new))

    def __add__(self, other: "LeastSquares") -> "LeastSquares":
        """The rows of both."""
        return self._with_factor(other.factor, other.rows)

    def over_processes(self) -> "LeastSquares":
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
        inverse = ridge_inverse(self.design * unit, regularization)
        return unit[:, None] * (inverse @ self.factor[:n, n:])

    def residual(self, X: Float[Tensor, "n k"]) -> Float[Tensor, "k"]:
        """Root mean square of A X - B over all rows, column by column."""
        n = self.unknowns
        error = self.factor[:, :n] @ X - self.factor[:, n:]
        # R'R is that of all rows, so norms are too.
        return error.norm(dim=0) / max(self.rows, 1) ** 0.5

    def _with_factor(self, more: Tensor, rows: int) -> "LeastSquares":
        factor = _triangle(torch.cat([self.factor, more]))
        return LeastSquares(factor, self.unknowns, self.rows + rows)


def _triangle(rows: Float[Tensor, "rows n"]) -> Float[Tensor, "n n"]:
    return torch.linalg.qr(rows, mode="r").R


TIMESTAMPS = 1000
"""Samples of a rollout without arguments: demonstrations need not be sampled alike."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SharedFit:
    """What a pass over the demonstrations gave."""

    primitive: JointDMP
    demonstrations: int
    samples: int
    rmse: Float[Tensor, "D"]
    """Of all samples against the primitive with start, goal and duration of their own."""


def fit_shared(
    demonstrations: Sequence[tuple[Times, Points]],
    n_basis: int = 50,
    *,
    basis: Basis | None = None,
    spring: SpringDamper | None = None,
    approach: float = 0.0,
    regularization: float = 1e-7,
    joint_names: Sequence[str] | None = None,
    units: str = "rad",
) -> SharedFit:
    """Learn what all demonstrations have in common, in one pass and bounded memory.

    Minimises the distance of all samples to one primitive that starts and ends where, and
    takes as long as, each demonstration: weights and start velocity (per duration) are
    shared. Demonstrations sampled alike give the same as the mean of a primitive each. Of
    several processes, each reads its share, and all return the same.

    Args:
        demonstrations: Timestamps (T,) [s] and positions (T, D) of each; read one by one, so a
            sequence that loads them when asked is enough.
        n_basis: N, unless `basis` is given.
        basis: Shape of the forcing term.
        spring: Gains.
        approach: Share of the motion along which a new goal is taken up.
        regularization: Ridge, relative to the largest singular value.
        joint_names: D names, kept with the primitive.
        units: Of the coordinates.

    Raises:
        ValueError: No demonstrations, or one that cannot be fitted; says which.
    """
    if not len(demonstrations):
        raise ValueError("there are no demonstrations to learn from")
    response = response_of(
        spring or SpringDamper(), basis or GaussianBasis(count=n_basis), approach
    )
    totals = _gather(demonstrations, response)
    problem, mean = totals.problem, totals.sums / len(demonstrations)
    # One more unknown than weights: the start velocity.
    unit = balanced_units(response.basis, problem.design, others=1)
    X = problem.solve(regularization, unit)
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
        approach=approach,
        joint_names=joint_names,
        units=units,
    )
    return SharedFit(
        primitive=primitive,
        demonstrations=len(demonstrations),
        samples=problem.rows,
        rmse=problem.residual(X),
    )


@dataclass(frozen=True, eq=False)
class _Totals:
    problem: LeastSquares
    sums: Float[Tensor, "4 D"]
    """Over demonstrations: start, goal, range, duration."""


def _gather(demonstrations: Sequence[tuple[Times, Points]], response: Response) -> _Totals:
    """Everything a fit needs, of the demonstrations of all processes."""
    N, D = response.basis.count, None
    problem, sums = None, None
    for i, (time, position) in distributed.share(demonstrations):
        samples = _checked(i, time, position)
        D = samples.position.shape[1]
        problem = problem or LeastSquares.empty(N + 1, D)
        sums = torch.zeros(4, D, dtype=torch.float64) if sums is None else sums
        problem = problem.with_rows(*_equations(samples, response))
        ends = [samples.first[0], samples.last[0], samples.span[0]]
        sums = sums + torch.stack([*ends, samples.duration.expand(D)]).double()
    # A process without a share takes part with nothing, once it knows how many coordinates.
    D = int(max(distributed.gather(torch.tensor(D or 0))))
    problem = problem or LeastSquares.empty(N + 1, D)
    sums = torch.zeros(4, D, dtype=torch.float64) if sums is None else sums
    return _Totals(problem.over_processes(), distributed.sum_over_processes(sums))


def _checked(index: int, time: Times, position: Points) -> Samples:
    try:
        samples = check_samples(time, position)
    except ValueError as error:
        raise ValueError(f"demonstration {index}: {error}") from None
    if samples.batch:
        raise ValueError(f"demonstration {index}: position must be (T, D), one of many")
    return samples


def _equations(
    samples: Samples, response: Response
) -> tuple[Float[Tensor, "T n"], Float[Tensor, "T D"]]:
    """Rows of A X = B for one demonstration: what weights and start velocity have to give."""
    N = response.basis.count
    H = response.evaluate(samples.s[0])[:, 0]
    ends = torch.stack([samples.first[0], samples.last[0]]).double()
    return H[:, : N + 1], samples.position[0].mT.double() - H[:, N + 1 :] @ ends
