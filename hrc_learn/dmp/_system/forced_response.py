"""What forcing alone does to a spring: integrals along pieces, their sum, and a table of it.

x' = A x + (0, phi(s)) has the solution x(b) = E(b - a) x(a) + integral from a to b of
E(b - u) (0, phi(u)) du, E the transition matrix. Differentiable in whatever the transition
matrix and the forcing depend on.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

GAUSS_POINTS = 12
"""For the forcing over one piece of a table, which no basis function changes much in."""

type Propagate = Callable[[Tensor], Tensor]
"""Times (*batch) to transition matrices (*batch 2 2)."""
type Forcing = Callable[[Tensor], Tensor]
"""Times (*batch) to the forcing of each basis function (*batch N)."""


def impulse(
    propagate: Propagate,
    forcing: Forcing,
    start: Float[Tensor, "pieces"],
    length: Float[Tensor, "*pieces"],
    n_points: int = GAUSS_POINTS,
) -> Float[Tensor, "pieces 2 N"]:
    """(y, y') at start + length that the forcing since `start` has caused, by quadrature.

    Args:
        propagate: Transition matrix.
        forcing: Of the basis.
        start: Of each piece.
        length: Of each piece, or of all.
        n_points: Of Gauss-Legendre quadrature.
    """
    nodes, weights = (
        torch.from_numpy(x).to(start) for x in np.polynomial.legendre.leggauss(n_points)
    )
    u = length[..., None] * ((1 + nodes) / 2)
    kernel = (
        propagate(length[..., None] - u)[..., 1] * (length[..., None] / 2 * weights)[..., None]
    )
    return kernel.mT @ forcing(start[:, None] + u)


def accumulate(
    propagate: Propagate,
    knots: Float[Tensor, "K"],
    shares: Float[Tensor, "K_less_1 2 N"],
) -> Float[Tensor, "K 2 N"]:
    """States at the knots, from rest at the first, that the shares of the pieces add up to.

    A parallel prefix sum (Hillis and Steele 1986): its steps are the logarithm of K.
    """
    state = torch.cat([torch.zeros_like(shares[:1]), shares])
    stride = 1
    while stride < len(knots):
        E = propagate(knots[stride:] - knots[:-stride])
        state = torch.cat([state[:stride], state[stride:] + E @ state[:-stride]])
        stride *= 2
    return state


DEGREE = 12
"""Of the polynomial on a piece, whose error is then rounding: pieces are chosen that short."""


def chebyshev_points() -> Float[Tensor, "P"]:
    """Chebyshev points of a piece of unit length, both ends included."""
    k = torch.arange(DEGREE + 1, dtype=torch.float64)
    return (1 - torch.cos(torch.pi * k / DEGREE)) / 2


@dataclass(frozen=True, eq=False)
class PiecewisePolynomial:
    """A matrix f(s) = sum_p c_p u^p, u from -1 to 1 along the piece that s lies on."""

    coefficients: Float[Tensor, "pieces P rows columns"]
    interval: float
    """Length of a piece."""
    periodic: bool = False
    """Whether the last piece is followed by the first."""
    _exponents: Float[Tensor, "1 P"] = field(init=False)
    _moved: dict[torch.device, "PiecewisePolynomial"] = field(default_factory=dict)

    def __post_init__(self):
        # Now and not when first needed: that may be while a program is traced, and what is
        # made there is no tensor to keep.
        exponents = torch.arange(DEGREE + 1)[None].to(self.coefficients)
        object.__setattr__(self, "_exponents", exponents)

    @classmethod
    def interpolate(
        cls,
        values: Float[Tensor, "pieces P rows columns"],
        interval: float,
        periodic: bool = False,
    ) -> "PiecewisePolynomial":
        """The function that has these values at the Chebyshev points of its pieces."""
        u = 2 * chebyshev_points() - 1
        powers = u[:, None] ** torch.arange(DEGREE + 1)
        solved = torch.linalg.solve(powers, values.flatten(2))
        return cls(solved.reshape(values.shape).contiguous(), interval, periodic)

    @property
    def end(self) -> float:
        """Where the last piece ends."""
        return self.interval * self.coefficients.shape[0]

    def __call__(
        self, s: Float[Tensor, "*batch"] | float
    ) -> Float[Tensor, "*batch rows columns"]:
        """Value at `s`; past the end of what is not periodic, the value at the end."""
        pieces, P, *shape = self.coefficients.shape
        if not isinstance(s, Tensor):
            x = s / self.interval
            x = x % pieces if self.periodic else min(max(x, 0.0), float(pieces))
            piece = min(int(x), pieces - 1)
            powers = torch.pow(2 * (x - piece) - 1, self._exponents)
            return (powers @ self.coefficients[piece].view(P, -1)).view(shape)
        x = s / self.interval
        x = x % pieces if self.periodic else x.clamp(0, pieces)
        piece = x.detach().long().clamp(max=pieces - 1)
        powers = (2 * (x - piece) - 1)[..., None, None] ** self._exponents
        # Not by brackets: those read a single index as a number, which no export can trace.
        c = self.coefficients.view(pieces, -1).index_select(0, piece.reshape(-1))
        return (powers @ c.view(*s.shape, P, -1)).view(*s.shape, *shape)

    def to(self, device: torch.device) -> "PiecewisePolynomial":
        """The same function on another device; made once."""
        if device == self.coefficients.device:
            return self
        if device not in self._moved:
            moved = self.coefficients.to(device)
            self._moved[device] = PiecewisePolynomial(moved, self.interval, self.periodic)
        return self._moved[device]
