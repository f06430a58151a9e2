"""The control loop of a work cell, on an arm that does as it is told."""

import numpy as np
import pytest
import torch

from hrc_learn.kinematics import panda
from hrc_learn.protocols import ArmState
from hrc_learn.skills import WorkCell, joint_line
from hrc_learn.teleoperation import ScriptedPerturbation


class ObedientArm:
    def __init__(self, q):
        self.q, self.velocity, self.time = q.copy(), np.zeros_like(q), 0.0

    def read(self):
        return ArmState(
            time=self.time,
            joint_position=self.q.copy(),
            joint_velocity=self.velocity,
            gripper_width=0.08,
        )

    def command(self, joint_velocity):
        self.velocity = joint_velocity.copy()

    def move(self, width):
        raise AssertionError("no path opens the gripper")

    def advance(self, duration):
        self.q, self.time = self.q + duration * self.velocity, self.time + duration


@pytest.fixture
def cell():
    arm, person = ObedientArm(panda.ready.numpy()), ScriptedPerturbation(panda, ())
    return WorkCell(chain=panda, arm=arm, gripper=arm, human=person, advance=arm.advance)


def test_the_joints_move_along_a_path_as_fast_as_it_runs(cell):
    far = torch.tensor([0.3, -0.2, 0.1, 0.2, -0.1, 0.3, -0.3], dtype=torch.float64)
    path = joint_line(panda.ready, panda.ready + far, speed=0.3, dt=0.01).numpy()
    assert cell.follow_path(path) == len(path)
    commanded = cell.log["command_velocity"]
    # The slope of a minimum jerk motion, by its polynomial (Flash and Hogan 1985).
    duration = 1.875 * 0.3 / 0.3  # its peak is 15/8 of its mean speed
    s = np.minimum(0.01 * np.arange(len(path)) / duration, 1.0)[:, None]
    slope = 30 * s**2 * (1 - s) ** 2 / duration * far.numpy()
    # Steps of 10 ms leave errors of their square, which the feedback decays.
    np.testing.assert_allclose(commanded, slope, atol=4e-3)
    np.testing.assert_allclose(cell.joints, path[-1], atol=1e-3)


def test_a_path_of_one_sample_or_none_leaves_the_arm_where_it_is(cell):
    here = cell.joints.numpy()
    for samples in (1, 0):
        assert cell.follow_path(np.repeat(here[None], samples, axis=0)) == samples
    np.testing.assert_array_equal(cell.joints, here)


def test_a_path_is_left_when_its_end_is_told(cell):
    far = torch.full((7,), 0.1, dtype=torch.float64)
    path = joint_line(panda.ready, panda.ready + far, speed=0.3, dt=0.01).numpy()
    assert cell.follow_path(path, until=lambda: len(cell.log) == 12) == 12


class CountingSensor:
    def __init__(self):
        self.asked = []

    def corners(self, ids):
        self.asked.append(ids)
        return {}


@pytest.mark.parametrize("tracked", [(), (7,)])
def test_markers_are_detected_now_and_then_while_they_are_tracked(cell, tracked):
    cell._sensor, cell.tracked_markers = CountingSensor(), tracked
    cell.hold_pose(0.02)
    assert cell._sensor.asked == []
    cell.hold_pose(0.10)  # twelve steps by now, with a detection at each fourth
    assert cell._sensor.asked == 3 * [tracked] * bool(tracked)
