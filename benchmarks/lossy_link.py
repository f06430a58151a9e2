"""Packets of a served arm's protocol that are lost on purpose."""

import random

from hrc_learn.hardware.protocol_server import ArmServer


class LossyLink:
    """Drops states and answers of motions, each by chance.

    Attributes:
        loss: Fraction of the packets that are dropped, of states and of answers each.
        lost: Number of packets dropped.
    """

    def __init__(self, server: ArmServer, loss: float):
        """Get between the server and its sockets.

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
            # The package cannot leave one out, and has to count it.
            self._link._FrankaServer__message_id += 1
        else:
            self._send()

    def _on_answer(self, command_data: bytes) -> None:
        if not self._drops():
            self._take(command_data)
