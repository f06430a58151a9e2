"""Stop an arm whose control loop no longer reports, and retry stops that fail."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import final

_FIRST_PAUSE = 0.02
_LONGEST_PAUSE = 1.0
"""First and longest pause between attempts to stop [s]; each pause is twice as long as the
previous one. Network drivers recover within some tens of milliseconds, a control box within
seconds."""


class WatchdogError(RuntimeError):
    """The watchdog no longer works: do not move the arm."""


def bring_to_rest(stop: Callable[[], object], timeout: float) -> bool:
    """Stop an arm, retrying with growing pauses.

    Args:
        stop: Function that brings the arm to rest.
        timeout: Time for which to retry [s].

    Returns:
        True if an attempt succeeded.
    """
    end, pause, attempts = time.monotonic() + timeout, _FIRST_PAUSE, 0
    while not _attempt(stop, attempts):
        attempts += 1
        if time.monotonic() + pause > end:
            return False
        time.sleep(pause)
        pause = min(2 * pause, _LONGEST_PAUSE)
    return True


def _attempt(stop: Callable[[], object], failed: int) -> bool:
    """Try to stop once, after `failed` failures in a row; True if the arm is at rest."""
    try:
        stop()
        return True
    except (Exception, SystemExit) as error:  # a driver's sys.exit() must not end the thread
        failed += 1
        if failed & (failed - 1) == 0:  # the 1st, 2nd, 4th, ...
            with suppress(Exception):  # a closed stderr must not end the thread either
                text = f"watchdog: stop failed {failed} times, retrying: {error!r}"
                print(text, file=sys.stderr)
        return False


@final
class Watchdog:
    """Stops an arm once its control loop has not reported for too long.

    with Watchdog(0.05, arm.stop) as watchdog:
        while servoing():
            arm.command(runner.step())
            watchdog.feed()

    The watchdog runs in its own thread. It notices a loop that hangs. It does not notice a loop
    that holds the interpreter lock, or a suspended or killed process: for a real arm use
    `ArmProcess`. A stop that fails is retried, with growing pauses, until it succeeds or the
    loop reports again. After a trip the arm is at rest and the controller's state is stale:
    start from `initial_state` again. If the context ends with an exception, or while a stop is
    pending, the watchdog stops the arm.

    Attributes:
        trips: Number of times the loop was silent for too long.
    """

    def __init__(
        self,
        timeout: float,
        stop: Callable[[], object],
        *,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Set up the watchdog; silence counts from the first `feed`, or from entering `with`.

        Args:
            timeout: Longest silence [s]. A longer silence is detected with a delay of at most a
                quarter of this time.
            stop: Function that brings the arm to rest. It is called once for every silence, and
                again if it fails.
            clock: Current time [s].

        Raises:
            ValueError: The timeout is not positive, or is more than a thread can wait.
        """
        if not 0 < timeout < threading.TIMEOUT_MAX:
            raise ValueError(f"timeout must be positive and finite, but is {timeout}")
        self.trips = 0
        self._timeout, self._stop, self._clock = timeout, stop, clock
        self._fed: float | None = None
        # Time of the next attempt to stop; None: no stop is pending.
        self._due: float | None = None
        self._pause, self._in_a_row = _FIRST_PAUSE, 0
        self._stopping_since: float | None = None
        self._lock = threading.Lock()
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)

    def feed(self) -> None:
        """Report that the loop is alive.

        Raises:
            WatchdogError: The watchdog's thread has ended, or a stop hangs.
        """
        with self._lock:
            if self._thread.ident is not None and not self._thread.is_alive():
                raise WatchdogError("the watchdog's thread has ended: stop the arm.")
            now, since = self._clock(), self._stopping_since
            if since is not None and now - since > self._timeout:
                raise WatchdogError(f"the stop has not returned for {now - since:.2f} s.")
            self._fed, self._due = now, None

    def check(self) -> bool:
        """Stop the arm if a stop is due. The thread calls this by itself.

        Returns:
            True if a stop was due.
        """
        with self._lock:
            now = self._clock()
            if self._fed is not None and now - self._fed > self._timeout:
                self._fed, self._due = None, now  # a silence counts once, until the next feed
                self._pause, self._in_a_row = _FIRST_PAUSE, 0
                self.trips += 1
            if self._due is None or now < self._due:
                return False
            self._due, self._stopping_since = None, now
        # Outside the lock, because `stop` may take long and may call `feed`.
        stopped = _attempt(self._stop, self._in_a_row)
        with self._lock:
            self._stopping_since = None
            self._in_a_row += 1
            # If the watchdog was fed meanwhile, the loop is running again.
            if not stopped and self._fed is None:
                self._due = self._clock() + self._pause
                self._pause = min(2 * self._pause, _LONGEST_PAUSE)
        return True

    def start(self) -> None:
        """Start the thread; silences count from the first `feed` on."""
        self._thread.start()

    def close(self) -> None:
        """End the thread without waiting for a stop that hangs, so that the process can end."""
        self._done.set()
        if self._thread.is_alive():
            self._thread.join(self._timeout + _LONGEST_PAUSE)

    def __enter__(self) -> Watchdog:
        self.feed()
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close()
        if kind is not None or self._due is not None:
            bring_to_rest(self._stop, _LONGEST_PAUSE)

    def _watch(self) -> None:
        # A silence is detected with a delay of at most a quarter of the timeout.
        while not self._done.wait(self._timeout / 4):
            self.check()
