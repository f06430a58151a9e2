"""From what a station logged, and what the simulator knows, to a recording to look at."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from .. import viz
from ..demos import Demonstration
from ..geometry import Pose, quaternion
from ..kinematics import panda
from ..sim import MotionLog, World
from ..viz import LoggedSteps
from .collaboration import INTERACT, TRANSFER
from .placing import Plan
from .station import SAFETY_COLUMNS, Station

ELBOW, TOOL = 3, 8
"""Frames of the elbow and of the tool among the links."""


def record(
    title: str,
    station: Station,
    world: World,
    motion: MotionLog,
    *,
    plan: Plan | None = None,
    region: viz.Box | None = None,
    demonstration: Demonstration | None = None,
) -> viz.RunRecording:
    """Everything worth looking at in a run of the collaboration, over or still going on.

    Args:
        title: What it was.
        station: That ran it.
        world: That it ran in; tells what only a simulator knows.
        motion: Where everything was.
        plan: The way to the shelf, if it came to that.
        region: Box above the table in which the camera takes over.
        demonstration: One that the way was learned from.
    """
    # Another thread may ask while the loop goes on: both logs as far as both have come.
    log = station.log.snapshot(len(motion))
    time, safety = log["time"], log["safety"]
    images = tuple(station.images)
    deviation = Deviation.of(log)
    limits = panda.limits
    return viz.RunRecording(
        title=title,
        time=time,
        joint_names=panda.joint_names,
        joint_position=log["joint_position"],
        joint_limits=viz.JointLimits(lower=limits.lower.numpy(), upper=limits.upper.numpy()),
        demo_joint_position=_matching_demonstration(log, plan, demonstration),
        position=link_poses(log).position[:, TOOL].numpy(),
        demo_path=None if demonstration is None else demonstration.position,
        plan_path=None if plan is None else plan.hand.position.numpy(),
        bodies=motion.bodies(len(log)),
        boxes=tuple(world.config.boxes()),
        region=region,
        camera=viz.CameraRecording(
            model=world.config.camera,
            feature=log["feature"],
            target=log["target"],
            image_time=np.array([kept.time for kept in images]),
            images=tuple(kept.image for kept in images),
        ),
        image_jacobian=log["image_jacobian"],
        true_image_jacobian=true_image_jacobian(log, world),
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


def span(log: LoggedSteps, phase: str) -> tuple[float, float]:
    """Start and end of the first time a phase was entered [s].

    Infinite is the end of the last one, and empty the span of one that never was.
    """
    events = log.events
    for event, following in zip(events, [*events[1:], None], strict=True):
        if event.text == phase:
            return event.time, math.inf if following is None else following.time
    return 0.0, 0.0


def _matching_demonstration(
    log: LoggedSteps, plan: Plan | None, demonstration: Demonstration | None
) -> Float[np.ndarray, "time joints"] | None:
    """Demonstrated joints at the same share of the way to the shelf, NaN elsewhere [rad]."""
    if plan is None or demonstration is None or demonstration.joint_position is None:
        return None
    time = log["time"]
    start, end = span(log, TRANSFER)
    share = (time - start) / plan.duration * demonstration.duration
    joints = np.column_stack(
        [np.interp(share, demonstration.time, q) for q in demonstration.joint_position.T]
    )
    return np.where(((time >= start) & (time < end))[:, None], joints, np.nan)


def true_image_jacobian(log: LoggedSteps, world: World) -> Float[np.ndarray, "time 2 6"]:
    """True image Jacobian of the hand's marker wherever the controller used its estimate."""
    used = np.isfinite(log["image_jacobian"]).all(axis=(1, 2))
    jacobian = np.full_like(log["image_jacobian"], np.nan)
    tool = link_poses(log)[torch.from_numpy(used), TOOL]
    marker = tool.apply(torch.from_numpy(world.hand_marker_offset())).numpy()
    jacobian[used] = world.config.camera.image_jacobian(marker, tool.position.numpy())
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
