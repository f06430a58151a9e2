"""The unforced dynamics in closed form: the spring-damper and the minimum-jerk approach.

Left to the spring, a motion reacts to a new goal at once: the acceleration jumps at the start
and the motion becomes several times faster. With a minimum-jerk approach the forcing term
contains a part proportional to goal - start under which, with all weights zero, the motion is
y_0 + (g - y_0) m(s). The weights then shape the remainder (the elementary trajectory of Zhou et
al. 2019, "Learning via-movement primitives", as part of a second-order system).
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import minimum_jerk

CRITICAL = 1e-12
"""Bound on |1 - 4 beta / alpha| below which the damping counts as critical. Closer to zero,
sinh(r s) / r loses more than six digits to cancellation."""


@dataclass(frozen=True, kw_only=True)
class SpringDamper:
    """y'' = alpha (beta (g - y) - y'), solved exactly for any gains.

    (paper eq. (eq_tf)); primes are derivatives by s = t / tau. With x = (y - g, y') this
    is x' = A x, A = [[0, 1], [-alpha beta, -alpha]].
    """

    alpha: float = 25.0
    """Damping gain alpha_q."""
    beta: float = math.nan
    """Spring gain beta_q; alpha / 4, critical damping, by default."""

    def __post_init__(self):
        if math.isnan(self.beta):
            object.__setattr__(self, "beta", self.alpha / 4)
        for name in ("alpha", "beta"):
            gain = getattr(self, name)
            if not (math.isfinite(gain) and gain > 0):
                raise ValueError(f"{name} must be positive for stability, got {gain}")

    @property
    def stiffness(self) -> float:
        """Product alpha beta."""
        return self.alpha * self.beta

    @property
    def smooth_interval(self) -> float:
        """Length over which the unforced motion is a polynomial of low degree."""
        half = self.alpha / 2
        fastest = half + math.sqrt(max(half**2 - self.stiffness, 0.0))
        # The modulus of complex modes is the square root of the stiffness.
        return 1 / max(fastest, math.sqrt(self.stiffness))

    def acceleration(self, offset: Tensor, velocity: Tensor) -> Tensor:
        """Second derivative y'' of the unforced system at the offset y - g."""
        return -self.stiffness * offset - self.alpha * velocity

    def propagator(self, s: Float[Tensor, "*batch"] | float) -> Float[Tensor, "*batch 2 2"]:
        """Transition matrix exp(A s): maps (y - g, y') at 0 to the same at `s`.

        exp(A s) = C I + S (A + alpha / 2 I) by Cayley-Hamilton; see `modes` for C and S.
        The matrix of a number is cached: do not change it in place.
        """
        if not isinstance(s, Tensor):
            return _cached_propagator(self, s)
        C, S = self.modes(s, torch)
        lean = S * (self.alpha / 2)  # A + alpha / 2 I has +-alpha / 2 on its diagonal
        entries = torch.stack([C + lean, S, -self.stiffness * S, C - lean], dim=-1)
        return entries.view(*s.shape, 2, 2)

    def modes(self, s: Any, xp: ModuleType) -> tuple[Any, Any]:
        """exp(-alpha s / 2) times cosh(r s) and sinh(r s) / r, r^2 = alpha^2 / 4 - alpha beta.

        Trigonometric for imaginary r, 1 and s for r = 0.

        Args:
            s: Normalised time, of a type that `xp` accepts.
            xp: `torch` for tensors, `math` for numbers.
        """
        half = self.alpha / 2
        discriminant = 1 - 4 * (self.beta / self.alpha)
        rate = half * math.sqrt(abs(discriminant))
        if abs(discriminant) < CRITICAL:
            C = xp.exp(-half * s)
            return C, s * C
        if discriminant > 0:
            # Both exponents are negative: unlike cosh, nothing overflows at large s.
            slow, fast = xp.exp((rate - half) * s), xp.exp((-rate - half) * s)
            return (slow + fast) / 2, (slow - fast) / (2 * rate)
        envelope = xp.exp(-half * s)
        return envelope * xp.cos(rate * s), envelope * xp.sin(rate * s) / rate


# A control loop uses few step lengths, each of which needs one 2x2 matrix.
@lru_cache(maxsize=64)
def _cached_propagator(spring: SpringDamper, s: float) -> Float[Tensor, "2 2"]:
    """`SpringDamper.propagator` of a number (float64)."""
    C, S = spring.modes(s, math)
    lean = S * spring.alpha / 2
    # Tensors made in inference mode cannot take part in a backward pass later.
    with torch.inference_mode(False):
        return torch.tensor(
            [[C + lean, S], [-spring.stiffness * S, C - lean]], dtype=torch.float64
        )


def minimum_jerk_curve(
    s: Float[Tensor, "*batch"], fraction: float = 1.0
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Curve m(s) from 0 to 1 over the first `fraction` of a motion, and m' and m''."""
    u = (s / fraction).clamp(0, 1)
    m, slope = minimum_jerk(u)
    curvature = 60 * u * (1 - u) * (1 - 2 * u)
    return m, slope / fraction, curvature / fraction**2


def approach_state(s: Float[Tensor, "*batch"], fraction: float) -> Float[Tensor, "*batch 2"]:
    """State (m - 1, m') of the approach, relative to the goal, per unit of goal - start."""
    m, slope, _ = minimum_jerk_curve(s, fraction)
    return torch.stack([m - 1, slope], dim=-1)
