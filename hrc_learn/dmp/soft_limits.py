"""Coordinates without bounds for joints that have them.

    q = lower + beta (softplus((x - lower) / beta) - softplus((x - upper) / beta))

q lies between its limits for every x. Far from them, beyond a few times the softness beta, q
is x; close to them it is logistic. The idea of driving a transformed state that cannot leave
the limits is that of Duan et al. 2018, "Constrained DMPs for feasible skill learning on
humanoid robots"; this transformation leaves the middle of the range as it is.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

CLOSEST = 1e-6
"""How close to a limit a joint comes, in units of the softness."""


@dataclass(frozen=True, eq=False)
class SoftLimits:
    """Limits of D joints, and how they are approached; all in the units of the joints."""

    lower: Float[Tensor, "D"]
    upper: Float[Tensor, "D"]
    softness: Float[Tensor, "D"]
    """Beta: a few of it from a limit, a motion begins to feel it."""

    def constrain(self, x: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch D"]:
        """Q of x."""
        lower, upper, beta = self._like(x)
        a, b = (x - lower) / beta, (x - upper) / beta
        # From the nearer limit: a difference of two large numbers would round past it.
        above = lower + beta * (_softplus(a) - _softplus(b))
        below = upper - beta * (_softplus(-b) - _softplus(-a))
        return self.clamp(torch.where(a + b < 0, above, below))

    def release(self, q: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch D"]:
        """X of q, which lies between the limits: the inverse of `constrain`."""
        lower, upper, beta = self._like(q)
        a, b = (q - lower) / beta, (upper - q) / beta
        # log(expm1(a)) = a + log(1 - exp(-a)), and neither side overflows.
        return q + beta * (torch.log(-torch.expm1(-a)) - torch.log(-torch.expm1(-b)))

    def clamp(self, q: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch D"]:
        """The nearest q that an x leads to: between the limits, in any precision."""
        lower, upper, beta = self._like(q)
        rounding = 4 * torch.finfo(q.dtype).eps * torch.maximum(lower.abs(), upper.abs())
        room = torch.maximum(CLOSEST * beta, rounding)
        return torch.minimum(torch.maximum(q, lower + room), upper - room)

    def contain(self, q: Float[Tensor, "*batch D"]) -> Bool[Tensor, "*batch D"]:
        """Whether q lies between its limits."""
        lower, upper, _ = self._like(q)
        return (q > lower) & (q < upper)

    def _like(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return self.lower.to(x), self.upper.to(x), self.softness.to(x)


def _softplus(x: Tensor) -> Tensor:
    """log(1 + exp(x)), to rounding on both sides; twice differentiable as it is written."""
    return torch.logaddexp(x, torch.zeros_like(x))


torch.export.register_dataclass(SoftLimits, serialized_type_name="hrc_learn.dmp.SoftLimits")
