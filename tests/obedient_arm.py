"""An arm that does as it is told: it integrates velocities exactly."""

import numpy as np

from hrc_learn.protocols import ArmState


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
