"""Quantities that several experiments measure, from log and contacts."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import panda
from hrc_learn.sim import Touch, World
from hrc_learn.skills.pick_and_place import INTERACT
from hrc_learn.skills.work_cell import WorkCell
from hrc_learn.vision import CameraModel
from hrc_learn.viz import LoggedSteps

ELBOW, TOOL = 3, 8
"""Frames of the elbow and of the tool among the links."""


def spans(log: LoggedSteps, phase: str) -> list[tuple[float, float]]:
    """Start and end of each time a phase was entered [s]; infinite is the end of the last."""
    events = log.events
    return [
        (event.time, math.inf if following is None else following.time)
        for event, following in zip(events, [*events[1:], None], strict=True)
        if event.text == phase
    ]


def span(log: LoggedSteps, phase: str) -> tuple[float, float]:
    """Start and end of the first time a phase was entered [s]; empty if it never was."""
    return next(iter(spans(log, phase)), (0.0, 0.0))


def true_image_jacobian(
    log: LoggedSteps, world: World, cameras: Sequence[tuple[float, CameraModel]]
) -> Float[np.ndarray, "time 2 6"]:
    """True image Jacobian of the gripper's marker wherever the controller used its estimate.

    Args:
        log: The run's.
        world: Knows where the marker is on the gripper.
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
    """How far end effector and elbow moved while a person pushed; NaN at other times."""

    position: Float[np.ndarray, " time"]
    """Of the end effector [m]."""
    rotation: Float[np.ndarray, " time"]
    """Of the end effector [rad]."""
    elbow: Float[np.ndarray, " time"]
    """Of the elbow [m]."""

    @classmethod
    def of(cls, log: LoggedSteps) -> "Deviation":
        """From the first null-space force until the time left to the person is over."""
        time = log["time"]
        start, end = span(log, INTERACT)
        within = (time >= start) & (time < end)
        pushed = within & (np.abs(log["human_effort"]).max(axis=1) > 0)
        first = int(pushed.argmax()) if pushed.any() else 0
        rows = within & (np.arange(len(time)) >= first) & bool(pushed.any())
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
    def largest_position(self) -> float:
        """Largest displacement of the end effector [m]; 0 if nobody pushed."""
        return _largest(self.position)

    @property
    def largest_rotation(self) -> float:
        """Largest rotation of the end effector [rad]; 0 if nobody pushed."""
        return _largest(self.rotation)

    @property
    def largest_elbow(self) -> float:
        """Largest displacement of the elbow [m]; 0 if nobody pushed."""
        return _largest(self.elbow)


def _largest(values: Float[np.ndarray, " time"]) -> float:
    return float(np.nanmax(values)) if np.isfinite(values).any() else 0.0


def limit_violations(cell: WorkCell) -> int:
    """Steps in which a joint was measured outside its range of position or velocity."""
    if not len(cell.log):
        return 0
    q = torch.from_numpy(cell.log["joint_position"])
    v = torch.from_numpy(cell.log["joint_velocity"])
    limits = panda.limits
    outside = (q < limits.lower) | (q > limits.upper) | (v.abs() > limits.velocity)
    return int(outside.any(dim=-1).sum())


def unwanted_contacts(
    world: World, released: Mapping[str, float] | None = None
) -> dict[str, tuple[Touch, ...]]:
    """Contacts of the arm and of what it carried, by what was met.

    Args:
        world: As the run left it.
        released: When each object was let go on its shelf [s]: what it touches from then on is
            wanted.
    """
    released = released or {}
    carried = [
        touch
        for touch in world.object_contacts.touches
        if touch.start < released.get(touch.first, math.inf)
    ]
    return {
        "cabinet": (*world.cabinet_contacts.touches, *carried),
        "table": tuple(world.table_contacts.touches),
        "arm itself": tuple(world.self_contacts.touches),
    }
