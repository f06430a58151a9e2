"""A scripted person who draws, alone and beside another."""

import numpy as np
import pytest

from hrc_learn.kinematics import panda
from hrc_learn.protocols import ArmState, DrawnRegion
from hrc_learn.teleoperation import (
    CombinedInput,
    DrawnInterval,
    ScriptedDrawing,
    ScriptedForce,
    ScriptedPerturbation,
)

BOX = DrawnRegion(centre=(0.3, 0.4, 0.3), half_size=(0.1, 0.1, 0.1))
SCRIPT = (
    DrawnInterval(start=1.0, duration=2.0, region=BOX),
    DrawnInterval(start=2.0, duration=2.0, target=(0.3, 0.4, 0.35), turn=(0.1, 0.0, 0.0)),
    DrawnInterval(start=2.0, duration=9.0, turn=(0.0, 0.2, 0.0)),
)


def at(time):
    q = panda.ready.numpy()
    return ArmState(time=time, joint_position=q, joint_velocity=0 * q, gripper_width=0.08)


def test_everything_is_drawn_in_its_interval():
    person = ScriptedDrawing(SCRIPT)
    asked = [person.read(at(t)) for t in (0.9, 1.0, 2.5, 3.0, 4.0, 12.0)]
    assert [a.region for a in asked] == [None, BOX, BOX, None, None, None]
    assert [a.target is not None for a in asked] == [False, False, True, True, False, False]
    first, second = (0.1, 0.0, 0.0), (0.0, 0.2, 0.0)
    assert [a.turn for a in asked] == [None, None, first, first, second, None]
    assert not any(a.twist.any() or a.effort(7).any() for a in asked)


def test_one_draws_while_another_pulls():
    pull = ScriptedForce(start=0.0, duration=9.0, towards=(0.0, 1.0, 0.5))
    puller = ScriptedPerturbation(panda, [pull])
    both = CombinedInput(puller, ScriptedDrawing(SCRIPT)).read(at(2.5))
    assert (both.region, both.target, both.turn) == (BOX, (0.3, 0.4, 0.35), (0.1, 0.0, 0.0))
    np.testing.assert_array_equal(both.nullspace_input, puller.read(at(2.5)).nullspace_input)


def test_an_interval_has_a_duration():
    with pytest.raises(ValueError, match="duration must be positive"):
        DrawnInterval(start=1.0, duration=0.0)
