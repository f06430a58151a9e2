"""A simulated arm as a robot of franky-sim, which speaks the protocol of a Franka arm.

Imported on demand: it needs the package franky-sim.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from franky_sim.base_simulator import BaseRobot, InnerRobotState
from franky_sim.franka_robot_server import FrankaRobotServer

from hrc_learn.hardware.franka_settings import CYCLE
from hrc_learn.sim.arm_model import FINGER_STROKE
from hrc_learn.sim.world import World

_CATCH_UP = 20.0
"""Rate at which joints commanded by position approach it [1/s]: those of franky's motions move
on by themselves, so this only takes away what rounding leaves."""


class ServedRobot(BaseRobot):
    """The world's arm and gripper, commanded by velocity or position in each cycle.

    Its servos are the world's own, so commands of torque come to nothing.

    Attributes:
        answered: True once a command has come in this cycle.
        reading: Reading of the arm before this cycle.
        velocity: Commanded joint velocities [rad/s].
    """

    def __init__(self, world: World):
        super().__init__()
        self._world = world
        self.answered = False
        self._target: np.ndarray | None = None
        # Velocities of this cycle and of the two before it.
        self.velocity = self._last = self._before = np.zeros(7)
        self._width_goal: float | None = None
        self._finger_speed = 0.0
        self.reading = world.arm.read()

    def _get_state(self) -> InnerRobotState:
        read = self.reading
        assert read.external_torque is not None
        # franky-sim tells of one kind of torque only: what drivers ask for is the external.
        return InnerRobotState(
            q=tuple(read.joint_position.tolist()),
            dq=tuple(read.joint_velocity.tolist()),
            tau_j=tuple(read.external_torque.tolist()),
        )

    def begin_cycle(self) -> None:
        """Begin a cycle in which no command has come yet."""
        self.answered = False
        self._before, self._last = self._last, self.velocity

    def go_on(self) -> None:
        """Keep the acceleration of the last two cycles, for want of an answer.

        Where positions are commanded, the arm waits for the next one instead.
        """
        if self._target is None:
            self.velocity = 2 * self._last - self._before
            self.joint_velocity_control(self.velocity, has_new_command=False)

    def joint_velocity_control(self, target_dq: Any, has_new_command: bool = True) -> None:
        self.answered |= has_new_command
        if not has_new_command:
            target_dq = self.velocity
        super().joint_velocity_control(target_dq, has_new_command)
        # The package tells a smoothed acceleration; a control box knows what it commands.
        self._tracked_state_components["ddq_d"].set(
            vars(self)["_BaseRobot__t"], (self.velocity - self._last) / CYCLE
        )

    def joint_position_control(self, target_q: Any, has_new_command: bool = True) -> None:
        self.answered |= has_new_command
        super().joint_position_control(target_q, has_new_command)

    def _joint_velocity_control(self, target_dq: np.ndarray) -> None:
        self._target = None
        self._drive(np.asarray(target_dq, dtype=float))

    def _joint_position_control(self, target_q: np.ndarray) -> None:
        if self.server is None or not self.server.current_motion_id:
            # No motion: its own servos hold the arm where it is.
            self._target = None
            self._drive(np.zeros(7))
            return
        ahead = np.zeros(7) if self._target is None else target_q - self._target
        self._target = target_q.copy()
        behind = target_q - self.reading.joint_position
        self._drive(ahead / CYCLE + _CATCH_UP * behind)

    def _drive(self, velocity: np.ndarray) -> None:
        self.velocity = velocity
        self._world.arm.command(velocity)
        self.torque_control([0.0] * 7)  # reported commanded torques

    def _torque_control(self, torques: np.ndarray) -> None:
        pass

    def set_hand_goal(self, width: float, max_velocity: float, max_force: float) -> None:
        force = min(max_force, self._world.config.arm.grip_force)
        for finger in ("finger_left", "finger_right"):
            self._world.model.actuator(finger).forcerange[:] = (-force, force)
        self._width_goal = width
        self._finger_speed = max_velocity
        self._width_now = self._get_hand_width()

    def _get_hand_width(self) -> float:
        return self.reading.gripper_width

    def _pre_step(self) -> None:
        if self._width_goal is None:
            return
        # Both fingers move at the speed, so their distance changes by twice as much.
        step = 2 * self._finger_speed * CYCLE
        change = float(np.clip(self._width_goal - self._width_now, -step, step))
        self._width_now = float(np.clip(self._width_now + change, 0.0, 2 * FINGER_STROKE))
        self._world.arm.move(self._width_now)

    def step(self) -> None:
        """Advance the world by one cycle, and take its reading."""
        self._pre_step()
        self._world.advance(CYCLE)
        self.reading = self._world.arm.read()
        self._post_step()


class LossyServer(FrankaRobotServer):
    """Drops states, answers, and answers that come late."""

    lose_state = lose_answer = has_lost_answer = False

    def send_state(self) -> None:
        self.has_lost_answer = False
        if self.lose_state:
            # The package cannot leave one out, and has to count it.
            self._FrankaServer__message_id += 1
        else:
            super().send_state()

    def _handle_udp_command(self, command_data: bytes) -> None:
        # An answer names its state. One to an earlier state comes too late: taken for this
        # cycle's, each answer would be a cycle late from then on.
        answered = int.from_bytes(command_data[:8], "little")
        if answered != self._FrankaServer__message_id - 1:
            return
        self.has_lost_answer = self.lose_answer
        if not self.lose_answer:
            super()._handle_udp_command(command_data)
