"""A basis with local support: cubic B-splines."""

import math
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp.system.basis import check_count
from hrc_learn.dmp.system.canonical import ExponentialPhase, Phase

DEGREE = 3


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
