"""Play a fitted model to a goal: in the model's own coordinates, or on an arm within limits."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller.motion_filter import MotionFilter, MotionState
from hrc_learn.dmp import JointDMP
from hrc_learn.geometry import Pose, minimum_jerk, quaternion
from hrc_learn.kinematics import Arm, UnreachableError
from hrc_learn.kinematics.inverse import TASK_ROWS, follow_poses
from hrc_learn.learning.fitted_model import FittedModel, Target
from hrc_learn.learning.model_choice import predicted_primitive

DT = 0.02
"""Time between samples [s]."""
_DEVIATION = 2e-3
"""Largest distance of a joint from the planned path [rad]: 1 mm at a lever of 0.5 m."""
_KINDS = "velocity", "acceleration"
"""Limits checked on the planned path; the limit of jerk is enforced by `MotionFilter`."""
# `_SLOWER`: factor on the duration if the jerk limit distorts the path. `_ATTEMPTS`: largest
# number of durations tried.
_SLOWER, _ATTEMPTS = 1.1, 30
_SETTLING = 1.0
"""Longest time that a motion may take to settle after the end of its path [s]."""
_TURNS = 30
"""Number of steps of inverse kinematics that bring the tool of an arm of fewer than six joints
as near to an orientation as possible."""
_MISSED = 1e-3
"""Smallest error of a pose that counts as out of reach [m, rad]."""


class BeyondLimitsError(RuntimeError):
    """The motion violates a limit at any duration."""


@dataclass(frozen=True, kw_only=True)
class PlayedMotion:
    """Motion of a model to a goal."""

    time: Float[np.ndarray, " samples"]
    """Time of each sample [s]."""
    joints: Float[np.ndarray, "samples joints"] | None = None
    """Joint positions, in rad on an arm, else in the model's unit."""
    position: Float[np.ndarray, "samples 3"] | None = None
    """Position of the end effector [m]."""
    orientation: Float[np.ndarray, "samples 4"] | None = None
    """Unit quaternions (w, x, y, z)."""
    planned_duration: float
    """Requested duration [s]; the motion takes longer if the arm's limits require it."""
    slowed_by: str = ""
    """First limit that made the motion slower; empty if none did."""
    goal_errors: Mapping[str, float]
    """Errors at the goal: `goal_position_error_mm` and `goal_turn_error_deg`, or
    `goal_joint_error`, the largest error of a joint in the unit of `joints`."""
    deviation: float = 0.0
    """Largest distance of a joint from the planned path [rad]."""


def play_path(
    model: FittedModel, start: Target | None, goal: Target, duration: float | None
) -> PlayedMotion:
    """Motion in the model's own coordinates.

    Args:
        model: The model.
        start: Start; None: the model's start.
        goal: Goal.
        duration: Duration [s]; None: the model's duration.

    Raises:
        ValueError: The model has no primitive for such a goal, or only one of start and goal is
            given in joints.
    """
    kind = "joint" if goal.joints is not None else "pose"
    if kind == "pose" and model.pose is None:
        kind = "position"
    if kind not in model.primitives:
        raise ValueError(
            f"{model.folder} holds no primitive for a goal of "
            f"{'joints' if kind == 'joint' else 'the end effector'}: it has "
            f"{' and '.join(model.primitives)}. With --robot, kinematics converts the goal."
        )
    if start is not None and (start.joints is None) != (goal.joints is None):
        raise ValueError("--start and --goal must be of one kind, or give --robot.")
    lasting = _duration(model, kind, duration)
    time = _times(lasting).numpy()
    if goal.joints is not None:
        first = None if start is None else start.joints
        joints = _joint_path(model, first, goal.joints, lasting)
        error = {"goal_joint_error": float((joints[-1] - goal.joints).abs().max())}
        return PlayedMotion(
            time=time, joints=joints.numpy(), planned_duration=lasting, goal_errors=error
        )
    pose = _pose_path(model, start, goal, lasting)
    if kind == "position":  # a primitive of positions does not move the orientation
        goal = Target(position=goal.position)
    return PlayedMotion(
        time=time,
        position=pose.position.numpy(),
        orientation=None if kind == "position" else pose.orientation.numpy(),
        planned_duration=lasting,
        goal_errors=_pose_errors(pose, goal),
    )


def play_on_arm(
    model: FittedModel, robot: Arm, start: Target | None, goal: Target, duration: float | None
) -> PlayedMotion:
    """Motion of an arm within its limits, from rest to rest.

    The path keeps its shape; if the limits of velocity, acceleration or jerk require it, the
    motion takes longer.

    Args:
        model: The model.
        robot: The arm, from `arm_for`.
        start: Start; None: the model's start.
        goal: Goal.
        duration: Duration [s]; None: the model's duration.

    Raises:
        ValueError: The model's joint unit has no fixed size.
        UnreachableError: The arm does not reach the path or the goal.
        BeyondLimitsError: The path leaves the range of a joint.
    """
    channel, path_in = _planner(model, robot, start, goal)
    lasting = _duration(model, channel, duration)
    path, note, stretch = path_in(lasting), "", 1.0
    for _ in range(_ATTEMPTS):
        _require_range(robot, path)
        excess, at = robot.limits.excess(path, DT, _KINDS)
        factor = float(excess)
        if factor > 1.0:
            kind, joint = divmod(int(at), robot.joints)
            note = note or f"{_KINDS[kind]} of {robot.chain.joint_names[joint]}"
        else:
            joints = _within_limits(robot, path)
            off = _distance(joints, path)
            if off <= _DEVIATION:
                break
            factor, note = _SLOWER, note or "jerk"
        stretch *= max(factor, 1 + 1e-3) * (1 + 1e-6)
        path = path_in(lasting * stretch)
    else:
        raise BeyondLimitsError(f"no duration keeps the limits of {robot.name} on this path.")
    reached = robot.forward(torch.from_numpy(joints))
    errors = _pose_errors(reached, goal)
    if goal.joints is not None:
        wanted = model.in_rad(robot, goal.joints).numpy()
        errors = {"goal_joint_error": float(np.abs(joints[-1] - wanted).max())}
    return PlayedMotion(
        time=DT * np.arange(len(joints)),
        joints=joints,
        position=reached.position.numpy(),
        orientation=reached.orientation.numpy(),
        planned_duration=lasting,
        slowed_by=note if stretch > 1 else "",
        deviation=off,
        goal_errors=errors,
    )


def _planner(
    model: FittedModel, robot: Arm, start: Target | None, goal: Target
) -> tuple[str, Callable[[float], Float[Tensor, "samples joints"]]]:
    """Channel that plans the motion, and a function that maps duration [s] to joint path [rad].

    For a goal of the tool, the path follows the tool's primitive by inverse kinematics if the
    model has such a primitive. Otherwise, the path follows the joints' primitive.
    """
    tool = "pose" if model.pose is not None else "position"
    if goal.joints is None and tool in model.primitives:
        first = _first_joints(model, robot, start)
        return tool, partial(_joints_along, model, robot, first, goal)
    if model.joint is None:
        raise ValueError(
            f"{model.folder} holds no primitive of joints: give --goal position or pose."
        )
    usual = model.in_rad(robot, model.joint.goal)  # raises if the unit has no fixed size
    if goal.joints is None:
        end = _joints_at(model, robot, goal, usual, robot.forward(usual))
    else:
        end = model.in_rad(robot, goal.joints)
    first = _first_joints(model, robot, start)

    def path(duration: float) -> Tensor:
        asked, wanted = (model.from_rad(robot, q) for q in (first, end))
        return model.in_rad(robot, _joint_path(model, asked, wanted, duration))

    return "joint", path


def _duration(model: FittedModel, channel: str, given: float | None) -> float:
    if given is not None and not (math.isfinite(given) and given > DT):
        raise ValueError(f"--duration must be more than {DT} s, but is {given}.")
    return float(model.primitives[channel].duration) if given is None else given


def _times(duration: float) -> Float[Tensor, " samples"]:
    return DT * torch.arange(math.ceil(duration / DT - 1e-9) + 1, dtype=torch.float64)


@torch.no_grad()
def _joint_path(
    model: FittedModel, start: Tensor | None, goal: Tensor, duration: float
) -> Float[Tensor, "samples joints"]:
    """Joint path that the best model predicts, starting at rest, in the model's unit."""
    joint = model.joint
    assert joint is not None
    start = joint.start if start is None else start
    best = predicted_primitive(model.folder, "joint", start, goal).double()
    still = torch.zeros_like(start)
    return best.rollout(_times(duration), start, goal, duration, still).position


@torch.no_grad()
def _pose_path(model: FittedModel, start: Target | None, goal: Target, duration: float) -> Pose:
    """Poses of the end effector, starting at rest.

    With a model of positions, the orientation is constant: that of the goal, or the identity if
    the goal has none.
    """
    time, pose = _times(duration), model.pose
    assert goal.position is not None
    if pose is None:
        linear = cast("JointDMP", model.primitives["position"])
        first = linear.start if start is None or start.position is None else start.position
        best = predicted_primitive(model.folder, "position", first, goal.position).double()
        moved = best.rollout(time, first, goal.position, duration, torch.zeros_like(first))
        still = torch.tensor((1.0, 0.0, 0.0, 0.0), dtype=time.dtype)
        turned = still if goal.orientation is None else goal.orientation
        return Pose(moved.position, turned.expand(len(time), 4))
    begin, end = _completed(start, pose.start), _completed(goal, pose.goal)
    rest = torch.zeros(6, dtype=time.dtype)
    return pose.rollout(time, begin, end, duration, rest).pose


def _completed(target: Target | None, usual: Pose) -> Pose:
    """Pose of a target; a missing position or orientation is that of the pose `usual`."""
    if target is None or target.position is None:
        return usual
    turned = usual.orientation if target.orientation is None else target.orientation
    return Pose(target.position, turned)


@torch.no_grad()
def _joints_along(
    model: FittedModel, robot: Arm, first: Tensor, goal: Target, duration: float
) -> Float[Tensor, "samples joints"]:
    """Joint positions [rad] along the model's poses, starting at the joints `first` [rad].

    In the null space, the arm moves towards the joint positions of the model's goal. An arm of
    fewer than six joints moves towards joint positions that turn the tool as near to the goal's
    orientation as possible.
    """
    begin = robot.forward(first)
    start = Target(position=begin.position, orientation=begin.orientation)
    poses, end = _pose_path(model, start, goal, duration), None
    whole = robot.joints >= 6 and (model.pose is not None or goal.orientation is not None)
    if robot.joints < 6:
        end = _joints_at(model, robot, goal, first, poses[-1])
    elif model.joint is not None:
        end = model.in_rad(robot, model.joint.goal)
    wish = None
    if end is not None:
        progress, _ = minimum_jerk(torch.linspace(0, 1, len(poses.position)).to(first))
        wish = torch.lerp(first, end, progress[:, None])
    task = "pose" if whole else "position"
    path, _ = follow_poses(robot.chain, poses, first, wish, task)
    rows = TASK_ROWS[task]
    missed = robot.forward(path).twist_to(poses)[:, :rows].abs().amax(-1) > _MISSED
    if bool(missed.any()):
        where = ", ".join(f"{x:.3f}" for x in poses.position[int(missed.int().argmax())])
        raise UnreachableError(
            f"{robot.name} does not reach the path at position ({where}) m"
            f"{' with this orientation' if rows == 6 else ''}: choose another goal or start."
        )
    return path


def _first_joints(model: FittedModel, robot: Arm, start: Target | None) -> Tensor:
    """Joint positions at the start [rad]."""
    near = robot.ready if model.joint is None else model.in_rad(robot, model.joint.start)
    if start is None and model.joint is not None:
        return near
    if start is not None and start.joints is not None:
        return model.in_rad(robot, start.joints)
    usual = robot.forward(near)
    if model.pose is not None:
        usual = model.pose.start
    elif "position" in model.primitives:
        linear = cast("JointDMP", model.primitives["position"])
        usual = Pose(linear.start, usual.orientation)
    return _joints_at(model, robot, start, near, usual)


@torch.no_grad()
def _joints_at(
    model: FittedModel, robot: Arm, target: Target | None, near: Tensor, usual: Pose
) -> Float[Tensor, " joints"]:
    """Joint positions [rad] that reach a target, near the joint positions `near` [rad].

    An arm of fewer than six joints reaches the position, and comes as near to the orientation
    as it can.
    """
    pose = _completed(target, usual)
    free = target is not None and target.orientation is None and model.pose is None
    if robot.joints >= 6 and not free:
        return robot.inverse(pose, near=near)
    q = robot.inverse(pose, near=near, task="position")
    if free:
        return q
    still = Pose(pose.position.expand(_TURNS, 3), pose.orientation.expand(_TURNS, 4))
    turned, _ = follow_poses(robot.chain, still, q)
    missed = torch.linalg.vector_norm(robot.forward(turned[-1]).position - pose.position)
    return turned[-1] if float(missed) < _MISSED / 10 else q


def _require_range(robot: Arm, path: Float[Tensor, "samples joints"]) -> None:
    """Raise `BeyondLimitsError` if a path leaves the range of a joint."""
    beyond = torch.maximum(robot.limits.lower - path, path - robot.limits.upper)
    if float(beyond.max()) > 1e-9:
        k, i = divmod(int(beyond.argmax()), path.shape[1])
        raise BeyondLimitsError(
            f"{robot.chain.joint_names[i]} would be {float(beyond[k, i]):.3f} rad beyond its "
            f"range at {k / max(len(path) - 1, 1):.0%} of the motion: choose another goal or "
            "start."
        )


def _within_limits(
    robot: Arm, path: Float[Tensor, "samples joints"]
) -> Float[np.ndarray, "moments joints"]:
    """Motion along a path within all limits, from rest to rest, sampled every `DT` [rad]."""
    names = ("velocity", "acceleration", "jerk", "lower", "upper")
    limits = {name: getattr(robot.limits, name).double().numpy() for name in names}
    smoother, state = MotionFilter(DT, **limits), MotionState.moving(path[0].numpy())
    made, end = [state.position], path[-1].numpy()
    for asked in path[1:].numpy():
        state = smoother.step(state, asked)
        made.append(state.position)
    for _ in range(round(_SETTLING / DT)):
        if np.abs(state.position - end).max() < 1e-5 and np.abs(state.velocity).max() < 1e-4:
            break
        state = smoother.step(state, end)
        made.append(state.position)
    return np.stack(made)


def _distance(
    joints: Float[np.ndarray, "moments joints"], path: Float[Tensor, "samples joints"]
) -> float:
    """Largest distance of any joint of a motion from a path, regardless of time [rad]."""
    between = torch.linspace(0, 1, 5, dtype=path.dtype)[:-1, None, None]
    fine = torch.cat([torch.lerp(path[:-1], path[1:], between).flatten(0, 1), path[-1:]])
    # Computed in parts: for a motion of minutes, all distances at once need gigabytes.
    parts = torch.from_numpy(joints).split(256)
    return max(float(torch.cdist(part, fine, p=torch.inf).amin(1).max()) for part in parts)


def _pose_errors(pose: Pose, goal: Target) -> dict[str, float]:
    """Distance [mm] and angle [deg] between the last pose and the goal, by name."""
    errors = {}
    if goal.position is not None:
        apart = (pose.position[-1] - goal.position).norm()
        errors["goal_position_error_mm"] = 1e3 * float(apart)
    if goal.orientation is not None:
        turn = quaternion.angle(goal.orientation, pose.orientation[-1])
        errors["goal_turn_error_deg"] = float(turn.rad2deg())
    return errors
