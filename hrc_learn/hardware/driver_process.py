"""A driver in a process of its own, which answers one call at a time."""

from __future__ import annotations

import math
import multiprocessing
import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any, final

from hrc_learn.watchdog import WatchdogError

_STARTUP = 60.0
"""Longest that connecting may take [s]."""


class DriverError(RuntimeError):
    """The driver of a device raised an exception; the message has it."""


@final
class DriverProcess:
    """Starts the process of a driver and calls it, from any thread.

    Attributes:
        process: The process.
        news: Numbers that the process sends with each answer, as of the last one.
    """

    def __init__(self, serve: Callable[..., None], *arguments: object, name: str):
        """Start the process and wait until its driver is connected.

        Args:
            serve: Called in the process with its end of the connection and the arguments; it
                is pickled. See `opened` and `answer_calls`.
            arguments: Further arguments of `serve`.
            name: Name of the device.

        Raises:
            DriverError: The device cannot be reached.
            WatchdogError: The process died, or takes too long.
        """
        self.news: tuple[int, ...] = ()
        self._name, self._lost, self._number = name, "", 0
        self._calling = threading.Lock()
        # A forked process would have this one's locks, but not the threads that hold them.
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self.process = context.Process(
            target=serve, args=(theirs, *arguments), name=name, daemon=True
        )
        self.process.start()
        theirs.close()  # or its end would never be noticed here
        try:
            self._answer(_STARTUP)
        except BaseException:
            self.kill()
            raise

    def call(self, *request: object, timeout: float = math.inf) -> Any:
        """Call the driver and wait for its answer.

        Args:
            request: Name and arguments.
            timeout: Longest wait for the answer [s].

        Raises:
            DriverError: The driver raised an exception.
            WatchdogError: The process has ended or does not answer, now or in an earlier call.
        """
        with self._calling:
            if self._lost:
                raise WatchdogError(self._lost)
            self._number += 1
            try:
                self._connection.send((self._number, *request))
            except OSError as error:
                raise self._has_gone("has ended") from error
            return self._answer(timeout)

    def end(self, timeout: float) -> None:
        """Close the connection, and kill a process that has not answered.

        Args:
            timeout: Longest wait for the process [s].
        """
        hangs = self._lost != ""
        self._lost = self._lost or f"the process of the {self._name} is closed."
        self._connection.close()
        self.process.join(timeout)
        if hangs:
            self.kill()

    def kill(self) -> None:
        """Kill the process, whatever call it is in."""
        if self.process.is_alive():
            self.process.kill()
        self.process.join()

    def _answer(self, timeout: float) -> Any:
        end = time.monotonic() + timeout
        try:
            while True:
                left = None if timeout == math.inf else max(0.0, end - time.monotonic())
                if not self._connection.poll(left):
                    raise self._has_gone(f"has not answered for {timeout:g} s")
                number, value, error, self.news = self._connection.recv()
                # A signal may have cut off the wait for an earlier answer.
                if number == self._number:
                    break
        except (EOFError, OSError) as error:
            raise self._has_gone("has ended") from error
        if error:
            raise DriverError(error)
        return value

    def _has_gone(self, what: str) -> WatchdogError:
        self._lost = (
            f"the process of the {self._name} {what}: make sure that the {self._name} is at "
            "rest, and connect again."
        )
        return WatchdogError(self._lost)


def opened[Driver](connection: Connection, open_driver: Callable[[], Driver]) -> Driver | None:
    """Connect to a device in the driver's process; None if an error has been sent instead."""
    # Ctrl-C reaches all processes of a terminal: the calling one decides what follows from it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        return open_driver()
    except Exception as error:
        connection.send((0, None, _described(error), ()))
        return None


def answer_calls(
    connection: Connection,
    carry_out: Callable[..., object],
    news: Callable[[], tuple[int, ...]] = tuple,
) -> None:
    """Answer calls until the calling process closes the connection or dies.

    Args:
        connection: The process's end of the connection.
        carry_out: Carries out a call, given its name and arguments.
        news: Numbers to send with each answer.
    """
    with suppress(EOFError, OSError):
        connection.send((0, None, "", news()))
        while True:
            number, *request = connection.recv()
            value, error = None, ""
            try:
                value = carry_out(*request)
            except Exception as raised:
                error = _described(raised)
            connection.send((number, value, error, news()))


def _described(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
