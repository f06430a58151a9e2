"""From sampled motions to the weights of a linear primitive.

Demonstrations sampled at the same normalised times are fitted by one matrix product.

Samples that lie far off can be taken back to where the others lead: M-estimates by iteratively
reweighted least squares (Huber and Ronchetti 2009, "Robust statistics", chapter 7), the motion
of a primitive that is closest to the samples, each weighed by the trust in it, which falls with
its residual over their spread. A motion through y* = y_fit + trust (y - y_fit), fitted by plain
least squares, is the same one: so these stand for the samples, whatever the method that fits
them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, TypedDict

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.dmp._arguments import FitReport, Samples
from hrc_learn.dmp._smoothing import smoothed, warn_of_few_samples
from hrc_learn.dmp._system.bases import Basis, GaussianBasis, balanced_units
from hrc_learn.dmp._system.closed_forms import SpringDamper
from hrc_learn.dmp._system.own_times import ColumnPieces
from hrc_learn.dmp._system.response import Response, Trajectory, response_of
from hrc_learn.dmp.forcing_scale import Demonstrated, NoScaling, Scaling


class FitOptions(TypedDict, total=False):
    """Options of `fit`, handed on unchanged to where they are used: `fit_motion`."""

    method: str
    """`"trajectory"` (default), least squares on the positions, the closest reproduction;
    `"ridge"`, regression on the force; `"lwr"`, the paper's."""
    robust: str | None
    """`"huber"` or `"tukey"`: how samples that lie far off are trusted less.
    None (default): all alike. See `robust_weights`."""
    approach: float | int
    """Share of the motion, 0 to 1, along which a new start and goal are taken up, smoothly;
    0 (default): at once, as the paper has it."""
    basis: Basis | None
    """Shape of the forcing term; `n_basis` Gaussians unless given."""
    spring: SpringDamper | None
    """Gains; alpha = 25, critically damped, unless given."""
    regularization: float
    """Ridge, relative to the largest singular value; 1e-7 unless given."""
    smooth: bool | None
    """Whether noise is taken off the samples first, as much of it as they give evidence of; see
    `_smoothing.py`. None (default): unless the number of basis functions is given."""


DEFAULT_COUNT = 50
"""Basis functions, unless said: what is no noise in recordings of arms they follow to 5e-5 of
the range, and fewer would not make a motion without noise smoother."""
REGULARIZATION = 1e-7
"""Of a fit, unless said: far above rounding, far below what a sensor can tell."""
METHODS = ("trajectory", "ridge", "lwr")
type Fit = tuple[Float[Tensor, "*batch D N"], Float[Tensor, "*batch D"]]


def fit_samples(
    method: str, response: Response, samples: Samples, regularization: float
) -> tuple[Float[Tensor, "B D N"], Float[Tensor, "B D"]]:
    """Weights of the unscaled forcing term and start velocity dy/ds, in float64.

    Args:
        method: `"trajectory"`, least squares on the positions themselves; `"ridge"`, ridge
            regression on the force; `"lwr"`, locally weighted regression on the force as in
            the paper, which fits each weight alone.
        response: Of the primitive to be fitted.
        samples: Of one demonstration or many.
        regularization: Ridge, relative to the largest singular value of the design matrix.
    """
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}; there are {', '.join(METHODS)}")
    position = samples.position.double()
    rate = None
    if samples.velocity is not None:
        rate = samples.velocity.double() * samples.duration[:, None, None]
    if samples.shared:
        return _fit(method, response, samples.s[0], position, rate, regularization)
    weights = position.new_empty(*position.shape[:2], response.basis.count)
    start_rate = position.new_empty(position.shape[:2])
    alone = torch.ones(len(position), dtype=torch.bool)
    if method == "trajectory" and not (response.approach or response.basis.periodic):
        weights, start_rate, alone = _fit_at_own_times(
            response, samples, position, rate, regularization
        )
    for i in alone.nonzero()[:, 0].tolist():
        valid = samples.mask[i]
        one_rate = None if rate is None else rate[i, :, valid]
        s = samples.s[i, valid]
        weights[i], start_rate[i] = _fit(
            method, response, s, position[i, :, valid], one_rate, regularization
        )
    return weights, start_rate


EVEN = 20
"""Samples a basis function of the even grid that columns are orthonormal on."""
WELL_POSED = 1e-3
"""Least over largest diagonal entry of a Cholesky factor from which products are solved: half
of the digits of float64 are lost at 1e-8."""
ROUNDS_OF_NORM = 4
"""Of the power iteration for the largest singular value, which a ridge is measured by; the next
one is a third of it, so that an error falls to a percent in two."""


def _fit_at_own_times(
    response: Response,
    samples: Samples,
    position: Float[Tensor, "B D T"],
    rate: Float[Tensor, "B D T"] | None,
    regularization: float,
) -> tuple[Float[Tensor, "B D N"], Float[Tensor, "B D"], Bool[Tensor, "B"]]:
    """`"trajectory"` for all demonstrations at once, whatever their timestamps.

    The normal equations, in columns that are orthonormal on an even grid: of samples that tell
    the functions apart, no digits are lost by squaring those.

    Returns:
        Weights, dy/ds, and which demonstrations leave functions undetermined, whose results are
        not to be used.
    """
    N, fit_rate = response.basis.count, rate is None
    n = N + fit_rate
    mixing, sigma, directions, pieces = _orthonormal_columns(response, n, samples.s.device)
    apart = mixing[:n, :n]
    mask = samples.mask.to(mixing)
    if not samples.complete:
        position = torch.where(samples.mask[:, None], position, 0.0)
    gram, right = pieces.products(samples.s, position, mask)
    known = [samples.first.double(), samples.last.double()]
    if rate is not None:
        known.insert(0, rate[..., 0] if samples.complete else _first(rate, samples.mask))
    right = right[:, :n] - gram[:, :n, n:] @ torch.stack(known, 1)
    A = gram[:, :n, :n]
    # The ridge is one of the balanced weights, in units of their largest singular value: by
    # power iteration from that of the even grid.
    v, norm = directions[:1].expand(len(A), -1), A.new_zeros(len(A), 1)
    for _ in range(ROUNDS_OF_NORM):
        v = (A @ (v @ directions.mT * sigma)[..., None])[..., 0] * sigma @ directions
        norm = v.norm(dim=-1, keepdim=True)
        v = v / norm
    A = A + torch.diag_embed(regularization**2 * norm / sigma**2)
    factor, failed = torch.linalg.cholesky_ex(A)
    diagonal = factor.diagonal(dim1=-2, dim2=-1)
    alone = (failed > 0) | ~(diagonal.amin(-1) > WELL_POSED * diagonal.amax(-1))
    unknown = (apart @ torch.cholesky_solve(right, factor)).mT
    if rate is None:
        return unknown[..., :-1], unknown[..., -1], alone
    return unknown, known[0], alone


@lru_cache(maxsize=16)
def _orthonormal_columns(
    response: Response, n: int, device: torch.device
) -> tuple[Float[Tensor, "M M"], Float[Tensor, "n"], Float[Tensor, "n n"], ColumnPieces]:
    """What n columns stand for that are orthonormal on an even grid.

    Returns:
        Coordinates of each column, those after n as they are; singular values of the balanced
        design, and its right singular vectors in rows; and the columns along the motion.
    """
    N = response.basis.count
    even = torch.linspace(0, 1, EVEN * N + 1, dtype=torch.float64, device=device)
    H = response.evaluate(even)[:, 0]
    unit = balanced_units(response.basis, H, n - N)
    _, sigma, Vh = torch.linalg.svd(H[:, :n] * unit, full_matrices=False)
    mixing = torch.eye(H.shape[1]).to(H)
    mixing[:n, :n] = unit[:, None] * Vh.mT / sigma
    return mixing, sigma, Vh, ColumnPieces.of(response, mixing)


def _first(values: Float[Tensor, "B D T"], mask: Bool[Tensor, "B T"]) -> Float[Tensor, "B D"]:
    index = mask.long().argmax(-1)[:, None, None].expand(-1, values.shape[1], 1)
    return values.gather(-1, index)[..., 0]


def _fit(
    method: str,
    response: Response,
    s: Float[Tensor, "T"],
    position: Float[Tensor, "*batch D T"],
    rate: Float[Tensor, "*batch D T"] | None,
    regularization: float,
) -> Fit:
    # Timestamps as something to look an operator up by.
    sampled = response, s.cpu().numpy().tobytes(), s.device
    if method == "trajectory":
        # The squared distance to the samples, without differentiation. Start and goal are the
        # first and the last sample, the start velocity the recorded one or fitted along.
        K, to_weights = _trajectory_operator(*sampled, rate is None, regularization)
        unknown = _apply(position, K)
        if rate is None:
            return unknown[..., :-1], unknown[..., -1]
        return unknown - rate[..., :1] * to_weights, rate[..., 0]
    if rate is None:
        rate = differentiate(s, position)
    goal = position[..., -1:]
    force = differentiate(s, rate) - response.spring.acceleration(position - goal, rate)
    if response.approach:
        force = force - (goal - position[..., :1]) * response.approach_force(s)
    return _apply(force, _force_operator(*sampled, method, regularization)), rate[..., 0]


def _apply(
    y: Float[Tensor, "*batch D T"], K: Float[Tensor, "n T"]
) -> Float[Tensor, "*batch D n"]:
    """One flat product K y for every coordinate of every demonstration."""
    return (y.reshape(-1, y.shape[-1]) @ K.T).view(*y.shape[:-1], -1)


def differentiate(
    s: Float[Tensor, "T"], y: Float[Tensor, "*batch T"]
) -> Float[Tensor, "*batch T"]:
    """dy/ds of second order on any spacing, ends included (exact for parabolas)."""
    slope = y.diff() / s.diff()
    h = s.diff()
    # The parabola through three samples: each slope counts by the step on the other side.
    inner = (h[1:] * slope[..., :-1] + h[:-1] * slope[..., 1:]) / (h[1:] + h[:-1])
    # Slopes of the outer parabolas at their ends: linear, with the mean one in the middle.
    first = 2 * slope[..., :1] - inner[..., :1]
    last = 2 * slope[..., -1:] - inner[..., -1:]
    return torch.cat([first, inner, last], dim=-1)


# Sampled alike, demonstrations share one: 16 of them are as many datasets.
@lru_cache(maxsize=16)
def _trajectory_operator(
    response: Response,
    timestamps: bytes,
    device: torch.device,
    fit_rate: bool,
    regularization: float,
) -> tuple[Float[Tensor, "unknown T"], Float[Tensor, "unknown"]]:
    """Maps samples to unknowns, and a known start velocity to what it takes off them.

    With y_0 = y(0) and g = y(1) read off the samples, the residual is linear in the samples
    too, so that one matrix does it all.
    """
    N = response.basis.count
    s = _timestamps(timestamps, device)
    H = response.evaluate(s)[:, 0]
    velocity, start, goal = H[:, N], H[:, N + 1], H[:, N + 2]
    unit = balanced_units(response.basis, H, int(fit_rate))
    K = unit[:, None] * ridge_inverse(H[:, : N + fit_rate] * unit, regularization)
    # What start and goal cause by themselves is taken off the samples.
    from_samples = K.clone()
    from_samples[:, 0] -= K @ start
    from_samples[:, -1] -= K @ goal
    return from_samples, K @ velocity


@lru_cache(maxsize=16)
def _force_operator(
    response: Response,
    timestamps: bytes,
    device: torch.device,
    method: str,
    regularization: float,
) -> Float[Tensor, "N T"]:
    """Maps a force to the weights closest to it."""
    s, basis = _timestamps(timestamps, device), response.basis
    if method == "ridge":
        return ridge_inverse(basis.forcing(s), regularization)
    # w_i = (z' Gamma_i f) / (z' Gamma_i z), the paper's solution of its (Cost_i). Without a
    # ridge: each weight is a mean of its own samples, so that nothing is ill-posed.
    z = basis.phase(s)
    weighted = (basis.kernels(s) * z[:, None]).T
    # A Gaussian narrower than the sampling may see no sample: its weight is zero then.
    return weighted / (weighted @ z).clamp_min(torch.finfo(s.dtype).tiny)[:, None]


def _timestamps(key: bytes, device: torch.device) -> Float[Tensor, "T"]:
    return torch.frombuffer(bytearray(key), dtype=torch.float64).to(device)


def ridge_inverse(A: Float[Tensor, "T n"], regularization: float) -> Float[Tensor, "n T"]:
    """(A'A + (r sigma_max)^2 I)^-1 A', by singular values: A'A is never formed."""
    U, sigma, Vh = torch.linalg.svd(A, full_matrices=False)
    damping = regularization * sigma[0]
    return (Vh.T * (sigma / (sigma**2 + damping**2))) @ U.T


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionFit:
    """What was fitted to a flat batch of demonstrations, in float64."""

    response: Response
    """Of the spring and the basis."""
    samples: Samples
    """Those fitted: as recorded, but for outliers of a robust fit and noise."""
    noisy: Samples
    """With the noise."""
    noise: Float[Tensor, "B D"] | None
    """Its standard deviation; None: nobody looked."""
    trust: Float[Tensor, "B D T"] | None
    """In each recorded sample, 0 to 1; None: whole in all."""
    weights: Float[Tensor, "B D N"]
    """Of the unscaled forcing term."""
    rate: Float[Tensor, "B D"]
    """Start velocity dy/ds."""

    def arguments(self, scaling: Scaling, names: Sequence[str] | None) -> dict[str, Any]:
        """What a `JointDMP` is put together from, in the demonstrations' shape and dtype.

        Raises:
            ValueError: A scaling that a motion forbids; `names` are those of its coordinates.
        """
        samples = self.samples
        # One where a coordinate never moves: nothing to scale, and nothing to divide by.
        amplitude = samples.span.masked_fill(samples.span == 0, 1.0)
        weights = self._unscaled(scaling, amplitude, names)
        s = samples.s[0] if samples.shared else samples.s.view(*samples.batch, -1)
        return {
            "weights": self._batched(weights),
            "start": self._batched(samples.first),
            "goal": self._batched(samples.last),
            "start_velocity": self._batched(self.rate / samples.duration[:, None]),
            "duration": self._batched(samples.duration),
            "amplitude": self._batched(amplitude),
            "timestamps": s,
            "basis": self.response.basis,
            "spring": self.response.spring,
            "scaling": scaling,
            "approach": self.response.approach,
        }

    def _unscaled(
        self, scaling: Scaling, amplitude: Float[Tensor, "B D"], names: Sequence[str] | None
    ) -> Float[Tensor, "B D N"]:
        if isinstance(scaling, NoScaling):
            return self.weights
        samples, noisy = self.samples, self.noisy
        ends = (samples.first, samples.last, amplitude)
        shown = Demonstrated(*(x.double() for x in ends))
        scaling.check(shown, samples.batch, names)
        if noisy is not samples:
            # Noise would make a way of none, and taking it off as well.
            first, last = noisy.first.double(), noisy.last.double()
            scaling.check(Demonstrated(first, last, shown.amplitude), samples.batch, names)
        return scaling.unscale(self.weights.mT, shown).mT

    def report(self, motion: Trajectory) -> FitReport:
        """Residuals of a motion at all samples, noise included, and how rough it is."""
        trust = None if self.trust is None else self._batched(self.trust).mT
        positions = motion.position.mT.reshape(self.samples.position.shape)
        report = self.noisy.compare(positions, trust)
        if self.noise is None:
            return report
        return replace(
            report,
            noise=self._batched(self.noise),
            peak_acceleration=motion.acceleration.abs().amax(-2),
            peak_jerk=motion.jerk.abs().amax(-2),
        )

    def _batched(self, values: Tensor) -> Tensor:
        samples = self.samples
        values = values.to(samples.position.dtype)
        return values.reshape(samples.batch + values.shape[1:]) if samples.batch else values[0]


def fit_motion(
    samples: Samples,
    n_basis: int | None,
    *,
    method: str = "trajectory",
    robust: str | None = None,
    approach: float | int = 0.0,
    basis: Basis | None = None,
    spring: SpringDamper | None = None,
    regularization: float = REGULARIZATION,
    smooth: bool | None = None,
) -> MotionFit:
    """Fit weights and start velocity; arguments as in `FitOptions`.

    Raises:
        ValueError: An option that there is not.
    """
    is_named = n_basis is not None or basis is not None
    if smooth is None:
        smooth = not is_named
    if basis is None:
        basis = GaussianBasis(count=DEFAULT_COUNT if n_basis is None else n_basis)
    if is_named:
        warn_of_few_samples(samples, basis.count)
    response = response_of(spring or SpringDamper(), basis, float(approach))
    trust = noise = None
    if robust is not None:
        samples, trust = robust_weights(robust, response, samples, regularization)
    noisy = samples
    if smooth:
        samples, noise = smoothed(samples)
    weights, rate = fit_samples(method, response, samples, regularization)
    return MotionFit(
        response=response,
        samples=samples,
        noisy=noisy,
        noise=noise,
        trust=trust,
        weights=weights,
        rate=rate,
    )


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
        # Sampled alike, all demonstrations can make the same motions.
        if reach is None or not samples.shared:
            reach = _Reach(response, samples.s[i, valid], regularization)
        y = position[i, :, valid]
        fitted, trusted = _fit_robustly(loss, reach, y)
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


def _fit_robustly(
    loss: str, reach: _Reach, y: Float[Tensor, "D T"]
) -> tuple[Float[Tensor, "D T"], Float[Tensor, "D T"]]:
    """The closest motion and the trust in each sample."""
    trust, spread = torch.ones_like(y), torch.zeros_like(y[:, :1])
    fitted = reach.closest(y, trust)
    # The smallest number as well: a coordinate that never moves covers no range.
    least = LEAST_SPREAD * (y.amax(-1) - y.amin(-1))[:, None] + torch.finfo(y.dtype).tiny
    # Biweights have several minima: they start from the answer that is unique, and keep its
    # spread.
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
