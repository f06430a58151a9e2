"""Stops an arm whose control loop has fallen silent."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import final


@final
class Watchdog:
    """Calls for a stop once a loop has not reported for too long.

    with Watchdog(0.05, arm.stop) as watchdog:
        while servoing():
            arm.command(runner.step())
            watchdog.feed()

    It runs in a thread of its own, so it also notices a loop that hangs. After a trip the arm
    is at rest, which the controller does not know: start from `initial_state` again.

    Attributes:
        trips: How often it had to act.
    """

    def __init__(
        self,
        timeout: float,
        stop: Callable[[], object],
        *,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Set up; the time starts with the first `feed`, or on entering the context.

        Args:
            timeout: Longest silence [s]; it is noticed up to a quarter of it late.
            stop: Brings the arm to rest. Called once for every silence.
            clock: Tells the time [s].

        Raises:
            ValueError: The timeout is not positive.
        """
        if not timeout > 0:
            raise ValueError(f"timeout must be positive, but is {timeout}")
        self.trips = 0
        self._timeout, self._stop, self._clock = timeout, stop, clock
        self._fed: float | None = None
        self._lock = threading.Lock()
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)

    @property
    def tripped(self) -> bool:
        """Whether it has acted since it was last fed."""
        return self.trips > 0 and self._fed is None

    def feed(self) -> None:
        """Report that the loop is alive."""
        with self._lock:
            self._fed = self._clock()

    def check(self) -> bool:
        """Stop the arm if the time is up; whether it was. The thread does this by itself."""
        with self._lock:
            late = self._fed is not None and self._clock() - self._fed > self._timeout
            if late:
                self._fed = None  # until fed again there is nothing to stop
                self.trips += 1
        # Outside the lock: stopping an arm may take long, and may feed.
        if late:
            self._stop()
        return late

    def __enter__(self) -> Watchdog:
        self.feed()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._done.set()
        self._thread.join()

    def _watch(self) -> None:
        # A silence is noticed at most a quarter of the timeout late.
        while not self._done.wait(self._timeout / 4):
            self.check()
