"""For how long the hand's marker was out of sight where it should have been seen."""

import numpy as np
import torch

from ..geometry import Pose
from ..kinematics import panda
from ..viz import StepLog

_NEAR = 0.22
"""Distance of the hand from the middle of the table within which it should be seen [m]."""


def longest_unseen(log: StepLog, middle: Pose, since: float) -> float:
    """Longest spell in which the marker was not seen while the hand was over the table [s].

    Args:
        log: Of a station.
        middle: Of the hand above the middle of the table.
        since: Steps from this time on count [s].
    """
    time = log["time"]
    rows = time >= since
    hand = panda.forward(torch.from_numpy(log["joint_position"][rows])).position
    over = ((hand - middle.position).norm(dim=-1) < _NEAR).numpy()
    unseen = over & np.isnan(log["feature"][rows, 0])
    # Steps of each spell, by where it begins and ends.
    edges = np.flatnonzero(np.diff(np.concatenate([[False], unseen, [False]]).astype(int)))
    steps = edges[1::2] - edges[::2]
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    return float(steps.max()) * step if len(steps) else 0.0
