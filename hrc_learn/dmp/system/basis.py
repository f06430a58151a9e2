"""Bases of the forcing term: Gaussians for motions that end, periodic ones for rhythms."""

import math
from dataclasses import dataclass, field
from typing import ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp.system.canonical import ExponentialPhase, Phase, check_positive

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

    def __post_init__(self):
        check_positive("width", self.width)
        check_count(self.count)
        if self.domain not in DOMAINS:
            raise ValueError(f"unknown domain {self.domain!r}; there are {', '.join(DOMAINS)}")

    @property
    def knot_spacing(self) -> None:
        """Smooth everywhere."""
        return None

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

    def __post_init__(self):
        check_positive("width", self.width)
        check_count(self.count)

    @property
    def horizon(self) -> float:
        """The period."""
        return 1.0

    @property
    def smooth_interval(self) -> float:
        """Length over which the forcing is a polynomial of low degree."""
        return min(0.5, 1.4 * self.width**2) / self.count

    @property
    def knot_spacing(self) -> float:
        """A period: the table of the response has to close on itself."""
        return 1.0

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
        sharpness = (self.count / (2 * math.pi * self.width)) ** 2
        angle = 2 * math.pi * (s[..., None] - self.centre_times().to(s))
        return sharpness * (torch.cos(angle) - 1)


def check_count(count: int) -> None:
    """Raise ValueError for fewer functions than can share anything."""
    if count < 2:
        raise ValueError(f"a basis needs at least 2 functions, got {count}")
