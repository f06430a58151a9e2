"""Canonical systems: the clock that a movement primitive's forcing term runs on.

Any frozen dataclass that is a `Phase` can be passed to a basis; files keep those of this
module.
"""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

ROUNDING = 38.0
"""exp(-38) = 3e-17 is lost in float64 rounding."""


@runtime_checkable
class Phase(Protocol):
    """What fades the forcing term, as a function of time; hashable."""

    @property
    def horizon(self) -> float:
        """Normalised time after which the phase is lost in float64 rounding."""
        ...

    @property
    def smooth_interval(self) -> float:
        """Length over which the phase is a polynomial of low degree."""
        ...

    def __call__(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Phase z at normalised time `s`: positive, 1 at s = 0, never growing."""
        ...


@dataclass(frozen=True, kw_only=True)
class ExponentialPhase:
    """Exponentially decaying phase z, solved in closed form.

    dz/ds = -alpha_z z,  z(0) = 1,  so  z(s) = exp(-alpha_z s),  s = t / tau

    (paper eq. (eq_cs)), with s the time divided by the duration: 0 at the start of the
    motion, 1 at its end. The forcing term keeps fading after the end.
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
        """Normalised time after which forcing is lost in float64 rounding."""
        return ROUNDING / self.decay

    @property
    def smooth_interval(self) -> float:
        """Length over which the phase is a polynomial of low degree."""
        return 1 / self.decay


@dataclass(frozen=True, kw_only=True)
class SigmoidPhase:
    """Phase that stays up along the motion and falls at its end.

    z(s) = (1 + exp(-a m)) / (1 + exp(a (s - m)))

    (after Kulvicius et al. 2012, "Joining movement sequences", where the exponential decay
    leaves the end of a motion little forcing). Weights early and late act alike.
    """

    steepness: float = 50.0
    """a: from 88 % to 12 % of the way the phase takes 4 / a."""
    middle: float = 1.0
    """m: where it has fallen to one half."""

    def __post_init__(self):
        check_positive("steepness", self.steepness)
        check_positive("middle", self.middle)

    def __call__(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Phase z at normalised time `s`."""
        top = 1 + math.exp(-self.steepness * self.middle)
        return top * torch.sigmoid(self.steepness * (self.middle - s))

    @property
    def horizon(self) -> float:
        """Normalised time after which forcing is lost in float64 rounding."""
        return self.middle + ROUNDING / self.steepness

    @property
    def smooth_interval(self) -> float:
        """Length over which the phase is a polynomial of low degree."""
        # Analytic within pi / a; the same share of that as between two Gaussians.
        return 1.4 / self.steepness


def check_positive(name: str, value: float) -> None:
    """Raise ValueError unless `value` is a positive number; says what it is called."""
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{name} must be positive, got {value}")
