"""Keys that lead the hand: which way, for as long as they are held."""

import time
from collections.abc import Callable
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

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


class HeldKeys:
    """Where the keys held lead.

    Terminals and browsers tell presses and repeats, no releases: a press counts for a moment,
    and a key that is held is pressed again before that is over (after a quarter to half a
    second at first, then every 30 ms). So a keyboard that falls silent leads nowhere.
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
        """Note a press or repeat; whether the key leads anywhere."""
        if key not in self._until:
            return False
        self._until[key] = self._clock() + self._holds_for
        return True

    def direction(self) -> Float[np.ndarray, "3"]:
        """Where the keys lead now: a unit vector, or zero."""
        now = self._clock()
        held = [DIRECTIONS[key] for key, until in self._until.items() if now < until]
        total = np.sum(held, axis=0) if held else np.zeros(3)
        length = float(np.linalg.norm(total))
        return total / length if length > 0 else total
