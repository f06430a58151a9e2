"""Who holds the arm where: handles that people have taken in their browsers."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from threading import Lock

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, kw_only=True, eq=False)
class Grip:
    """A handle that somebody holds."""

    joint: int | None
    """Joint that moves the link held, counted from 1; None: the hand is held."""
    held_at: Float[np.ndarray, "3"]
    """Point of the link that is held, in the frame of the link; of the hand: that point less
    the tool centre point, in the base frame [m]."""
    pointer: Float[np.ndarray, "3"]
    """Where the handle has been dragged to, in the base frame [m]."""
    orientation: Float[np.ndarray, "4"] | None = None
    """Orientation the handle of the hand has been turned to (wxyz)."""


class Grips:
    """All grips, each until it is let go or its holder is not heard of any more.

    Safe to use from several threads. A holder is whatever tells two browsers apart.
    """

    def __init__(self, patience: float, clock: Callable[[], float] = time.monotonic):
        """Start with nobody holding anything.

        Args:
            patience: Time after the last sign of life at which a holder is given up [s].
            clock: Tells the time [s].

        Raises:
            ValueError: The patience is not positive.
        """
        if not patience > 0:
            raise ValueError(f"patience must be positive, but is {patience}.")
        self.patience = patience
        self._clock = clock
        self._grips: dict[tuple[int, str], Grip] = {}
        self._heard: dict[int, float] = {}
        self._lock = Lock()

    def take(self, holder: int, handle: str, grip: Grip) -> None:
        """Begin to hold a handle."""
        with self._lock:
            self._grips[holder, handle] = grip
            self._heard[holder] = self._clock()

    def move(
        self,
        holder: int,
        handle: str,
        pointer: Float[np.ndarray, "3"],
        orientation: Float[np.ndarray, "4"] | None = None,
    ) -> None:
        """Drag a handle on; one that is not held (any more) stays where it is."""
        with self._lock:
            self._heard[holder] = self._clock()
            grip = self._grips.get((holder, handle))
            if grip is not None:
                self._grips[holder, handle] = replace(
                    grip, pointer=pointer, orientation=orientation
                )

    def release(self, holder: int, handle: str) -> None:
        """Let go of a handle."""
        with self._lock:
            self._grips.pop((holder, handle), None)

    def release_all(self, holder: int) -> None:
        """Forget somebody who has left."""
        with self._lock:
            self._drop(holder)

    def hear(self, holder: int) -> None:
        """Note a sign of life."""
        with self._lock:
            if holder in self._heard:
                self._heard[holder] = self._clock()

    @property
    def holders(self) -> set[int]:
        """Those who hold something."""
        with self._lock:
            return {holder for holder, _ in self._grips}

    def held(self) -> dict[tuple[int, str], Grip]:
        """Grips of those who have been heard of lately, by holder and handle.

        The others lose theirs for good: a connection that comes back does not move the arm
        before its handle is taken anew.
        """
        with self._lock:
            now = self._clock()
            for holder in [h for h, t in self._heard.items() if now - t > self.patience]:
                self._drop(holder)
            return dict(self._grips)

    def _drop(self, holder: int) -> None:
        self._heard.pop(holder, None)
        for key in [key for key in self._grips if key[0] == holder]:
            del self._grips[key]
