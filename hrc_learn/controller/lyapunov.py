"""The function that the law makes smaller, and how fast.

V = P_v(x) + P_c(r) + 1/2 tr(W~ L^-1 W~^T),  W~ = W - W_hat                          (vt)

`docs/controller.md` states under which assumptions V_dot = -|s|^2. `Command.potential` and
`Command.potential_rate` hold the part that needs no true weights, at every step.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def lyapunov_function(
    potential: Float[Tensor, "*batch"],
    weight_error: Float[Tensor, "*batch rows K"],
    gain: float,
) -> Float[Tensor, "*batch"]:
    """V of (vt), with the factor 1/2 that its trace lacks in print.

    Args:
        potential: P_v + P_c.
        weight_error: W~, which only a simulation knows.
        gain: Of the paper's update, L = gain I.
    """
    return potential + weight_error.square().sum((-2, -1)) / (2 * gain)


def lyapunov_rate(s: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch"]:
    """V_dot = -|s|^2 where the assumptions hold."""
    return -torch.linalg.vecdot(s, s)


def potential_rate(
    s: Float[Tensor, "*batch 6"],
    jacobian: Float[Tensor, "*batch 6 n"],
    joint_velocity: Float[Tensor, "*batch n"],
) -> Float[Tensor, "*batch"]:
    """Rate of P_v + P_c that a joint velocity brings if the image Jacobian is right [1/s].

    Its fall behind the measured change of the potential shows an image Jacobian that is wrong,
    its rise above zero a motion that a limit or a person has turned against the task.
    """
    twist = torch.linalg.vecdot(jacobian, joint_velocity.unsqueeze(-2))
    return torch.linalg.vecdot(s, twist)
