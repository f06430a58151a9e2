"""What a turning axis adds to the rate of a rotation vector.

For q = exp(-e) g with angular velocity -v, the rotation vector e has the rate

    e' = v + n(e, v),   n = e x v / 2 + c(|e|) e x (e x v),   c(a) = (1 - a/2 cot(a/2)) / a^2

(the inverse left Jacobian of SO(3); Barfoot 2017, "State estimation for robotics", section
7.1.5). It has no bound as |e| approaches a whole turn.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry.numerics import cos_and_sinc

_SMALL = 0.1
"""Below this angle squared the series are exact to rounding and the closed forms are not."""


def axis_drift(
    e: Float[Tensor, "*batch 3"], v: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """n(e, v), zero where v lies along e; in the unit of v."""
    square = (e * e).sum(-1, keepdim=True)
    cosine, sinc = cos_and_sinc(square.clamp_min(_SMALL) / 4)
    closed = (1 - cosine / sinc) / square.clamp_min(_SMALL)
    series = _polynomial(
        square.clamp_max(_SMALL), (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160)
    )
    c = torch.where(square < _SMALL, series, closed)
    cross = torch.linalg.cross(e, v)
    return cross / 2 + c * torch.linalg.cross(e, cross)


def drift_free_rate(
    e: Float[Tensor, "*batch 3"], rate: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """The v of which e' = v + n(e, v) is `rate`: minus the angular velocity."""
    square = (e * e).sum(-1, keepdim=True)
    _, half = cos_and_sinc(square / 4)
    _, sinc = cos_and_sinc(square.clamp_min(_SMALL))
    closed = (1 - sinc) / square.clamp_min(_SMALL)
    series = _polynomial(
        square.clamp_max(_SMALL), (1 / 6, -1 / 120, 1 / 5040, -1 / 362880, 1 / 39916800)
    )
    c = torch.where(square < _SMALL, series, closed)
    cross = torch.linalg.cross(e, rate)
    return rate - half**2 / 2 * cross + c * torch.linalg.cross(e, cross)


def left_jacobian(
    phi: Float[Tensor, "*batch 3"], rate: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """J_l(phi) rate: the angular velocity at which a rotation vector moves, in the base frame."""
    return drift_free_rate(-phi, rate)


def left_jacobian_transposed(
    phi: Float[Tensor, "*batch 3"], slope: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """J_l(phi)^T slope: from a derivative over small rotations to one over phi."""
    return drift_free_rate(phi, slope)


def _polynomial(x: Tensor, coefficients: tuple[float, ...]) -> Tensor:
    """The constant term first."""
    value = torch.zeros_like(x)
    for coefficient in reversed(coefficients):
        value = value * x + coefficient
    return value
