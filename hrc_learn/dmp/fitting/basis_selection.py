"""How many basis functions a demonstration supports."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._types import Points, Times
from hrc_learn.dmp.fitting.motion_samples import check_samples
from hrc_learn.dmp.joint_dmp import JointDMP

TOLERANCE = 1.05
"""A held-out error this close to the smallest, by ratio, is as good."""


@dataclass(frozen=True, kw_only=True)
class BasisSelection:
    """Held-out error over basis counts."""

    count: int
    """The smallest count whose error is within 5 % of the best."""
    candidates: tuple[int, ...]
    error: Float[Tensor, "candidates"]
    """RMSE on samples not fitted, relative to the largest range, over all demonstrations."""


def select_basis_count(
    time: Times,
    position: Points,
    candidates: Sequence[int] = (10, 15, 20, 30, 40, 50, 70, 100),
    *,
    n_folds: int = 5,
    **fit_arguments: Any,
) -> BasisSelection:
    """Choose the number of basis functions by the error on held-out samples.

    Every `n_folds`-th sample is held out in turn. First and last samples stay, as they are
    the start and the goal.

    Args:
        time: Timestamps [s], (T,) or (*B, T).
        position: (T,), (T, D) or (*B, T, D).
        candidates: Counts to try.
        n_folds: Fits per candidate.
        fit_arguments: For `JointDMP.fit`, such as `mask`, `method` or `scaling`.

    Raises:
        ValueError: Bad samples or arguments; says which.
    """
    mask = fit_arguments.pop("mask", None)
    samples = check_samples(time, position, mask=mask)
    if not candidates or n_folds < 2:
        raise ValueError(f"needs candidates and 2 folds or more, got {candidates}, {n_folds}")
    folds = [_held_out(samples.mask, fold, n_folds) for fold in range(n_folds)]
    elapsed = (samples.s * samples.duration[:, None]).reshape(*samples.batch, -1)
    errors = []
    for count in candidates:
        square, weight = torch.zeros((), dtype=torch.float64), 0
        for held in folds:
            kept = (samples.mask & ~held).reshape(*samples.batch, -1)
            dmp = JointDMP.fit(time, position, count, mask=kept, **fit_arguments)
            with torch.no_grad():
                reproduction = dmp.rollout(elapsed).position.mT.reshape(samples.position.shape)
                miss = (reproduction - samples.position).double() / samples.span.amax()
            square = square + miss.mT[held].square().sum()
            weight += int(held.sum()) * miss.shape[1]
        errors.append((square / weight).sqrt())
    error = torch.stack(errors)
    good = error <= TOLERANCE * error.min()
    count = min(n for n, is_good in zip(candidates, good.tolist(), strict=True) if is_good)
    return BasisSelection(count=count, candidates=tuple(candidates), error=error)


def _held_out(mask: Tensor, fold: int, n_folds: int) -> Tensor:
    """Every n-th of the samples that count, ends excepted."""
    order = mask.long().cumsum(-1)
    inner = (order > 1) & (order < order[..., -1:])
    return mask & inner & (order % n_folds == fold)
