"""Samples that lie far off, taken back to where the others lead.

M-estimates by iteratively reweighted least squares (Huber and Ronchetti 2009, "Robust
statistics", chapter 7): the motion of a primitive that is closest to the samples, each
weighed by the trust in it, which falls with its residual over their spread. A motion through
y* = y_fit + trust (y - y_fit), fitted by plain least squares, is the same one: so these stand
for the samples, whatever the method that fits them.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._system.bases import balanced_units
from hrc_learn.dmp._system.response import Response
from hrc_learn.dmp.fitting.motion_samples import Samples

HUBER, TUKEY = 1.345, 4.685
"""Residuals in standard deviations beyond which trust falls and ends: 95 % efficient for
Gaussian noise."""
SPREAD_OF_MEDIAN = 1.4826
"""Standard deviation over median absolute value of Gaussian noise."""
LEAST_SPREAD = 1e-12
"""Of residuals, as a share of the range covered: below, they are rounding."""
ROUNDS = 50
"""At most: trust may swing to and fro between samples and never settle."""
SETTLED = 1e-3
"""Change of trust at which the iteration ends."""


def huber(residual: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Trust by residual in standard deviations, >= 0: whole, then falling as its inverse."""
    return HUBER / residual.clamp(min=HUBER)


def tukey(residual: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Biweight: falls from the start, and far off there is none."""
    return (1 - (residual / TUKEY).clamp(max=1) ** 2) ** 2


LOSSES: dict[str, Callable[[Tensor], Tensor]] = {"huber": huber, "tukey": tukey}


def robust_weights(
    loss: str, response: Response, samples: Samples, regularization: float
) -> tuple[Samples, Float[Tensor, "B D T"]]:
    """Samples with outliers taken back, and the trust in what was recorded.

    Args:
        loss: `"huber"`, convex, so that there is one answer; `"tukey"`, which from that answer
            on forgets what lies far off.
        response: Of the primitive to be fitted.
        samples: Of one demonstration or many.
        regularization: Ridge, relative to the largest singular value.

    Raises:
        ValueError: No such loss.
    """
    if loss not in LOSSES:
        raise ValueError(f"unknown robust loss {loss!r}; there are {', '.join(LOSSES)}")
    position = samples.position.double()
    trust = torch.zeros_like(position)
    tamed, reach = position.clone(), None
    for i, valid in enumerate(samples.mask):
        if reach is None or not samples.shared:
            reach = _Reach(response, samples.s[i, valid], regularization)
        y = position[i, :, valid]
        fitted, trusted = _fit(loss, reach, y)
        trust[i, :, valid] = trusted
        tamed[i, :, valid] = fitted + trusted * (y - fitted)
    return replace(samples, position=tamed.to(samples.position)), trust


class _Reach:
    """The motions that a primitive can make at given times, start and goal free too.

    The goal is where the motion is at the end. Without that the last sample would be the goal,
    and nothing could tell whether it is an outlier.
    """

    def __init__(self, response: Response, s: Float[Tensor, "T"], regularization: float):
        N = response.basis.count
        H = response.evaluate(s)[:, 0]
        goal = torch.zeros_like(H[-1])
        goal[-1] = 1.0
        # The motion at all times but the last, the goal, and by how much it is missed.
        A = torch.cat([H[:-1], goal[None], (H[-1] - goal)[None]])
        U, sigma, _ = torch.linalg.svd(
            A * balanced_units(response.basis, A, A.shape[1] - N), full_matrices=False
        )
        self._U = U
        self._ridge = torch.diag((regularization * sigma[0] / sigma) ** 2)

    def closest(
        self, y: Float[Tensor, "D T"], trust: Float[Tensor, "D T"]
    ) -> Float[Tensor, "D T"]:
        """The motion with the least weighted squared distance to samples."""
        trust = torch.nn.functional.pad(trust, (0, 1), value=1.0)
        y = torch.nn.functional.pad(y, (0, 1))
        weighted = self._U.mT * trust[:, None]
        # U is orthonormal: little is lost by squaring it.
        normal = weighted @ self._U + self._ridge
        c = torch.linalg.solve(normal, weighted @ y[..., None])
        return (self._U @ c)[:, :-1, 0]


def _fit(
    loss: str, reach: _Reach, y: Float[Tensor, "D T"]
) -> tuple[Float[Tensor, "D T"], Float[Tensor, "D T"]]:
    """The closest motion and the trust in each sample."""
    trust, spread = torch.ones_like(y), torch.zeros_like(y[:, :1])
    fitted = reach.closest(y, trust)
    # The smallest number as well: a coordinate that never moves covers no range.
    least = LEAST_SPREAD * (y.amax(-1) - y.amin(-1))[:, None] + torch.finfo(y.dtype).tiny
    for name in dict.fromkeys(("huber", loss)):
        for _ in range(ROUNDS):
            residual = (y - fitted).abs()
            if name == "huber":
                spread = SPREAD_OF_MEDIAN * residual.median(-1, keepdim=True).values
                spread = torch.maximum(spread, least)
            before, trust = trust, LOSSES[name](residual / spread)
            fitted = reach.closest(y, trust)
            if (trust - before).abs().amax() < SETTLED:
                break
    return fitted, trust
