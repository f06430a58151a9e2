"""Record the cycles of a served arm's protocol, and drop packets on purpose."""

import random
from typing import NamedTuple

import numpy as np

from hrc_learn.hardware.protocol_server import ArmServer


class DrivenCycle(NamedTuple):
    """One cycle of a motion, with its command."""

    motion: int
    """Number that the driver has given to the motion."""
    velocity: np.ndarray
    """Commanded joint velocities, extrapolated where no answer has come [rad/s]."""
    position: np.ndarray
    """Previous joint positions, as sent to the driver [rad]."""
    answered: bool


class CycleLog(list[DrivenCycle]):
    """All cycles of motions, each recorded when the next one begins."""

    def __init__(self, server: ArmServer):
        """Record a cycle before each step of the arm."""
        super().__init__()
        self._robot, self._link = server.robot, server.link
        self._step, self._robot.step = self._robot.step, self._noted_step

    def _noted_step(self) -> None:
        robot = self._robot
        if motion := self._link.current_motion_id:
            position = robot.reading.joint_position
            self.append(DrivenCycle(motion, robot.velocity, position, robot.answered))
        self._step()


class LossyLink:
    """Drops states and answers of motions, each by chance.

    Attributes:
        loss: Fraction of the packets that are dropped, of states and of answers each.
        lost: Number of packets dropped.
    """

    def __init__(self, server: ArmServer, loss: float):
        """Insert the link between the server and its sockets.

        Args:
            server: Server of the arm.
            loss: Fraction of the packets that are dropped.
        """
        self.loss, self.lost, self._chance = loss, 0, random.Random(0)
        self._link = server.link
        self._send, self._take = self._link.send_state, self._link._handle_udp_command
        self._link.send_state, self._link._handle_udp_command = self._on_state, self._on_answer

    def _drops(self) -> bool:
        drops = bool(self._link.current_motion_id) and self._chance.random() < self.loss
        self.lost += drops
        return drops

    def _on_state(self) -> None:
        if self._drops():
            # The package cannot skip a packet, so it must count the dropped one.
            self._link._FrankaServer__message_id += 1
        else:
            self._send()

    def _on_answer(self, command_data: bytes) -> None:
        if not self._drops():
            self._take(command_data)
