"""What is known in closed form: phases, the spring without its forcing, minimum-jerk curves.

Phases are canonical systems: the clock that a movement primitive's forcing term runs on. Any
frozen dataclass that is a `Phase` can be passed to a basis; files keep those of this module.

The curves say how a motion takes up a new goal, and passes from one point to the next. Left to
the spring, a motion sets off for a new goal at once: a moved goal makes the acceleration jump
at the start and the motion up to several times as fast. Along a minimum-jerk approach the
forcing term holds a part proportional to goal - start under which, with all weights zero, the
motion is y_0 + (g - y_0) m(s). The weights then shape what is left (the elementary trajectory
of Zhou et al. 2019, "Learning via-movement primitives", as part of a second-order system).
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
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
        # Late, the sigmoid falls as exp(-a (s - m)).
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
        # Complex modes have the root of the stiffness for modulus.
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


def minimum_jerk(
    s: Float[Tensor, "*batch"], share: float
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """m(s) from 0 to 1 over the first `share` of the motion, and its derivatives by s."""
    u = (s / share).clamp(0, 1)
    m, slope = quintic(u)
    curvature = 60 * u * (1 - u) * (1 - 2 * u)
    return m, slope / share, curvature / share**2


def quintic(u: Any) -> tuple[Any, Any]:
    """Minimum-jerk curve from 0 to 1 on [0, 1], and its slope; of tensors or numbers."""
    return u**3 * (10 - 15 * u + 6 * u**2), 30 * (u * (1 - u)) ** 2


def approach_state(s: Float[Tensor, "*batch"], share: float) -> Float[Tensor, "*batch 2"]:
    """(m - 1, m'): the motion to the goal per unit of goal - start, seen from the goal."""
    m, slope, _ = minimum_jerk(s, share)
    return torch.stack([m - 1, slope], dim=-1)


def piecewise_quintic(
    s: Float[Tensor, "G"],
    knots: Float[Tensor, "*batch K"],
    value: Float[Tensor, "*batch K D"],
    rate: Float[Tensor, "*batch K D"],
    active: Bool[Tensor, "*batch K D"],
) -> Float[Tensor, "*batch G 3 D"]:
    """Value and two derivatives at times `s`, from the first knot to the last.

    Args:
        s: Between the first and the last knot.
        knots: Increasing times.
        value: At the knots.
        rate: At the knots.
        active: Which knots there are for a coordinate; the first and the last always.
    """
    K = knots.shape[-1]
    index = torch.arange(K, device=s.device)[:, None]
    passed = (knots[..., None, :] <= s[:, None])[..., None]
    active = active[..., None, :, :]
    before = torch.where(active & passed, index, 0).amax(-2).clamp(max=K - 2)
    after = torch.where(active & ~passed, index, K - 1).amin(-2)
    times = knots[..., None].expand_as(value)
    (t0, y0, v0), (t1, y1, v1) = (
        [torch.take_along_dim(x, at, dim=-2) for x in (times, value, rate)]
        for at in (before, after)
    )
    L = t1 - t0
    u = (s[:, None] - t0) / L
    m, slope = quintic(u)
    curvature = 60 * u * (1 - u) * (1 - 2 * u)
    way, w0, w1 = y1 - y0, v0 * L, v1 * L
    # Hermite's quintic with no second derivative at its ends: of the way and of both rates.
    position = y0 + way * m
    position = position + w0 * (u - u**3 * (6 - 8 * u + 3 * u**2))
    position = position - w1 * u**3 * (4 - 7 * u + 3 * u**2)
    velocity = way * slope + w0 * (1 - u**2 * (18 - 32 * u + 15 * u**2))
    velocity = velocity - w1 * u**2 * (12 - 28 * u + 15 * u**2)
    acceleration = way * curvature - w0 * u * (36 - 96 * u + 60 * u**2)
    acceleration = acceleration - w1 * u * (24 - 84 * u + 60 * u**2)
    return torch.stack([position, velocity / L, acceleration / L**2], dim=-2)
