"""Demonstrations of visual servoing, of which the camera must see the object."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.marker_sensor import MarkerSensor
from hrc_learn.skills.visual_skill import OBJECT_FEATURE
from hrc_learn.teleoperation.scripted_demonstrations import (
    ServoDemonstrationConfig,
    demonstrate_servoing,
)

CORNERS = np.array([[300.0, 200.0], [310.0, 200.0], [310.0, 210.0], [300.0, 210.0]])


class Obscured(MarkerSensor):
    """A fake: sees nothing at first, then all markers in one place."""

    def __init__(self, unseen: int):
        self.unseen = unseen

    def corners(self, ids=None):
        self.unseen -= 1
        return {} if self.unseen >= 0 else dict.fromkeys(range(30), CORNERS)


CONFIG = ServoDemonstrationConfig(duration=0.4, points=1, descent=0.01)


def demonstrate(unseen: int):
    workplace = Workplace()
    world = World(workplace.scene)
    rng = np.random.default_rng(0)
    return demonstrate_servoing(world, workplace, Obscured(unseen), CONFIG, rng)


def test_an_object_that_is_not_seen_is_put_elsewhere():
    frames, rng = demonstrate(unseen=2), np.random.default_rng(0)
    for _ in range(3):
        place = Workplace().random_object_pose(CONFIG.reach, rng, CONFIG.yaw)
    # The expert ends above the third place.
    np.testing.assert_allclose(frames[-1]["position"][:2], place[:2, 3], atol=0.02)
    np.testing.assert_allclose(frames[0][OBJECT_FEATURE][:2], CORNERS.mean(0))


def test_the_gripper_turns_to_the_object_within_reach():
    workplace, rng = Workplace(), np.random.default_rng(0)
    place = workplace.random_object_pose(CONFIG.reach, rng, CONFIG.yaw)
    end, hover = demonstrate(unseen=0)[-1]["orientation"], workplace.hover().orientation
    turn = (
        Rotation.from_quat(end, scalar_first=True)
        * Rotation.from_quat(hover, scalar_first=True).inv()
    )
    yaw, low = turn.as_rotvec()[2], workplace.hover_turns[0]
    # A box looks the same after half a turn.
    expected = low + (np.arctan2(place[1, 0], place[0, 0]) - low) % np.pi
    assert abs(expected - low) > 0.3
    # The arm follows its tremor and lags by some hundredths of a radian.
    assert yaw == pytest.approx(expected, abs=0.05)


def test_a_camera_that_never_sees_it_is_said_to():
    with pytest.raises(ValueError, match=r"marker 11, wherever on the table.*move the camera"):
        demonstrate(unseen=10**6)
