"""Gaussians over primitives, their mean and their mixtures, from several demonstrations.

The mean of demonstrations that pass an obstacle on either side collides with it. A mixture
separates them by expectation-maximisation on their paths. What is known before the motion
(start and goal, or another context) or observed during it determines the likely mode.

Orientations and poses move linearly in columns, so everything is computed on the columns of
their `motion`.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import Points, Scalars, Times, Vectors, seconds, to_tensor
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.linear_primitive import Boundary, LinearPrimitive
from hrc_learn.dmp.motion_primitive import MotionPrimitive, ViaOptions
from hrc_learn.dmp.orientation_error import intrinsic_mean, nearest_turn, reference_of, to_error
from hrc_learn.dmp.via_points import ViaPoints
from hrc_learn.geometry import Pose

PATH_TIMES = 30
"""Times at which paths are compared; no two routes separate and join again between them."""
EXPLAINED, MAXIMUM_DIRECTIONS = 0.9, 3
"""Fraction of the variance of paths in the directions of comparison, and the largest number of
these: with few demonstrations, further directions are chance."""
MINIMUM_SPREAD = 0.1
"""Spread within a mode, relative to the total: two demonstrations that agree by chance must not
form a mode."""
STRONG_EVIDENCE = 10.0
"""Difference of the criterion that is very strong evidence for more modes (Kass and Raftery
1995, "Bayes factors"); with few demonstrations, chance alone makes half of it."""
MAXIMUM_ITERATIONS, SETTLED = 100, 1e-6
"""Limit of expectation-maximisation, and change of responsibilities at which it ends."""
SAME_ORIENTATION = 1e-9
"""Angle [rad] below which orientations count as equal: above rounding, below any sensor."""


def mean_primitive[P: MotionPrimitive](primitives: P) -> P:
    """Mean over all batch dimensions of a primitive.

    A rollout is linear in weights, start, goal and start velocity. For one duration, and a
    scaling that does not depend on start and goal, its mean is the rollout of the means.

    Args:
        primitives: Primitives fitted to several demonstrations of one motion.

    Returns:
        A primitive without batch dimensions and without a fit report.

    Raises:
        ValueError: The scaling is `"rotation"`, with weights in a frame per demonstration.
    """
    motion, columns = _mean_motion(primitives.motion), primitives.error_columns
    if columns is None:
        return primitives.with_motion(motion)
    goal: Any = primitives.goal
    q = goal.orientation if isinstance(goal, Pose) else goal
    middle = intrinsic_mean(q.reshape(-1, 4))
    return primitives.with_motion(motion, reference_of(motion.goal[..., columns], middle))


def with_common_reference[P: MotionPrimitive](primitives: P) -> P:
    """Batch of primitives whose columns mean the same for all of them.

    Orientations with different goals become errors to the mean of their references. The map is
    not linear, so the errors are fitted again.
    """
    columns = primitives.error_columns
    if columns is None:
        return primitives
    own: Any = primitives.reference
    middle = intrinsic_mean(own.reshape(-1, 4))
    motion = primitives.motion
    if (to_error(own, middle).abs() < SAME_ORIENTATION).all():
        return primitives
    if motion.basis.periodic:
        raise ValueError("rhythms about different centres have no distribution")
    with torch.no_grad():
        shown: Any = primitives.rollout()
        errors = motion.rollout_columns(Boundary(), motion.duration).position[..., columns]
    fitted = JointDMP.fit(
        shown.time,
        nearest_turn(to_error(shown.orientation, middle), errors),
        basis=motion.basis,
        spring=motion.spring,
        approach=motion.response.approach,
    )
    x = motion.coordinates().detach().clone()
    x[..., columns, :] = fitted.coordinates().detach()
    motion = motion.with_coordinates(x, motion.duration)
    return primitives.with_motion(motion, middle.expand_as(own))


def _mean_motion(motions: LinearPrimitive) -> LinearPrimitive:
    if motions.forcing_scale.turns and motions.weights.ndim > 2:
        raise ValueError(
            f"scaling {motions.scaling!r} gives each primitive a frame of its own: fit with "
            "'none' to average them"
        )
    x, count = motions.coordinates().detach(), motions.timestamps.shape[-1]
    batch = x.ndim - 2

    def mean(tensor: Tensor) -> Tensor:
        return tensor.flatten(0, batch - 1).mean(dim=0) if batch else tensor

    return motions.with_coordinates(
        mean(x),
        mean(motions.duration),
        amplitude=mean(motions.amplitude),
        timestamps=torch.linspace(0, 1, count, dtype=torch.float64).to(motions.timestamps),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class ProbabilisticDMP[P: MotionPrimitive]:
    """Gaussian over the coordinates x = (weights, start velocity, start, goal) of a primitive.

    A motion is linear in its coordinates, y(s) = H(s) x, and therefore Gaussian too: means,
    likelihoods and conditioning on via points are closed form. All joints vary together, in
    float64. Any kind of primitive is accepted; for orientations and poses the error to one
    reference is Gaussian.
    """

    primitive: P
    """Primitive with the common spring, basis, duration, names and reference."""
    mean: Float[Tensor, "D M"]
    spread: Float[Tensor, "DM rank"]
    """Square root of the covariance, with the rank of the demonstrations."""

    @classmethod
    def fit(cls, primitives: P, slack: float = 0.0) -> "ProbabilisticDMP[P]":
        """Compute mean and covariance of a batch of primitives.

        Args:
            primitives: Primitives of one motion, fitted with `scaling="none"`.
            slack: Freedom beyond the variation of the demonstrations, as in `around`. Without
                it, a via point that no mixture of them passes is approached but not reached.

        Raises:
            ValueError: Fewer than two primitives, or a scaling, which is not linear.
        """
        motion = primitives.motion
        batch = motion.weights.shape[:-2]
        if batch.numel() < 2 or not batch:
            raise ValueError("a distribution needs a batch of at least 2 primitives")
        _linear_coordinates(motion)
        primitives = with_common_reference(primitives)
        motion = primitives.motion
        x = _linear_coordinates(motion).flatten(0, -3)
        mean, middle = x.mean(0), mean_primitive(primitives).motion
        reference = getattr(primitives, "reference", None)
        if reference is not None:
            reference = reference.reshape(-1, 4)[0]
        # n - 1, because the mean is taken from the same primitives.
        spread = (x - mean).flatten(1).mT / (len(x) - 1) ** 0.5
        if slack:
            spread = torch.cat([spread, _free_forcing(middle, slack)], dim=1)
        return cls(
            primitive=primitives.with_motion(middle, reference), mean=mean, spread=spread
        )

    @classmethod
    def around(cls, primitive: P, slack: float = 1.0) -> "ProbabilisticDMP[P]":
        """Gaussian around one primitive whose forcing may vary, for via points.

        Start, start velocity and goal are certain.

        Args:
            primitive: A single primitive, fitted with `scaling="none"`.
            slack: Standard deviation of the forcing term, equal at all times, in units of the
                force that holds a coordinate at a distance of its range from the goal.
        """
        motion = primitive.motion
        certain = _linear_coordinates(motion)
        if certain.ndim != 2:
            raise ValueError(f"needs one primitive, got a batch {tuple(certain.shape[:-2])}")
        return cls(primitive=primitive, mean=certain, spread=_free_forcing(motion, slack))

    def mean_primitive(self) -> P:
        """Most likely primitive."""
        return self._with_coordinates(self.mean)

    def sample(self, n: int, generator: torch.Generator | None = None) -> P:
        """Batch of n random primitives."""
        rank = self.spread.shape[1]
        z = torch.randn(n, rank, generator=generator, dtype=torch.float64).to(self.spread)
        return self._with_coordinates(
            self.mean + (z @ self.spread.mT).unflatten(-1, self.mean.shape)
        )

    def position(self, time: Times) -> tuple[Float[Tensor, "T D"], Float[Tensor, "T D"]]:
        """Mean and standard deviation of the columns at times [s].

        Columns are joints, position, error to the primitive's reference, or body. For
        orientations, use `mean_primitive().rollout`.
        """
        motion = self.primitive.motion
        time = seconds(time, motion.start.device)
        if time.ndim != 1:
            raise ValueError(f"time must be (n,), got {tuple(time.shape)}")
        rows = motion.response.evaluate(time / motion.duration.double())[:, 0]
        mean, root = self._observe(rows)
        shape = (len(time), self.mean.shape[0])
        return mean.view(shape), root.norm(dim=-1).view(shape)

    def condition(
        self,
        time: Times,
        value: Points | Pose | None = None,
        velocity: Points | None = None,
        *,
        noise: Scalars | Vectors = 1e-6,
        **options: Unpack[ViaOptions],
    ) -> "ProbabilisticDMP[P]":
        """Gaussian conditioned on values and velocities at some times.

        Gradients flow to times, values, velocities, mean and spread.

        Args:
            time: Times of the via points [s], (n,).
            value: Joints (n, D), unit quaternions (n, 4) or a `Pose` of (n). NaN leaves a
                coordinate free; in a quaternion, the orientation.
            velocity: Of joints (n, D), angular (n, 3) or a twist (n, 6), per second. An angular
                one without an orientation is taken at that of the mean motion.
            noise: Standard deviation of each value in the units of its coordinate ([rad] for an
                orientation), or of each velocity per second; one number, (D,) or (n, D).
            options: Via points of the kind of primitive.
        """
        via = self._via(time, value, velocity, **options)
        motion = self.primitive.motion
        H, tau = motion.response.evaluate(via.s), motion.duration.double()
        mean, root = self._observe(torch.cat([H[:, 0], H[:, 1] / tau]))
        wanted = torch.cat([via.position, via.rate / tau]).reshape(-1)
        given = ~wanted.isnan()
        deviation = to_tensor(noise, mean.dtype, mean.device).expand_as(via.position)
        deviation = deviation.repeat(2, 1).reshape(-1)[given]
        # In units of the noise, and in coordinates z of the spread, whose prior is a unit
        # Gaussian.
        root = root[given] / deviation[:, None]
        residual = (wanted[given] - mean[given]) / deviation
        # The unit covariance keeps it positive definite for any number of equal via points.
        precision = root.mT @ root + torch.eye(root.shape[1]).to(root)
        factor = torch.linalg.cholesky(precision)
        z = torch.cholesky_solve((root.mT @ residual)[:, None], factor)[:, 0]
        # precision^-1 = L^-T L^-1: L^-T is a square root of the remaining variance.
        remaining = torch.linalg.solve_triangular(factor, self.spread.mT, upper=False).mT
        moved = self.mean + (self.spread @ z).view(self.mean.shape)
        return replace(self, mean=moved, spread=remaining)

    def log_prob(
        self, time: Times, value: Points | Pose, *, noise: float, **options: Unpack[ViaOptions]
    ) -> Float[Tensor, ""]:
        """Log density of values observed at times (n,) with this sensor noise.

        For orientations it is the density of the error to the primitive's reference. NaN marks
        values that were not observed.
        """
        via = self._via(time, value, None, **options)
        motion = self.primitive.motion
        mean, root = self._observe(motion.response.evaluate(via.s)[:, 0])
        seen = ~via.position.isnan().reshape(-1)
        z = (via.position.reshape(-1) - mean)[seen] / noise
        return log_density(z, root[seen] / noise) - len(z) * math.log(noise)

    def _via(
        self,
        time: Times,
        value: Points | Pose | None,
        velocity: Points | None,
        **options: Unpack[ViaOptions],
    ) -> ViaPoints:
        with torch.no_grad():
            middle = self.mean_primitive()
        via = middle.via_points(time, value, velocity, **options)
        if via.position.ndim != 2:
            raise ValueError(f"via points must be (n, D), got {tuple(via.position.shape)}")
        return via

    def _observe(self, rows: Float[Tensor, "T M"]) -> tuple[Tensor, Tensor]:
        """Mean (T D) of all columns at all times, and a square root of their covariance."""
        spread = self.spread.view(*self.mean.shape, -1)
        root = torch.einsum("tm,dmr->tdr", rows, spread)
        return (rows @ self.mean.mT).reshape(-1), root.flatten(0, 1)

    def _with_coordinates(self, x: Float[Tensor, "*batch D M"]) -> P:
        motion = self.primitive.motion
        return self.primitive.with_motion(motion.with_coordinates(x))


def log_density(
    z: Float[Tensor, "*batch n"], root: Float[Tensor, "*batch n rank"]
) -> Float[Tensor, "*batch"]:
    """Log density of a Gaussian with covariance I + root root', by Woodbury's identity."""
    factor = torch.linalg.cholesky(root.mT @ root + torch.eye(root.shape[-1]).to(root))
    part = torch.linalg.solve_triangular(factor, root.mT @ z[..., None], upper=False)
    square = z.square().sum(-1) - part.square().sum((-2, -1))
    size = z.shape[-1] * math.log(2 * math.pi)
    return -(square + size) / 2 - factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def _linear_coordinates(primitives: LinearPrimitive) -> Float[Tensor, "*batch D M"]:
    if primitives.scaling != "none":
        raise ValueError(f"scaling {primitives.scaling!r} is not linear: fit with 'none'")
    return primitives.coordinates().detach().double()


def _free_forcing(primitive: LinearPrimitive, slack: float) -> Float[Tensor, "DM DN"]:
    """Spread of independent weights with which the forcing varies equally at all times."""
    basis, amplitude = primitive.basis, primitive.amplitude.detach().double()
    D, N = len(amplitude), basis.count
    unit = 1 / basis.phase(basis.centre_times().to(amplitude))
    deviation = slack * primitive.spring.stiffness * amplitude[:, None] * unit
    spread = torch.zeros(D, N + 3, D, N).to(amplitude)
    spread[:, :N] = torch.diag_embed(deviation.flatten()).view(D, N, D, N)
    return spread.flatten(0, 1).flatten(1)


@dataclass(frozen=True, kw_only=True, eq=False)
class MixtureDMP[P: MotionPrimitive]:
    """Modes of a motion, each a `ProbabilisticDMP`, and their probabilities.

    All modes have the same covariance around their means, because one mode has too few
    demonstrations to estimate it. `at` and `condition` return the updated mixture.
    """

    modes: tuple[ProbabilisticDMP[P], ...]
    probability: Float[Tensor, "K"]
    """Probability of each mode; a priori, its fraction of the demonstrations."""
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
            context: (n, C) known before the motion; by default starts and goals, in columns.
            n_modes: K. None: the smallest number without strong evidence against it by the
                Bayesian information criterion (Schwarz 1978), at most half the demonstrations.
            slack: Freedom beyond the variation of the demonstrations; see
                `ProbabilisticDMP.fit`.

        Raises:
            ValueError: Fewer than two primitives, more modes than primitives, or another number
                of contexts.
        """
        whole = ProbabilisticDMP.fit(primitives, slack)
        motion = with_common_reference(primitives).motion
        x = motion.coordinates().detach().double().flatten(0, -3)
        n = len(x)
        if n_modes is not None and not 1 <= n_modes <= n:
            raise ValueError(f"{n} primitives have 1 to {n} modes, not {n_modes}")
        r = _responsibilities(principal_components(_paths(motion)), n_modes)
        fraction = r / r.sum(0)
        means = torch.einsum("nk,ndm->kdm", fraction, x)
        duration = fraction.mT @ motion.duration.detach().double().flatten()
        # Around the means of its modes, each primitive is weighted by its responsibilities.
        off = ((x[:, None] - means) * r.sqrt()[..., None, None]).flatten(2).flatten(0, 1)
        spread = off.mT / max(n - r.shape[1], 1) ** 0.5
        spread = torch.cat([spread, whole.spread[:, n:]], dim=1)
        middle = whole.primitive.motion
        modes = [
            replace(
                whole,
                primitive=whole.primitive.with_motion(middle.with_coordinates(mean, tau)),
                mean=mean,
                spread=spread,
            )
            for mean, tau in zip(means, duration, strict=True)
        ]
        if context is None:
            c = x[..., -2:].flatten(1)
        else:
            c = to_tensor(context, torch.float64).reshape(n, -1)
        return cls(
            modes=tuple(modes),
            probability=r.mean(0),
            responsibilities=r,
            contexts=fraction.mT @ c,
            precision=_context_precision(c, r, fraction),
        )

    @property
    def most_likely(self) -> ProbabilisticDMP[P]:
        """Mode of the largest probability."""
        return self.modes[int(self.probability.argmax())]

    def mean_primitive(self) -> P:
        """Mean of the most likely mode; the mean of all modes would take none of the routes."""
        return self.most_likely.mean_primitive()

    def at(self, context: Vectors) -> "MixtureDMP[P]":
        """Mixture given a context, (C,): modes with similar contexts become more likely."""
        c = to_tensor(context, torch.float64)
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
        **options: Unpack[ViaOptions],
    ) -> "MixtureDMP[P]":
        """Mixture conditioned on via points; see `ProbabilisticDMP.condition`.

        The density of the values under each mode updates the probabilities, and each mode is
        conditioned.
        """
        body = options.get("body")
        densities = [mode.log_prob(time, value, noise=noise, body=body) for mode in self.modes]
        modes = [
            mode.condition(time, value, velocity, noise=noise, **options) for mode in self.modes
        ]
        return replace(self._updated(torch.stack(densities)), modes=tuple(modes))

    def _updated(self, log_likelihood: Float[Tensor, "K"]) -> "MixtureDMP[P]":
        """Mixture with probabilities updated by Bayes' rule."""
        score = self.probability.log() + log_likelihood
        return replace(self, probability=torch.softmax(score, 0))


def _paths(motion: LinearPrimitive) -> Float[Tensor, "n DT"]:
    s = torch.linspace(0, 1, PATH_TIMES, dtype=torch.float64)
    rows = motion.response.evaluate(s.to(motion.start.device))[:, 0]
    x = motion.coordinates().detach().double().flatten(0, -3)
    return (x @ rows.mT).flatten(1)


def principal_components(paths: Float[Tensor, "n F"]) -> Float[Tensor, "n d"]:
    """Coordinates of paths in the directions of largest variance."""
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

    It starts from the samples farthest from each other (Gonzalez 1985), which is deterministic.
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
        # Each mean takes one degree of freedom, which matters for few samples.
        spread = (r[..., None] * square).sum((0, 1)) / max(len(z) - K, 1)
        variance = torch.maximum(spread, least)
        log_density = (weight / len(z)).log() - (
            square / variance + (2 * torch.pi * variance).log()
        ).sum(-1) / 2
        before, r = r, torch.softmax(log_density, -1)
        if (r - before).abs().amax() < SETTLED:
            break
    return r, torch.logsumexp(log_density, -1).sum().item()


def _context_precision(c: Tensor, r: Tensor, fraction: Tensor) -> Float[Tensor, "C C"]:
    """Inverse covariance of contexts around the means of their modes.

    The standard deviation is at least `MINIMUM_SPREAD` of that over all demonstrations, in the
    mean of the coordinates, because a context is evidence and not proof.
    """
    off = (c[:, None] - fraction.mT @ c) * r.sqrt()[..., None]
    within = off.flatten(0, 1)
    covariance = within.mT @ within / max(len(c) - r.shape[1], 1)
    floor = MINIMUM_SPREAD**2 * c.var(0, correction=0).mean() + torch.finfo(c.dtype).tiny
    return torch.linalg.inv(covariance + floor * torch.eye(c.shape[1]).to(c))
