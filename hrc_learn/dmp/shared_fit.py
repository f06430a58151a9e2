"""One primitive fitted to any number of demonstrations, with one in memory at a time.

The rows [A B] of min |A X - B|^2 enter through their products [A B]'[A B], which add up in any
order and over any number of processes. The columns of A are orthonormal on an even grid, so
that squaring them loses no digits.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn import distributed
from hrc_learn.dmp._arguments import Points, Times
from hrc_learn.dmp.dynamics import GaussianBasis, SpringDamper
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.response import Response, response_of
from hrc_learn.dmp.samples import Samples, check_samples
from hrc_learn.dmp.solvers import REGULARIZATION, normal_products, solve_normal

STRONG_RIDGE = 1e-5
"""Ridge where the samples do not determine all functions: its square is well above rounding."""
TIMESTAMPS = 1000
"""Samples of the default rollout, because the demonstrations have no common grid."""


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
    products, sums, rows = _accumulate(demonstrations, response)
    # The start velocity is one more unknown after the weights.
    n = n_basis + 1
    X, square, undetermined = solve_normal(response, n, products, REGULARIZATION)
    if undetermined.any():
        X, square, _ = solve_normal(response, n, products, STRONG_RIDGE)
    mean = sums / len(demonstrations)
    start, goal, amplitude, duration = mean[0], mean[1], mean[2], mean[3, 0]
    primitive = JointDMP.from_coordinates(
        torch.cat([X[0], start[:, None], goal[:, None]], dim=-1),
        duration,
        torch.where(amplitude > 0, amplitude, 1.0),
        torch.linspace(0, 1, TIMESTAMPS, dtype=torch.float64),
        response,
        joint_names=joint_names,
        units=units,
    )
    return SharedFit(
        primitive=primitive,
        demonstrations=len(demonstrations),
        samples=rows,
        rmse=(square[0] / rows).sqrt(),
    )


def _accumulate(
    demonstrations: Sequence[tuple[Times, Points]], response: Response
) -> tuple[Float[Tensor, "1 m m"], Float[Tensor, "4 D"], int]:
    """Products of all processes, sums of start, goal, range and duration, and sample count."""
    D, rows, products, sums = 0, 0, None, None
    for i, (time, position) in distributed.local_items(demonstrations):
        samples = _checked(i, time, position)
        D, rows = samples.position.shape[1], rows + samples.s.shape[1]
        ends = torch.stack([samples.first, samples.last], 1).double()
        own = normal_products(response, samples, ends)
        products = own if products is None else products + own
        last = [samples.span[0], samples.duration.expand(D)]
        values = torch.stack([*ends[0], *last]).double()
        sums = values if sums is None else sums + values
    # A process without demonstrations contributes zeros, for as many coordinates as the others.
    D, m = int(max(distributed.gather(torch.tensor(D)))), response.size - 2
    if products is None or sums is None:
        products = torch.zeros(1, m + D, m + D, dtype=torch.float64)
        sums = torch.zeros(4, D, dtype=torch.float64)
    total = distributed.sum_over_processes
    return total(products), total(sums), int(total(torch.tensor(rows)))


def _checked(index: int, time: Times, position: Points) -> Samples:
    try:
        samples = check_samples(time, position)
    except ValueError as error:
        raise ValueError(f"demonstration {index}: {error}") from None
    if samples.batch:
        raise ValueError(f"demonstration {index}: position must be (T, D), without a batch")
    return samples
