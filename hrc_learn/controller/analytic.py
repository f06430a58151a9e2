"""The law with the analytic Jacobian, whose orientation rows are those of a rotation vector."""

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import quaternion
from hrc_learn.geometry.left_jacobian import left_jacobian, left_jacobian_transposed


def analytic_descent(
    s: Float[Tensor, "*batch 6"], orientation: Float[Tensor, "*batch 4"]
) -> Float[Tensor, "*batch 6"]:
    """Twist B B^T s, to which -J_A^+ (J_sA^T xi_x + xi_rA) amounts (but for the sign).

    With r_dot = B^-1 twist, B = diag(I, J_l(phi)) for the rotation vector phi of the tool, the
    analytic Jacobian is J_A = B^-1 J, so J_A^+ = J^+ B, and a gradient over r is B^T times one
    over small motions of the tool. So s of the geometric form serves both laws; they differ in
    the metric by which a gradient becomes a motion.

    Args:
        s: J_s_hat^T xi_x + xi_r of the geometric form.
        orientation: Of the tool.
    """
    phi = quaternion.log(orientation)
    turn = left_jacobian(phi, left_jacobian_transposed(phi, s[..., 3:]))
    return torch.cat([s[..., :3], turn], dim=-1)
