"""Bases of the forcing term: Gaussians and splines for motions that end, periodic ones."""

import math
from dataclasses import dataclass, field
from typing import ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._system.closed_forms import ROUNDING, ExponentialPhase, Phase, check_positive

DOMAINS = ("time", "phase")


@runtime_checkable
class Basis(Protocol):
    """Functions that the weights of a forcing term multiply; a frozen, hashable dataclass."""

    periodic: ClassVar[bool]
    """Whether the forcing goes on for ever, with a period of one."""

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
        """The forcing is smooth but at multiples of this; None: everywhere."""
        ...

    def centre_times(self) -> Float[Tensor, "N"]:
        """Normalised times at which the basis functions peak (float64)."""
        ...

    def phase(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """What fades the forcing term."""
        ...

    def kernels(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch N"]:
        """Basis functions at normalised time `s`, neither normalised nor faded."""
        ...

    def forcing(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch N"]:
        """What each unit weight adds to the forcing term at normalised time `s`."""
        ...


@dataclass(frozen=True, kw_only=True)
class GaussianBasis:
    """Normalised Gaussians, faded by the phase z.

    psi_i(x) = exp(-(x - c_i)^2 / (2 sigma_i^2)),  phi_i = psi_i z / sum_j psi_j

    Centres are equally spaced in time, s_i = (i - 1) / (N - 1), so that detail is resolved
    alike early and late; sigma_i is `width` times the distance to the next centre.

    In the domain `"time"`, x = s, and one more Gaussian without a weight follows the last: as
    it takes over, the forcing term ends with the motion, which then settles at its goal. In
    the domain `"phase"`, x = z, as the paper has it. There all Gaussians come back in equal
    shares as z -> 0, and the motion wanders after its end before it settles.
    """

    count: int = 50
    """N, the number of basis functions."""
    width: float = 0.6
    """sigma_i as a share of the distance between neighbouring centres."""
    domain: str = "time"
    """What the Gaussians are spread over: `"time"` or `"phase"`."""
    phase: Phase = field(default_factory=ExponentialPhase)
    """The canonical system, whose z fades the forcing term."""
    periodic: ClassVar[bool] = False
    knot_spacing = None
    """Smooth everywhere."""

    def __post_init__(self):
        check_positive("width", self.width)
        check_count(self.count)
        if self.domain not in DOMAINS:
            raise ValueError(f"unknown domain {self.domain!r}; there are {', '.join(DOMAINS)}")

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

        Neighbours hand over along a logistic function of scale width^2 times the spacing,
        which is analytic within pi times that.
        """
        # 1.4 width^2 is 0.45 of where the logistic function's nearest pole lies, pi width^2.
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
        """What each unit weight adds to the forcing term at normalised time `s`."""
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
    """Normalised periodic bells, that do not fade.

    psi_i(s) = exp(h (cos(2 pi (s - c_i)) - 1)),  phi_i = psi_i / sum_j psi_j

    (Ijspeert et al. 2013, section 2.2.2). Centres c_i = (i - 1) / N; h such that a bell has
    the standard deviation `width` times their distance.
    """

    count: int = 25
    """N, the number of basis functions."""
    width: float = 0.6
    """Standard deviation of a bell as a share of the distance between centres."""
    periodic: ClassVar[bool] = True
    horizon = 1.0
    """The period."""
    knot_spacing = 1.0
    """A period: the table of the response has to close on itself."""

    def __post_init__(self):
        check_positive("width", self.width)
        check_count(self.count)

    @property
    def smooth_interval(self) -> float:
        """Length over which the forcing is a polynomial of low degree."""
        # Bells hand over to each other as Gaussians do; see `GaussianBasis.smooth_interval`.
        return min(0.5, 1.4 * self.width**2) / self.count

    def phase(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """What fades the forcing term: nothing."""
        return torch.ones_like(s)

    def centre_times(self) -> Float[Tensor, "N"]:
        """Normalised times c_i at which the basis functions peak (float64)."""
        return torch.arange(self.count, dtype=torch.float64) / self.count

    def kernels(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch N"]:
        """Bells psi_i at normalised time `s`, not normalised."""
        return self._exponents(s).exp()

    def forcing(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch N"]:
        """What each unit weight adds to the forcing term at normalised time `s`."""
        return torch.softmax(self._exponents(s), dim=-1)

    def _exponents(self, s: Tensor) -> Tensor:
        # cos(x) - 1 is -x^2 / 2 near the centre: a Gaussian of variance 1 / h, in radians.
        sharpness = (self.count / (2 * math.pi * self.width)) ** 2
        angle = 2 * math.pi * (s[..., None] - self.centre_times().to(s))
        return sharpness * (torch.cos(angle) - 1)


def check_count(count: int) -> None:
    """Raise ValueError for fewer functions than can share anything."""
    if count < 2:
        raise ValueError(f"a basis needs at least 2 functions, got {count}")


DEGREE = 3
"""Cubic: the lowest whose forcing has a continuous second derivative."""


@dataclass(frozen=True, kw_only=True)
class SplineBasis:
    """Uniform cubic B-splines, faded by the phase z: phi_i = B(s / h - i + 2) z.

    B is centred at zero and vanishes beyond two spacings, so a weight changes nothing before
    c_i - 2 h, to the last bit, and four weights at most act at a time. The splines add up to
    one by themselves (de Boor 1978, "A practical guide to splines", chapter IX).

    Centres are c_i = (i - 2) h, i = 1 ... N, with the spacing h = 1 / (N - 1): from one
    spacing before the start, so that the first interval has all its splines, to one before
    the end. The forcing term fades over the last two spacings and is zero from 1 + h on.
    """

    count: int = 50
    """N, the number of basis functions."""
    phase: Phase = field(default_factory=ExponentialPhase)
    """The canonical system, whose z fades the forcing term."""
    periodic: ClassVar[bool] = False

    def __post_init__(self):
        check_count(self.count)

    @property
    def knot_spacing(self) -> float:
        """h; the third derivative of the forcing jumps at its multiples."""
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
        """What each unit weight adds to the forcing term at normalised time `s`."""
        return self.kernels(s) * self.phase(s)[..., None]


def cubic_spline(x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The cubic B-spline on the knots -2, -1, 0, 1, 2; exactly zero beyond them."""
    # By truncated powers of the distance to the nearer end: nothing cancels there.
    inwards = 2 - x.abs()
    outer, inner = inwards.clamp_min(0), (inwards - 1).clamp_min(0)
    return (outer**DEGREE - 4 * inner**DEGREE) / math.factorial(DEGREE)


INSPECTED = 8
"""Times per narrowest width at which the slopes of a basis are inspected."""


@dataclass(frozen=True, kw_only=True)
class LearnedGaussianBasis:
    """Normalised Gaussians with a centre and a width each, faded by the phase z.

    psi_i(s) = exp(-(s - c_i)^2 / (2 sigma_i^2)),  phi_i = psi_i z / sum_j psi_j

    One more Gaussian without a weight, as wide as the widest, follows the last at the
    distance of the last two centres or its width, whichever is more: so it takes over from
    all others after the end. Equally spaced and alike they are a `GaussianBasis`.
    """

    centres: tuple[float, ...]
    """c_i in normalised time, increasing."""
    widths: tuple[float, ...]
    """sigma_i in normalised time."""
    phase: Phase = field(default_factory=ExponentialPhase)
    """The canonical system, whose z fades the forcing term."""
    periodic: ClassVar[bool] = False
    knot_spacing = None
    """Smooth everywhere."""

    def __post_init__(self):
        check_count(self.count)
        if len(self.widths) != self.count:
            raise ValueError(f"{len(self.widths)} widths for {self.count} centres")
        if not all(math.isfinite(c) for c in self.centres):
            raise ValueError(f"centres must be finite, got {self.centres}")
        for k in range(1, self.count):
            if self.centres[k] <= self.centres[k - 1]:
                raise ValueError(
                    f"centres must increase, but {self.centres[k]} follows "
                    f"{self.centres[k - 1]} at place {k}"
                )
        for width in self.widths:
            check_positive("each width", width)

    @property
    def count(self) -> int:
        """N, the number of basis functions."""
        return len(self.centres)

    @property
    def horizon(self) -> float:
        """Normalised time after which the forcing is lost in float64 rounding."""
        c, sigma = with_follower(*self._placed())
        # Where the exponents fall behind the follower's: a (x - c_f)^2 + b (x - c_f) = d.
        after, last = c[-1] - c[:-1], 1 / sigma[-1] ** 2
        a = 0.5 * (1 / sigma[:-1] ** 2 - last)
        b = after / sigma[:-1] ** 2
        d = ROUNDING - 0.5 * (after / sigma[:-1]) ** 2
        # The root that stays finite where a vanishes, widths being alike.
        root = 2 * d / (b + (b**2 + 4 * a * d).clamp_min(0).sqrt())
        end = c[-1] + root.clamp_min(0).amax()
        return min(end.item(), self.phase.horizon)

    @property
    def smooth_interval(self) -> float:
        """Length over which the forcing is a polynomial of low degree.

        One function hands over to the next the faster, the more the slopes of their
        exponents differ. Two alike have +- m there, and a logistic function of scale 1 / 2 m;
        see `GaussianBasis.smooth_interval`.
        """
        c, sigma = with_follower(*self._placed())
        n_times = math.ceil(INSPECTED * self.horizon / min(self.widths))
        s = torch.linspace(0, self.horizon, n_times, dtype=torch.float64)[:, None]
        share = torch.softmax(exponents(s[:, 0], c, sigma), dim=-1)
        slope = -(s - c) / sigma**2
        mean = (share * slope).sum(-1, keepdim=True)
        spread = (share * (slope - mean) ** 2).sum(-1).amax().sqrt().item()
        # 0.7 / m is 1.4 times the scale 1 / 2 m, as between equally spaced Gaussians.
        return min(0.7 / spread, *self.widths, self.phase.smooth_interval)

    def centre_times(self) -> Float[Tensor, "N"]:
        """Normalised times c_i (float64)."""
        return self._placed()[0]

    def kernels(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch N"]:
        """Gaussians psi_i at normalised time `s`, not normalised."""
        return exponents(s, *(x.to(s) for x in self._placed())).exp()

    def forcing(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch N"]:
        """What each unit weight adds to the forcing term at normalised time `s`."""
        centres, widths = (x.to(s) for x in self._placed())
        return placed_activation(s, centres, widths) * self.phase(s)[..., None]

    def _placed(self) -> tuple[Tensor, Tensor]:
        return tuple(torch.tensor(x, dtype=torch.float64) for x in (self.centres, self.widths))  # pyright: ignore[reportReturnType]


def placed_activation(
    s: Float[Tensor, "*batch"], centres: Float[Tensor, "N"], widths: Float[Tensor, "N"]
) -> Float[Tensor, "*batch N"]:
    """Normalised Gaussians psi_i / sum_j psi_j; differentiable in all arguments."""
    # A softmax never divides by zero, however far s lies from every centre.
    with_last = exponents(s, *with_follower(centres, widths))
    return torch.softmax(with_last, dim=-1)[..., : len(centres)]


def with_follower(
    centres: Float[Tensor, "N"], widths: Float[Tensor, "N"]
) -> tuple[Float[Tensor, "N_and_1"], Float[Tensor, "N_and_1"]]:
    """Centres and widths with those of the Gaussian that ends the forcing term."""
    width = widths.amax()
    centre = centres[-1] + torch.maximum(centres[-1] - centres[-2], width)
    return torch.cat([centres, centre[None]]), torch.cat([widths, width[None]])


def exponents(
    s: Float[Tensor, "*batch"], centres: Float[Tensor, "K"], widths: Float[Tensor, "K"]
) -> Float[Tensor, "*batch K"]:
    """Logarithms of Gaussians."""
    return -0.5 * ((s[..., None] - centres) / widths) ** 2


def balanced_units(
    basis: Basis, A: Float[Tensor, "rows M"], others: int
) -> Float[Tensor, "unknown"]:
    """Units of the weights and `others` columns after them that a ridge weighs alike.

    Late weights act through a small phase, and the ends of a motion through no integration.
    """
    unit = 1 / basis.phase(basis.centre_times().to(A))
    norm = A.norm(dim=0)
    size = (norm[: basis.count] * unit).amax()
    return torch.cat([unit, size / norm[basis.count : basis.count + others]])
