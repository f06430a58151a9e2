"""Phases and basis functions of the forcing term.

A phase is the canonical system of a movement primitive: the clock that fades its forcing term.
Any frozen dataclass with the members of `Phase` can be passed to a basis; files can store the
phases and bases of this module only.
"""

import math
from dataclasses import dataclass, field
from typing import ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

ROUNDING = 38.0
"""Exponent below which a factor is lost in float64 rounding: exp(-38) = 3e-17."""
DOMAINS = ("time", "phase")
DEGREE = 3
"""Degree of the splines: the lowest whose forcing has a continuous second derivative."""


@runtime_checkable
class Phase(Protocol):
    """Decaying factor of the forcing term as a function of normalised time; hashable."""

    @property
    def horizon(self) -> float:
        """Normalised time after which the phase is lost in float64 rounding."""
        ...

    @property
    def smooth_interval(self) -> float:
        """Length over which the phase is a polynomial of low degree."""
        ...

    def __call__(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Phase z at normalised time `s`: positive, 1 at s = 0, non-increasing."""
        ...


@dataclass(frozen=True, kw_only=True)
class ExponentialPhase:
    """Exponentially decaying phase z, solved in closed form.

    dz/ds = -alpha_z z,  z(0) = 1,  so  z(s) = exp(-alpha_z s),  s = t / tau

    (paper eq. (eq_cs)), with s = 0 at the start of the motion and 1 at its end. The forcing
    term keeps fading after the end.
    """

    decay: float = 4.0
    """alpha_z: the phase falls to exp(-decay) by the end of the motion."""

    def __post_init__(self):
        check_positive("decay", self.decay)

    def __call__(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Phase z at normalised time `s`."""
        return torch.exp(-self.decay * s)

    @property
    def horizon(self) -> float:
        """Normalised time after which the forcing is lost in float64 rounding."""
        return ROUNDING / self.decay

    @property
    def smooth_interval(self) -> float:
        """Length over which the phase is a polynomial of low degree."""
        return 1 / self.decay


@dataclass(frozen=True, kw_only=True)
class SigmoidPhase:
    """Phase that stays near one during the motion and falls at its end.

    z(s) = (1 + exp(-a m)) / (1 + exp(a (s - m)))

    (after Kulvicius et al. 2012, "Joining movement sequences"; an exponential decay leaves
    little forcing for the end of a motion). Early and late weights have similar effect.
    """

    steepness: float = 50.0
    """a: the phase falls from 88 % to 12 % within 4 / a."""
    middle: float = 1.0
    """m: normalised time at which the phase has fallen to one half."""

    def __post_init__(self):
        check_positive("steepness", self.steepness)
        check_positive("middle", self.middle)

    def __call__(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Phase z at normalised time `s`."""
        top = 1 + math.exp(-self.steepness * self.middle)
        return top * torch.sigmoid(self.steepness * (self.middle - s))

    @property
    def horizon(self) -> float:
        """Normalised time after which the forcing is lost in float64 rounding."""
        # For large s the sigmoid falls as exp(-a (s - m)).
        return self.middle + ROUNDING / self.steepness

    @property
    def smooth_interval(self) -> float:
        """Length over which the phase is a polynomial of low degree."""
        # The sigmoid is analytic within pi / a; 1.4 is the same fraction as for Gaussians.
        return 1.4 / self.steepness


@runtime_checkable
class Basis(Protocol):
    """Functions that the weights of a forcing term multiply; a frozen, hashable dataclass."""

    periodic: ClassVar[bool]
    """True if the forcing repeats with a period of one."""

    @property
    def count(self) -> int:
        """N, the number of basis functions."""
        ...

    @property
    def horizon(self) -> float:
        """Normalised time after which the forcing is lost in rounding; the period, if any."""
        ...

    @property
    def smooth_interval(self) -> float:
        """Length over which the forcing, between knots, is a polynomial of low degree."""
        ...

    @property
    def knot_spacing(self) -> float | None:
        """Spacing of the points where the forcing is not smooth; None: smooth everywhere."""
        ...

    def centre_times(self) -> Float[Tensor, "N"]:
        """Normalised times at which the basis functions peak (float64)."""
        ...

    def phase(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Fading factor of the forcing term at normalised time `s`."""
        ...

    def kernels(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch N"]:
        """Basis functions at normalised time `s`, neither normalised nor faded."""
        ...

    def forcing(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch N"]:
        """Forcing term per unit of each weight at normalised time `s`."""
        ...


@dataclass(frozen=True, kw_only=True)
class GaussianBasis:
    """Normalised Gaussians, faded by the phase z.

    psi_i(x) = exp(-(x - c_i)^2 / (2 sigma_i^2)),  phi_i = psi_i z / sum_j psi_j

    Centres are equally spaced in time, s_i = (i - 1) / (N - 1), so that early and late detail
    is resolved alike; sigma_i is `width` times the distance to the next centre.

    In the domain `"time"`, x = s, and one more Gaussian without a weight follows the last one.
    As it takes over, the forcing term ends with the motion, which then settles at its goal. In
    the domain `"phase"`, x = z, as in the paper. There all Gaussians return in equal parts as
    z -> 0, and the motion wanders after its end before it settles.
    """

    count: int = 50
    """N, the number of basis functions."""
    width: float = 0.6
    """sigma_i relative to the distance between neighbouring centres."""
    domain: str = "time"
    """Variable of the Gaussians: `"time"` or `"phase"`."""
    phase: Phase = field(default_factory=ExponentialPhase)
    """Canonical system, whose z fades the forcing term."""
    periodic: ClassVar[bool] = False
    knot_spacing = None
    """No knots: smooth everywhere."""

    def __post_init__(self):
        check_positive("width", self.width)
        check_count(self.count)
        if self.domain not in DOMAINS:
            raise ValueError(
                f"unknown domain {self.domain!r}; choose from {', '.join(DOMAINS)}"
            )

    @property
    def horizon(self) -> float:
        """Normalised time after which the forcing is lost in float64 rounding."""
        if self.domain == "phase":
            return self.phase.horizon
        # Past the end, the last Gaussian falls behind its follower by
        # exp((1/2 - x) / width^2) at x spacings; exp(-39) = 1e-17.
        end = 1 + (0.5 + 39 * self.width**2) / (self.count - 1)
        return min(end, self.phase.horizon)

    @property
    def smooth_interval(self) -> float:
        """Length over which the forcing is a polynomial of low degree.

        The ratio of two neighbours is a logistic function of scale width^2 times the spacing,
        which is analytic within pi times that.
        """
        # 1.4 width^2 is 0.45 of the distance to the nearest pole, pi width^2.
        handover = min(0.5, 1.4 * self.width**2) / (self.count - 1)
        return min(handover, self.phase.smooth_interval)

    def centre_times(self) -> Float[Tensor, "N"]:
        """Normalised times s_i at which the basis functions peak (float64)."""
        return torch.linspace(0, 1, self.count, dtype=torch.float64)

    def kernels(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch N"]:
        """Gaussians psi_i at normalised time `s`, not normalised."""
        return self._exponents(s).exp()[..., : self.count]

    def activation(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch N"]:
        """Normalised Gaussians psi_i / sum_j psi_j at normalised time `s`."""
        # A softmax never divides by zero, however far s lies from every centre.
        return torch.softmax(self._exponents(s), dim=-1)[..., : self.count]

    def forcing(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch N"]:
        """Forcing term per unit of each weight at normalised time `s`."""
        return self.activation(s) * self.phase(s)[..., None]

    def _exponents(self, s: Tensor) -> Tensor:
        if self.domain == "time":
            spacing = 1 / (self.count - 1)
            centres = spacing * torch.arange(self.count + 1, dtype=s.dtype, device=s.device)
            return -0.5 * ((s[..., None] - centres) / (self.width * spacing)) ** 2
        centres = self.phase(self.centre_times().to(s))
        spacing = -centres.diff()
        widths = self.width * torch.cat([spacing, spacing[-1:]])
        return -0.5 * ((self.phase(s)[..., None] - centres) / widths) ** 2


@dataclass(frozen=True, kw_only=True)
class PeriodicBasis:
    """Normalised periodic bells that do not fade.

    psi_i(s) = exp(h (cos(2 pi (s - c_i)) - 1)),  phi_i = psi_i / sum_j psi_j

    (Ijspeert et al. 2013, section 2.2.2). Centres c_i = (i - 1) / N; h such that a bell has
    the standard deviation `width` times the distance between centres.
    """

    count: int = 25
    """N, the number of basis functions."""
    width: float = 0.6
    """Standard deviation of a bell relative to the distance between centres."""
    periodic: ClassVar[bool] = True
    horizon = 1.0
    """The period."""
    knot_spacing = 1.0
    """The period: the table of the response has to close on itself."""

    def __post_init__(self):
        check_positive("width", self.width)
        check_count(self.count)

    @property
    def smooth_interval(self) -> float:
        """Length over which the forcing is a polynomial of low degree."""
        # Neighbours behave like Gaussians; see `GaussianBasis.smooth_interval`.
        return min(0.5, 1.4 * self.width**2) / self.count

    def phase(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Fading factor of the forcing term: one, because a rhythm does not fade."""
        return torch.ones_like(s)

    def centre_times(self) -> Float[Tensor, "N"]:
        """Normalised times c_i at which the basis functions peak (float64)."""
        return torch.arange(self.count, dtype=torch.float64) / self.count

    def kernels(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch N"]:
        """Bells psi_i at normalised time `s`, not normalised."""
        return self._exponents(s).exp()

    def forcing(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch N"]:
        """Forcing term per unit of each weight at normalised time `s`."""
        return torch.softmax(self._exponents(s), dim=-1)

    def _exponents(self, s: Tensor) -> Tensor:
        # cos(x) - 1 is -x^2 / 2 near the centre: a Gaussian of variance 1 / h, in radians.
        sharpness = (self.count / (2 * math.pi * self.width)) ** 2
        angle = 2 * math.pi * (s[..., None] - self.centre_times().to(s))
        return sharpness * (torch.cos(angle) - 1)


@dataclass(frozen=True, kw_only=True)
class SplineBasis:
    """Uniform cubic B-splines, faded by the phase z: phi_i = B(s / h - i + 2) z.

    B is centred at zero and vanishes beyond two spacings. A weight therefore changes nothing
    before c_i - 2 h, to the last bit, and at most four weights act at a time. The splines add
    up to one without normalisation (de Boor 1978, "A practical guide to splines", chapter IX).

    Centres are c_i = (i - 2) h, i = 1 ... N, with the spacing h = 1 / (N - 1): from one
    spacing before the start, which completes the first interval, to one before the end. The
    forcing term fades over the last two spacings and is zero from 1 + h on.
    """

    count: int = 50
    """N, the number of basis functions."""
    phase: Phase = field(default_factory=ExponentialPhase)
    """Canonical system, whose z fades the forcing term."""
    periodic: ClassVar[bool] = False

    def __post_init__(self):
        check_count(self.count)

    @property
    def knot_spacing(self) -> float:
        """Spacing h; the third derivative of the forcing jumps at its multiples."""
        return 1 / (self.count - 1)

    @property
    def horizon(self) -> float:
        """Normalised time after which the forcing is zero."""
        return 1 + self.knot_spacing

    @property
    def smooth_interval(self) -> float:
        """Length over which the forcing, between knots, is a polynomial of low degree."""
        return min(self.knot_spacing, self.phase.smooth_interval)

    def centre_times(self) -> Float[Tensor, "N"]:
        """Normalised times c_i at which the basis functions peak (float64)."""
        return self.knot_spacing * torch.arange(-1, self.count - 1, dtype=torch.float64)

    def kernels(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch N"]:
        """B-splines at normalised time `s`."""
        index = torch.arange(-1, self.count - 1, dtype=s.dtype, device=s.device)
        return cubic_spline(s[..., None] * (self.count - 1) - index)

    def forcing(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch N"]:
        """Forcing term per unit of each weight at normalised time `s`."""
        return self.kernels(s) * self.phase(s)[..., None]


def cubic_spline(x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Cubic B-spline on the knots -2, -1, 0, 1, 2; exactly zero beyond them."""
    # Truncated powers of the distance to the nearer end: nothing cancels there.
    inwards = 2 - x.abs()
    outer, inner = inwards.clamp_min(0), (inwards - 1).clamp_min(0)
    return (outer**DEGREE - 4 * inner**DEGREE) / math.factorial(DEGREE)


def check_positive(name: str, value: float) -> None:
    """Raise ValueError unless `value` is positive and finite."""
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{name} must be positive, got {value}")


def check_count(count: int) -> None:
    """Raise ValueError for a basis of fewer than two functions."""
    if count < 2:
        raise ValueError(f"a basis needs at least 2 functions, got {count}")


def balanced_units(
    basis: Basis, A: Float[Tensor, "rows M"], others: int
) -> Float[Tensor, "unknown"]:
    """Units in which a ridge penalises the weights and the next `others` columns alike.

    Late weights act through a small phase, and the columns of start and goal are not
    integrated.
    """
    unit = 1 / basis.phase(basis.centre_times().to(A))
    norm = A.norm(dim=0)
    size = (norm[: basis.count] * unit).amax()
    return torch.cat([unit, size / norm[basis.count : basis.count + others]])
