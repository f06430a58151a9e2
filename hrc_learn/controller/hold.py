"""Pose hold: undoes what null-space motion leaks into the tool pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.pytree import pytree

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
