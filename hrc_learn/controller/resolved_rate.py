"""Resolved-rate control: one joint velocity from a tool twist and a null-space velocity.

The second half compensates the pose drift that null-space motion causes: the projector is
right to first order of a step only, so what it lets through is measured and given back.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.geometry.numerics import (
    Constant,
    inverse_norm,
    is_number,
    matmul,
    null_projection,
    solve_positive,
)
from hrc_learn.kinematics.redundancy import SINGULAR_BELOW
from hrc_learn.pytree import pytree

# Lets the Cholesky factorisation go through at a singularity; used there only to see how
# near it is, never in a solution.
_FLOOR = 1e-9
_EYE = {rows: Constant(torch.eye(rows, dtype=torch.float64)) for rows in range(1, 7)}


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


def led_descent(
    J: Float[Tensor, "*batch 6 n"],
    basis: Float[Tensor, "*batch rows 6"],
    gradient: Float[Tensor, "*batch 6"],
) -> Float[Tensor, "*batch 6"]:
    """The part of a gradient that leading fewer than six dimensions of the tool descends along.

    With J_t = B J the joints move by J_t^+ y for a motion y of the task, and the tool by all of
    J J_t^+ y, turns that nobody leads included. So the gradient over y is (J J_t^+)^T s, and
    the potential falls by its square. Where the task leads all that s asks for, it is B s.

    Args:
        J: Geometric Jacobian.
        basis: B, orthonormal twists that the task leads (`task_basis`).
        gradient: s, of the potentials over small motions of the tool.

    Returns:
        B^T y, a twist.
    """
    J_t = matmul(basis, J)
    pushed = matmul(J_t, matmul(J.mT, gradient.unsqueeze(-1)))
    return matmul(basis.mT, solve_positive(_damped_gram(J_t), pushed)).squeeze(-1)


def resolved_rate(
    J: Float[Tensor, "*batch rows n"],
    twist: Float[Tensor, "*batch rows"],
    null_velocity: Float[Tensor, "*batch n"],
) -> tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"]]:
    """J^+ twist and N w, for a null-space velocity w.

        J^+ v = J^T (J J^T + lambda^2 I)^-1 v,   N w = w - Q Q^T w,   J^T = Q R

    The damping lambda is exactly zero unless J is near a singularity. It is judged by
    |(J J^T)^-1|_F^(-1/2), which is at most sigma_min and close to it where sigma_min is small.

    N is never damped: |J N w| <= 1e-12 |w| in float64 at any J, singular ones included. There
    the null space has a dimension more, of which N keeps n - 6, and which ones may change from
    one step to the next; the safety filter limits the acceleration that takes.

    Args:
        J: Geometric Jacobian, or the rows of it that the task leads: 6 or fewer, at most n.
        twist: Wanted motion of the tool (linear [m/s], angular [rad/s]), or of those.
        null_velocity: Wanted joint velocity w, of which N keeps what leaves the tool at rest
            [rad/s].

    Returns:
        Joint velocity of the task, and that of the null space [rad/s].
    """
    return task_rate(J, twist), null_projection(J, null_velocity)


def task_rate(
    J: Float[Tensor, "*batch rows n"], twist: Float[Tensor, "*batch rows"]
) -> Float[Tensor, "*batch n"]:
    """J^+ twist, the smallest joint velocity for a twist, damped near singularities [rad/s].

    Arguments are those of `resolved_rate`.
    """
    return matmul(J.mT, solve_positive(_damped_gram(J), twist.unsqueeze(-1))).squeeze(-1)


def _damped_gram(J: Float[Tensor, "*batch rows n"]) -> Float[Tensor, "*batch rows rows"]:
    """J J^T + lambda^2 I."""
    gram = matmul(J, J.mT)
    eye = _EYE[J.shape[-2]].like(J)
    sigma_square = 1 / inverse_norm(torch.add(gram, eye, alpha=_FLOOR))
    damping_square = (SINGULAR_BELOW**2 - sigma_square).clamp(min=0)
    return torch.addcmul(gram, eye, damping_square[..., None, None])


def saturate_in_null_space(
    task: Float[Tensor, "*batch n"],
    J: Float[Tensor, "*batch rows n"],
    twist: Float[Tensor, "*batch rows"],
    lower: Float[Tensor, "*#batch n"],
    upper: Float[Tensor, "*#batch n"],
) -> Float[Tensor, "*batch n"]:
    """Let the other joints do what limits take from single ones of the task.

    Joints that a limit cuts move as fast as it lets them, and the others are solved for what is
    left of the twist: one round of the saturation in the null space (Flacco, De Luca and
    Khatib, "Control of redundant robots under hard joint constraints", T-RO 2015). Without it
    an arm with a joint at its limit may stand still short of where it could go: where the least
    velocity for the twist is of that joint alone.

    Args:
        task: Joint velocity of the task, by `resolved_rate` [rad/s].
        J: As there.
        twist: As there.
        lower: Lowest allowed velocity [rad/s].
        upper: Highest allowed velocity [rad/s].

    Returns:
        The velocity, in which only joints that were not cut may leave their bounds; or the one
        given, where that, cut, comes nearer to the twist [rad/s].
    """
    cut = torch.minimum(torch.maximum(task, lower), upper)
    free = cut == task
    left = twist - torch.linalg.vecdot(J, cut.masked_fill(free, 0).unsqueeze(-2))
    J_free = J * free.unsqueeze(-2)
    others = matmul(J_free.mT, solve_positive(_damped_gram(J_free), left.unsqueeze(-1)))
    shared = torch.where(free, others.squeeze(-1), cut)

    def off(velocity: Tensor) -> Tensor:
        within = torch.minimum(torch.maximum(velocity, lower), upper)
        missing = twist - torch.linalg.vecdot(J, within.unsqueeze(-2))
        return torch.linalg.vecdot(missing, missing).unsqueeze(-1)

    # Of a task that is not cut both are alike, but for rounding.
    better = (off(shared) < off(task)) & ~free.all(-1, keepdim=True)
    return torch.where(better, shared, task)


def scale_task(
    task: Float[Tensor, "*batch n"],
    J: Float[Tensor, "*batch 6 n"],
    lower: Float[Tensor, "*#batch n"],
    upper: Float[Tensor, "*#batch n"],
    caps: Float[Tensor, "2"],
) -> Float[Tensor, "*batch n"]:
    """Slow the task down where limits that cut single joints would make the tool faster.

    A limit that cuts one of two joints which nearly undo each other's motion lets the other
    swing the tool off its path, faster than was asked for. Slowed down as a whole, less is
    cut. Where a cut makes the tool slower the task goes on, and slides along the limit.

    Args:
        task: Joint velocity of the task [rad/s].
        J: Geometric Jacobian of the tool.
        lower: Lowest allowed velocity [rad/s].
        upper: Highest allowed velocity [rad/s].
        caps: Highest linear and angular speed [m/s, rad/s], by which both are compared.

    Returns:
        The velocity, scaled no further than to where nothing is cut [rad/s].
    """
    cut = torch.minimum(torch.maximum(task, lower), upper)
    asked, done = (
        torch.linalg.vector_norm(
            torch.linalg.vecdot(J, v.unsqueeze(-2)).view(*v.shape[:-1], 2, 3) / caps[:, None],
            dim=(-2, -1),
        ).unsqueeze(-1)
        for v in (task, cut)
    )
    moving = torch.where(task == 0, torch.finfo(task.dtype).tiny, task)
    fits = torch.maximum(lower / moving, upper / moving).amin(-1, keepdim=True)
    slowed = torch.maximum(asked / done, fits).clamp(0, 1)
    return torch.where(done > asked, slowed, 1.0) * task


def scale_null_space(
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
    # A joint that does not move bounds no factor: divided by the smallest number the bounds
    # are infinite, or of the wrong sign where the task alone is too fast.
    null_or_tiny = torch.where(null == 0, torch.finfo(null.dtype).tiny, null)
    at_lower, at_upper = (lower - task) / null_or_tiny, (upper - task) / null_or_tiny
    least = torch.minimum(at_lower, at_upper).amax(-1, keepdim=True)
    most = torch.maximum(at_lower, at_upper).amin(-1, keepdim=True)
    wanted = (least <= most).to(null.dtype)
    low, high = torch.minimum(least, most), torch.maximum(least, most)
    factor = torch.minimum(torch.maximum(wanted, low), high).clamp(0, 1)
    return factor * null


# Bound on each component of the remembered drift [m, rad]: a person who blocks the arm must
# not wind it up.
_MAX_DRIFT = 0.005


@pytree
@dataclass(frozen=True, kw_only=True)
class PoseDrift:
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
    """Whether drift was measured in the last step; where not, the rest may be old."""


def restored_drift(drift: PoseDrift) -> PoseDrift:
    """The same, or none where it is not of numbers."""
    numbers = (drift.drift, drift.joint_position, drift.planned, drift.jacobian.flatten(-2))
    known = is_number(torch.cat(numbers, dim=-1)).all(-1)
    unknown = ~known.unsqueeze(-1)
    return PoseDrift(
        drift=drift.drift.masked_fill(unknown, 0),
        joint_position=drift.joint_position.masked_fill(unknown, 0),
        jacobian=drift.jacobian.masked_fill(unknown.unsqueeze(-1), 0),
        planned=drift.planned.masked_fill(unknown, 0),
        active=drift.active & known,
    )


def measure_drift(
    before: PoseDrift,
    joint_position: Float[Tensor, "*batch n"],
    jacobian: Float[Tensor, "*batch 6 n"],
    active: Bool[Tensor, "*batch"],
) -> PoseDrift:
    """Add the drift of the last step: what was planned, less what the tool did.

    The motion of the tool is (J_0 + J_1)/2 dq, right to the third order of the step, where
    the J_0 dq by which it was planned is right to the second: the difference is the drift.

    Args:
        before: After the last step.
        joint_position: Now [rad].
        jacobian: Now.
        active: Where to compensate. Elsewhere, and in the first step of it, the drift is zero,
            so that every null-space input starts afresh.
    """
    step = (joint_position - before.joint_position).unsqueeze(-2)
    moved = torch.linalg.vecdot(before.jacobian + jacobian, step)  # twice the motion
    drift = torch.add(before.drift + before.planned, moved, alpha=-0.5)
    drift = drift.clamp(-_MAX_DRIFT, _MAX_DRIFT)
    drift = torch.where((active & before.active).unsqueeze(-1), drift, 0.0)
    return replace(
        before, drift=drift, joint_position=joint_position, jacobian=jacobian, active=active
    )


# Speed below which what is done of a twist cannot be told [m/s, rad/s]; all of it then.
_NO_SPEED = 1e-6


def planned_motion(
    task_twist: Float[Tensor, "*batch 6"],
    twist: Float[Tensor, "*batch 6"],
    jacobian: Float[Tensor, "*batch 6 n"],
    joint_velocity: Float[Tensor, "*batch n"],
    dt: float | Float[Tensor, ""],
) -> Float[Tensor, "*batch 6"]:
    """The part of the step to come that the task has planned.

    Limits may slow the motion down. That is no drift, so only the fraction that the filtered
    joint velocity carries out counts as planned. The fraction is that of the whole twist: the
    correction of measured noise, which is as large as a slow task's own twist, would make that
    of the task alone seem not to be carried out.

    Args:
        task_twist: Of the task alone.
        twist: Of the task and the correction of the drift.
        jacobian: Of the tool.
        joint_velocity: Filtered [rad/s].
        dt: Step [s].
    """
    done = torch.linalg.vecdot(jacobian, joint_velocity.unsqueeze(-2))
    along = torch.linalg.vecdot(done, twist) + _NO_SPEED**2
    square = torch.linalg.vecdot(twist, twist) + _NO_SPEED**2
    fraction = (along / square).clamp(0, 1)
    return (fraction * dt).unsqueeze(-1) * task_twist
