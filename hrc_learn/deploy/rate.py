"""A fixed rate for a loop, without drift."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import final

# Rest of a wait that is spent awake [s]: a sleeping process wakes up late by about as much.
_SPIN = 0.0002


@final
class Rate:
    """Keeps a loop at a fixed rate, and counts the periods that it was too slow for.

        rate = Rate(0.004)
        while running():
            step()
            rate.wait()

    Attributes:
        missed: Periods skipped because the loop was still busy, or woken too late.
    """

    def __init__(
        self,
        period: float,
        *,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ):
        """The first period starts now.

        Args:
            period: Time between two returns of `wait` [s]: one over the rate.
            clock: Tells the time [s].
            sleep: Lets at least a given time pass [s].

        Raises:
            ValueError: The period is not positive.
        """
        if not period > 0:
            raise ValueError(f"period must be positive, but is {period}")
        self.missed = 0
        self._period, self._clock, self._sleep = period, clock, sleep
        self._next = clock() + period

    def wait(self) -> float:
        """Wait for the end of the period; one that ended a whole period ago is skipped.

        Returns:
            How late the loop goes on [s].
        """
        # Ends are counted from the start, not from the last return: delays do not add up.
        rest = self._next - self._clock()
        if rest > _SPIN:
            self._sleep(rest - _SPIN)
        while (now := self._clock()) < self._next:
            pass
        skipped = int((now - self._next) / self._period)
        self.missed += skipped
        late = now - self._next - skipped * self._period
        self._next += (skipped + 1) * self._period
        return late
