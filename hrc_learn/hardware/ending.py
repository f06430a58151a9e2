"""Programs that move an arm end with the arm at rest, also when a signal tells them to."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from hrc_learn.watchdog import Report, bring_to_rest, report_failed_stop

SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGTERM", "SIGINT", "SIGHUP") if hasattr(signal, name)
)
"""Signals that end a program: from its supervisor, from Ctrl-C, from a closed terminal."""


@contextmanager
def ending_at_rest(
    stop: Callable[[], object], *, patience: float = 5.0, report: Report = report_failed_stop
) -> Iterator[None]:
    """Bring the arm to rest however this block ends.

        with ending_at_rest(arm.stop):
            while servoing():
                arm.command(runner.step())

    SIGTERM and SIGHUP end the block as `SystemExit` with status 128 + number, SIGINT as
    `KeyboardInterrupt`; further signals change nothing until the arm is at rest. An ignored
    signal stays ignored. Signals are left alone in threads other than the main one.

    Args:
        stop: Brings the arm to rest.
        patience: Longest time for which a failing stop is repeated [s].
        report: Called with each failure.

    Raises:
        RuntimeError: The arm could not be stopped, and the block itself raised nothing.
    """
    ending = False

    def end(number: int, frame: FrameType | None) -> None:
        nonlocal ending
        if ending:
            return
        ending = True
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(128 + number)

    before = _handled_by(end)
    stopped = False
    try:
        try:
            yield
        finally:
            ending = True
    finally:  # also where the signal came in the line above
        stopped = bring_to_rest(stop, patience, report)
        for number, handler in before.items():
            signal.signal(number, handler)
        if not stopped:
            print(f"the arm could not be stopped for {patience:g} s", file=sys.stderr)
    if not stopped:
        raise RuntimeError(f"the arm could not be stopped for {patience:g} s.")


def _handled_by(handler: Callable[[int, FrameType | None], None]) -> dict[int, Any]:
    """Set a handler of the signals; those before it."""
    before: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for number in SIGNALS:
            # None: a library handles it by itself.
            if signal.getsignal(number) not in (signal.SIG_IGN, None):
                before[number] = signal.signal(number, handler)
    return before
