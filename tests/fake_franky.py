"""A fake of the driver package franky, as far as it is used: the same names and arguments."""

from types import SimpleNamespace

import numpy as np


class Duration:
    def __init__(self, milliseconds: int):
        self.milliseconds = milliseconds


class JointVelocityMotion:
    def __init__(self, target, duration):
        self.target, self.duration = list(target), duration


class JointVelocityStopMotion:
    pass


class Robot:
    """Moves at once as it is told; time passes by `run`."""

    def __init__(self, ip):
        self.ip, self.motions, self.recovered = ip, [], 0
        self.relative_dynamics_factor = 1.0
        self.q = np.array([0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4])
        self.dq = np.zeros(7)

    def recover_from_errors(self):
        self.recovered += 1

    @property
    def current_joint_state(self):
        return SimpleNamespace(position=self.q.tolist(), velocity=self.dq.tolist())

    def move(self, motion, asynchronous=False):
        assert asynchronous, "a motion that is waited for would hold up the loop"
        self.motions.append(motion)
        stopped = isinstance(motion, JointVelocityStopMotion)
        self.dq = np.zeros(7) if stopped else np.array(motion.target)

    def run(self, time):
        self.q = self.q + time * self.dq


class Gripper:
    def __init__(self, ip):
        self.ip, self.width, self.calls = ip, 0.08, []

    def move_async(self, width, speed):
        self.calls.append(("move", width, speed))
        self.width = width

    def grasp_async(self, width, speed, force, *, epsilon_inner=0.005, epsilon_outer=0.005):
        assert epsilon_outer > 0.08, "any thing between the fingers is a grasp"
        self.calls.append(("grasp", width, force))
