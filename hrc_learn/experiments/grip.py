"""How an object was grasped and hung in the hand, from the simulator's poses and contacts."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.experiments.run_recording import body_poses, true_tool
from hrc_learn.geometry import quaternion
from hrc_learn.log import LoggedSteps
from hrc_learn.sim import MotionLog, World

# How an object is to be held: its x axis along the fingers' line of closing, which is the
# hand's y axis, its top towards the palm.
_IN_HAND = quaternion.from_matrix(
    torch.tensor([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]], dtype=torch.float64)
)


class Hold(NamedTuple):
    """How an object hung in the hand while it was carried."""

    tilt: float
    """Largest angle from how it was to be held [rad]."""
    slip: float
    """How far it moved between the fingers [m]."""


def hold(
    log: LoggedSteps, motion: MotionLog, world: World, name: str, start: float, end: float
) -> Hold:
    """From the beginning and the end of the time in which an object was carried.

    Args:
        log: The run's.
        motion: Poses of everything that moved.
        world: That it ran in.
        name: Of the object.
        start: When it had been lifted [s].
        end: Before it was let go [s]; at most the end of the run.
    """
    steps = np.searchsorted(log["time"], [start, end]).clip(max=len(log) - 1)
    tool, item = true_tool(motion, world, len(log)), body_poses(motion, name, len(log))
    hand, held = tool[torch.from_numpy(steps)], item[torch.from_numpy(steps)]
    back = quaternion.conjugate(hand.orientation)
    away = quaternion.rotate(back, held.position - hand.position)
    return Hold(
        tilt=float(box_angle(quaternion.multiply(back, held.orientation), _IN_HAND).max()),
        slip=float((away[1] - away[0]).norm()),
    )


def grasp_offset(
    log: LoggedSteps, motion: MotionLog, world: World, name: str, descent: float
) -> float:
    """Horizontal distance of end effector and object when the last descent began [m].

    Args:
        log: The run's.
        motion: Poses of everything that moved.
        world: That it ran in.
        name: Of the object.
        descent: When it began [s].
    """
    step = int(np.searchsorted(log["time"], descent))
    tool, item = true_tool(motion, world, len(log)), body_poses(motion, name, len(log))
    return float((tool.position - item.position)[step, :2].norm())


def place_angle(pose: Float[np.ndarray, "4 4"], goal: Float[Tensor, "4"]) -> float:
    """Angle of a box from how it should stand, that of the hand at its goal given [rad]."""
    q = quaternion.from_matrix(torch.from_numpy(pose[:3, :3].copy()))
    return float(box_angle(q, quaternion.multiply(goal, _IN_HAND)))


def box_angle(
    q: Float[Tensor, "*batch 4"], goal: Float[Tensor, "4"]
) -> Float[Tensor, "*batch"]:
    """Angle between orientations of a box that may be turned by half about its z axis [rad]."""
    half = q.new_tensor([0.0, 0.0, 0.0, 1.0])
    other = quaternion.multiply(q, half)
    return torch.minimum(quaternion.angle(q, goal), quaternion.angle(other, goal))
