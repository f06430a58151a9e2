"""The dynamics of a primitive: spring-damper, phase, and basis functions of the forcing term.

A primitive adapts to a new goal in one of two ways. If only the spring reacts to the goal, the
acceleration jumps at the start, and the velocity towards the goal peaks more than twice as high
as in a minimum-jerk motion. With an approach (`approach_curve`), the forcing term also contains
a part proportional to goal - start. With all weights zero, the motion is then
y_0 + (g - y_0) m(s), with the minimum-jerk curve m from 0 to 1. This is the elementary
trajectory of Zhou et al. 2019, "Learning via-movement primitives", in a second-order system.
The weights describe how a motion deviates from this trajectory.

Labels such as (eq_tf) are those of the paper by Yan et al.; see `docs/concepts/paper.md`.
"""

import math
from dataclasses import asdict, dataclass
from types import ModuleType
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry.numerics import cached_tensors, check_settings, polynomial

CRITICAL = 1e-12
"""Bound on |1 - 4 beta / alpha| below which the damping counts as critical. At smaller
values, sinh(r s) / r in `SpringDamper.modes` would lose more than six digits to
cancellation."""
ROUNDING = 38.0
"""Exponent from which a decaying factor is lost in float64 rounding: exp(-38) = 3e-17."""
DEGREE = 3
"""Degree of the splines: the lowest for which the forcing has a continuous second
derivative."""


@dataclass(frozen=True, kw_only=True)
class SpringDamper:
    """y'' = alpha (beta (g - y) - y'), solved exactly for any gains.

    This is the unforced equation (eq_tf) of the paper for a position y and a goal g; primes are
    derivatives with respect to s = t / tau. With x = (y - g, y') it reads x' = A x,
    A = [[0, 1], [-alpha beta, -alpha]].
    """

    alpha: float = 25.0
    """Damping gain alpha_q."""
    beta: float = math.nan
    """Spring gain beta_q; alpha / 4, critical damping, by default."""

    def __post_init__(self):
        if math.isnan(self.beta):
            object.__setattr__(self, "beta", self.alpha / 4)
        check_settings(self, positive=("alpha", "beta"))

    @property
    def stiffness(self) -> float:
        """Product alpha beta."""
        return self.alpha * self.beta

    @property
    def smooth_interval(self) -> float:
        """Normalised time over which the free motion is nearly a polynomial of low degree."""
        half = self.alpha / 2
        fastest = half + math.sqrt(max(half**2 - self.stiffness, 0.0))
        # The modulus of complex modes is the square root of the stiffness.
        return 1 / max(fastest, math.sqrt(self.stiffness))

    def acceleration(self, offset: Tensor, velocity: Tensor) -> Tensor:
        """Second derivative y'' of the unforced system at the offset y - g."""
        return -self.stiffness * offset - self.alpha * velocity

    def propagator(self, s: Float[Tensor, "*batch"] | float) -> Float[Tensor, "*batch 2 2"]:
        """Transition matrix exp(A s), which maps (y - g, y') at 0 to (y - g, y') at `s`.

        exp(A s) = C I + S (A + alpha / 2 I) (Cayley-Hamilton theorem); `modes` computes C, S.
        If `s` is a plain number, the result is cached: do not change it in place.
        """
        if not isinstance(s, Tensor):
            return _cached_propagator(self, s)
        C, S = self.modes(s, torch)
        lean = S * (self.alpha / 2)  # A + alpha / 2 I has +-alpha / 2 on its diagonal
        entries = torch.stack([C + lean, S, -self.stiffness * S, C - lean], dim=-1)
        return entries.view(*s.shape, 2, 2)

    def modes(self, s: Any, xp: ModuleType) -> tuple[Any, Any]:
        """C = exp(-alpha s / 2) cosh(r s) and S = exp(-alpha s / 2) sinh(r s) / r.

        r^2 = alpha^2 / 4 - alpha beta. If r is imaginary, cos and sin of |r| s take the place
        of cosh and sinh; for r = 0, C = exp(-alpha s / 2) and S = s C.

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
            # Both exponents are negative, so nothing overflows at large s; cosh would overflow.
            slow, fast = xp.exp((rate - half) * s), xp.exp((-rate - half) * s)
            return (slow + fast) / 2, (slow - fast) / (2 * rate)
        envelope = xp.exp(-half * s)
        return envelope * xp.cos(rate * s), envelope * xp.sin(rate * s) / rate


# A control loop uses few step lengths, each of which needs one 2x2 matrix.
@cached_tensors(maxsize=64)
def _cached_propagator(spring: SpringDamper, s: float) -> Float[Tensor, "2 2"]:
    """`SpringDamper.propagator` of a number (float64)."""
    C, S = spring.modes(s, math)
    lean = S * spring.alpha / 2
    rows = [[C + lean, S], [-spring.stiffness * S, C - lean]]
    return torch.tensor(rows, dtype=torch.float64)


def approach_curve(s: Float[Tensor, "*batch"], fraction: float, order: int) -> Tensor:
    """m(s) - 1, or its derivative of the given order.

    The minimum-jerk curve m rises from 0 at s = 0 to 1 at s = `fraction`.
    """
    coefficients = (-1.0, 0.0, 0.0, 10.0, -15.0, 6.0)
    for _ in range(order):
        coefficients = tuple(k * c for k, c in enumerate(coefficients))[1:]
    value = polynomial((s / fraction).clamp(0, 1), (*coefficients, 0.0, 0.0))
    return torch.where((s < fraction) | (order == 0), value / fraction**order, 0.0)


def approach_state(s: Float[Tensor, "*batch"], fraction: float) -> Float[Tensor, "*batch 2"]:
    """State (m - 1, m') of the approach, relative to the goal, per unit of goal - start."""
    return torch.stack([approach_curve(s, fraction, order) for order in (0, 1)], dim=-1)


@dataclass(frozen=True, kw_only=True)
class ExponentialPhase:
    """Exponentially decaying phase z, solved in closed form.

    dz/ds = -alpha_z z,  z(0) = 1,  so  z(s) = exp(-alpha_z s),  s = t / tau

    This is equation (eq_cs) of the paper, with s = 0 at the start of the motion and 1 at its
    end. The forcing term keeps fading after the end.
    """

    decay: float = 4.0
    """alpha_z: the phase falls to exp(-decay) by the end of the motion."""

    def __post_init__(self):
        check_settings(self, positive=["decay"])

    def __call__(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Phase z at normalised time `s`."""
        return torch.exp(-self.decay * s)

    @property
    def horizon(self) -> float:
        """Normalised time after which the forcing is lost in float64 rounding."""
        return ROUNDING / self.decay

    @property
    def smooth_interval(self) -> float:
        """Normalised time over which the phase is nearly a polynomial of low degree."""
        return 1 / self.decay


@dataclass(frozen=True, kw_only=True)
class _Bells:
    """Normalised bells exp(`_exponents`), of which the first `count` are faded by `phase`."""

    count: int
    periodic: ClassVar[bool] = False

    def __post_init__(self):
        if not (self.count >= 2 and self.count % 1 == 0):
            raise ValueError(
                f"a basis needs a whole number of at least 2 functions, got {self.count}"
            )
        object.__setattr__(self, "count", int(self.count))
        check_settings(self, positive=vars(self).keys() & {"width"})

    def kernels(self: Any, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch N"]:
        """Bells psi_i at normalised time `s`, before their normalisation."""
        return self._exponents(s).exp()[..., : self.count]

    def forcing(self: Any, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch N"]:
        """Forcing term per unit of each weight at normalised time `s`."""
        # A softmax never divides by zero, however far s lies from every centre.
        activation = torch.softmax(self._exponents(s), dim=-1)[..., : self.count]
        return activation * self.phase(s)[..., None]


@dataclass(frozen=True, kw_only=True)
class GaussianBasis(_Bells):
    """Normalised Gaussians, faded by the phase z.

    psi_i(x) = exp(-(x - c_i)^2 / (2 sigma_i^2)),  phi_i = psi_i z / sum_j psi_j

    Centres are equally spaced in time, s_i = (i - 1) / (N - 1), so that early and late detail
    is resolved equally well. sigma_i is `width` times the distance to the next centre.

    In the domain `"time"`, x = s, and one more Gaussian without a weight follows the last one.
    After the end it dominates the sum, so the forcing term vanishes and the motion settles at
    its goal. In the domain `"phase"`, x = z, as in the paper. As z -> 0, all Gaussians become
    equally active again, and the motion wanders after its end before it settles.
    """

    count: int = 50
    """N, the number of basis functions."""
    width: float = 0.6
    """sigma_i relative to the distance between neighbouring centres."""
    domain: Literal["time", "phase"] = "time"
    """Variable of the Gaussians: `"time"` or `"phase"`."""
    phase: ExponentialPhase = ExponentialPhase()
    """Canonical system, whose z fades the forcing term."""
    knot_spacing = None
    """No knots: smooth everywhere."""

    @property
    def horizon(self) -> float:
        """Normalised time after which the forcing is lost in float64 rounding."""
        if self.domain == "phase":
            return self.phase.horizon
        # The ratio of the last Gaussian with a weight to the one without a weight is
        # exp((1/2 - x) / width^2) at x spacings after the end; exp(-39) = 1e-17.
        end = 1 + (0.5 + 39 * self.width**2) / (self.count - 1)
        return min(end, self.phase.horizon)

    @property
    def smooth_interval(self) -> float:
        """Normalised time over which the forcing is nearly a polynomial of low degree.

        Between two neighbours, a normalised Gaussian is a logistic function of s with the scale
        width^2 times the spacing. The nearest pole of this function, in the complex plane, is
        pi times the scale away.
        """
        # 1.4 width^2 is 0.45 of the distance to the nearest pole, pi width^2.
        handover = min(0.5, 1.4 * self.width**2) / (self.count - 1)
        return min(handover, self.phase.smooth_interval)

    def centre_times(self) -> Float[Tensor, "N"]:
        """Normalised times s_i at which the basis functions peak (float64)."""
        return torch.linspace(0, 1, self.count, dtype=torch.float64)

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
class PeriodicBasis(_Bells):
    """Normalised periodic bells that do not fade.

    psi_i(s) = exp(h (cos(2 pi (s - c_i)) - 1)),  phi_i = psi_i / sum_j psi_j

    (Ijspeert et al. 2013, section 2.2.2). The centres are c_i = (i - 1) / N. The sharpness h
    gives a bell the standard deviation `width` times the distance between centres.
    """

    count: int = 25
    """N, the number of basis functions."""
    width: float = 0.6
    """Standard deviation of a bell relative to the distance between centres."""
    periodic: ClassVar[bool] = True
    horizon = 1.0
    """The period."""
    knot_spacing = 1.0
    """The period, so that a whole number of polynomial pieces of the `Response` covers it."""

    @property
    def smooth_interval(self) -> float:
        """Normalised time over which the forcing is nearly a polynomial of low degree."""
        # Neighbours behave like Gaussians; see `GaussianBasis.smooth_interval`.
        return min(0.5, 1.4 * self.width**2) / self.count

    def phase(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Fading factor of the forcing term: one, because a rhythm does not fade."""
        return torch.ones_like(s)

    def centre_times(self) -> Float[Tensor, "N"]:
        """Normalised times c_i at which the basis functions peak (float64)."""
        return torch.arange(self.count, dtype=torch.float64) / self.count

    def _exponents(self, s: Tensor) -> Tensor:
        # cos(x) - 1 is -x^2 / 2 near the centre: a Gaussian of variance 1 / h, in radians.
        sharpness = (self.count / (2 * math.pi * self.width)) ** 2
        angle = 2 * math.pi * (s[..., None] - self.centre_times().to(s))
        return sharpness * (torch.cos(angle) - 1)


@dataclass(frozen=True, kw_only=True)
class SplineBasis(_Bells):
    """Uniform cubic B-splines, faded by the phase z: phi_i = B(s / h - i + 2) z.

    B is centred at zero and is zero beyond two spacings. A weight therefore has no effect
    before c_i - 2 h, and at most four weights act at a time. The splines add up to one
    without normalisation (de Boor 1978, "A practical guide to splines", chapter IX).

    The centres are c_i = (i - 2) h, i = 1 ... N, with the spacing h = 1 / (N - 1). The first
    centre lies one spacing before the start, so that four splines act in the first interval;
    the last centre lies one spacing before the end. The forcing term fades from s = 1 - 2 h to
    s = 1 + h and is zero afterwards.
    """

    count: int = 50
    """N, the number of basis functions."""
    phase: ExponentialPhase = ExponentialPhase()
    """Canonical system, whose z fades the forcing term."""

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
        """Normalised time over which the forcing, between knots, is nearly a polynomial."""
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
    # Truncated powers of the distance to the nearer end, so that no digits cancel there.
    inwards = 2 - x.abs()
    outer, inner = inwards.clamp_min(0), (inwards - 1).clamp_min(0)
    return (outer**DEGREE - 4 * inner**DEGREE) / math.factorial(DEGREE)


type Basis = GaussianBasis | PeriodicBasis | SplineBasis
"""Basis functions of a forcing term, each multiplied by one weight; frozen and hashable.

`horizon` is the normalised time after which the forcing is lost in rounding, or the period.
`smooth_interval` is the time over which the forcing, between knots, is nearly a polynomial of
low degree. `knot_spacing` is the distance between points where the forcing is not smooth, or
None if it is smooth everywhere.
"""
BASES: dict[str, type[Any]] = {
    kind.__name__: kind for kind in (GaussianBasis, PeriodicBasis, SplineBasis)
}


def basis_config(basis: Basis) -> dict[str, Any]:
    """Description of a basis as JSON values, from which `restored_basis` restores the basis."""
    return {"type": type(basis).__name__, **asdict(basis)}


def restored_basis(config: dict[str, Any]) -> Basis:
    """Basis that `basis_config` described.

    Raises:
        ValueError: Unknown type, or values that the type refuses.
        TypeError: Fields that the type does not have.
        KeyError: The type is missing.
    """
    fields = dict(config)
    kind = fields.pop("type")
    if kind not in BASES:
        raise ValueError(f"unknown type {kind!r}; choose from {', '.join(BASES)}")
    if "phase" in fields:
        fields["phase"] = ExponentialPhase(**fields["phase"])
    return BASES[kind](**fields)


def balanced_units(
    basis: Basis, A: Float[Tensor, "rows M"], others: int
) -> Float[Tensor, "unknown"]:
    """Units of the unknowns in which a ridge penalises all unknowns equally.

    The columns of A are the weights, then `others` unknowns such as the start velocity. Late
    weights act through a small phase, so the unit of a weight is 1 / phase at its centre. The
    other columns are scaled to the size of the largest column of a weight, in these units.
    """
    unit = 1 / basis.phase(basis.centre_times().to(A))
    norm = A.norm(dim=0)
    size = (norm[: basis.count] * unit).amax()
    return torch.cat([unit, size / norm[basis.count : basis.count + others]])
