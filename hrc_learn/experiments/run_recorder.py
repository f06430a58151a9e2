"""Recording of a simulated run, and its live dashboard."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.controller import INTERVENTIONS
from hrc_learn.demos import Demonstration
from hrc_learn.experiments.run_measures import (
    Deviation,
    spans,
    true_image_jacobian,
    true_tool,
    worker_distance,
)
from hrc_learn.experiments.simulated_cell import LiveView
from hrc_learn.geometry import Box
from hrc_learn.geometry.numerics import null_projection
from hrc_learn.kinematics import SerialChain
from hrc_learn.log import CameraRecording, JointRanges, LoggedSteps, RunRecording
from hrc_learn.protocols import HINDRANCES
from hrc_learn.sim import MotionLog, World
from hrc_learn.skills.pick_and_place import INTERACT, TRANSFER
from hrc_learn.skills.placing import Plan
from hrc_learn.skills.work_cell import WorkCell
from hrc_learn.vision import CameraModel

# Joint, counted from 1, whose frame is at the elbow of an arm with seven joints: the person
# takes hold of the arm there (paper, Experiment 3).
_PUSHED = 4
# Null-space input below which nobody pushes [N m], and length of the arrow of a push [m].
_NO_PUSH, _ARROW = 0.5, 0.45


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
    """Record a run of a work cell, finished or not.

    Args:
        title: Title of the recording.
        cell: Work cell of the run.
        world: World of the run, with everything that only a simulator knows.
        motion: True poses of everything that moved.
        plans: Motion to the shelf of each transfer that began.
        cameras: True cameras, each with the time from which it watched [s]; by default that
            of the world.
        region: Box above the table in which the vision region takes over.
        demonstration: Demonstration that the motion was learned from.
    """
    # Another thread may call this while the loop runs: take the steps that both logs have.
    log = cell.log.snapshot(len(motion))
    time, safety = log["time"], log["safety"]
    images = tuple(cell.images)
    if spans(log, INTERACT):
        deviation = Deviation.of(log, motion, world)
    else:
        deviation = Deviation.from_path(log, cell.chain)
    # The end effector retreats from a shelf on the path of its approach.
    paths = [plan.tool_pose.position.numpy() for plan in plans]
    plan_paths = [np.vstack([path, path[::-1]]) for path in paths]
    cameras = cameras or ((-math.inf, world.config.camera),)
    return RunRecording(
        title=title,
        time=time,
        joint_names=cell.chain.joint_names,
        joint_position=log["joint_position"],
        joint_velocity=log["joint_velocity"],
        joint_limits=joint_ranges(cell.chain),
        demo_joint_position=_matching_demonstration(log, plans, demonstration),
        position=true_tool(motion, world, len(log)).position.numpy(),
        demo_path=None if demonstration is None else demonstration.position,
        plan_path=np.concatenate(plan_paths) if plan_paths else None,
        bodies=motion.bodies(len(log)),
        boxes=tuple(world.config.boxes()),
        region=region,
        active_region=log["region"],
        drawn=log["drawn"],
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
        nullspace_input=log["nullspace_input"],
        push=push_arrows(cell.chain, log["joint_position"], log["nullspace_input"]),
        followed=log["followed"],
        hindered={name: log["hindered"][:, i] for i, name in enumerate(HINDRANCES)},
        elbow_motion=deviation.elbow,
        position_deviation=deviation.position,
        rotation_deviation=deviation.rotation,
        **_worker_fields(motion, log),
        safety={name: safety[:, i] for i, name in enumerate(INTERVENTIONS)},
        phases=tuple(log.events),
        remarks=tuple(cell.remarks),
    )


def joint_ranges(chain: SerialChain) -> JointRanges:
    """Limits of an arm, to be drawn with its joint positions."""
    limits = chain.limits
    return JointRanges(
        lower=limits.lower.numpy(),
        upper=limits.upper.numpy(),
        velocity=limits.velocity.numpy(),
    )


def push_arrows(
    chain: SerialChain,
    joint_position: Float[np.ndarray, "time joints"],
    nullspace_input: Float[np.ndarray, "time joints"],
) -> Float[np.ndarray, "time 2 3"]:
    """Arrows from the elbow in the direction of a person's push [m]; NaN without a push.

    Args:
        chain: Kinematics of the arm.
        joint_position: Joint positions [rad].
        nullspace_input: Null-space input of the person on each joint [N m].
    """
    points = np.full((len(joint_position), 2, 3), np.nan)
    rows = np.abs(nullspace_input).max(axis=1, initial=0.0) > _NO_PUSH
    if len(chain.joint_names) < _PUSHED or not rows.any():
        return points
    q, d = torch.from_numpy(joint_position[rows]), torch.from_numpy(nullspace_input[rows])
    velocity = null_projection(chain.jacobian(q), d)
    direction = (chain.joint_jacobian(q, _PUSHED)[..., :3, :] @ velocity[..., None])[..., 0]
    elbow = chain.joint_origins(q)[..., _PUSHED - 1, :]
    tip = elbow + _ARROW * torch.nn.functional.normalize(direction, dim=-1)
    points[rows] = torch.stack([elbow, tip], dim=-2).numpy()
    return points


def _worker_fields(motion: MotionLog, log: LoggedSteps) -> dict[str, Any]:
    """Fields of a recording about the worker; none without a worker."""
    nearest = motion.nearest(len(log))
    if not nearest:
        return {}
    distance = {"true": worker_distance(motion, len(log))}
    if "person_distance" in log:
        distance["seen by the robot"] = log["person_distance"]
        distance["protective distance"] = log["protective_distance"]
    points = np.stack([pair.points for pair in nearest])
    return {"worker_distance": distance, "worker_nearest": points}


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
        fraction = (time[rows] - start) / plan.duration
        matching[rows] = demonstrated_joints(demonstration, fraction)
    return matching


def demonstrated_joints(
    demonstration: Demonstration, fraction: Float[np.ndarray, " samples"]
) -> Float[np.ndarray, "samples joints"]:
    """Demonstrated joint positions at fractions of the motion, 0 to 1 [rad]."""
    assert demonstration.joint_position is not None
    time = demonstration.time[0] + fraction * demonstration.duration
    columns = demonstration.joint_position.T
    return np.column_stack([np.interp(time, demonstration.time, joint) for joint in columns])


@dataclass(frozen=True, kw_only=True)
class LiveViewConfig:
    """Port and rate of the live dashboard of a run."""

    port: int = 9090
    """Port of the page."""
    period: float = 0.25
    """Time between two updates [s]."""


def live_view(title: str, config: LiveViewConfig, on_open: Callable[[str], None]) -> LiveView:
    """Serve the dashboard of a run on a page of its own.

    The loop pays for its log only: another thread makes and sends recordings of the run so
    far. A page that is open when the run ends keeps its content.

    Args:
        title: Title of the dashboard.
        config: Port and rate.
        on_open: Called with the address of the page.
    """

    @contextmanager
    def watch(cell: WorkCell, world: World, motion: MotionLog) -> Iterator[None]:
        # Rerun takes a second to import.
        from hrc_learn.teleoperation.dashboard_page import serve_stream
        from hrc_learn.viz.run_dashboard import live_dashboard

        def snapshot() -> RunRecording | None:
            return record(title, cell, world, motion) if len(motion) else None

        with serve_stream(config.port) as server:
            on_open(server.viewer)
            with live_dashboard(server.stream, snapshot, period=config.period):
                yield

    return watch
