"""The paper's derivative of the orientation error over a rotation vector, as printed.

(PartialV2Quat) divides by the components of both quaternions and counts the constraint of unit
length twice: along unit quaternions it is twice the true derivative, for which
`OrientationRegion` has a form without divisions.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import quaternion
from hrc_learn.geometry.numerics import cos_and_sinc

# Smaller components are not divided by: the printed form has poles there.
_LEAST_COMPONENT = 1e-9
# Below this angle squared the closed form of the last term loses digits, its series none.
_SMALL = 1e-3


def printed_derivative(
    p: Float[Tensor, "*#batch 4"], goal: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*both 3"]:
    """Derivative of v_e: (PartialV2Quat) times J_rot (JacobianQuatAngAxisDetailed).

    Args:
        p: Orientation with p_w >= 0; r_o is its rotation vector.
        goal: p_g. The sign of the error's real part v_e is made positive.
    """
    g = quaternion.conjugate(goal)  # (v_g, u_g) are components of the inverse
    real = quaternion.multiply(p, g)[..., :1]
    g = torch.where(real < 0, -g, g)
    p, g = torch.broadcast_tensors(p, g)
    sign = p.new_tensor([1.0, -1.0, -1.0, -1.0])
    tiny = p.abs() < _LEAST_COMPONENT
    ratio = torch.where(tiny, 0.0, sign * g / torch.where(tiny, 1.0, p))
    # Each line adds p_i times minus the ratios of the other three.
    over_p = sign * g - p * (ratio.sum(-1, keepdim=True) - ratio)
    return _over_rotation_vector(over_p, quaternion.log(p))


def _over_rotation_vector(over_p: Tensor, r: Tensor) -> Tensor:
    """The row d v_e/d p times J_rot, whose columns are

    d p_w/d r = -sinc(phi/2)/4 r,   d p_u/d r = sinc(phi/2)/2 (I - n n^T) + cos(phi/2)/2 n n^T.
    """
    square = (r * r).sum(-1, keepdim=True)
    cosine, sinc = cos_and_sinc(square / 4)
    closed = (cosine - sinc) / (2 * square.clamp(min=_SMALL))
    series = -1 / 24 + square.clamp(max=_SMALL) / 960
    along = torch.where(square < _SMALL, series, closed) * (over_p[..., 1:] * r).sum(
        -1, keepdim=True
    )
    return sinc / 2 * over_p[..., 1:] + (along - sinc / 4 * over_p[..., :1]) * r
