"""An arm that does as it is told, integrating velocities exactly; and its work cell."""

import numpy as np

from hrc_learn.kinematics import panda
from hrc_learn.protocols import HINDRANCES, ArmState
from hrc_learn.skills import WorkCell
from hrc_learn.teleoperation import ScriptedPerturbation


class ObedientArm:
    """Of any number of joints, with its own clock, and a gripper that must not be asked."""

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


def cell_with(arm, human=None, **options):
    """A work cell of a Panda, by default with nobody beside it."""
    return WorkCell(
        chain=panda,
        arm=arm,
        gripper=arm,
        human=human or ScriptedPerturbation(panda, ()),
        advance=arm.advance,
        **options,
    )


def hindered(cell, hindrance):
    """In which steps the person was told of a hindrance."""
    return cell.log["hindered"][:, HINDRANCES.index(hindrance)].astype(bool)
