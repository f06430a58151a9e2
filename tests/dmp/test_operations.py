"""Operations that PyTorch carries out, which no load on the machine changes."""

import math
from typing import Any

import pytest
import torch
from demo_motions import minimum_jerk
from operations import count_operations
from unchecked import shapes_unchecked

from hrc_learn.dmp import JointDMP, OrientationDMP, PoseDMP
from hrc_learn.geometry import Pose, quaternion

S = torch.linspace(0, 1, 200, dtype=torch.float64)
COLUMNS = minimum_jerk(S)[:, None] * torch.tensor([0.4, -0.2, 0.1], dtype=torch.float64)
TURNED = quaternion.exp(COLUMNS)
ASIDE = torch.tensor([math.cos(0.1), 0.0, math.sin(0.1), 0.0], dtype=torch.float64)


@pytest.mark.parametrize("kind", ["joint", "orientation", "pose"])
def test_a_new_goal_adds_few_operations_to_a_step(kind):
    dmp, goal = {
        "joint": lambda: (JointDMP.fit(2 * S, COLUMNS, 20), COLUMNS[-1] + 0.1),
        "orientation": lambda: (OrientationDMP.fit(2 * S, TURNED, 20), ASIDE),
        "pose": lambda: (PoseDMP.fit(2 * S, COLUMNS, TURNED, 20), Pose(COLUMNS[-1], ASIDE)),
    }[kind]()
    with torch.no_grad(), shapes_unchecked():
        state = dmp.step(dmp.initial_state(), 0.5)
        without = count_operations(lambda: dmp.step(state, 1e-3))
        new = count_operations(lambda: dmp.step(state, 1e-3, goal=goal))
    assert new <= 1.4 * without


def test_own_durations_take_few_operations():
    """A batch on ragged times moves no coefficients in memory and evaluates no approach."""
    position = COLUMNS.float() * torch.linspace(1, 2, 5)[:, None, None]
    dmp = JointDMP.fit(2 * S, position, 20)
    duration = torch.linspace(2, 4, 5)
    with torch.no_grad(), shapes_unchecked():
        count = count_operations(lambda: dmp.rollout(2 * S, duration=duration).position)
    assert count <= 90


def test_a_wrong_goal_of_one_motion_is_named():
    """The shortcut for one motion in plain numbers leaves wrong goals to the general one."""
    pose = PoseDMP.fit(2 * S, COLUMNS, TURNED, 20)
    orientation = OrientationDMP.fit(2 * S, TURNED, 20)
    place, far = COLUMNS[-1], COLUMNS[-1] * math.nan
    cases: list[tuple[Any, Any, str]] = [
        (pose, Pose(far, ASIDE), "position of goal must be finite"),
        (pose, Pose(place, 0 * ASIDE), "must be unit quaternions"),
        (pose, ASIDE, "must be a Pose"),
        (orientation, Pose(place, ASIDE), "unit quaternions|Pose"),
        (orientation, place, "must be unit quaternions"),
    ]
    with torch.no_grad(), shapes_unchecked():
        for dmp, goal, message in cases:
            with pytest.raises((ValueError, TypeError), match=message):
                dmp.step(dmp.initial_state(), 1e-3, goal=goal)
