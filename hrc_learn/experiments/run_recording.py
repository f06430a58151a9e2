"""What a run logged, as a recording to look at, afterwards or while it goes on."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.demos import Demonstration
from hrc_learn.geometry import Box, Pose, quaternion
from hrc_learn.kinematics import panda
from hrc_learn.sim import MotionLog, World
from hrc_learn.skills.pick_and_place import INTERACT, TRANSFER
from hrc_learn.skills.placing import Plan
from hrc_learn.skills.work_cell import SAFETY_COLUMNS, WorkCell
from hrc_learn.vision import CameraModel
from hrc_learn.viz import CameraRecording, JointLimits, LoggedSteps, RunRecording

# From what a work cell logged, and what the simulator knows, to a recording to look at.

ELBOW, TOOL = 3, 8
"""Frames of the elbow and of the tool among the links."""


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
    """Everything worth looking at in a run of the collaboration, over or still going on.

    Args:
        title: What it was.
        cell: That ran it.
        world: That it ran in; tells what only a simulator knows.
        motion: Where everything was.
        plans: The ways to the shelves, in turn, as far as it came to that.
        cameras: The true cameras, and from when on each watched [s]; the world's when none.
        region: Box above the table in which the camera takes over.
        demonstration: One that the way was learned from.
    """
    # Another thread may ask while the loop goes on: both logs as far as both have come.
    log = cell.log.snapshot(len(motion))
    time, safety = log["time"], log["safety"]
    images = tuple(cell.images)
    deviation = Deviation.of(log)
    cameras = cameras or ((-math.inf, world.config.camera),)
    limits = panda.limits
    return RunRecording(
        title=title,
        time=time,
        joint_names=panda.joint_names,
        joint_position=log["joint_position"],
        joint_limits=JointLimits(lower=limits.lower.numpy(), upper=limits.upper.numpy()),
        demo_joint_position=_matching_demonstration(log, plans, demonstration),
        position=link_poses(log).position[:, TOOL].numpy(),
        demo_path=None if demonstration is None else demonstration.position,
        plan_path=_there_and_back(plans),
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


def spans(log: LoggedSteps, phase: str) -> list[tuple[float, float]]:
    """Start and end of each time a phase was entered [s]; infinite is the end of the last."""
    events = log.events
    return [
        (event.time, math.inf if following is None else following.time)
        for event, following in zip(events, [*events[1:], None], strict=True)
        if event.text == phase
    ]


def span(log: LoggedSteps, phase: str) -> tuple[float, float]:
    """The first of them; empty if there is none."""
    return next(iter(spans(log, phase)), (0.0, 0.0))


def _there_and_back(plans: Sequence[Plan]) -> Float[np.ndarray, "samples 3"] | None:
    """Path of the hand along all plans; it backs out of a shelf the way it went in."""
    paths = [plan.tool_pose.position.numpy() for plan in plans]
    return np.concatenate([np.vstack([path, path[::-1]]) for path in paths]) if paths else None


def _matching_demonstration(
    log: LoggedSteps, plans: Sequence[Plan], demonstration: Demonstration | None
) -> Float[np.ndarray, "time joints"] | None:
    """Demonstrated joints at the same share of the way to the shelf, NaN elsewhere [rad]."""
    if not plans or demonstration is None or demonstration.joint_position is None:
        return None
    time = log["time"]
    matching = np.full_like(log["joint_position"], np.nan)
    for plan, (start, end) in zip(plans, spans(log, TRANSFER), strict=False):
        rows = (time >= start) & (time < end)
        share = (time[rows] - start) / plan.duration * demonstration.duration
        for joint, shown in enumerate(demonstration.joint_position.T):
            matching[rows, joint] = np.interp(share, demonstration.time, shown)
    return matching


def true_image_jacobian(
    log: LoggedSteps, world: World, cameras: Sequence[tuple[float, CameraModel]]
) -> Float[np.ndarray, "time 2 6"]:
    """True image Jacobian of the hand's marker wherever the controller used its estimate.

    Args:
        log: Of the run.
        world: That knows where the marker is on the hand.
        cameras: The true ones, and from when on each watched [s].
    """
    used = np.isfinite(log["image_jacobian"]).all(axis=(1, 2))
    jacobian = np.full_like(log["image_jacobian"], np.nan)
    poses, offset = link_poses(log), torch.from_numpy(world.hand_marker_offset())
    ends = [*(start for start, _ in cameras[1:]), math.inf]
    for (start, camera), end in zip(cameras, ends, strict=True):
        rows = used & (log["time"] >= start) & (log["time"] < end)
        tool = poses[torch.from_numpy(rows), TOOL]
        marker = tool.apply(offset).numpy()
        jacobian[rows] = camera.image_jacobian(marker, tool.position.numpy())
    return jacobian


def link_poses(log: LoggedSteps) -> Pose:
    """Poses of the joint frames, the flange and the tool at every step, (time, links)."""
    return panda.link_poses(torch.from_numpy(log["joint_position"]))


@dataclass(frozen=True, kw_only=True, eq=False)
class Deviation:
    """How far hand and elbow were from where the person found them; NaN at other times."""

    position: Float[np.ndarray, " time"]
    """Of the hand [m]."""
    rotation: Float[np.ndarray, " time"]
    """Of the hand [rad]."""
    elbow: Float[np.ndarray, " time"]
    """Of the elbow [m]."""

    @classmethod
    def of(cls, log: LoggedSteps) -> "Deviation":
        """From the first pull at the body on, until the time left to the person is over."""
        time = log["time"]
        start, end = span(log, INTERACT)
        within = (time >= start) & (time < end)
        pulled = within & (np.abs(log["human_effort"]).max(axis=1) > 0)
        first = int(pulled.argmax()) if pulled.any() else 0
        rows = within & (np.arange(len(time)) >= first) & bool(pulled.any())
        links = link_poses(log)

        def distance(link: int) -> Float[np.ndarray, " time"]:
            position = links.position[:, link].numpy()
            return np.where(rows, np.linalg.norm(position - position[first], axis=1), np.nan)

        turn = links.orientation[:, TOOL]
        angle = quaternion.angle(turn, turn[first]).numpy()
        return cls(
            position=distance(TOOL),
            rotation=np.where(rows, angle, np.nan),
            elbow=distance(ELBOW),
        )

    @property
    def most_moved(self) -> float:
        """Largest distance of the hand [m]; 0 if nobody pulled."""
        return _largest(self.position)

    @property
    def most_turned(self) -> float:
        """Largest turn of the hand [rad]; 0 if nobody pulled."""
        return _largest(self.rotation)

    @property
    def elbow_most_moved(self) -> float:
        """Largest distance of the elbow [m]; 0 if nobody pulled."""
        return _largest(self.elbow)


def _largest(values: Float[np.ndarray, " time"]) -> float:
    return float(np.nanmax(values)) if np.isfinite(values).any() else 0.0


# FeatureTrajectories a run from the side while it goes on.

Watch = Callable[[WorkCell, World, MotionLog], AbstractContextManager[None]]
"""Entered once a work cell is ready to start, and left when the run is over."""


def unwatched(cell: WorkCell, world: World, motion: MotionLog) -> AbstractContextManager[None]:
    """Nobody watches."""
    return nullcontext()


@dataclass(frozen=True, kw_only=True)
class ServeConfig:
    """Where the dashboard of a run can be watched while it goes on."""

    port: int = 9090
    """Port of the page."""
    data_port: int = 9876
    """Port from which the page, or `rerun rerun+http://HOST:PORT/proxy`, gets the data."""
    period: float = 0.25
    """How often what is new is sent [s]."""


def serving(title: str, config: ServeConfig, on_open: Callable[[str], None]) -> Watch:
    """Serve the dashboard of a run on a page of its own.

    The loop pays for its log only: another thread makes and sends recordings of what the run
    is so far. A page that is open when the run ends keeps what it shows.

    Args:
        title: Of the dashboard.
        config: Where.
        on_open: Told the address of the page.
    """

    @contextmanager
    def watch(cell: WorkCell, world: World, motion: MotionLog) -> Iterator[None]:
        from hrc_learn.viz.live_dashboard import (
            live_dashboard,  # rerun takes a second
            serve_stream,
        )

        def snapshot():
            return record(title, cell, world, motion) if len(motion) else None

        with serve_stream(config.port, config.data_port) as server:
            on_open(server.viewer)
            with live_dashboard(server.stream, snapshot, period=config.period):
                yield

    return watch
