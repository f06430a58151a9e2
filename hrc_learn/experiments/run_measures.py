"""Quantities measured from the log of a run and from the simulator.

The simulator provides true poses and contacts, which the robot does not know.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import SerialChain
from hrc_learn.log import Event, LoggedSteps
from hrc_learn.sim import MotionLog, Touch, World
from hrc_learn.skills.grasping import INTERACT
from hrc_learn.skills.work_cell import WorkCell
from hrc_learn.teleoperation import ScriptedForce
from hrc_learn.vision import CameraModel

ELBOW = 3
"""Index of the elbow among the frames of the links."""

# Time after the end of a pull in which its effect still counts, while the arm moves back [s].
_AFTER = 1.0
# Largest lag of the end effector behind its goal [s]: servos lag, and limits may delay a motion
# further.
_LAG = 0.5
# Distance that the goal must move within `_LAG` to have a direction [m].
_LEAST_MOTION = 0.002
# Orientation of a held object in the frame of the hand. The object's x axis lies along the
# closing direction of the fingers, which is the y axis of the hand. The object's top faces the
# palm.
_IN_HAND = quaternion.from_matrix(
    torch.tensor([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]], dtype=torch.float64)
)


def lasting(phases: Sequence[Event], last: float = math.inf) -> list[tuple[Event, float]]:
    """Phases with their ends [s]: the start of the next phase, or `last` for the last phase."""
    return list(zip(phases, [*(phase.time for phase in phases[1:]), last], strict=False))


def spans(log: LoggedSteps, phase: str) -> list[tuple[float, float]]:
    """Start and end of each occurrence of a phase [s]; the last end may be infinite."""
    return [(event.time, end) for event, end in lasting(log.events) if event.text == phase]


def span(log: LoggedSteps, phase: str) -> tuple[float, float]:
    """Start and end of the first occurrence of a phase [s]; (0, 0) if the phase never began."""
    return (spans(log, phase) or [(0.0, 0.0)])[0]


def true_image_jacobian(
    log: LoggedSteps, world: World, cameras: Sequence[tuple[float, CameraModel]]
) -> Float[np.ndarray, "time 2 6"]:
    """True image Jacobian of the gripper's marker at steps that used the estimate, else NaN.

    Args:
        log: Log of the run.
        world: World with the true place of the marker on the gripper.
        cameras: True cameras, each with the time from which it was used [s].
    """
    used = np.isfinite(log["image_jacobian"]).all(axis=(1, 2))
    jacobian = np.full_like(log["image_jacobian"], np.nan)
    tools = world.arm.robot.forward(log["joint_position"])
    offset = torch.from_numpy(world.hand_marker_offset())
    ends = [*(start for start, _ in cameras[1:]), math.inf]
    for (start, camera), end in zip(cameras, ends, strict=True):
        rows = used & (log["time"] >= start) & (log["time"] < end)
        tool = tools[torch.from_numpy(rows)]
        marker = tool.apply(offset).numpy()
        jacobian[rows] = camera.image_jacobian(marker, tool.position.numpy())
    return jacobian


def true_tool(motion: MotionLog, world: World, steps: int) -> Pose:
    """True poses of the tool centre point, independent of the encoders; batch shape (time,)."""
    hand = body_poses(motion, "hand", steps)
    # The hand may be mounted askew; the tool centre point lies on the axis of the hand.
    return Pose(hand.apply(torch.from_numpy(world.arm.tool_offset)), hand.orientation)


def body_poses(motion: MotionLog, name: str, steps: int) -> Pose:
    """True poses of a link or an object in the first steps of a run; batch shape (time,)."""
    (body,) = (body for body in motion.bodies(steps) if body.name == name)
    return Pose(torch.from_numpy(body.position), torch.from_numpy(body.orientation))


@dataclass(frozen=True, kw_only=True, eq=False)
class Deviation:
    """Displacement of end effector and elbow due to a person's pushes; NaN at other times."""

    position: Float[np.ndarray, " time"]
    """Displacement of the end effector [m]."""
    rotation: Float[np.ndarray, " time"]
    """Rotation of the end effector [rad]."""
    elbow: Float[np.ndarray, " time"]
    """Displacement of the elbow [m]."""

    @classmethod
    def of(cls, log: LoggedSteps, motion: MotionLog, world: World) -> "Deviation":
        """Deviation from the first push until the end of the interaction phase.

        Args:
            log: Log of the run.
            motion: True poses of everything that moved.
            world: World of the run.
        """
        time = log["time"]
        start, end = span(log, INTERACT)
        within = (time >= start) & (time < end)
        pushed = within & (np.abs(log["nullspace_input"]).max(axis=1) > 0)
        first = int(pushed.argmax()) if pushed.any() else 0
        rows = within & (np.arange(len(time)) >= first) & bool(pushed.any())
        tool = true_tool(motion, world, len(time))
        # The frame of joint 4 is at the elbow.
        elbow = body_poses(motion, f"link{ELBOW + 1}", len(time))

        def distance(pose: Pose) -> Float[np.ndarray, " time"]:
            moved = (pose.position - pose.position[first]).norm(dim=-1).numpy()
            return np.where(rows, moved, np.nan)

        angle = quaternion.angle(tool.orientation, tool.orientation[first]).numpy()
        return cls(
            position=distance(tool),
            rotation=np.where(rows, angle, np.nan),
            elbow=distance(elbow),
        )

    @classmethod
    def from_path(cls, log: LoggedSteps, chain: SerialChain) -> "Deviation":
        """Deviation from the path while the arm follows it and is pushed.

        The encoders measure this deviation.

        Args:
            log: Log of the run.
            chain: Kinematics of the arm.
        """
        joints, path = (
            torch.from_numpy(log[name]) for name in ("joint_position", "path_joints")
        )
        pushed = (log["nullspace_input"] != 0).any(axis=1)
        tool = chain.forward(joints).position.numpy()
        off = path_distance(tool, log["goal_position"], log["time"])
        elbow, planned = (chain.joint_origins(q)[:, ELBOW] for q in (joints, path))
        moved = (elbow - planned).norm(dim=-1).numpy()
        return cls(
            position=np.where(pushed, off, np.nan),
            rotation=np.full_like(off, np.nan),
            elbow=np.where(pushed, moved, np.nan),
        )


def limit_violations(cell: WorkCell) -> int:
    """Number of steps in which a joint was measured outside its position or velocity range."""
    if not len(cell.log):
        return 0
    q = torch.from_numpy(cell.log["joint_position"])
    v = torch.from_numpy(cell.log["joint_velocity"])
    limits = cell.chain.limits
    outside = (q < limits.lower) | (q > limits.upper) | (v.abs() > limits.velocity)
    return int(outside.any(dim=-1).sum())


def unwanted_contacts(
    world: World, log: LoggedSteps, released: Mapping[str, float] | None = None
) -> dict[str, tuple[Touch, ...]]:
    """Contacts of the arm and of the objects it carried, by the object that was hit.

    The fingertips may touch the table while the arm moves down to find the table's height.

    Args:
        world: World at the end of the run.
        log: Log of the run.
        released: Time at which each object was released on its shelf [s]; later contacts of
            this object do not count.
    """
    released = released or {}
    carried = [
        touch
        for touch in world.object_contacts.touches
        if touch.start < released.get(touch.first, math.inf)
    ]
    grasps = spans(log, "grasp")
    hit = (
        touch
        for touch in world.table_contacts.touches
        if not (
            touch.first.startswith("finger")
            and any(start <= touch.start < end for start, end in grasps)
        )
    )
    return {
        "cabinet": (*world.cabinet_contacts.touches, *carried),
        "table": tuple(hit),
        "arm itself": tuple(world.self_contacts.touches),
    }


def worker_distance(motion: MotionLog, steps: int) -> Float[np.ndarray, " time"]:
    """True smallest distance between worker and robot [m]; empty without a worker."""
    return np.array([pair.distance for pair in motion.nearest(steps)])


def grasp_offset(
    log: LoggedSteps, motion: MotionLog, world: World, name: str, descent: float
) -> float:
    """Horizontal distance between end effector and object at the start of a descent [m].

    Args:
        log: Log of the run.
        motion: True poses of everything that moved.
        world: World of the run.
        name: Name of the object.
        descent: Start of the descent [s].
    """
    step = int(np.searchsorted(log["time"], descent))
    tool, item = true_tool(motion, world, len(log)), body_poses(motion, name, len(log))
    return float((tool.position - item.position)[step, :2].norm())


def place_angle(pose: Float[np.ndarray, "4 4"], goal: Float[Tensor, "4"]) -> float:
    """Angle between the orientation of a placed box and its intended orientation [rad].

    Args:
        pose: Pose of the box.
        goal: Orientation of the hand at the goal.
    """
    return float(_place_turn(pose, goal).norm())


def place_pitch_and_yaw(
    pose: Float[np.ndarray, "4 4"], goal: Float[Tensor, "4"]
) -> tuple[float, float]:
    """Absolute pitch and yaw of a placed box relative to its intended orientation [rad].

    Yaw is a rotation about the vertical axis. Pitch is a rotation about the horizontal axis
    that is perpendicular to the direction of the hand.

    Args:
        pose: Pose of the box.
        goal: Orientation of the hand at the goal; the hand must not point up or down.
    """
    turn = _place_turn(pose, goal)
    up = turn.new_tensor([0.0, 0.0, 1.0])
    across = torch.linalg.cross(up, quaternion.rotate(goal, up))
    return float((turn @ across / across.norm()).abs()), float(turn[2].abs())


def _place_turn(pose: Float[np.ndarray, "4 4"], goal: Float[Tensor, "4"]) -> Float[Tensor, "3"]:
    """Rotation vector of a box from intended to actual orientation, in the base frame [rad]."""
    q = quaternion.from_matrix(torch.from_numpy(pose[:3, :3].copy()))
    back = quaternion.conjugate(quaternion.multiply(goal, _IN_HAND))
    # A box looks the same after half a turn about its z axis.
    turned = quaternion.multiply(q, q.new_tensor([0.0, 0.0, 0.0, 1.0]))
    turns = [quaternion.log(quaternion.multiply(either, back)) for either in (q, turned)]
    return min(turns, key=lambda turn: float(turn.norm()))


class PullEffect(NamedTuple):
    """Effect of one pull at the elbow during a job."""

    elbow: float
    """Largest displacement of the elbow [m]."""
    tool: float
    """Largest distance of the end effector from its path [m]; NaN if it had no path."""


def pull_effects(
    log: LoggedSteps,
    pulls: Sequence[ScriptedForce],
    chain: SerialChain,
    encoder_offset: Float[np.ndarray, " joints"] | None = None,
) -> list[PullEffect]:
    """Effects of the pulls that acted during a run.

    While the arm follows a path or holds its end effector in place, the effect on the end
    effector is its distance from this path. Visual servoing has no path, so this effect is NaN;
    the grasp offset shows it instead.

    Args:
        log: Log of a work cell.
        pulls: Pulls, with times by the clock of the log.
        chain: Kinematics of the arm.
        encoder_offset: Constant errors of the encoders [rad], to compute true distances: a
            displaced elbow changes the effect of these errors. None: distances as the encoders
            show them.
    """
    time, joints = log["time"], torch.from_numpy(log["joint_position"])
    tool = chain.forward(joints).position.numpy()
    if encoder_offset is not None:
        tool = tool + _hidden_displacement(chain, log, torch.from_numpy(encoder_offset))
    off_path = path_distance(tool, log["goal_position"], time)
    effects = []
    for pull in pulls:
        elbow, known = [], [math.nan]
        # Each phase has its own path, and the displacement of the elbow is relative to it.
        for phase, end in lasting(log.events):
            rows = (time >= max(pull.start, phase.time)) & (time < min(pull.end + _AFTER, end))
            if not (rows & (time < pull.end)).any():
                continue
            during = torch.from_numpy(rows)
            planned = torch.from_numpy(log["path_joints"])[during]
            elbow.append(float(_elbow_displacement(chain, joints[during], planned).max()))
            known += off_path[rows].tolist()
        if elbow:
            effects.append(PullEffect(max(elbow), float(np.fmax.reduce(known))))
    return effects


def _hidden_displacement(
    chain: SerialChain, log: LoggedSteps, offset: Float[Tensor, " joints"]
) -> Float[np.ndarray, "time 3"]:
    """Displacement of the end effector that a push causes and the encoders do not show [m].

    Because of the encoders' errors, the true position of the end effector differs from the
    measured position by an offset that depends on the joint positions. The result is the change
    of this offset from the undisturbed to the present joint positions. The undisturbed joint
    positions are those of the path or, without a path, the last ones before the push.
    """
    joints = torch.from_numpy(log["joint_position"])
    path = torch.from_numpy(log["path_joints"])
    pushed = (log["nullspace_input"] != 0).any(axis=1)
    rows = np.arange(len(joints))
    last = np.maximum.accumulate(np.where(pushed, 0, rows))
    undisturbed = torch.where(path.isfinite().all(-1, keepdim=True), path, joints[last])

    def error(q: Float[Tensor, "time joints"]) -> Float[Tensor, "time 3"]:
        return chain.forward(q - offset).position - chain.forward(q).position

    return (error(joints) - error(undisturbed)).numpy()


def _elbow_displacement(
    chain: SerialChain,
    joints: Float[Tensor, "time joints"],
    planned: Float[Tensor, "time joints"],
) -> Float[Tensor, " time"]:
    """Distance of the elbow from its undisturbed position [m].

    The undisturbed position is the elbow's position on the path. Without a path, it is the
    elbow's position at the start of the pull, shifted by the motion of the end effector since
    then.
    """
    on_path = planned.isfinite().all(-1, keepdim=True)
    elbow, tool = chain.joint_origins(joints)[:, ELBOW], chain.forward(joints).position
    path = chain.joint_origins(torch.where(on_path, planned, joints))[:, ELBOW]
    undisturbed = torch.where(on_path, path, elbow[0] + tool - tool[0])
    return (elbow - undisturbed).norm(dim=-1)


def path_distance(
    position: Float[np.ndarray, "time 3"],
    goal: Float[np.ndarray, "time 3"],
    time: Float[np.ndarray, " time"],
) -> Float[np.ndarray, " time"]:
    """Distance of each position from the path of the goals [m]; NaN without a path.

    The end effector may be anywhere along the path: behind its goal, as servos lag, or ahead of
    a goal that stops. The distance is therefore measured from the nearest of the recent goals,
    and from the line along which the goal moved last.

    Args:
        position: Position of the end effector [m].
        goal: Goal of the end effector [m]; NaN without a path.
        time: Time of each sample [s].
    """
    nearest = _distance_across(position - goal, goal, time)
    start, step = goal[:-1], np.diff(goal, axis=0)
    length = (step**2).sum(axis=1)
    for lag in range(_lag_samples(time)):
        here = position[lag + 1 :]
        a, d, square = start[: len(here)], step[: len(here)], length[: len(here)]
        fraction = ((here - a) * d).sum(axis=1) / np.maximum(square, 1e-12)
        away = np.linalg.norm(here - a - np.clip(fraction, 0, 1)[:, None] * d, axis=1)
        # fmin ignores the NaN of segments with an unknown end.
        nearest[lag + 1 :] = np.fmin(nearest[lag + 1 :], away)
    return np.where(np.isfinite(goal).all(axis=1), nearest, np.nan)


def _distance_across(
    error: Float[np.ndarray, "time 3"],
    goal: Float[np.ndarray, "time 3"],
    time: Float[np.ndarray, " time"],
) -> Float[np.ndarray, " time"]:
    """Length of an error's component perpendicular to the recent motion of the goal [m]."""
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
    """Number of samples within the largest lag; repeated times do not count."""
    steps = np.diff(np.unique(time))
    return round(_LAG / float(np.median(steps))) if len(steps) else 0
