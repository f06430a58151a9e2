"""Effects of pulls at the elbow at any moment of a job.

While the arm follows a motion or holds its end effector, its path is known, and so is its
distance from that path. Visual servoing has no path: there the grasp offset is the measure.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry.numerics import null_projection
from hrc_learn.kinematics import SINGULAR_BELOW, SerialChain
from hrc_learn.log import LoggedSteps
from hrc_learn.teleoperation import ScriptedForce

type Clearance = Callable[[Float[torch.Tensor, "*batch joints"]], Float[torch.Tensor, "*batch"]]
"""Distance [m] between an arm at given joint positions [rad] and its surroundings."""

# Step of a self-motion at the elbow [m], at the joints [rad], and the largest number of steps.
_STEP, _STEP_JOINTS, _MAX_STEPS = 0.005, 0.05, 300
# Elbow velocity per force below which the elbow moves no further [m/s/N]: a few per cent of
# that of a free elbow.
_STILL = 5e-4
# Distances at which the margin of a pull ends: of a joint from its limit [rad], and of the arm
# from its surroundings [m].
_NEAR_LIMIT, _NEAR = 0.1, 0.03
# Index of the joint at the elbow.
_ELBOW = 3
# Time after its end during which a pull still counts, while the arm moves back [s].
_AFTER = 1.0
# Largest lag of the end effector behind its goal [s]: servos lag, and a motion that waits for
# a limit lags further.
_LAG = 0.5
# Distance the goal must move within that lag to have a direction [m].
_LEAST_MOTION = 0.002


@dataclass(frozen=True, kw_only=True)
class PullEffect:
    """Effect of one pull in one phase of the task."""

    phase: str
    pull: ScriptedForce
    elbow: float
    """Largest displacement of the elbow [m]."""
    margin: float
    """Possible displacement of the elbow where the pull began (`elbow_margin`) [m]."""
    tool: float
    """Largest distance of the end effector from its path [m]; NaN if it had no path."""


def pull_effects(
    log: LoggedSteps,
    pulls: Sequence[ScriptedForce],
    chain: SerialChain,
    encoder_offset: Float[np.ndarray, " joints"] | None = None,
    clearance: Clearance | None = None,
) -> list[PullEffect]:
    """Effects of the pulls of a run, one for each phase that a pull reaches into.

    Args:
        log: Log of a work cell.
        pulls: Pulls in the time of the log [s].
        chain: Kinematics of the arm.
        encoder_offset: Constant errors of the encoders [rad]. With them distances are true
            ones, also where a displaced elbow changes the joints for the same pose. None:
            distances are those of the encoders.
        clearance: Distance between the arm and its surroundings [m]; None: free space.
    """
    time, joints = log["time"], torch.from_numpy(log["joint_position"])
    tool = chain.forward(joints).position.numpy()
    if encoder_offset is not None:
        tool = tool + _hidden_displacement(chain, log, torch.from_numpy(encoder_offset))
    off_path = path_distance(tool, log["goal_position"], time)
    effects = []
    for phase, begin, end in _phases(log):
        for pull in pulls:
            rows = (time >= max(pull.start, begin)) & (time < min(pull.end + _AFTER, end))
            if not (rows & (time < pull.end)).any():
                continue
            during = torch.from_numpy(rows)
            planned = torch.from_numpy(log["path_joints"])[during]
            known = off_path[rows][np.isfinite(off_path[rows])]
            effects.append(
                PullEffect(
                    phase=phase,
                    pull=pull,
                    elbow=float(_elbow_displacement(chain, joints[during], planned).max()),
                    margin=elbow_margin(joints[during][0], pull, chain, clearance),
                    tool=float(known.max()) if len(known) else math.nan,
                )
            )
    return effects


def elbow_margin(
    joint_position: Float[torch.Tensor, " joints"],
    pull: ScriptedForce,
    chain: SerialChain,
    clearance: Clearance | None = None,
) -> float:
    """Displacement of the elbow that a pull can reach with the end effector at rest [m].

    Follows the self-motion of the arm in the direction of the pull, until a joint is near its
    limit, the arm is near its surroundings or near a singularity, or the elbow stands still.

    Args:
        joint_position: Joint positions where the pull begins [rad].
        pull: Pull with its direction.
        chain: Kinematics of the arm.
        clearance: Distance between the arm and its surroundings [m]; None: free space.
    """
    q, limits = joint_position, chain.limits
    pose, first = chain.forward(q), chain.joint_origins(q)[_ELBOW]
    farthest, time = 0.0, (pull.start + pull.end) / 2
    for _ in range(_MAX_STEPS):
        elbow = chain.joint_origins(q)[_ELBOW]
        farthest = max(farthest, float((elbow - first).norm()))
        J, J_elbow = chain.jacobian(q), chain.joint_jacobian(q, pull.joint)[:3]
        force = torch.from_numpy(pull.force(time, elbow.numpy()))
        self_motion = null_projection(J, J_elbow.mT @ force)
        speed = float((J_elbow @ self_motion).norm())
        if (
            speed < _STILL * float(force.norm())
            or torch.minimum(q - limits.lower, limits.upper - q).min() < _NEAR_LIMIT
            or float(torch.linalg.svdvals(J)[-1]) < SINGULAR_BELOW
            or (clearance is not None and float(clearance(q)) < _NEAR)
        ):
            break
        q = q + self_motion * min(_STEP / speed, _STEP_JOINTS / float(self_motion.norm()))
        # Newton step back to the pose, from which the step along the tangent departed.
        q = q + torch.linalg.pinv(chain.jacobian(q)) @ chain.forward(q).twist_to(pose)
    return farthest


def _hidden_displacement(
    chain: SerialChain, log: LoggedSteps, offset: Float[torch.Tensor, " joints"]
) -> Float[np.ndarray, "time 3"]:
    """Displacement of the end effector by a push that the encoders do not show [m].

    It is the change of the encoders' error at the end effector against that without the push:
    on the path, or else when no input last moved the null space.
    """
    joints = torch.from_numpy(log["joint_position"])
    path = torch.from_numpy(log["path_joints"])
    pushed = (log["nullspace_input"] != 0).any(axis=1)
    rows = np.arange(len(joints))
    last = np.maximum.accumulate(np.where(pushed, 0, rows))
    undisturbed = torch.where(path.isfinite().all(-1, keepdim=True), path, joints[last])

    def error(q: Float[torch.Tensor, "time joints"]) -> Float[torch.Tensor, "time 3"]:
        return chain.forward(q - offset).position - chain.forward(q).position

    return (error(joints) - error(undisturbed)).numpy()


def _elbow_displacement(
    chain: SerialChain,
    joints: Float[torch.Tensor, "time joints"],
    planned: Float[torch.Tensor, "time joints"],
) -> Float[torch.Tensor, " time"]:
    """Distance of the elbow from its undisturbed position [m].

    The undisturbed position is that of the path, or else that at the start of the pull, moved
    along with the end effector.
    """
    on_path = planned.isfinite().all(-1, keepdim=True)
    elbow, tool = chain.joint_origins(joints)[:, _ELBOW], chain.forward(joints).position
    path = chain.joint_origins(torch.where(on_path, planned, joints))[:, _ELBOW]
    undisturbed = torch.where(on_path, path, elbow[0] + tool - tool[0])
    return (elbow - undisturbed).norm(dim=-1)


def _phases(log: LoggedSteps) -> list[tuple[str, float, float]]:
    """Name, start and end of every phase [s]."""
    starts = [event.time for event in log.events]
    ends = [*starts[1:], math.inf]
    return [(e.text, e.time, end) for e, end in zip(log.events, ends, strict=True)]


def path_distance(
    position: Float[np.ndarray, "time 3"],
    goal: Float[np.ndarray, "time 3"],
    time: Float[np.ndarray, " time"],
) -> Float[np.ndarray, " time"]:
    """Distance of each position from the path of the goals [m]; NaN without a path.

    The end effector may be anywhere along the path: behind its goal, as servos lag, or ahead of
    it when it stops. The distance is therefore measured from the nearest of the recent goals,
    and from the line along which the goal moved last.

    Args:
        position: Position of the end effector [m].
        goal: Goal of the end effector [m]; NaN without a path.
        time: Time of both [s].
    """
    nearest = _distance_across(position - goal, goal, time)
    start, step = goal[:-1], np.diff(goal, axis=0)
    length = (step**2).sum(axis=1)
    for lag in range(_lag_samples(time)):
        here = position[lag + 1 :]
        a, d, square = start[: len(here)], step[: len(here)], length[: len(here)]
        fraction = ((here - a) * d).sum(axis=1) / np.maximum(square, 1e-12)
        away = np.linalg.norm(here - a - np.clip(fraction, 0, 1)[:, None] * d, axis=1)
        # A segment with an unknown end is none: fmin leaves NaN out.
        nearest[lag + 1 :] = np.fmin(nearest[lag + 1 :], away)
    return np.where(np.isfinite(goal).all(axis=1), nearest, np.nan)


def _distance_across(
    error: Float[np.ndarray, "time 3"],
    goal: Float[np.ndarray, "time 3"],
    time: Float[np.ndarray, " time"],
) -> Float[np.ndarray, " time"]:
    """Size of the part of an error across the recent direction of the goal [m]."""
    lag = min(_lag_samples(time), len(time))
    motion = np.full_like(goal, np.nan)
    motion[lag:] = goal[lag:] - goal[: len(goal) - lag]
    length = np.linalg.norm(motion, axis=1, keepdims=True)
    # A goal that hardly moved has no direction.
    moved = length > _LEAST_MOTION
    direction = np.where(moved, motion / np.maximum(length, _LEAST_MOTION), 0.0)
    along = (error * direction).sum(axis=1, keepdims=True) * direction
    return np.linalg.norm(error - along, axis=1)


def _lag_samples(time: Float[np.ndarray, " time"]) -> int:
    """Number of samples within the largest lag."""
    return round(_LAG / float(np.median(np.diff(time)))) if len(time) > 1 else 0
