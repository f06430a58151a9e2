"""Several ways of doing one thing: a mixture of Gaussians over primitives, one for each way.

The mean of demonstrations that pass an obstacle on either side leads into it. So they are
parted first, by expectation and maximisation on the paths they take, and what is asked for
(start and goal, or any other context; values seen under way) tells which way is meant.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import Points, Times, Vectors, to_tensor
from hrc_learn.dmp.linear_primitive import LinearPrimitive
from hrc_learn.dmp.motion_primitive import AdaptedPrimitive
from hrc_learn.dmp.probabilistic_dmp import ProbabilisticDMP, alike
from hrc_learn.geometry import Pose

PATH_TIMES = 30
"""At which paths are compared; between two of them no way of an arm parts and joins again."""
EXPLAINED, MOST_DIRECTIONS = 0.9, 3
"""Share of the variance of paths in the directions they are compared in, and how many of these
at most: few demonstrations leave chance to decide about the others."""
LEAST_SPREAD = 0.1
"""Within a mode, as a share of that over all: demonstrations that agree better by chance, as
two may, must not count for a mode."""
STRONG_EVIDENCE = 10.0
"""Difference of the criterion that speaks very strongly for more modes (Kass and Raftery 1995,
"Bayes factors"): with few demonstrations chance alone makes half of it."""
ROUNDS, SETTLED = 100, 1e-6
"""Of expectation and maximisation; change of responsibilities at which it ends."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MixtureDMP[P: AdaptedPrimitive]:
    """Modes of a motion, each a `ProbabilisticDMP`, and how likely each of them is.

    All modes share the covariance around their means: of each alone, few demonstrations would
    tell too little. `at`, `condition` and the other methods return what is known afterwards.
    """

    modes: tuple[ProbabilisticDMP[P], ...]
    probability: Float[Tensor, "K"]
    """Of each mode; beforehand, its share of the demonstrations."""
    responsibilities: Float[Tensor, "n K"]
    """Of each mode for each demonstration; rows sum to one."""
    contexts: Float[Tensor, "K C"]
    """Mean of the contexts of each mode."""
    precision: Float[Tensor, "C C"]
    """Inverse covariance of contexts around these."""

    @classmethod
    def fit(
        cls,
        primitives: P,
        context: Vectors | None = None,
        n_modes: int | None = None,
        *,
        slack: float = 0.0,
    ) -> "MixtureDMP[P]":
        """Part a batch of primitives into modes.

        Args:
            primitives: Of several demonstrations, fitted with `scaling="none"`.
            context: (n, C) that is known beforehand; starts and goals, in columns, if None.
            n_modes: K. None: as few as the Bayesian information criterion (Schwarz 1978) does
                not speak strongly against, half as many as demonstrations at most.
            slack: Freedom beyond what the demonstrations vary; see `ProbabilisticDMP.fit`.

        Raises:
            ValueError: Fewer than two primitives, more modes than primitives, or contexts of
                another number.
        """
        whole = ProbabilisticDMP.fit(primitives, slack)
        motion = alike(primitives).linear_motion()
        x = motion.coordinates().detach().double().flatten(0, -3)
        n = len(x)
        if n_modes is not None and not 1 <= n_modes <= n:
            raise ValueError(f"{n} primitives have 1 to {n} modes, not {n_modes}")
        paths = principal_components(_paths(motion))
        r = _responsibilities(paths, n_modes)
        share = r / r.sum(0)
        means = torch.einsum("nk,ndm->kdm", share, x)
        duration = share.mT @ motion.duration.detach().double().flatten()
        # Around the means of its modes each primitive counts by how much it is of them.
        off = ((x[:, None] - means) * r.sqrt()[..., None, None]).flatten(2).flatten(0, 1)
        spread = off.mT / max(n - r.shape[1], 1) ** 0.5
        free = whole.spread[:, n:]
        modes = []
        for mean, tau in zip(means, duration, strict=True):
            of_mode = whole.primitive.linear_motion().with_coordinates(mean, tau)
            modes.append(
                replace(
                    whole,
                    primitive=whole.primitive.with_motion(of_mode),
                    mean=mean,
                    spread=torch.cat([spread, free], dim=1),
                )
            )
        if context is None:
            c = x[..., -2:].flatten(1)
        else:
            c = to_tensor(context, torch.float64).reshape(n, -1)
        return cls(
            modes=tuple(modes),
            probability=r.mean(0),
            responsibilities=r,
            contexts=share.mT @ c,
            precision=_precision(c, r, share),
        )

    @property
    def most_likely(self) -> ProbabilisticDMP[P]:
        """The mode of the largest probability."""
        return self.modes[int(self.probability.argmax())]

    def mean_primitive(self) -> P:
        """The mean of the most likely mode: that of all would be none of their ways."""
        return self.most_likely.mean_primitive()

    def at(self, context: Vectors) -> "MixtureDMP[P]":
        """Given a context, (C,): modes whose demonstrations had the like are more likely."""
        c = to_tensor(context, torch.float64)
        if c.shape != self.contexts.shape[1:]:
            raise ValueError(
                f"context must be {tuple(self.contexts.shape[1:])}, got {tuple(c.shape)}"
            )
        off = c - self.contexts
        return self._given((off @ self.precision * off).sum(-1) / -2)

    def condition(
        self,
        time: Times,
        value: Points | Pose,
        velocity: Points | None = None,
        *,
        noise: float = 1e-6,
        **others: Any,
    ) -> "MixtureDMP[P]":
        """Given where the motion passes; see `ProbabilisticDMP.condition`.

        Modes are likely by the density that they give the values, and each is conditioned.
        """
        body = {k: x for k, x in others.items() if k == "body"}
        known = self._given(self._log_densities(time, value, noise=noise, **body))
        modes = [
            mode.condition(time, value, velocity, noise=noise, **others) for mode in self.modes
        ]
        return replace(known, modes=tuple(modes))

    def log_prob(
        self, time: Times, value: Points | Pose, *, noise: float, **others: Any
    ) -> Float[Tensor, ""]:
        """Log density of what was observed; see `ProbabilisticDMP.log_prob`."""
        densities = self._log_densities(time, value, noise=noise, **others)
        return torch.logsumexp(densities + self.probability.log(), 0)

    def sample(self, n: int, generator: torch.Generator | None = None) -> P:
        """A batch of n primitives drawn at random, each of a mode drawn first."""
        # On the CPU, as all of it: a seed means the same on every device.
        likely = self.probability.cpu()
        drawn = torch.multinomial(likely, n, replacement=True, generator=generator)
        drawn = drawn.to(self.probability.device)
        spread = torch.stack([mode.spread for mode in self.modes])[drawn]
        z = torch.randn(n, spread.shape[-1], 1, generator=generator, dtype=torch.float64)
        means = torch.stack([mode.mean for mode in self.modes])[drawn]
        motions = [mode.primitive.linear_motion() for mode in self.modes]
        duration = torch.stack([motion.duration for motion in motions])[drawn]
        x = means + (spread @ z.to(spread)).view(means.shape)
        return self.modes[0].primitive.with_motion(motions[0].with_coordinates(x, duration))

    def _log_densities(self, time: Times, value: Any, **others: Any) -> Float[Tensor, "K"]:
        return torch.stack([mode.log_prob(time, value, **others) for mode in self.modes])

    def _given(self, log_likelihood: Float[Tensor, "K"]) -> "MixtureDMP[P]":
        """What is known after something this likely under each mode."""
        score = self.probability.log() + log_likelihood
        return replace(self, probability=torch.softmax(score, 0))


def _paths(motion: LinearPrimitive) -> Float[Tensor, "n DT"]:
    s = torch.linspace(0, 1, PATH_TIMES, dtype=torch.float64)
    rows = motion.response.evaluate(s.to(motion.start.device))[:, 0]
    x = motion.coordinates().detach().double().flatten(0, -3)
    return (x @ rows.mT).flatten(1)


def principal_components(paths: Float[Tensor, "n F"]) -> Float[Tensor, "n d"]:
    """Paths in the directions that they differ in most."""
    U, sigma, _ = torch.linalg.svd(paths - paths.mean(0), full_matrices=False)
    share = sigma.square().cumsum(0) / sigma.square().sum().clamp(min=1e-300)
    d = min(int((share < EXPLAINED).sum()) + 1, MOST_DIRECTIONS)
    return U[:, :d] * sigma[:d]


def _responsibilities(z: Float[Tensor, "n d"], n_modes: int | None) -> Float[Tensor, "n K"]:
    """Of K modes, or of as many as there is evidence for."""
    n, d = z.shape
    if n_modes is not None:
        return _expectation_maximisation(z, n_modes)[0]
    found = []
    for K in range(1, max(n // 2, 1) + 1):
        r, log_likelihood = _expectation_maximisation(z, K)
        # Means and shares of the modes, and one spread in each direction.
        criterion = ((K - 1) + K * d + d) * math.log(n) - 2 * log_likelihood
        found.append((criterion, r))
    least = min(criterion for criterion, _ in found)
    return next(r for criterion, r in found if criterion <= least + STRONG_EVIDENCE)


def _expectation_maximisation(
    z: Float[Tensor, "n d"], K: int
) -> tuple[Float[Tensor, "n K"], float]:
    """Responsibilities of K Gaussians of one diagonal covariance, and the log likelihood.

    It begins with the samples farthest from each other (Gonzalez 1985): always the same ones.
    """
    middle = z.square().sum(-1).argmax()[None]
    while len(middle) < K:
        away = torch.cdist(z, z[middle]).amin(-1)
        middle = torch.cat([middle, away.argmax()[None]])
    total = z.var(0, correction=0)
    least = LEAST_SPREAD**2 * total + torch.finfo(z.dtype).tiny
    r = torch.nn.functional.one_hot(torch.cdist(z, z[middle]).argmin(-1), K).to(z)
    log_density = torch.zeros_like(r)
    for _ in range(ROUNDS):
        weight = r.sum(0).clamp(min=torch.finfo(z.dtype).tiny)
        means = r.mT @ z / weight[:, None]
        square = (z[:, None] - means).square()
        # Each mean takes one degree of freedom, which with few samples is much of them.
        spread = (r[..., None] * square).sum((0, 1)) / max(len(z) - K, 1)
        variance = torch.maximum(spread, least)
        log_density = (weight / len(z)).log() - (
            square / variance + (2 * torch.pi * variance).log()
        ).sum(-1) / 2
        before, r = r, torch.softmax(log_density, -1)
        if (r - before).abs().amax() < SETTLED:
            break
    return r, torch.logsumexp(log_density, -1).sum().item()


def _precision(c: Tensor, r: Tensor, share: Tensor) -> Float[Tensor, "C C"]:
    """Inverse covariance of contexts around the means of their modes.

    What varies hardly at all within modes is taken to vary by `LEAST_SPREAD` of what it does
    over all, in the mean of the coordinates: a context is a hint, and no proof.
    """
    off = (c[:, None] - share.mT @ c) * r.sqrt()[..., None]
    within = off.flatten(0, 1)
    covariance = within.mT @ within / max(len(c) - r.shape[1], 1)
    floor = LEAST_SPREAD**2 * c.var(0, correction=0).mean() + torch.finfo(c.dtype).tiny
    return torch.linalg.inv(covariance + floor * torch.eye(c.shape[1]).to(c))
