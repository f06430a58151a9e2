"""Connect a simulated arm to franky-sim, which implements the protocol of a Franka arm.

This module needs the package franky-sim, so it is imported on demand.
"""

from typing import Any

import numpy as np
from franky_sim.base_simulator import BaseRobot, InnerRobotState
from franky_sim.franka_robot_server import FrankaRobotServer

from hrc_learn.hardware.franka_settings import CYCLE
from hrc_learn.sim.arm_model import FINGER_STROKE
from hrc_learn.sim.world import World


class ServedRobot(BaseRobot):
    """The world's arm and gripper, commanded by joint velocities in each cycle.

    The world's own servos drive the arm, so torque commands have no effect.

    Attributes:
        answered: True once a command has come in this cycle.
        reading: Reading of the arm at the beginning of this cycle.
        velocity: Commanded joint velocities [rad/s].
    """

    def __init__(self, world: World):
        super().__init__()
        self._world = world
        self.answered = False
        # Velocities of this cycle and of the two before it.
        self.velocity = self._last = self._before = np.zeros(7)
        self._width_goal: float | None = None
        self._finger_speed = 0.0
        self.reading = world.arm.read()

    def _get_state(self) -> InnerRobotState:
        read = self.reading
        assert read.external_torque is not None
        # franky-sim reports only one kind of torque; drivers need the external torques.
        return InnerRobotState(
            q=tuple(read.joint_position.tolist()),
            dq=tuple(read.joint_velocity.tolist()),
            tau_j=tuple(read.external_torque.tolist()),
        )

    def begin_cycle(self) -> None:
        """Begin a cycle, for which no command has come yet."""
        self.answered = False
        self._before, self._last = self._last, self.velocity

    def go_on(self) -> None:
        """Continue with the acceleration of the last two cycles, without an answer."""
        self.velocity = 2 * self._last - self._before
        self.joint_velocity_control(self.velocity, has_new_command=False)

    def joint_velocity_control(self, target_dq: Any, has_new_command: bool = True) -> None:
        self.answered |= has_new_command
        if not has_new_command:
            target_dq = self.velocity
        super().joint_velocity_control(target_dq, has_new_command)
        # franky-sim reports a smoothed acceleration, but a control box reports the commanded
        # one.
        self._tracked_state_components["ddq_d"].set(
            vars(self)["_BaseRobot__t"], (self.velocity - self._last) / CYCLE
        )

    def _joint_velocity_control(self, target_dq: np.ndarray) -> None:
        self.velocity = np.asarray(target_dq, dtype=float)
        self._world.arm.command(self.velocity)
        self.torque_control([0.0] * 7)  # reported commanded torques

    def _joint_position_control(self, target_q: np.ndarray) -> None:
        if self.server is not None and self.server.current_motion_id:
            raise NotImplementedError("the simulated arm accepts joint velocity motions only")
        # Without a motion, the servos hold the arm where it is.
        self._joint_velocity_control(np.zeros(7))

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
        """Advance the world by one cycle, and read its arm."""
        self._pre_step()
        self._world.advance(CYCLE)
        self.reading = self._world.arm.read()
        self._post_step()


class PunctualServer(FrankaRobotServer):
    """Server that drops answers to earlier states.

    If it accepted such an answer in this cycle, all later answers would be a cycle late, too.
    """

    def _handle_udp_command(self, command_data: bytes) -> None:
        # An answer has the number of its state. Once the state is sent, the counter is one
        # ahead.
        counted = self._FrankaServer__message_id  # pyright: ignore[reportAttributeAccessIssue]
        if int.from_bytes(command_data[:8], "little") == counted - 1:
            super()._handle_udp_command(command_data)
