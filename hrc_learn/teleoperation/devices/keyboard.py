"""The keys of a terminal, and keys held in a browser, as a stand-in for a haptic device."""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Callable
from types import MappingProxyType

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.kinematics import SerialChain, coarse_orientation
from hrc_learn.protocols import ArmState, HumanInput, Request
from hrc_learn.teleoperation.interaction_force import InteractionForceConfig, guiding_twist

DIRECTIONS = MappingProxyType(
    {
        "i": (1.0, 0.0, 0.0),
        "k": (-1.0, 0.0, 0.0),
        "j": (0.0, 1.0, 0.0),
        "l": (0.0, -1.0, 0.0),
        "u": (0.0, 0.0, 1.0),
        "o": (0.0, 0.0, -1.0),
    }
)
"""Direction of each key in the base frame: i away from the robot, j to its left, u up."""


class KeyboardState:
    """Which keys are held, and the direction they ask for.

    Terminals and browsers tell presses and repeats, no releases: a press counts for a moment,
    and a key that is held is pressed again before that is over (after a quarter to half a
    second at first, then every 30 ms). So a keyboard that falls silent asks for no motion.
    """

    def __init__(self, holds_for: float = 0.3, clock: Callable[[], float] = time.monotonic):
        """Start with no key held.

        Args:
            holds_for: Time that a press counts [s].
            clock: Tells the time [s].

        Raises:
            ValueError: `holds_for` is not positive.
        """
        if not holds_for > 0:
            raise ValueError(f"holds_for must be positive, but is {holds_for}.")
        self._holds_for, self._clock = holds_for, clock
        self._until = dict.fromkeys(DIRECTIONS, float("-inf"))

    def press(self, key: str) -> bool:
        """Note a press or repeat; whether the key has a direction."""
        if key not in self._until:
            return False
        self._until[key] = self._clock() + self._holds_for
        return True

    def direction(self) -> Float[np.ndarray, "3"]:
        """The direction asked for now: a unit vector, or zero."""
        now = self._clock()
        held = [DIRECTIONS[key] for key, until in self._until.items() if now < until]
        total = np.sum(held, axis=0) if held else np.zeros(3)
        length = float(np.linalg.norm(total))
        return total / length if length > 0 else total


REQUESTS: MappingProxyType[str, Request] = MappingProxyType(
    {"1": "start", "2": "stop", "3": "save", "4": "discard", "0": "home", "q": "finish"}
)
"""What keys ask for, beside those that lead (see `DIRECTIONS`)."""

_GRIPPER = {"[": 0.08, "]": 0.0}


class TerminalKeyboard:
    """Moves the end effector by keys: i k away and back, j l left and right, u o up and down.

    [ opens the gripper, ] closes it; `REQUESTS` has the rest. The end effector turns by the
    coarse orientation rule.
    """

    def __init__(
        self,
        chain: SerialChain,
        typed: Callable[[], str],
        keys: KeyboardState | None = None,
        config: InteractionForceConfig | None = None,
    ):
        """Take a source of characters; `TerminalKeyboard.open` takes the terminal.

        Args:
            chain: The arm that is guided.
            typed: Characters typed since it was last asked; does not wait.
            keys: How long a press counts.
            config: Fastest motion of the end effector, and how it turns.
        """
        self._chain, self._typed = chain, typed
        self._keys = keys or KeyboardState()
        self._config = config or InteractionForceConfig()
        self._gripper: float | None = None

    @classmethod
    def open(
        cls, chain: SerialChain, config: InteractionForceConfig | None = None
    ) -> TerminalKeyboard:
        """Read the terminal this process runs in, key by key, until the process ends.

        Raises:
            ValueError: Standard input is no terminal.
        """
        if not sys.stdin.isatty():
            raise ValueError("the keyboard needs a terminal: standard input is none.")
        _take_terminal()
        return cls(chain, _typed_in_terminal, config=config)

    def read(self, state: ArmState) -> HumanInput:
        """Motion of the end effector, gripper and requests, by the keys typed lately."""
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
            tool = self._chain.forward(torch.from_numpy(state.joint_position))
            velocity = self._config.speed * direction
            rule = coarse_orientation(tool.position)
            twist = guiding_twist(tool, velocity, rule, self._config)
        return HumanInput(
            nullspace_input=np.zeros(len(state.joint_position)),
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
