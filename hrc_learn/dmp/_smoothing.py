"""What a recording holds of a motion and what of noise.

Penalised splines (Eilers and Marx 1996, "Flexible smoothing with B-splines and penalties"):
y = B c + noise, with a penalty on the third differences of c, which stand for the jerk. How
strong it is, the evidence says: the restricted likelihood of the samples (Wood 2011) if jerks
are Gaussian, each column for itself. The same likelihood gives the standard deviation of the
noise, whatever its cause: encoders, a tracker, a trembling hand faster than the motion.
"""

import warnings
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import Samples, demo_label
from hrc_learn.dmp._system.bases import cubic_spline

MOST_KNOTS = 120
"""Intervals of the splines: finer than the most basis functions there are to choose from."""
STRENGTHS = 81
"""Penalties compared, from 1e-10 to 1e6 times the one as strong as the samples: a fifth of a
decade apart, which changes the error by less than a percent."""
AS_LIKELY = 1.0
"""Twice the logarithm of a likelihood ratio that says nothing yet: of two standard deviations
it would be four."""
CLEAN = 2e-5
"""Share of the range below which noise is left in: it is the accuracy of fifty functions."""
ORDER = 3
"""Of the differences: a motion without jerk is a parabola."""


def smoothed(samples: Samples) -> tuple[Samples, Float[Tensor, "B D"]]:
    """Samples without their noise, and its standard deviation in each column.

    Columns with less noise than `CLEAN` stay as they are, and so do those that never move.
    """
    position = samples.position.double()
    smooth, noise = position.clone(), torch.zeros_like(position[..., 0])
    if samples.shared:
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
    """Warn of as many functions as samples: between these the motion is arbitrary."""
    if samples.complete and samples.s.shape[-1] > n_basis:
        return  # without looking: a short fit notices
    counts = samples.mask.sum(-1)
    if (counts <= n_basis).any():
        i = int((counts <= n_basis).nonzero()[0])
        warnings.warn(
            f"{demo_label(i, samples.batch)}{n_basis} basis functions are fitted to "
            f"{int(counts[i])} samples, which cannot tell them apart: the motion between "
            "samples is arbitrary. Take fewer, or have noise taken off (smooth=True).",
            stacklevel=4,
        )


@dataclass(frozen=True, eq=False)
class _Spline:
    """Splines at some times, in coordinates that neither samples nor penalty mix."""

    U: Float[Tensor, "T K"]
    """Samples to coordinates, and back to the motion."""
    data: Float[Tensor, "K"]
    """What the samples say of each coordinate, 0 to 1; the penalty says the rest."""
    strengths: Float[Tensor, "L"]

    def smooth(self, y: Float[Tensor, "C T"]) -> tuple[Float[Tensor, "C T"], Tensor]:
        """The motion of most evidence and the noise about it."""
        T = y.shape[-1]
        middle = y.mean(-1, keepdim=True)
        y = y - middle
        c = y @ self.U
        e, r = self.data, 1 - self.data
        # Coordinate k has the prior precision of lambda r_k, the samples' is e_k.
        total = e + self.strengths[:, None] * r
        free = r < 1e-9
        n = T - int(free.sum())
        # What the penalty and the distance to the samples come to, at the least of both.
        misfit = y.square().sum(-1)[:, None] - c.square() @ (1 / total).mT
        misfit = misfit.clamp(min=torch.finfo(y.dtype).tiny)
        prior = torch.where(free, 1.0, self.strengths[:, None] * r)
        known = torch.where(free, 1.0, total)
        score = n * misfit.log() + (known.log() - prior.log()).sum(-1)
        # The strongest of the penalties that the samples do not speak against.
        likely = score <= score.amin(-1, keepdim=True) + AS_LIKELY
        best = (likely * torch.arange(1, STRENGTHS + 1, device=y.device)).argmax(-1)
        fitted = (c / total[best]) @ self.U.mT
        noise = (misfit.gather(-1, best[:, None])[:, 0] / n).sqrt()
        return fitted + middle, noise


# Sampled alike, demonstrations share one.
@lru_cache(maxsize=16)
def _spline(timestamps: bytes, device: torch.device) -> _Spline:
    s = torch.frombuffer(bytearray(timestamps), dtype=torch.float64).to(device)
    knots = max(4, min(MOST_KNOTS, len(s) // 2))
    B = cubic_spline(s[:, None] * knots - torch.arange(-1, knots + 2).to(s))
    K = B.shape[1]
    D = torch.diff(torch.eye(K, dtype=s.dtype, device=s.device), n=ORDER, dim=0)
    # In units in which penalty and samples are alike on the whole.
    data, penalty = B.mT @ B, D.mT @ D
    penalty = penalty * (data.trace() / penalty.trace())
    # Splines that no sample lies on have the penalty alone.
    L = torch.linalg.cholesky(data + penalty + 1e-13 * torch.eye(K).to(s))
    W = torch.linalg.solve_triangular(L, B.mT, upper=False)
    e, V = torch.linalg.eigh(W @ W.mT)
    return _Spline(W.mT @ V, e.clamp(0, 1), torch.logspace(-10, 6, STRENGTHS).to(s))
