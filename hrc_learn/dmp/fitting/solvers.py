"""From sampled motions to the weights of a linear primitive.

Demonstrations sampled at the same normalised times are fitted by one matrix product.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypedDict

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._system.bases import Basis, GaussianBasis, balanced_units
from hrc_learn.dmp._system.response import Response, response_of
from hrc_learn.dmp._system.spring import SpringDamper
from hrc_learn.dmp.fitting.motion_samples import FitReport, Samples
from hrc_learn.dmp.fitting.robust_weights import robust_weights
from hrc_learn.dmp.forcing_scale import Demonstrated, Scaling


class FitOptions(TypedDict, total=False):
    """Options of `fit`, handed on unchanged to where they are used: `fit_motion`."""

    method: str
    """`"trajectory"` (default), least squares on the positions, the closest reproduction;
    `"ridge"`, regression on the force; `"lwr"`, the paper's."""
    robust: str | None
    """`"huber"` or `"tukey"`: how samples that lie far off are trusted less; see `robust.py`.
    None (default): all alike."""
    approach: float | int
    """Share of the motion, 0 to 1, along which a new start and goal are taken up, smoothly;
    0 (default): at once, as the paper has it."""
    basis: Basis | None
    """Shape of the forcing term; `n_basis` Gaussians unless given."""
    spring: SpringDamper | None
    """Gains; alpha = 25, critically damped, unless given."""
    regularization: float
    """Ridge, relative to the largest singular value; 1e-7 unless given."""


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
    fits = []
    for i, valid in enumerate(samples.mask):
        one_rate = None if rate is None else rate[i, :, valid]
        s = samples.s[i, valid]
        fits.append(_fit(method, response, s, position[i, :, valid], one_rate, regularization))
    weights, start_rate = zip(*fits, strict=True)
    return torch.stack(weights), torch.stack(start_rate)


def _fit(
    method: str,
    response: Response,
    s: Float[Tensor, "T"],
    position: Float[Tensor, "*batch D T"],
    rate: Float[Tensor, "*batch D T"] | None,
    regularization: float,
) -> Fit:
    if method == "trajectory":
        return _trajectory(response, s, position, rate, regularization)
    if rate is None:
        rate = differentiate(s, position)
    goal = position[..., -1:]
    force = differentiate(s, rate) - response.spring.acceleration(position - goal, rate)
    if response.approach:
        force = force - (goal - position[..., :1]) * response.approach_force(s)
    K = _force_operator(method, response, _key(s), s.device, regularization)
    return _apply(force, K), rate[..., 0]


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
    first = 2 * slope[..., :1] - inner[..., :1]
    last = 2 * slope[..., -1:] - inner[..., -1:]
    return torch.cat([first, inner, last], dim=-1)


def _trajectory(
    response: Response, s: Tensor, position: Tensor, rate: Tensor | None, regularization: float
) -> Fit:
    """Minimise the squared distance between motion and samples; no differentiation.

    Start and goal are the first and the last sample. The start velocity is the recorded one
    or, without, fitted along.
    """
    K, to_weights = _trajectory_operator(
        response, _key(s), s.device, rate is None, regularization
    )
    unknown = _apply(position, K)
    if rate is None:
        return unknown[..., :-1], unknown[..., -1]
    start_rate = rate[..., 0]
    return unknown - start_rate[..., None] * to_weights, start_rate


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
    K = unit[:, None] * _ridge_inverse(H[:, : N + fit_rate] * unit, regularization)
    from_samples = K.clone()
    from_samples[:, 0] -= K @ start
    from_samples[:, -1] -= K @ goal
    return from_samples, K @ velocity


def _key(s: Float[Tensor, "T"]) -> bytes:
    """Timestamps as something to look an operator up by."""
    return s.cpu().numpy().tobytes()


def _timestamps(key: bytes, device: torch.device) -> Float[Tensor, "T"]:
    return torch.frombuffer(bytearray(key), dtype=torch.float64).to(device)


@lru_cache(maxsize=16)
def _force_operator(
    method: str,
    response: Response,
    timestamps: bytes,
    device: torch.device,
    regularization: float,
) -> Float[Tensor, "N T"]:
    s = _timestamps(timestamps, device)
    if method == "ridge":
        return ridge_operator(response, s, regularization)
    return _lwr_operator(response, s)


def ridge_operator(
    response: Response, s: Float[Tensor, "T"], regularization: float
) -> Float[Tensor, "N T"]:
    """Maps a force at times `s` to the weights closest to it."""
    return _ridge_inverse(response.basis.forcing(s), regularization)


def _lwr_operator(response: Response, s: Tensor) -> Tensor:
    """w_i = (z' Gamma_i f) / (z' Gamma_i z), the paper's solution of its (Cost_i)."""
    # Without a ridge: each weight is a mean of its own samples, so that nothing is ill-posed.
    z = response.basis.phase(s)
    weighted = (response.basis.kernels(s) * z[:, None]).T
    # A Gaussian narrower than the sampling may see no sample: its weight is zero then.
    return weighted / (weighted @ z).clamp_min(torch.finfo(s.dtype).tiny)[:, None]


def _ridge_inverse(A: Float[Tensor, "T n"], regularization: float) -> Float[Tensor, "n T"]:
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
    """Those fitted: as recorded, but for outliers of a robust fit."""
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
        amplitude = torch.where(samples.span > 0, samples.span, 1.0)
        shown = Demonstrated(*(x.double() for x in (samples.first, samples.last, amplitude)))
        scaling.check(shown, samples.batch, names)
        s = samples.s[0] if samples.shared else samples.s.view(*samples.batch, -1)
        return {
            "weights": self._batched(scaling.unscale(self.weights.mT, shown).mT),
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

    def report(self, reproduction: Float[Tensor, "*batch T D"]) -> FitReport:
        """Residuals of a motion, at all samples."""
        trust = None if self.trust is None else self._batched(self.trust).mT
        return self.samples.compare(reproduction.mT.reshape(self.samples.position.shape), trust)

    def _batched(self, values: Tensor) -> Tensor:
        samples = self.samples
        return values.to(samples.position.dtype).reshape(samples.batch + values.shape[1:])


def fit_motion(
    samples: Samples,
    n_basis: int,
    *,
    method: str = "trajectory",
    robust: str | None = None,
    approach: float | int = 0.0,
    basis: Basis | None = None,
    spring: SpringDamper | None = None,
    # Far above rounding, far below what a sensor can tell.
    regularization: float = 1e-7,
) -> MotionFit:
    """Fit weights and start velocity; arguments as in `FitOptions`.

    Raises:
        ValueError: An option that there is not.
    """
    basis, spring = basis or GaussianBasis(count=n_basis), spring or SpringDamper()
    response = response_of(spring, basis, float(approach))
    trust = None
    if robust is not None:
        samples, trust = robust_weights(robust, response, samples, regularization)
    weights, rate = fit_samples(method, response, samples, regularization)
    return MotionFit(
        response=response, samples=samples, trust=trust, weights=weights, rate=rate
    )
