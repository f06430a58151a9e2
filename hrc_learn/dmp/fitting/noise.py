"""Noise and outliers in recorded samples.

Noise is removed by penalised splines (Eilers and Marx 1996, "Flexible smoothing with B-splines
and penalties"): y = B c + noise, with a penalty on the third differences of c, which stand for
the jerk. The strength of the penalty maximises the restricted likelihood of the samples (Wood
2011) for Gaussian jerks, in each column separately. The same likelihood gives the standard
deviation of the noise, whether it comes from encoders, a tracker or a trembling person.

Outliers are pulled in by M-estimates with iteratively reweighted least squares (Huber and
Ronchetti 2009, "Robust statistics", chapter 7): the motion of a primitive closest to the
samples, each weighted by a trust that falls with its residual over their spread. Plain least
squares through y* = y_fit + trust (y - y_fit) gives the same motion, so y* replaces the samples
for every method of fitting.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._system.bases import balanced_units, cubic_spline
from hrc_learn.dmp._system.response import Response
from hrc_learn.dmp.fitting.samples import Samples, demo_label

MAXIMUM_KNOTS = 120
"""Intervals of the splines: finer than any reasonable number of basis functions."""
STRENGTHS = 81
"""Penalties compared, from 1e-10 to 1e6 relative to the samples: a fifth of a decade apart,
which changes the error by less than a percent."""
LIKELIHOOD_MARGIN = 1.0
"""Twice the logarithm of a likelihood ratio that is not significant; two standard deviations
would be four."""
CLEAN = 2e-5
"""Noise relative to the range below which samples stay as they are: the accuracy of a fit with
fifty functions."""
ORDER = 3
"""Order of the penalised differences: a motion without jerk is a parabola."""


def smoothed(samples: Samples) -> tuple[Samples, Float[Tensor, "B D"]]:
    """Samples without their noise, and its standard deviation in each column.

    Columns with less noise than `CLEAN`, and columns that never move, stay unchanged.
    """
    position = samples.position.double()
    smooth, noise = position.clone(), torch.zeros_like(position[..., 0])
    if samples.shared_grid:
        flat = position.flatten(0, 1)
        smooth, noise = (
            x.view(*position.shape[:2], *x.shape[1:]) for x in _smooth(samples.s[0], flat)
        )
    else:
        for i, valid in enumerate(samples.mask):
            smooth[i, :, valid], noise[i] = _smooth(samples.s[i, valid], position[i, :, valid])
    noisy = (noise > CLEAN * samples.span)[..., None]
    smooth = torch.where(noisy, smooth, position)
    return replace(samples, position=smooth.to(samples.position)), noise


def _smooth(s: Float[Tensor, "T"], y: Float[Tensor, "C T"]) -> tuple[Tensor, Tensor]:
    return _spline(s.cpu().numpy().tobytes(), s.device).smooth(y)


def warn_of_few_samples(samples: Samples, n_basis: int) -> None:
    """Warn if there are at most as many samples as functions, which leaves gaps arbitrary."""
    if samples.complete and samples.s.shape[-1] > n_basis:
        return  # without counting, which a short fit would notice
    counts = samples.mask.sum(-1)
    if (counts <= n_basis).any():
        i = int((counts <= n_basis).nonzero()[0])
        warnings.warn(
            f"{demo_label(i, samples.batch)}{n_basis} basis functions are fitted to "
            f"{int(counts[i])} samples, which do not determine them: the motion between "
            "samples is arbitrary. Use fewer functions, or remove noise (smooth=True).",
            stacklevel=4,
        )


@dataclass(frozen=True, eq=False)
class _Spline:
    """Splines on a time grid, in coordinates that diagonalise both samples and penalty."""

    U: Float[Tensor, "T K"]
    """Maps samples to coordinates, and coordinates to the motion."""
    data: Float[Tensor, "K"]
    """Precision of each coordinate from the samples, 0 to 1; the penalty adds the rest."""
    strengths: Float[Tensor, "L"]
    """Penalties to choose from."""

    def smooth(self, y: Float[Tensor, "C T"]) -> tuple[Float[Tensor, "C T"], Tensor]:
        """Most likely motion and the standard deviation of the noise, for each column."""
        T = y.shape[-1]
        middle = y.mean(-1, keepdim=True)
        y = y - middle
        c = y @ self.U
        e, r = self.data, 1 - self.data
        # The prior precision of coordinate k is lambda r_k, that of the samples e_k.
        total = e + self.strengths[:, None] * r
        free = r < 1e-9
        n = T - int(free.sum())
        # Penalty plus squared distance to the samples, at their minimum.
        misfit = y.square().sum(-1)[:, None] - c.square() @ (1 / total).mT
        misfit = misfit.clamp(min=torch.finfo(y.dtype).tiny)
        prior = torch.where(free, 1.0, self.strengths[:, None] * r)
        known = torch.where(free, 1.0, total)
        score = n * misfit.log() + (known.log() - prior.log()).sum(-1)
        # The strongest penalty that is not significantly less likely than the best.
        likely = score <= score.amin(-1, keepdim=True) + LIKELIHOOD_MARGIN
        best = (likely * torch.arange(1, STRENGTHS + 1, device=y.device)).argmax(-1)
        fitted = (c / total[best]) @ self.U.mT
        noise = (misfit.gather(-1, best[:, None])[:, 0] / n).sqrt()
        return fitted + middle, noise


# Demonstrations on one grid share a spline.
@lru_cache(maxsize=16)
def _spline(timestamps: bytes, device: torch.device) -> _Spline:
    s = torch.frombuffer(bytearray(timestamps), dtype=torch.float64).to(device)
    knots = max(4, min(MAXIMUM_KNOTS, len(s) // 2))
    B = cubic_spline(s[:, None] * knots - torch.arange(-1, knots + 2).to(s))
    K = B.shape[1]
    D = torch.diff(torch.eye(K, dtype=s.dtype, device=s.device), n=ORDER, dim=0)
    # In units in which penalty and samples have equal weight overall.
    data, penalty = B.mT @ B, D.mT @ D
    penalty = penalty * (data.trace() / penalty.trace())
    # The small diagonal keeps splines without samples, which have a penalty only, invertible.
    L = torch.linalg.cholesky(data + penalty + 1e-13 * torch.eye(K).to(s))
    W = torch.linalg.solve_triangular(L, B.mT, upper=False)
    e, V = torch.linalg.eigh(W @ W.mT)
    return _Spline(W.mT @ V, e.clamp(0, 1), torch.logspace(-10, 6, STRENGTHS).to(s))


HUBER, TUKEY = 1.345, 4.685
"""Residuals, in standard deviations, beyond which trust falls and vanishes: 95 % efficiency for
Gaussian noise."""
MEDIAN_TO_DEVIATION = 1.4826
"""Ratio of the standard deviation to the median absolute value of Gaussian noise."""
MINIMUM_SPREAD = 1e-12
"""Spread of residuals relative to the range, below which they are rounding."""
MAXIMUM_ITERATIONS = 50
"""Limit of the reweighting, because trust may oscillate between samples and never settle."""
SETTLED = 1e-3
"""Change of trust at which the reweighting ends."""


def huber(residual: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Trust for a residual >= 0 in standard deviations: one, then falling as its inverse."""
    return HUBER / residual.clamp(min=HUBER)


def tukey(residual: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Biweight trust: falls from the start and is zero far off."""
    return (1 - (residual / TUKEY).clamp(max=1) ** 2) ** 2


LOSSES: dict[str, Callable[[Tensor], Tensor]] = {"huber": huber, "tukey": tukey}


def without_outliers(
    loss: str, response: Response, samples: Samples, regularization: float
) -> tuple[Samples, Float[Tensor, "B D T"]]:
    """Samples with outliers pulled in, and the trust in each recorded sample.

    Args:
        loss: `"huber"`, convex with a unique solution; `"tukey"`, which continues from that
            solution and ignores far outliers.
        response: Response of the primitive to be fitted.
        samples: One demonstration or many.
        regularization: Ridge, relative to the largest singular value.

    Raises:
        ValueError: Unknown loss.
    """
    if loss not in LOSSES:
        raise ValueError(f"unknown robust loss {loss!r}; choose from {', '.join(LOSSES)}")
    position = samples.position.double()
    trust = torch.zeros_like(position)
    pulled_in, reachable = position.clone(), None
    for i, valid in enumerate(samples.mask):
        # On a shared grid, the reachable motions are the same for all demonstrations.
        if reachable is None or not samples.shared_grid:
            reachable = _ReachableMotions(response, samples.s[i, valid], regularization)
        y = position[i, :, valid]
        fitted, trusted = _fit_robustly(loss, reachable, y)
        trust[i, :, valid] = trusted
        pulled_in[i, :, valid] = fitted + trusted * (y - fitted)
    return replace(samples, position=pulled_in.to(samples.position)), trust


class _ReachableMotions:
    """Motions that a primitive can make at given times, with start and goal free.

    The goal is defined as the motion at the last time. If the last sample were the goal,
    nothing could tell whether it is an outlier.
    """

    def __init__(self, response: Response, s: Float[Tensor, "T"], regularization: float):
        N = response.basis.count
        H = response.evaluate(s)[:, 0]
        goal = torch.zeros_like(H[-1])
        goal[-1] = 1.0
        # The motion at all times but the last, the goal, and the distance by which it is
        # missed.
        A = torch.cat([H[:-1], goal[None], (H[-1] - goal)[None]])
        U, sigma, _ = torch.linalg.svd(
            A * balanced_units(response.basis, A, A.shape[1] - N), full_matrices=False
        )
        self._U = U
        self._ridge = torch.diag((regularization * sigma[0] / sigma) ** 2)

    def closest(
        self, y: Float[Tensor, "D T"], trust: Float[Tensor, "D T"]
    ) -> Float[Tensor, "D T"]:
        """Motion with the least weighted squared distance to the samples."""
        trust = torch.nn.functional.pad(trust, (0, 1), value=1.0)
        y = torch.nn.functional.pad(y, (0, 1))
        weighted = self._U.mT * trust[:, None]
        # U is orthonormal, so squaring it loses little.
        normal = weighted @ self._U + self._ridge
        c = torch.linalg.solve(normal, weighted @ y[..., None])
        return (self._U @ c)[:, :-1, 0]


def _fit_robustly(
    loss: str, reachable: _ReachableMotions, y: Float[Tensor, "D T"]
) -> tuple[Float[Tensor, "D T"], Float[Tensor, "D T"]]:
    """Closest motion, and the trust in each sample."""
    trust, spread = torch.ones_like(y), torch.zeros_like(y[:, :1])
    fitted = reachable.closest(y, trust)
    # The tiny number covers a coordinate that never moves and has no range.
    least = MINIMUM_SPREAD * (y.amax(-1) - y.amin(-1))[:, None] + torch.finfo(y.dtype).tiny
    # Biweights have several minima: they start from the unique Huber solution and keep its
    # spread.
    for name in dict.fromkeys(("huber", loss)):
        for _ in range(MAXIMUM_ITERATIONS):
            residual = (y - fitted).abs()
            if name == "huber":
                spread = MEDIAN_TO_DEVIATION * residual.median(-1, keepdim=True).values
                spread = torch.maximum(spread, least)
            before, trust = trust, LOSSES[name](residual / spread)
            fitted = reachable.closest(y, trust)
            if (trust - before).abs().amax() < SETTLED:
                break
    return fitted, trust
