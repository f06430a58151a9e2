"""Whether LeRobot's loop keeps the rate at which its recordings will be read."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

logger = logging.getLogger(__name__)

LATE = 1.5
"""Periods after which an action is late: from here on the nearest frame is the next one."""
PAUSE = 2.0
"""Longer without an action is no late one but a pause [s], as between two episodes."""
TOLERATED = 0.02
"""Share of late actions of which nothing is said."""


class LoopWatch:
    """Counts late actions, and warns at the end of each stretch of them.

    LeRobot stamps frames with their number over the rate, whenever they were recorded: in what
    is late the arm seems to have moved faster than it did.
    """

    def __init__(self, name: str, fps: float, clock: Callable[[], float] = time.perf_counter):
        """Begin with nothing.

        Args:
            name: Of the robot, for the warning.
            fps: Actions a second that there should be.
            clock: Seconds.
        """
        self._name, self._period, self._clock = name, 1 / fps, clock
        self._last: float | None = None
        self._clear()

    def tick(self) -> None:
        """Note an action."""
        now = self._clock()
        gap = 0.0 if self._last is None else now - self._last
        self._last = now
        if gap > PAUSE:
            self.end()
            self._last = now
            gap = 0.0
        self.actions += 1
        if gap > LATE * self._period:
            self.late += 1
            self.lost += round(gap / self._period) - 1
            self.latest = max(self.latest, gap - self._period)

    def end(self) -> None:
        """Warn of what came late since the last end, if it was much."""
        if self.late > TOLERATED * self.actions:
            logger.warning(
                "%s: %d of %d actions came late, by %.0f ms at most: what was recorded lacks "
                "about %d frames, and moves faster there than the arm did. Record again with "
                "fewer or smaller images, a lower --dataset.fps, or nothing else to compute",
                self._name,
                self.late,
                self.actions,
                1e3 * self.latest,
                self.lost,
            )
        self._last = None
        self._clear()

    def _clear(self) -> None:
        self.actions = self.late = self.lost = 0
        self.latest = 0.0
