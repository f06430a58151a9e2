"""What a turning axis adds to the rate of a rotation vector.

For q = exp(-e) g with angular velocity -v, the rotation vector e has the rate

    e' = v + n(e, v),   n = e x v / 2 + c(|e|) e x (e x v),   c(a) = (1 - a/2 cot(a/2)) / a^2

(the inverse left Jacobian of SO(3); Barfoot 2017, "State estimation for robotics", section
7.1.5). It has no bound as |e| approaches whole turns: there e cannot turn its axis at all, and
what v has across e is left out. The inverse of it is

    v = e' - h(|e|) e x e' + k(|e|) e x (e x e'),
    h(a) = (1 - cos a) / a^2,   k(a) = (1 - sin a / a) / a^2
"""

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry.numerics import cos_and_sinc, polynomial

# Below this angle squared the series are exact to rounding and the closed forms are not.
_SMALL = 0.1
# Fraction of v across e that must be seen in e' for e' to be told from v.
_SINGULAR = 1e-3


def axis_drift(
    e: Float[Tensor, "*batch 3"], v: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """n(e, v), zero where v lies along e; in the unit of v.

    A whole turn or several away, minus what v has across e, so that v + n lies along e.
    """
    square = (e * e).sum(-1, keepdim=True)
    far = square.clamp_min(_SMALL)
    cosine, sinc = cos_and_sinc(far / 4)
    # How much shorter v is across e, seen in e' the other way round.
    singular = sinc.abs() < _SINGULAR
    cosecant = torch.where(singular, 0.0, 1 / torch.where(singular, 1.0, sinc))
    series = polynomial(
        square.clamp_max(_SMALL), (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160)
    )
    c = torch.where(square < _SMALL, series, (1 - cosine * cosecant) / far)
    cross = torch.linalg.cross(e, v)
    return torch.where(singular, 0.0, cross / 2) + c * torch.linalg.cross(e, cross)


def drift_free_rate(
    e: Float[Tensor, "*batch 3"], rate: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """The v of which e' = v + n(e, v) is `rate`: minus the angular velocity."""
    square = (e * e).sum(-1, keepdim=True)
    cross = torch.linalg.cross(e, rate)
    return rate - _h(square) * cross + _k(square) * torch.linalg.cross(e, cross)


def drift_free_slope(
    e: Float[Tensor, "*batch 3"],
    rate: Float[Tensor, "*batch 3"],
    curvature: Float[Tensor, "*batch 3"],
) -> Float[Tensor, "*batch 3"]:
    """v', from e, e' and e'': minus the angular acceleration."""
    square = (e * e).sum(-1, keepdim=True)
    h, k = _h(square), _k(square)
    # h' = dh/da a' with a a' = e e'; likewise k'. Differences of near equals where a is small.
    far, near = square.clamp_min(_SMALL), square.clamp_max(_SMALL)
    _, sinc = cos_and_sinc(far)
    h_series = polynomial(near, (-1 / 12, 1 / 180, -1 / 6720, 1 / 453600, -1 / 47900160))
    k_series = polynomial(near, (-1 / 60, 1 / 1260, -1 / 60480, 1 / 4989600, -1 / 622702080))
    small, along = square < _SMALL, (e * rate).sum(-1, keepdim=True)
    h_rate = along * torch.where(small, h_series, (sinc - 2 * h) / far)
    k_rate = along * torch.where(small, k_series, (h - 3 * k) / far)
    cross, bend = torch.linalg.cross(e, rate), torch.linalg.cross(e, curvature)
    turning = torch.linalg.cross(e, k_rate * cross + k * bend)
    return curvature - h_rate * cross - h * bend + turning + k * torch.linalg.cross(rate, cross)


def left_jacobian(
    phi: Float[Tensor, "*batch 3"], rate: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """J_l(phi) rate: angular velocity in the base frame of a moving rotation vector."""
    return drift_free_rate(-phi, rate)


def left_jacobian_transposed(
    phi: Float[Tensor, "*batch 3"], slope: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """J_l(phi)^T slope: from a derivative over small rotations to one over phi."""
    return drift_free_rate(phi, slope)


def _h(square: Tensor) -> Tensor:
    """(1 - cos a) / a^2 from a squared, by half the angle: nothing cancels."""
    _, half = cos_and_sinc(square / 4)
    return half**2 / 2


def _k(square: Tensor) -> Tensor:
    """(1 - sin a / a) / a^2 from a squared."""
    far = square.clamp_min(_SMALL)
    _, sinc = cos_and_sinc(far)
    series = polynomial(
        square.clamp_max(_SMALL), (1 / 6, -1 / 120, 1 / 5040, -1 / 362880, 1 / 39916800)
    )
    return torch.where(square < _SMALL, series, (1 - sinc) / far)
