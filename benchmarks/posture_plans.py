"""Cycles of a job whose postures avoid the parts of a worker: a planner that knows them.

The tool moves as before. Of all postures with the same pose of the tool, the plan takes those
that come least near the worker's body with a hand at each part; the arm angle turns slowly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import convolve1d
from torch import Tensor
from worker_job import JobCycle
from working_worker import Work

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import CapsuleArm, panda, separation
from hrc_learn.kinematics.inverse import arm_angle_and_motion
from hrc_learn.sim.workplace import Workplace

# Change of the arm angle between two postures [rad], and number of such steps to either side.
TURN, TURNS = 0.06, 24
FIRST_MOVING = 2
"""First link whose distance from a worker changes noticeably: the upper arm."""
# Clearance of the arm from furniture and from itself that a posture must keep [m].
_CLEAR = 0.01
# Error of a tool after self-motion above which a posture does not count [m].
_EXACT = 1e-3
# Interval between two planned postures [s], and change of the posture in that time: the arm
# angle turns at 0.5 rad/s at most.
_EVERY, _STEPS = 0.25, 2
# Change of a joint between two planned postures beyond that of the job [rad], and weights that
# smooth the changes over 1 s.
_FASTER = 0.15
_SMOOTHING = np.hanning(7)[1:-1] / np.hanning(7).sum()
# Cost of turning the elbow, relative to the cost of being too near.
_TURNING = 1e-3


def all_postures(
    workplace: Workplace, q: Float[Tensor, "moments 7"]
) -> tuple[Float[Tensor, "postures moments 7"], Bool[Tensor, "postures moments"]]:
    """Postures with the same pose of the tool, by arm angle, and which of them are possible.

    The given posture is the one in the middle; the angles are `TURN` apart.

    Args:
        workplace: Table, shelves and arm.
        q: Joint positions [rad].
    """
    pose = panda.forward(q)
    found = [q]
    for sign in (1.0, -1.0):
        now = q
        for _ in range(TURNS):
            _, motion = arm_angle_and_motion(panda, now, panda.jacobian(now))
            now = at_pose(now + sign * TURN * motion, pose)
            found.insert(len(found) if sign > 0 else 0, now)
    postures = torch.stack(found)
    lower, upper = panda.limits.lower, panda.limits.upper
    valid = ((postures > lower) & (postures < upper)).all(-1)
    valid &= (panda.forward(postures).position - pose.position).norm(dim=-1) < _EXACT
    valid &= workplace.arm_clearance(postures) > _CLEAR
    valid[TURNS] = True
    return postures, valid


def at_pose(q: Float[Tensor, "*batch 7"], pose: Pose) -> Float[Tensor, "*batch 7"]:
    """The nearest joint positions at which the tool has a near pose: two Newton steps."""
    for _ in range(2):
        reached, J = panda.forward_and_jacobian(q)
        twist = reached.twist_to(pose).unsqueeze(-1)
        q = q + (J.mT @ torch.linalg.solve(J @ J.mT, twist)).squeeze(-1)
    return q


def planned_cycles(
    workplace: Workplace,
    arm: CapsuleArm,
    cycles: Sequence[JobCycle],
    works: Sequence[Work],
    kept: float,
) -> list[JobCycle]:
    """Cycles for arms that know the parts of their workers.

    Args:
        workplace: Table, shelves and arm.
        arm: Capsules of arm and tool.
        cycles: Cycles, done in turn.
        works: Work near each arm.
        kept: Distance from a worker that separation monitoring keeps [m].
    """
    planned, found = [], {}
    for run, work in enumerate(works):
        number = run % len(cycles)
        cycle = cycles[number]
        every = round(_EVERY / cycle.dt)
        rows = np.append(np.arange(0, len(cycle.path) - 1, every), len(cycle.path) - 1)
        if number not in found:
            found[number] = all_postures(workplace, torch.from_numpy(cycle.path[rows]))
        postures, valid = found[number]
        cost = _nearness(arm, postures, work, kept).masked_fill(~valid, torch.inf)
        chosen = torch.from_numpy(_cheapest(cost.mT.numpy(), postures.transpose(0, 1).numpy()))
        change = postures[chosen, torch.arange(len(rows))].numpy() - cycle.path[rows]
        change = convolve1d(change, _SMOOTHING, axis=0, mode="nearest")
        change[[0, -1]] = 0.0
        smooth = PchipInterpolator(rows, change)(np.arange(len(cycle.path)))
        q = torch.from_numpy(cycle.path)
        path = at_pose(q + torch.from_numpy(smooth), panda.forward(q))
        planned.append(replace(cycle, path=path.numpy()))
    return planned


def _nearness(
    arm: CapsuleArm, postures: Float[Tensor, "postures moments 7"], work: Work, kept: float
) -> Float[Tensor, "postures moments"]:
    """Mean distance by which a worker with a hand at each part is too near, as a fraction."""
    moving = [k for k, link in enumerate(arm.links) if link >= FIRST_MOVING]
    bodies = torch.from_numpy(work.visit.ends_at(work.spans[:, 1:3].mean(1)))
    radius = torch.from_numpy(work.visit.worker.radius)
    near = [
        separation(arm, postures, body, radius).distance[..., moving, :].amin((-2, -1))
        for body in bodies
    ]
    return (1 - torch.stack(near) / kept).clamp(min=0).mean(0)


def _cheapest(
    cost: Float[np.ndarray, "moments postures"],
    postures: Float[np.ndarray, "moments postures 7"],
) -> Int[np.ndarray, " moments"]:
    """Postures of the least total cost, from the middle to the middle: dynamic programming."""
    count = cost.shape[1]
    middle = count // 2
    turning = _TURNING * np.abs(np.arange(count) - middle)
    total, came = np.full(count, np.inf), np.zeros(cost.shape, np.int64)
    total[middle] = 0.0
    steps = np.arange(-_STEPS, _STEPS + 1)
    before = np.arange(count)[:, None] + steps
    inside = (before >= 0) & (before < count)
    before = before.clip(0, count - 1)
    for moment, now in enumerate(cost[1:], start=1):
        moved = np.abs(postures[moment][:, None] - postures[moment - 1][before]).max(-1)
        most = np.abs(postures[moment, middle] - postures[moment - 1, middle]).max() + _FASTER
        allowed = inside & (moved <= most)
        options = np.where(allowed, total[before] + _TURNING * np.abs(steps), np.inf)
        best = options.argmin(1)
        came[moment] = before[np.arange(count), best]
        total = options[np.arange(count), best] + now + turning
    chosen = np.full(len(cost), middle)
    for moment in range(len(cost) - 1, 0, -1):
        chosen[moment - 1] = came[moment, chosen[moment]]
    return chosen
