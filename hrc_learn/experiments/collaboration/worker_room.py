"""What room an arm leaves a worker who reaches under it: free volume, and the posture it takes.

Both are of the arm alone, at the moments at which he has a hand at a marker. Where he stands
and how he leans is looked for anew, so that arms can be compared whatever he did there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Box
from hrc_learn.kinematics import CapsuleArm, separation
from hrc_learn.sim import WorkerVisit
from hrc_learn.sim.worker import Posture
from hrc_learn.viz import LoggedSteps

CLEAR = 0.05
"""Distance from the arm that a posture has to leave [m]: intrusion beyond the capsules of body
and arm, as in the clearance of the protective distance."""
_HAND = 0.10
"""Distance from the arm from which on a place is free for a hand [m]: its half breadth and
`CLEAR`."""
_GRID = 0.02
"""Of the places that are counted [m]."""
_ABOVE = 0.40
"""Height over the bench up to which they are [m]: that of an elbow over a hand on the bench."""
_AROUND = (0.25, 0.20)
"""How far they are around what the arm is at work above [m]: where the markers lie."""
_ASIDE = np.linspace(-0.45, 0.45, 13)
"""Places along the bench that are tried, from where he stands [m]: a step to either side."""
_LEANS = np.deg2rad(np.arange(0.0, 66.0, 3.0))
"""Leans that are tried [rad], up to where only the pelvis bends any further."""


@dataclass(frozen=True, kw_only=True)
class ReachRoom:
    """What room there is while a hand is at a marker."""

    time: float
    """[s]"""
    free_volume: float
    """Over the bench around the marker, for a hand [m^3]."""
    lean: float
    """Of the trunk in the least awkward posture that reaches the marker and keeps clear of the
    arm [rad]; NaN if none does. Ergonomics take up to 20 degrees for comfortable (RULA's first
    step: McAtamney and Corlett 1993)."""


def reach_rooms(
    log: LoggedSteps,
    visit: WorkerVisit,
    arm: CapsuleArm,
    over: Box,
    encoder_offset: Float[np.ndarray, " joints"],
) -> list[ReachRoom]:
    """One for each marker that was reached for during a run.

    Args:
        log: Of the run.
        visit: Of the worker.
        arm: Capsules of arm and tool.
        over: Where room is wanted (`over_bench`).
        encoder_offset: What the joint positions of the log are too large by [rad].
    """
    rooms = []
    for marker, (begin, end) in zip(visit.markers, visit.reaches, strict=True):
        k = int(np.searchsorted(log["time"], (begin + end) / 2))
        if k == len(log["time"]):
            continue
        q = torch.from_numpy(log["joint_position"][k] - encoder_offset)
        rooms.append(
            ReachRoom(
                time=float(log["time"][k]),
                free_volume=free_volume(arm, q, over),
                lean=least_lean(arm, q, visit, marker),
            )
        )
    return rooms


def over_bench(centre: tuple[float, float], top: float) -> Box:
    """The box in which room is counted.

    Args:
        centre: Of what the arm is at work above [m].
        top: Height of the bench [m].
    """
    half = (*_AROUND, _ABOVE / 2)
    return Box(centre=(*centre, top + _ABOVE / 2), half_size=half)


def free_volume(arm: CapsuleArm, joint_position: Float[Tensor, " joints"], over: Box) -> float:
    """Volume of a box in which a hand keeps clear of an arm [m^3].

    Args:
        arm: Capsules of arm and tool.
        joint_position: [rad]
        over: The box.
    """
    axes = [
        torch.arange(c - h + _GRID / 2, c + h, _GRID, dtype=torch.float64)
        for c, h in zip(over.centre, over.half_size, strict=True)
    ]
    points = torch.cartesian_prod(*axes)
    ends = points[:, None, :].expand(-1, 2, 3)
    distance = separation(arm, joint_position, ends, points.new_zeros(len(points))).distance
    return float((distance.amin(0) >= _HAND).sum()) * _GRID**3


def least_lean(
    arm: CapsuleArm,
    joint_position: Float[Tensor, " joints"],
    visit: WorkerVisit,
    marker: Float[np.ndarray, "3"],
) -> float:
    """How far a worker has to lean to reach a marker and keep clear of an arm [rad].

    From the best place along the bench, with either hand; NaN if there is no such posture.

    Args:
        arm: Capsules of arm and tool.
        joint_position: [rad]
        visit: Who, and where he stands at the bench.
        marker: Where a hand has to be [m].
    """
    worker = visit.worker
    standing = visit.posture(np.array(visit.released))
    heading = float(standing.heading)
    forward = np.array([np.cos(heading), np.sin(heading)])
    aside = np.array([-forward[1], forward[0]])
    found = []
    for step in _ASIDE:
        place = standing.place + step * aside
        relative = marker[:2] - place
        own = np.array([relative @ forward, relative @ aside, marker[2] - worker.config.floor])
        for side in (0, 1):
            needed = worker.lean_to(own, side)
            if needed is not None:
                leans = _LEANS[needed <= _LEANS]
                found += [(place, lean, side, own) for lean in leans]
    if not found:
        return float("nan")
    places, leans, sides, hands = (np.array(each) for each in zip(*found, strict=True))
    rest = worker.hanging_hands()
    both = np.repeat(rest[None], len(found), axis=0)
    both[np.arange(len(found)), sides] = hands
    zero = np.zeros(len(found))
    postures = Posture(
        place=places,
        heading=np.full(len(found), heading),
        lean=leans,
        stride=zero,
        swing=zero,
        hands=both,
    )
    ends = torch.from_numpy(worker.ends(postures))
    radius = torch.from_numpy(worker.radius).expand(len(found), -1)
    q = joint_position.expand(len(found), -1)
    distance = separation(arm, q, ends, radius).distance.amin((-2, -1)).numpy()
    clear = leans[distance >= CLEAR]
    return float(clear.min()) if len(clear) else float("nan")
