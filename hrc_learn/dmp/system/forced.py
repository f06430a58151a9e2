"""What forcing alone does to a spring: integrals along pieces, and their sum along time.

x' = A x + (0, phi(s)) has the solution x(b) = E(b - a) x(a) + integral from a to b of
E(b - u) (0, phi(u)) du, E the transition matrix. Differentiable in whatever the transition
matrix and the forcing depend on.
"""

from collections.abc import Callable

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
