"""The keys of a terminal as a stand-in for a haptic device."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Callable
from types import MappingProxyType

import numpy as np
import torch

from ...kinematics import SerialChain
from ...protocols import ArmState, HumanInput, Request
from ..coarse_orientation import coarse_orientation
from ..drag import DragConfig, hand_twist
from ..held_keys import HeldKeys

REQUESTS: MappingProxyType[str, Request] = MappingProxyType(
    {"1": "start", "2": "stop", "3": "save", "4": "discard", "0": "home", "q": "finish"}
)
"""What keys ask for, beside those that lead (see `DIRECTIONS`)."""

_GRIPPER = {"[": 0.08, "]": 0.0}


class TerminalKeyboard:
    """Leads the hand by keys: i k away and back, j l left and right, u o up and down.

    [ opens the gripper, ] closes it; `REQUESTS` has the rest. The hand turns by the coarse
    orientation rule.
    """

    def __init__(
        self,
        chain: SerialChain,
        typed: Callable[[], str],
        keys: HeldKeys | None = None,
        config: DragConfig | None = None,
    ):
        """Take a source of characters; `TerminalKeyboard.open` takes the terminal.

        Args:
            chain: The arm that is led.
            typed: Characters typed since it was last asked; does not wait.
            keys: How long a press counts.
            config: Fastest motion of the hand, and how it turns.
        """
        self._chain, self._typed = chain, typed
        self._keys = keys or HeldKeys()
        self._config = config or DragConfig()
        self._gripper: float | None = None

    @classmethod
    def open(cls, chain: SerialChain, config: DragConfig | None = None) -> TerminalKeyboard:
        """Read the terminal this process runs in, key by key, until the process ends.

        Raises:
            ValueError: Standard input is no terminal.
        """
        if not sys.stdin.isatty():
            raise ValueError("the keyboard needs a terminal: standard input is none.")
        _take_terminal()
        return cls(chain, _typed_in_terminal, config=config)

    def read(self, state: ArmState) -> HumanInput:
        """Motion of the hand, gripper and requests, by the keys typed lately."""
        requests = []
        for key in self._typed():
            if key in REQUESTS:
                requests.append(REQUESTS[key])
            elif key in _GRIPPER:
                self._gripper = _GRIPPER[key]
            else:
                self._keys.press(key)
        direction, twist = self._keys.direction(), np.zeros(6)
        if direction.any():
            hand = self._chain.forward(torch.from_numpy(state.joint_position))
            velocity = self._config.speed * direction
            rule = coarse_orientation(hand.position)
            twist = hand_twist(hand, velocity, rule, self._config)
        return HumanInput(
            effort=np.zeros(len(state.joint_position)),
            twist=twist,
            gripper=self._gripper,
            requests=tuple(requests),
        )


def _take_terminal() -> None:
    """Let characters come without a line's end and unseen, and give the terminal back."""
    import atexit
    import termios
    import tty

    number = sys.stdin.fileno()
    before = termios.tcgetattr(number)
    atexit.register(termios.tcsetattr, number, termios.TCSADRAIN, before)
    tty.setcbreak(number)


def _typed_in_terminal() -> str:
    number, text = sys.stdin.fileno(), ""
    while select.select([number], [], [], 0)[0]:
        more = os.read(number, 64)
        if not more:  # the terminal is gone
            break
        text += more.decode(errors="ignore")
    return text
