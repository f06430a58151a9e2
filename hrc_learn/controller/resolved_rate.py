"""Resolved rate: from a tool twist and a joint-space wish to one joint velocity, and the
compensation of pose drift.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.geometry.constants import Constant
from hrc_learn.geometry.small_matrices import inverse_norm, matmul, solve_positive
from hrc_learn.pytree import pytree

# From a tool twist and a joint-space wish to one joint velocity.

SINGULAR_BELOW = 0.05
"""Smallest singular value of the Jacobian below which its inverse is damped, and the damping
at the singularity itself, as in `hrc_learn.kinematics.singularity_damping`."""

# Lets the Cholesky factorisation go through at a singularity; used there only to see how
# near it is, never in a solution.
_FLOOR = 1e-9
_EYE = Constant(torch.eye(6, dtype=torch.float64))


def excess_speed(
    twist: Float[Tensor, "*batch 6"], caps: Float[Tensor, "2"]
) -> Float[Tensor, "*batch 1"]:
    """What to divide a motion by to keep its twist within the caps; at least 1.

    Args:
        twist: Of the tool (linear [m/s], angular [rad/s]).
        caps: Highest linear and angular speed [m/s, rad/s].
    """
    speeds = torch.linalg.vector_norm(twist.view(*twist.shape[:-1], 2, 3), dim=-1)
    return (speeds / caps).amax(-1, keepdim=True).clamp(min=1)


def resolve(
    J: Float[Tensor, "*batch 6 n"],
    twist: Float[Tensor, "*batch 6"],
    wish: Float[Tensor, "*batch n"],
) -> tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"]]:
    """J^+ twist and N wish from one symmetric 6 x 6 solve.

        J^+ v = J^T A^-1 v,   N w = w - J^T A^-1 J w,   A = J J^T + lambda^2 I

    The damping lambda is exactly zero unless J is near a singularity. It is judged by
    |A^-1|_F^(-1/2), which is at most sigma_min and close to it where sigma_min is small.

    Args:
        J: Geometric Jacobian.
        twist: Wanted motion of the tool (linear [m/s], angular [rad/s]).
        wish: Wanted joint velocity in the null space [rad/s].

    Returns:
        Joint velocity of the task, and that of the null space [rad/s].
    """
    gram = matmul(J, J.mT)
    eye = _EYE.like(J)
    sigma_square = 1 / inverse_norm(torch.add(gram, eye, alpha=_FLOOR))
    damping = (SINGULAR_BELOW**2 - sigma_square).clamp(min=0)
    damped = torch.addcmul(gram, eye, damping[..., None, None])
    wish = wish.unsqueeze(-1)
    wrench = solve_positive(damped, torch.cat([twist.unsqueeze(-1), matmul(J, wish)], dim=-1))
    task, leak = matmul(J.mT, wrench).unbind(-1)
    return task, wish.squeeze(-1) - leak


def fit_null_space(
    task: Float[Tensor, "*batch n"],
    null: Float[Tensor, "*batch n"],
    lower: Float[Tensor, "*#batch n"],
    upper: Float[Tensor, "*#batch n"],
) -> Float[Tensor, "*batch n"]:
    """Scale the null-space velocity as a whole so that limits need not cut single joints.

    A limit that cuts one joint of a null-space motion makes it move the tool; scaled as a
    whole it does not. The factor is 0 to 1, the largest that fits; where none fits because
    the task alone is too fast, the one that comes closest. (Factors beyond would let the
    redundant joints give way to the task. They were measured to whip the elbow into the
    limits near singularities.)

    Args:
        task: Joint velocity of the task [rad/s].
        null: Joint velocity of the null space [rad/s].
        lower: Lowest allowed velocity [rad/s].
        upper: Highest allowed velocity [rad/s].

    Returns:
        The scaled null-space velocity [rad/s].
    """
    null_or_tiny = torch.where(null == 0, torch.finfo(null.dtype).tiny, null)
    at_lower, at_upper = (lower - task) / null_or_tiny, (upper - task) / null_or_tiny
    least = torch.minimum(at_lower, at_upper).amax(-1, keepdim=True)
    most = torch.maximum(at_lower, at_upper).amin(-1, keepdim=True)
    wanted = (least <= most).to(null.dtype)
    low, high = torch.minimum(least, most), torch.maximum(least, most)
    factor = torch.minimum(torch.maximum(wanted, low), high).clamp(0, 1)
    return factor * null


# Pose hold: undoes what null-space motion leaks into the tool pose.

_FARTHEST = 0.005
"""Bound on each component of the remembered drift [m, rad]: a person who blocks the arm
must not wind it up."""


@pytree
@dataclass(frozen=True, kw_only=True)
class Hold:
    """How far the tool has drifted from where the task sent it, and what that needs."""

    drift: Float[Tensor, "*batch 6"]
    """Motion still owed to the task (linear [m], angular [rad])."""
    joint_position: Float[Tensor, "*batch n"]
    """Of the last step [rad]."""
    jacobian: Float[Tensor, "*batch 6 n"]
    """Of the last step."""
    planned: Float[Tensor, "*batch 6"]
    """Motion the task had planned for the last step (linear [m], angular [rad])."""
    active: Bool[Tensor, "*batch"]
    """Whether the last step held; where not, the rest may be old."""


def measure_drift(
    hold: Hold,
    joint_position: Float[Tensor, "*batch n"],
    jacobian: Float[Tensor, "*batch 6 n"],
    holds: Bool[Tensor, "*batch"],
) -> Hold:
    """Add the drift of the last step: what was planned, less what the tool did.

    The motion of the tool is (J_0 + J_1)/2 dq, right to the third order of the step, where
    the J_0 dq by which it was planned is right to the second: the difference is the drift.

    Args:
        hold: Of the step before.
        joint_position: Now [rad].
        jacobian: Now.
        holds: Where to hold. Elsewhere, and in the first step of it, the drift is zero, so that
            every effort starts afresh.
    """
    step = (joint_position - hold.joint_position).unsqueeze(-2)
    moved = torch.linalg.vecdot(hold.jacobian + jacobian, step)
    drift = torch.add(hold.drift + hold.planned, moved, alpha=-0.5)
    drift = drift.clamp(-_FARTHEST, _FARTHEST)
    drift = torch.where((holds & hold.active).unsqueeze(-1), drift, 0.0)
    return replace(
        hold, drift=drift, joint_position=joint_position, jacobian=jacobian, active=holds
    )


def planned_motion(
    twist: Float[Tensor, "*batch 6"],
    jacobian: Float[Tensor, "*batch 6 n"],
    joint_velocity: Float[Tensor, "*batch n"],
    dt: float | Tensor,
) -> Float[Tensor, "*batch 6"]:
    """The part of the step to come that the task has planned.

    Limits may slow the task down. That is no drift, so only the share of the twist that the
    filtered joint velocity carries out counts as planned.
    """
    done = torch.linalg.vecdot(jacobian, joint_velocity.unsqueeze(-2))
    along = torch.linalg.vecdot(done, twist)
    square = torch.linalg.vecdot(twist, twist).clamp(min=torch.finfo(twist.dtype).tiny)
    share = (along / square).clamp(0, 1)
    return (share * dt).unsqueeze(-1) * twist
