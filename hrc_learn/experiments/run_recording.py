"""The recording of a run: what was logged and what the simulator knows, to be looked at."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from hrc_learn.demos import Demonstration
from hrc_learn.experiments.run_measures import (
    TOOL,
    Deviation,
    link_poses,
    spans,
    true_image_jacobian,
)
from hrc_learn.geometry import Box
from hrc_learn.kinematics import panda
from hrc_learn.sim import MotionLog, World
from hrc_learn.skills.pick_and_place import TRANSFER
from hrc_learn.skills.placing import Plan
from hrc_learn.skills.work_cell import SAFETY_COLUMNS, WorkCell
from hrc_learn.vision import CameraModel
from hrc_learn.viz import CameraRecording, JointLimits, LoggedSteps, RunRecording

PANDA_LIMITS = JointLimits(lower=panda.limits.lower.numpy(), upper=panda.limits.upper.numpy())
"""To be drawn beside joint positions."""


def record(
    title: str,
    cell: WorkCell,
    world: World,
    motion: MotionLog,
    *,
    plans: Sequence[Plan] = (),
    cameras: Sequence[tuple[float, CameraModel]] = (),
    region: Box | None = None,
    demonstration: Demonstration | None = None,
) -> RunRecording:
    """Record a run of a work cell, finished or still going on.

    Args:
        title: Of the recording.
        cell: The work cell that ran it.
        world: The world that it ran in; knows what only a simulator can know.
        motion: Poses of everything that moved.
        plans: Motions to the shelves, one for each transfer that was begun.
        cameras: The true cameras, and from when on each watched [s]; the world's when none.
        region: Box above the table in which the vision region takes over.
        demonstration: One that the motion was learned from.
    """
    # Another thread may ask while the loop goes on: take the steps that both logs have.
    log = cell.log.snapshot(len(motion))
    time, safety = log["time"], log["safety"]
    images = tuple(cell.images)
    deviation = Deviation.of(log)
    cameras = cameras or ((-math.inf, world.config.camera),)
    return RunRecording(
        title=title,
        time=time,
        joint_names=panda.joint_names,
        joint_position=log["joint_position"],
        joint_limits=PANDA_LIMITS,
        demo_joint_position=_matching_demonstration(log, plans, demonstration),
        position=link_poses(log).position[:, TOOL].numpy(),
        demo_path=None if demonstration is None else demonstration.position,
        plan_path=_paths(plans),
        bodies=motion.bodies(len(log)),
        boxes=tuple(world.config.boxes()),
        region=region,
        camera=CameraRecording(
            model=cameras[-1][1],
            feature=log["feature"],
            target=log["target"],
            image_time=np.array([kept.time for kept in images]),
            images=tuple(kept.image for kept in images),
        ),
        image_jacobian=log["image_jacobian"],
        true_image_jacobian=true_image_jacobian(log, world, cameras),
        weight_norm=log["weight_norm"],
        potentials={"task space": log["potential"]},
        potential_rate=log["potential_rate"],
        human_effort=log["human_effort"],
        elbow_motion=deviation.elbow,
        position_deviation=deviation.position,
        rotation_deviation=deviation.rotation,
        safety={name: safety[:, i] for i, name in enumerate(SAFETY_COLUMNS)},
        phases=tuple(log.events),
    )


def _paths(plans: Sequence[Plan]) -> Float[np.ndarray, "samples 3"] | None:
    """Path of the end effector along all plans; it backs out of a shelf the way it went in."""
    paths = [plan.tool_pose.position.numpy() for plan in plans]
    return np.concatenate([np.vstack([path, path[::-1]]) for path in paths]) if paths else None


def _matching_demonstration(
    log: LoggedSteps, plans: Sequence[Plan], demonstration: Demonstration | None
) -> Float[np.ndarray, "time joints"] | None:
    """Demonstrated joints at the same fraction of the transfer, NaN elsewhere [rad]."""
    if not plans or demonstration is None or demonstration.joint_position is None:
        return None
    time = log["time"]
    matching = np.full_like(log["joint_position"], np.nan)
    for plan, (start, end) in zip(plans, spans(log, TRANSFER), strict=False):
        rows = (time >= start) & (time < end)
        fraction = (time[rows] - start) / plan.duration * demonstration.duration
        for joint, demonstrated in enumerate(demonstration.joint_position.T):
            matching[rows, joint] = np.interp(fraction, demonstration.time, demonstrated)
    return matching
