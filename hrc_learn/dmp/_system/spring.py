"""The transformation system without its forcing term: a spring and a damper."""

import math
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

CRITICAL = 1e-12
"""1 - 4 beta / alpha, nearer to zero than which the damping is critical: closer,
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
    """Spring gain beta_q; alpha / 4, critical damping, unless given."""

    def __post_init__(self):
        if math.isnan(self.beta):
            object.__setattr__(self, "beta", self.alpha / 4)
        for name in ("alpha", "beta"):
            gain = getattr(self, name)
            if not (math.isfinite(gain) and gain > 0):
                raise ValueError(f"{name} must be positive for stability, got {gain}")

    @property
    def stiffness(self) -> float:
        """Alpha beta."""
        return self.alpha * self.beta

    @property
    def smooth_interval(self) -> float:
        """Length over which the unforced motion is a polynomial of low degree."""
        half = self.alpha / 2
        fastest = half + math.sqrt(max(half**2 - self.stiffness, 0.0))
        return 1 / max(fastest, math.sqrt(self.stiffness))

    def acceleration(self, offset: Tensor, velocity: Tensor) -> Tensor:
        """Y'' of the unforced system, `offset` being y - g."""
        return -self.stiffness * offset - self.alpha * velocity

    def propagator(self, s: Float[Tensor, "*batch"] | float) -> Float[Tensor, "*batch 2 2"]:
        """Transition matrix exp(A s): maps (y - g, y') at 0 to the same at `s`.

        exp(A s) = C I + S (A + alpha / 2 I) by Cayley-Hamilton; see `modes` for C and S.
        Of a number it is not to be changed in place: it serves again.
        """
        if not isinstance(s, Tensor):
            return _known_transition(self, s)
        return transition(s, self.alpha, self.beta / self.alpha)

    def modes(self, s: Any, xp: ModuleType) -> tuple[Any, Any]:
        """exp(-alpha s / 2) times cosh(r s) and sinh(r s) / r, r^2 = alpha^2 / 4 - alpha beta.

        Trigonometric where r is imaginary, 1 and s where it is zero.

        Args:
            s: Normalised time, of a type that `xp` takes.
            xp: `torch` for tensors, `math` for numbers.
        """
        return spring_modes(s, self.alpha, self.beta / self.alpha, xp)


def transition(
    s: Float[Tensor, "*batch"], alpha: Float[Tensor, ""] | float, ratio: float
) -> Float[Tensor, "*batch 2 2"]:
    """`SpringDamper.propagator` of alpha and beta = ratio alpha; differentiable in alpha."""
    C, S = spring_modes(s, alpha, ratio, torch)
    lean = S * (alpha / 2)  # A + alpha / 2 I has alpha / 2 and -alpha / 2 on its diagonal
    entries = torch.stack([C + lean, S, S * (-ratio * alpha**2), C - lean], dim=-1)
    return entries.view(*s.shape, 2, 2)


# Loops repeat a few step lengths, each of which needs one 2x2 matrix.
@lru_cache(maxsize=64)
def _known_transition(spring: SpringDamper, s: float) -> Float[Tensor, "2 2"]:
    """`SpringDamper.propagator` of a number: loops repeat their step length."""
    C, S = spring.modes(s, math)
    lean = S * spring.alpha / 2
    # What is made in inference mode cannot take part in a backward pass later.
    with torch.inference_mode(False):
        return torch.tensor(
            [[C + lean, S], [-spring.stiffness * S, C - lean]], dtype=torch.float64
        )


def spring_modes(s: Any, alpha: Any, ratio: float, xp: ModuleType) -> tuple[Any, Any]:
    """`SpringDamper.modes` of alpha and beta = ratio alpha; which case it is, ratio says."""
    half = alpha / 2
    shape = 1 - 4 * ratio
    rate = half * math.sqrt(abs(shape))
    if abs(shape) < CRITICAL:
        C = xp.exp(-half * s)
        return C, s * C
    if shape > 0:
        # Both exponents are negative: unlike cosh, nothing overflows at large s.
        slow, fast = xp.exp((rate - half) * s), xp.exp((-rate - half) * s)
        return (slow + fast) / 2, (slow - fast) / (2 * rate)
    envelope = xp.exp(-half * s)
    return envelope * xp.cos(rate * s), envelope * xp.sin(rate * s) / rate
