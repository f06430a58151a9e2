"""Canonical systems: the clock that a movement primitive's forcing term runs on."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


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
        if not (math.isfinite(self.decay) and self.decay > 0):
            raise ValueError(f"decay must be positive, got {self.decay}")

    def __call__(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Phase z at normalised time `s`."""
        return torch.exp(-self.decay * s)

    @property
    def horizon(self) -> float:
        """Normalised time after which forcing is lost in float64 rounding."""
        return 38.0 / self.decay  # exp(-38) = 3e-17
