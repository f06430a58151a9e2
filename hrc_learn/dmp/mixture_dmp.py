"""Several routes of a motion, each a Gaussian over primitives.

If demonstrations pass an obstacle on both sides, their mean collides with the obstacle. A
mixture separates the routes by expectation-maximisation on the paths. What is known before the
motion (start and goal, or another context) or observed during it determines the likely mode.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import Points, Times, Vectors, contexts_of, finite, to_tensor
from hrc_learn.dmp.motion_primitive import MotionPrimitive
from hrc_learn.dmp.probabilistic_dmp import (
    PATH_TIMES,
    ProbabilisticDMP,
    gaussians_of_modes,
    with_common_reference,
)
from hrc_learn.geometry import Pose

EXPLAINED, MAXIMUM_DIRECTIONS = 0.9, 3
"""`EXPLAINED`: fraction of the variance of paths that the principal directions explain.
`MAXIMUM_DIRECTIONS`: largest number of these directions; with few demonstrations, further
directions reflect chance."""
MINIMUM_SPREAD = 0.1
"""Smallest spread within a mode, relative to the total: two demonstrations that agree by chance
must not form a mode."""
STRONG_EVIDENCE = 10.0
"""Decrease of the Bayesian information criterion that is very strong evidence for more modes
(Kass and Raftery 1995, "Bayes factors"). With few demonstrations, chance alone may cause half
this decrease."""
MAXIMUM_ITERATIONS, SETTLED = 100, 1e-6
"""Largest number of iterations, and change of responsibilities below which iteration ends."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MixtureDMP[P: MotionPrimitive]:
    """Modes of a motion, each a `ProbabilisticDMP`, and their probabilities.

    `at` and `condition` return the updated mixture.
    """

    modes: tuple[ProbabilisticDMP[P], ...]
    probability: Float[Tensor, "K"]
    """Probability of each mode; after `fit`, the fraction of the demonstrations in the mode."""
    responsibilities: Float[Tensor, "n K"]
    """Probability of each mode for each demonstration; rows sum to one."""
    contexts: Float[Tensor, "K C"]
    """Mean context of each mode."""
    precision: Float[Tensor, "C C"]
    """Inverse covariance of contexts around these means."""

    @classmethod
    def fit(
        cls,
        primitives: P,
        context: Vectors | None = None,
        n_modes: int | None = None,
        *,
        slack: float = 0.0,
    ) -> "MixtureDMP[P]":
        """Separate a batch of primitives into modes.

        Args:
            primitives: Primitives of several demonstrations, fitted with `scaling="none"`.
            context: Values (n, C) known before each motion. None: starts and goals, in columns.
            n_modes: Number K of modes. None: the smallest number whose Bayesian information
                criterion (Schwarz 1978) is at most `STRONG_EVIDENCE` above the least, among
                numbers up to half the demonstrations.
            slack: Freedom beyond the variation of the demonstrations; see
                `ProbabilisticDMP.fit`.

        Raises:
            ValueError: Fewer than two primitives, more modes than primitives, or contexts that
                are not finite or not one row for each primitive.
        """
        motion = with_common_reference(primitives).motion
        n = motion.weights.shape[:-2].numel()
        if n < 2:
            raise ValueError("a distribution needs a batch of at least 2 primitives")
        x = motion.coordinates().detach().double().flatten(0, -3)
        if n_modes is not None and not 1 <= n_modes <= n:
            raise ValueError(f"{n} primitives have 1 to {n} modes, not {n_modes}")
        s = torch.linspace(0, 1, PATH_TIMES, dtype=torch.float64).to(x)
        paths = (x @ motion.response.evaluate(s)[:, 0].mT).flatten(1)
        r = _responsibilities(principal_components(paths), n_modes)
        c = x[..., -2:].flatten(1) if context is None else contexts_of(context, n, x.device)
        return cls(
            modes=tuple(gaussians_of_modes(primitives, r, slack)),
            probability=r.mean(0),
            responsibilities=r,
            contexts=(r / r.sum(0)).mT @ c,
            precision=_context_precision(c, r),
        )

    @property
    def most_likely(self) -> ProbabilisticDMP[P]:
        """Mode with the largest probability."""
        return self.modes[int(self.probability.argmax())]

    def mean_primitive(self) -> P:
        """Mean of the most likely mode; the mean of all modes would follow no route."""
        return self.most_likely.mean_primitive()

    def at(self, context: Vectors) -> "MixtureDMP[P]":
        """Mixture given a context, (C,): modes with similar contexts become more likely."""
        c = finite("context", to_tensor(context, torch.float64))
        if c.shape != self.contexts.shape[1:]:
            raise ValueError(
                f"context must be {tuple(self.contexts.shape[1:])}, got {tuple(c.shape)}"
            )
        off = c - self.contexts
        return self._updated((off @ self.precision * off).sum(-1) / -2)

    def condition(
        self,
        time: Times,
        value: Points | Pose,
        velocity: Points | None = None,
        *,
        noise: float = 1e-6,
    ) -> "MixtureDMP[P]":
        """Mixture conditioned on via points; see `ProbabilisticDMP.condition`.

        The density of the values under each mode updates the probabilities, and each mode is
        conditioned.
        """
        densities = [mode.log_prob(time, value, noise=noise) for mode in self.modes]
        modes = [mode.condition(time, value, velocity, noise=noise) for mode in self.modes]
        return replace(self._updated(torch.stack(densities)), modes=tuple(modes))

    def _updated(self, log_likelihood: Float[Tensor, "K"]) -> "MixtureDMP[P]":
        """Mixture with probabilities updated by Bayes' rule."""
        score = self.probability.log() + log_likelihood
        return replace(self, probability=torch.softmax(score, 0))


def principal_components(paths: Float[Tensor, "n F"]) -> Float[Tensor, "n d"]:
    """Coordinates of paths along the directions of largest variance."""
    U, sigma, _ = torch.linalg.svd(paths - paths.mean(0), full_matrices=False)
    explained = sigma.square().cumsum(0) / sigma.square().sum().clamp(min=1e-300)
    d = min(int((explained < EXPLAINED).sum()) + 1, MAXIMUM_DIRECTIONS)
    return U[:, :d] * sigma[:d]


def _responsibilities(z: Float[Tensor, "n d"], n_modes: int | None) -> Float[Tensor, "n K"]:
    """Responsibilities of K modes, or of as many as the evidence supports."""
    n, d = z.shape
    if n_modes is not None:
        return _expectation_maximisation(z, n_modes)[0]
    found = []
    for K in range(1, max(n // 2, 1) + 1):
        r, log_likelihood = _expectation_maximisation(z, K)
        # Parameters: probabilities and means of the modes, and one spread per direction.
        criterion = ((K - 1) + K * d + d) * math.log(n) - 2 * log_likelihood
        found.append((criterion, r))
    least = min(criterion for criterion, _ in found)
    return next(r for criterion, r in found if criterion <= least + STRONG_EVIDENCE)


def _expectation_maximisation(
    z: Float[Tensor, "n d"], K: int
) -> tuple[Float[Tensor, "n K"], float]:
    """Responsibilities of K Gaussians with one diagonal covariance, and the log likelihood.

    The start is deterministic: samples far from each other are the first means (Gonzalez 1985).
    """
    centres = z.square().sum(-1).argmax()[None]
    while len(centres) < K:
        distance = torch.cdist(z, z[centres]).amin(-1)
        centres = torch.cat([centres, distance.argmax()[None]])
    least = MINIMUM_SPREAD**2 * z.var(0, correction=0) + torch.finfo(z.dtype).tiny
    r = torch.nn.functional.one_hot(torch.cdist(z, z[centres]).argmin(-1), K).to(z)
    log_density = torch.zeros_like(r)
    for _ in range(MAXIMUM_ITERATIONS):
        weight = r.sum(0).clamp(min=torch.finfo(z.dtype).tiny)
        means = r.mT @ z / weight[:, None]
        square = (z[:, None] - means).square()
        # Each mean costs one degree of freedom, which matters for few samples.
        spread = (r[..., None] * square).sum((0, 1)) / max(len(z) - K, 1)
        variance = torch.maximum(spread, least)
        log_density = (weight / len(z)).log() - (
            square / variance + (2 * torch.pi * variance).log()
        ).sum(-1) / 2
        before, r = r, torch.softmax(log_density, -1)
        if (r - before).abs().amax() < SETTLED:
            break
    return r, torch.logsumexp(log_density, -1).sum().item()


def _context_precision(
    c: Float[Tensor, "n C"], r: Float[Tensor, "n K"]
) -> Float[Tensor, "C C"]:
    """Inverse covariance of contexts around the means of their modes.

    `MINIMUM_SPREAD`^2 times the mean variance of all contexts is added to each variance,
    so that a context makes a mode likely but never certain.
    """
    off = (c[:, None] - (r / r.sum(0)).mT @ c) * r.sqrt()[..., None]
    within = off.flatten(0, 1)
    covariance = within.mT @ within / max(len(c) - r.shape[1], 1)
    floor = MINIMUM_SPREAD**2 * c.var(0, correction=0).mean() + torch.finfo(c.dtype).tiny
    return torch.linalg.inv(covariance + floor * torch.eye(c.shape[1]).to(c))
