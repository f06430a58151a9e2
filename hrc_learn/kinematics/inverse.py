"""Inverse kinematics of any serial arm, and the null-space posture of redundant arms.

Poses are inverted in batches by damped least squares from many starts. The damping of the
Levenberg-Marquardt method is the squared error, so that it vanishes at a solution (Sugihara
2011, "Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt method"). Each
start of each pose is one row of a batch; converged rows are removed from the batch. Every
iteration keeps the joint limits. Among the solutions of a pose, the one nearest to a wanted
configuration is kept. Null-space motion then brings it closer to this configuration.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.geometry.numerics import Constant, check_choice, orthonormal_basis
from hrc_learn.kinematics.chain import SerialChain

type TaskSpace = Literal["pose", "nearest pose", "position+axis", "position"]
"""Constrained part of the tool's pose: the whole pose, the pose except for the rotation about
the tool's z axis ("position+axis"), or the position. For arms with fewer than six joints,
"nearest pose" is the exact position with the nearest orientation that the joints can reach
there; for other arms, "nearest pose" equals "pose".
"""

TASK_ROWS: dict[TaskSpace, int] = {
    "pose": 6,
    "nearest pose": 6,
    "position+axis": 5,
    "position": 3,
}
# Weight of angles relative to distances [m/rad]: 1 rad counts as much as this distance.
_LEVER = 0.3
# Singular values below these fractions of the largest one count as zero: `_RANK` in
# `null_space_dimension`, `_WEAK` in `task_rank`. `_WEAK` excludes directions in which joints
# hardly move the tool: the SO-101's tool, for example, is only 8 mm off its last joint's axis.
_RANK, _WEAK = 1e-6, 0.02
_BIAS = 1e-9  # smallest damping: keeps the system regular with more task rows than joints
# Starts per pose in each round, largest number of rounds, and iterations from each start.
_STARTS, _ROUNDS, _ITERATIONS = 24, 6, 40
# Largest error of a solution's position [m] and orientation [rad].
_TOLERANCE = 1e-9
# Largest rotation between a wanted pose and its "nearest pose" [rad]: beyond it, the arm would
# do another task.
_MISSED_TURN = 0.6
# Iterations of `_step` at each pose of a path: for most arms, and for arms with fewer than six
# joints, whose nearest orientation takes more.
_CORRECTIONS, _FEW_JOINTS = 2, 4


@dataclass(frozen=True)
class InverseSolution:
    """Joint positions that `solve_inverse` found."""

    position: Float[Tensor, "*batch joints"]
    """Joint positions [rad, m]; where no solution was found, `near` clamped to the limits."""
    found: Bool[Tensor, "*batch"]
    """True if the pose is reached within limits."""


def task_error_and_jacobian(
    chain: SerialChain, q: Float[Tensor, "rows joints"], pose: Pose, task: TaskSpace = "pose"
) -> tuple[Float[Tensor, "rows task"], Float[Tensor, "rows task joints"]]:
    """Error relative to a pose, and the Jacobian of the task with respect to the joints.

    The first three rows are linear, in the base frame [m]. "pose" adds three angular rows in
    the base frame [rad]; "position+axis" adds two, about axes perpendicular to the wanted axis
    of the tool.

    Args:
        chain: The arm.
        q: Joint positions [rad, m].
        pose: Wanted pose of the tool centre point.
        task: Constrained part of the pose.
    """
    check_choice("task", task, TASK_ROWS)
    T, J = chain.transform_and_jacobian(q)
    if task in ("pose", "nearest pose"):
        return Pose.from_matrix(T).twist_to(pose), J
    error, rows = pose.position - T[..., 3], J[..., :3, :]
    if task == "position":
        return error, rows
    R = pose.matrix()[..., :3, :3]
    sides, wanted, now = R[..., :2].mT, R[..., 2], T[..., 2]
    across = torch.linalg.cross(now, wanted)
    sine = torch.linalg.vector_norm(across, dim=-1, keepdim=True)
    cosine = (now * wanted).sum(-1, keepdim=True)
    angle = torch.atan2(sine, cosine)
    # For opposite axes, any perpendicular axis of rotation works: take x of the wanted frame.
    small = sine < 1e-9
    axis = torch.where(small, R[..., 0], across / sine.clamp(min=1e-9))
    turn = axis * torch.where(small & (cosine > 0), 0.0, angle)
    error = torch.cat([error, (sides @ turn[..., None])[..., 0]], dim=-1)
    return error, torch.cat([rows, sides @ J[..., 3:, :]], dim=-2)


def null_space_dimension(
    chain: SerialChain,
    q: Float[Tensor, "*batch joints"],
    task: TaskSpace = "pose",
    *,
    below: float = _RANK,
) -> Float[Tensor, "*batch"]:
    """Dimension of the joint motion that leaves a task unchanged: 1 for the pose of a 7-joint
    arm.

    Args:
        chain: The arm.
        q: Joint positions [rad, m]. The dimension is larger at singularities.
        task: Constrained part of the pose.
        below: Singular values below this fraction of the largest one count as zero.
    """
    flat = q.reshape(-1, q.shape[-1])
    _, J = task_error_and_jacobian(chain, flat, chain.forward(flat), task)
    values = torch.linalg.svdvals(J)
    rank = (values > below * values[..., :1]).sum(-1)
    return (q.shape[-1] - rank).reshape(q.shape[:-1]).to(q)


_SAMPLES = 64  # random joint positions that `task_rank` evaluates: nearly all are regular


def task_rank(chain: SerialChain, task: TaskSpace = "pose") -> int:
    """Number of task dimensions that an arm controls, away from its singularities.

    The rank is six for the pose of an arm with six or more joints. For "position+axis", the
    rank is five. It is only four (position and tilt) for a five-joint arm whose last joint
    turns the tool about the tool's z axis. Joint motion beyond the rank is null space. A
    direction does not count if it needs more than 50 times as much joint motion as the
    direction that needs least.

    Args:
        chain: The arm.
        task: Constrained part of the tool's pose.
    """
    n, limits, rng = len(chain.joint_names), chain.limits, torch.Generator().manual_seed(0)
    fraction = torch.rand(_SAMPLES, n, generator=rng, dtype=torch.float64)
    q = limits.lower + fraction * (limits.upper - limits.lower)
    return n - int(null_space_dimension(chain, q, task, below=_WEAK).amin())


_LINEAR = Constant(torch.eye(6, dtype=torch.float64)[:3])


def position_first(J: Float[Tensor, "*batch 6 n"]) -> Float[Tensor, "*batch n 6"]:
    """Orthonormal basis B of the tool twists that an arm with three to five joints controls.

    Rows are the linear velocities, then the rotations that the joints can cause without moving
    the position: B = [I 0; 0 U^T]. Let J_v and J_w be the linear and angular rows of J, and Z a
    basis of the null space of J_v. Then U is an orthonormal basis of the range of J_w Z. The
    solution of B J q_dot = B v moves the position as wanted, and turns the tool as close to the
    wanted rotation as the joints can.

    Args:
        J: Geometric Jacobian of the tool.
    """
    still = orthonormal_basis(J[..., :3, :])[..., 3:]
    U = orthonormal_basis((J[..., 3:, :] @ still).mT)[..., : J.shape[-1] - 3]
    rows = _LINEAR.like(J).expand(*J.shape[:-2], 3, 6)
    return torch.cat([rows, torch.nn.functional.pad(U.mT, (3, 0))], dim=-2)


def task_basis(
    J: Float[Tensor, "*batch 6 joints"],
    orientation: Float[Tensor, "*batch 4"],
    task: TaskSpace,
    rank: int,
) -> Float[Tensor, "*batch {rank} 6"]:
    """Orthonormal basis B of the tool's twists in a task; the task's velocity is B J q_dot.

    Rows are linear velocities, then the rotations of the task. If the arm controls fewer
    dimensions than the task has, the rows span only the dimensions that it controls.

    Args:
        J: Geometric Jacobian of the tool.
        orientation: Orientation of the tool.
        task: Constrained part of the pose.
        rank: `task_rank` of the arm.
    """
    check_choice("task", task, TASK_ROWS)
    rows = _LINEAR.like(J).expand(*J.shape[:-2], 3, 6)
    if task in ("pose", "nearest pose"):
        if rank < 6:
            return position_first(J)
        rows = torch.eye(6, dtype=J.dtype, device=J.device).expand(*J.shape[:-2], 6, 6)
    elif task == "position+axis":
        across = quaternion.to_matrix(orientation)[..., :2].mT
        rows = torch.cat([rows, torch.nn.functional.pad(across, (3, 0))], dim=-2)
    if rank == rows.shape[-2]:
        return rows
    U = torch.linalg.svd(rows @ J, full_matrices=False).U
    return U[..., :rank].mT @ rows


def solve_inverse(
    chain: SerialChain,
    pose: Pose,
    near: Float[Tensor, "*#batch joints"] | None = None,
    *,
    task: TaskSpace = "pose",
) -> InverseSolution:
    """Joint positions that bring the tool centre point to poses, within limits.

    Args:
        chain: The arm.
        pose: Poses of the tool centre point in the base frame.
        near: Configuration to stay close to [rad, m]; the ready posture if None.
        task: Constrained part of the pose.
    """
    joints = len(chain.joint_names)
    near = chain.ready if near is None else near
    batch = np.broadcast_shapes(pose.position.shape[:-1], near.shape[:-1])
    goal = _in_rows(pose, batch)
    wish = near.detach().to(goal.position).expand(*batch, joints).reshape(-1, joints)
    lower, upper = _limits(chain, wish)
    rng = torch.Generator().manual_seed(0)
    best = wish.clone().clamp(lower, upper)
    distance = wish.new_full((len(wish),), torch.inf)
    for round_ in range(_ROUNDS):
        # The first round starts from the wish, too; other starts are random postures.
        missing = distance.isinf().nonzero().flatten()
        if len(missing) == 0:
            break
        # All poses have the same starts, so a result does not depend on the other poses. Starts
        # are drawn on the CPU, because the numbers that a seed gives depend on the device.
        random = torch.rand(_STARTS, joints, generator=rng, dtype=torch.float64).to(wish.device)
        half = ((upper - lower) / 2).clamp(max=math.pi)
        start = ((lower + upper) / 2 + (2 * random - 1) * half).repeat(len(missing), 1, 1)
        if round_ == 0:
            start[:, 0] = best[missing]
        q = solutions_from(chain, goal[missing], start, task=task)
        q = unwound(chain, q, wish[missing, None])
        apart = torch.linalg.vector_norm(q - wish[missing, None], dim=-1).nan_to_num(torch.inf)
        least = apart.min(-1)
        chosen = q.take_along_dim(least.indices[:, None, None], dim=-2)[:, 0]
        good = least.values.isfinite()
        best[missing[good]], distance[missing[good]] = chosen[good], least.values[good]
    found = distance.isfinite()
    if found.any() and joints > TASK_ROWS[task]:
        best[found] = _drawn_nearer(chain, goal[found], best[found], wish[found], task)
    return InverseSolution(best.reshape(*batch, joints).to(near), found.reshape(batch))


def solutions_from(
    chain: SerialChain,
    pose: Pose,
    starts: Float[Tensor, "*#batch starts joints"],
    *,
    task: TaskSpace = "pose",
) -> Float[Tensor, "*batch starts joints"]:
    """Joint positions that reach poses within the limits, from each of several starts.

    Args:
        chain: The arm.
        pose: Poses of the tool centre point.
        starts: Joint positions [rad, m].
        task: Constrained part of the pose.

    Returns:
        Solutions in the order of the starts; NaN where a start does not lead to the pose.
    """
    count, joints = starts.shape[-2:]
    batch = np.broadcast_shapes(pose.position.shape[:-1], starts.shape[:-2])
    goal = _in_rows(pose, batch)
    row = torch.arange(len(goal.position), device=starts.device).repeat_interleave(count)
    start = starts.detach().double().expand(*batch, count, joints).reshape(-1, joints)
    start = start.clamp(*_limits(chain, start))
    q, reached = _descend(chain, goal[row], start, task)
    return torch.where(reached[:, None], q, torch.nan).reshape(*batch, count, joints)


def follow_poses(
    chain: SerialChain,
    path: Pose,
    start: Float[Tensor, "*rows joints"],
    wish: Float[Tensor, "steps *rows joints"] | None = None,
    task: TaskSpace = "nearest pose",
) -> tuple[Float[Tensor, "steps *rows joints"], Float[Tensor, "steps *rows"]]:
    """Joint positions along a path of the tool, by differential inverse kinematics.

    Joints move as little as possible from one pose to the next, as under velocity control of
    the tool. They stop at their limits.

    Args:
        chain: The arm.
        path: Poses of the tool centre point, (steps, *#rows).
        start: Joint positions at the first pose [rad, m].
        wish: Posture that the null-space motion approaches at each pose [rad, m]; None: no
            null-space motion.
        task: Constrained part of the poses.

    Returns:
        Joint positions, and the tool's error at each pose: the larger of distance [m] and
        angle [rad].
    """
    q, positions, errors = start.reshape(-1, start.shape[-1]), [], []
    rows = start.shape[:-1]
    for k in range(len(path.position)):
        goal = _in_rows(path[k], rows)
        near = None if wish is None else wish[k].reshape(q.shape)
        for _ in range(_CORRECTIONS if start.shape[-1] >= 6 else _FEW_JOINTS):
            q, _ = _step(chain, goal, q, task, near)
        left = chain.forward(q).twist_to(goal).unflatten(-1, (2, 3))
        positions.append(q.reshape(start.shape))
        errors.append(left.norm(dim=-1).amax(-1).reshape(rows))
    return torch.stack(positions), torch.stack(errors)


def _in_rows(pose: Pose, batch: Sequence[int]) -> Pose:
    """Poses broadcast to a batch and flattened to one axis, in float64, without gradients."""
    return Pose(
        pose.position.detach().double().expand(*batch, 3).reshape(-1, 3),
        pose.orientation.detach().double().expand(*batch, 4).reshape(-1, 4),
    )


def _step(
    chain: SerialChain, goal: Pose, q: Tensor, task: TaskSpace, wish: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Joint positions after one iteration, and the error before it [m, rad]."""
    error, J = task_error_and_jacobian(chain, q, goal, task)
    missed, few = error[..., 3:], task == "nearest pose" and J.shape[-1] < 6
    if few:
        basis = position_first(J)
        error, J = (basis @ error[..., None])[..., 0], basis @ J
    far = torch.linalg.vector_norm(missed, dim=-1, keepdim=True) > _MISSED_TURN
    weight = torch.ones_like(error[:1])
    weight[:, 3:] = _LEVER
    e, A = error * weight, J * weight[..., None]
    dq = _damped(A, e, e)
    if wish is not None and not few:  # few joints have no null space
        away = wish - q
        dq = dq + away - _damped(A, (A @ away[..., None])[..., 0], e)
    if task == "nearest pose":
        error = torch.where(far, torch.inf, error)
    after = (q + dq).clamp(*_limits(chain, q))
    if few:
        # Where joints stop at their limits, the other joints bring the tool to its position.
        lever, free = A[..., :3, :], after == q + dq
        rest = e[..., :3] - (lever @ (after - q)[..., None])[..., 0]
        more = _damped(lever * free[..., None, :], rest, rest)
        after = (after + more).clamp(*_limits(chain, q))
    return after, error


def _damped(A: Tensor, e: Tensor, error: Tensor) -> Tensor:
    """Joint motion dq that solves A dq = e by least squares, damped by the squared error."""
    damping = error.square().sum(-1)[:, None, None] + _BIAS
    gram = A @ A.mT + damping * torch.eye(A.shape[-2], dtype=A.dtype, device=A.device)
    return (A.mT @ torch.linalg.solve(gram, e[..., None]))[..., 0]


def _limits(chain: SerialChain, like: Tensor) -> tuple[Tensor, Tensor]:
    """Lower and upper joint limits, on the device of `like`."""
    return chain.limits.lower.to(like.device), chain.limits.upper.to(like.device)


def _descend(
    chain: SerialChain, goal: Pose, q: Tensor, task: TaskSpace
) -> tuple[Tensor, Tensor]:
    result, done = q.clone(), torch.zeros(len(q), dtype=torch.bool, device=q.device)
    rows = torch.arange(len(q), device=q.device)
    for _ in range(_ITERATIONS):
        after, error = _step(chain, goal[rows], q, task)
        arrived = error.abs().amax(-1) < _TOLERANCE
        result[rows[arrived]], done[rows[arrived]] = q[arrived], True
        rows, q = rows[~arrived], after[~arrived]
        if len(rows) == 0:
            break
    return result, done


def unwound(chain: SerialChain, q: Tensor, wish: Tensor) -> Tensor:
    """The same postures with joints moved by full revolutions, within limits, to be as close as
    possible to a wanted configuration.

    Args:
        chain: The arm.
        q: Joint positions [rad, m].
        wish: Wanted configuration [rad, m].
    """
    turns = torch.tensor([kind != "prismatic" for kind in chain.kinds], device=q.device)
    whole = 2 * math.pi * ((wish - q) / (2 * math.pi)).round()
    moved = q + torch.where(turns, whole, 0.0)
    lower, upper = _limits(chain, q)
    inside = (moved >= lower) & (moved <= upper)
    return torch.where(inside, moved, q)


def _drawn_nearer(
    chain: SerialChain, goal: Pose, q: Tensor, wish: Tensor, task: TaskSpace
) -> Tensor:
    """Solutions moved in the null space towards a wanted configuration `wish`.

    A solution is unchanged if the motion would lose the pose or would not end nearer to the
    wanted configuration.
    """
    moved = q
    for _ in range(15):  # each step removes most of the distance that null-space motion can
        moved, _ = _step(chain, goal, moved, task, wish)
    moved, reached = _descend(chain, goal, moved, task)
    nearer = (moved - wish).norm(dim=-1) < (q - wish).norm(dim=-1)
    return torch.where((reached & nearer)[:, None], moved, q)


# Redundancy. The arm angle is one number for the posture of a seven-joint arm while its end
# effector is at rest. It is the angle by which the plane of shoulder, elbow and wrist is turned
# out of the vertical (Kreutz-Delgado et al. 1992). Unlike the position of joint 7, this angle
# changes monotonically as the elbow circles, and keeps its meaning when the end effector moves.

# Smallest singular value of the 6 x n Jacobian (with unscaled metres and radians) below which
# its exact inverse demands joint speeds that no arm reaches.
SINGULAR_BELOW = 0.05


_SHOULDER, _ELBOW, _WRIST = 1, 3, 5  # frames of joints 2, 4 and 6
# Step of the central difference [rad]: rounding and truncation errors are both near 1e-10.
_STEP = 1e-5
# Damping of the joint motion that turns the arm angle, as a squared rate [1]. Without it, the
# motion is unbounded near configurations in which the null space does not move the elbow.
_DAMPING = 1e-2
# Singular values [1] and distances to a limit [rad] above these values do not raise a score.
_GOOD_SINGULAR_VALUE = 0.2
_GOOD_DISTANCE = 0.5
# Postures closer to each other than this count as the same [rad].
_ALIKE = 0.5


def arm_angle(chain: SerialChain, q: Float[Tensor, "*batch 7"]) -> Float[Tensor, "*batch"]:
    """Angle of the elbow about the line from shoulder to wrist [rad], in (-pi, pi].

    The angle is zero with the elbow straight above this line, and positive for a right-handed
    rotation about it. It is undefined where the wrist is straight above the shoulder, or the
    arm is stretched.

    Args:
        chain: A seven-joint arm with shoulder, elbow and wrist at joints 2, 4 and 6.
        q: Joint positions [rad].
    """
    points = chain.joint_origins(q)
    axis = points[..., _WRIST, :] - points[..., _SHOULDER, :]
    axis = torch.nn.functional.normalize(axis, dim=-1)
    upper_arm = points[..., _ELBOW, :] - points[..., _SHOULDER, :]
    up = torch.zeros_like(axis)
    up[..., 2] = 1.0
    side = torch.linalg.cross(axis, up)
    above = torch.linalg.cross(side, axis)
    return torch.atan2((upper_arm * side).sum(-1), (upper_arm * above).sum(-1))


def arm_angle_and_motion(
    chain: SerialChain, q: Float[Tensor, "*batch 7"], jacobian: Float[Tensor, "*batch 6 7"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 7"]]:
    """`arm_angle`, and the joint motion that turns it at 1 rad/s with the tool at rest.

    Args:
        chain: The arm.
        q: Joint positions [rad].
        jacobian: Jacobian of the tool at q.

    Returns:
        The angle [rad], and joint velocities [rad/s]; these are bounded near configurations
        in which the null space does not move the elbow.
    """
    direction = orthonormal_basis(jacobian)[..., -1]
    step = _STEP * direction
    angle, after, before = arm_angle(chain, torch.stack([q, q + step, q - step]))
    # Take the shorter difference if the angle wraps around between both ends.
    difference = torch.remainder(after - before + torch.pi, 2 * torch.pi) - torch.pi
    rate = (difference / (2 * _STEP)).unsqueeze(-1)
    return angle, direction * rate / (rate * rate + _DAMPING)


def best_postures(
    chain: SerialChain, solutions: Float[Tensor, "solutions n"]
) -> Float[Tensor, "postures n"]:
    """Distinct postures among several joint positions, the most comfortable one first.

    Args:
        chain: The arm.
        solutions: One or more joint positions [rad].
    """
    lower, upper = chain.limits.lower, chain.limits.upper
    distance = torch.minimum(solutions - lower, upper - solutions).amin(-1)
    smallest = torch.linalg.svdvals(chain.jacobian(solutions))[:, -1]
    margin = (distance / _GOOD_DISTANCE).clamp(max=1)
    score = margin + (smallest / _GOOD_SINGULAR_VALUE).clamp(max=1)
    chosen: list[Tensor] = []
    for posture in solutions[score.argsort(descending=True, stable=True)]:
        if all(torch.linalg.vector_norm(posture - other) > _ALIKE for other in chosen):
            chosen.append(posture)
    return torch.stack(chosen)
