"""Gaussians wherever they are wanted."""

import math
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp.system.basis import check_count
from hrc_learn.dmp.system.canonical import ROUNDING, ExponentialPhase, Phase, check_positive

INSPECTED = 8
"""Times per narrowest width at which the slopes of a basis are inspected."""


@dataclass(frozen=True, kw_only=True)
class PlacedBasis:
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
    def knot_spacing(self) -> None:
        """Smooth everywhere."""
        return None

    @property
    def horizon(self) -> float:
        """Normalised time after which the forcing is lost in float64 rounding."""
        c, sigma = with_follower(*self._placed())
        # Where the exponents fall behind the follower's: a (x - c_f)^2 + b (x - c_f) = d.
        after, last = c[-1] - c[:-1], 1 / sigma[-1] ** 2
        a = 0.5 * (1 / sigma[:-1] ** 2 - last)
        b = after / sigma[:-1] ** 2
        d = ROUNDING - 0.5 * (after / sigma[:-1]) ** 2
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
