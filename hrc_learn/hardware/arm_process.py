"""Real arms end at rest: when their program ends, and when its loop stalls, is stopped or dies.

A driver in a process of its own stops the arm then.

Each request of the loop is its heartbeat, each answer that of the process: both learn within
the timeout that the other is gone.
"""

from __future__ import annotations

import multiprocessing
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from types import FrameType, TracebackType
from typing import Any, Protocol, final, runtime_checkable

import numpy as np
from jaxtyping import Float

from hrc_learn.protocols import Arm, ArmState, Gripper
from hrc_learn.watchdog import (
    Report,
    Watchdog,
    WatchdogError,
    bring_to_rest,
    report_failed_stop,
)

_PATIENCE = 60.0
"""Longest time for which the process keeps trying to stop an arm whose loop has died [s]; a
control box restarts in less.
"""
_STARTUP = 60.0
"""Longest that connecting may take [s]."""
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


@runtime_checkable
class StoppableArm(Arm, Gripper, Protocol):
    """An arm and its gripper, as a driver has them."""

    def stop(self) -> None:
        """Bring the arm to rest."""
        ...


class DriverError(RuntimeError):
    """The driver of an arm raised an exception; the message has it."""


@final
class ArmProcess:
    """An `Arm` and a `Gripper` behind a driver that runs in another process.

    with ArmProcess(partial(FrankyArm, ip), timeout=0.15) as arm:
        while servoing():
            arm.command(velocity(arm.read()))

    The process stops the arm when no command has come for the timeout, whatever the loop's own
    process does: holds the interpreter, is stopped or is killed. Ctrl-C does not reach it, on
    SIGTERM it stops the arm and ends. If the process itself dies, its connection to the arm
    falls, which ends the motion at any arm with a control box, and the loop's next request
    raises `WatchdogError`.

    After a trip commands are not carried out until the loop has seen that `trips` has changed
    and starts from rest: the first command after one only brings the news.

    Attributes:
        trips: How often the process had stopped the arm, as of its last answer.
        failures: How many of its stops had failed.
    """

    def __init__(self, open_arm: Callable[[], StoppableArm], *, timeout: float):
        """Start the process and connect.

        Args:
            open_arm: Connects to the arm, in the process; it is pickled.
            timeout: Longest silence of the loop, and longest wait for an answer [s].

        Raises:
            ValueError: The timeout is not positive.
            DriverError: The arm cannot be reached.
            WatchdogError: The process died, or takes too long.
        """
        if not timeout > 0:
            raise ValueError(f"timeout must be positive, but is {timeout}")
        self.trips, self.failures = 0, 0
        self._timeout, self._gone = timeout, ""
        # A forked process would have the loop's threads' locks, but not the threads.
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(theirs, open_arm, timeout), name="arm", daemon=True
        )
        self._process.start()
        theirs.close()  # or its end would never be noticed here
        try:
            self._answer(_STARTUP)
        except BaseException:
            self._end()
            raise

    @property
    def pid(self) -> int | None:
        """Number of the process."""
        return self._process.pid

    def read(self) -> ArmState:
        """Return the newest state.

        Raises:
            DriverError: The driver does.
            WatchdogError: The process does not answer.
        """
        return self._ask("read")

    def command(self, joint_velocity: Float[np.ndarray, " joints"]) -> None:
        """Set the joint velocities [rad/s], and report that the loop is alive.

        Raises:
            DriverError: The driver does; such a command is no sign of life.
            WatchdogError: The process does not answer.
        """
        self._ask("command", np.asarray(joint_velocity, dtype=float), self.trips)

    def move(self, width: float) -> None:
        """Set the opening of the gripper [m].

        Raises:
            DriverError: The driver does.
            WatchdogError: The process does not answer.
        """
        self._ask("move", float(width))

    def feed(self) -> None:
        """Report that the loop is alive, with no command.

        Raises:
            WatchdogError: The process does not answer.
        """
        self._ask("feed")

    def stop(self) -> None:
        """Bring the arm to rest.

        Raises:
            DriverError: The driver does.
            WatchdogError: The process does not answer.
        """
        self._ask("stop")

    def close(self) -> None:
        """Bring the arm to rest and end the process.

        Raises:
            WatchdogError: The arm could not be stopped, or the process was gone.
        """
        try:
            if not self._ask("close", wait=_PATIENCE + self._timeout):
                raise WatchdogError(f"the arm could not be stopped for {_PATIENCE:g} s.")
        finally:
            self._end()

    def __enter__(self) -> ArmProcess:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None:
            self.close()
            return
        try:
            self.close()
        except WatchdogError as another:
            error.add_note(str(another))

    def _ask(self, *request: object, wait: float | None = None) -> Any:
        if self._gone:
            raise WatchdogError(self._gone)
        try:
            self._connection.send(request)
        except OSError as error:
            raise self._lost("has ended") from error
        return self._answer(self._timeout if wait is None else wait)

    def _answer(self, wait: float) -> Any:
        try:
            if not self._connection.poll(wait):
                raise self._lost(f"has not answered for {wait:g} s")
            value, error, self.trips, self.failures = self._connection.recv()
        except (EOFError, OSError) as error:
            raise self._lost("has ended") from error
        if error:
            raise DriverError(error)
        return value

    def _lost(self, what: str) -> WatchdogError:
        # Later answers would be those of earlier questions.
        self._gone = (
            f"the process that watches the arm {what}: make sure that the arm is at rest, and "
            "connect again."
        )
        return WatchdogError(self._gone)

    def _end(self) -> None:
        self._connection.close()
        self._process.join(self._timeout + 1.0)
        if self._gone and self._process.is_alive():
            # It hangs or is stopped. Without its connection the control box ends the motion.
            self._process.kill()
            self._process.join()


def _serve(
    connection: Connection, open_arm: Callable[[], StoppableArm], timeout: float
) -> None:
    """Answer requests in the driver's process until the loop's process closes or dies."""
    # Ctrl-C reaches all processes of a terminal: the loop decides what follows from it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        arm = open_arm()
    except Exception as error:
        connection.send((None, _describe(error), 0, 0))
        return
    dog = Watchdog(timeout, arm.stop)
    with ending_at_rest(arm.stop, patience=_PATIENCE):
        dog.start()
        connection.send((None, "", 0, 0))
        try:
            _answer_requests(connection, arm, dog)
        finally:
            dog.close()


def _answer_requests(connection: Connection, arm: StoppableArm, dog: Watchdog) -> None:
    while True:
        try:
            name, *arguments = connection.recv()
        except (EOFError, OSError):
            return  # the loop's process has died
        value, error = None, ""
        try:
            value = _carry_out(name, arguments, arm, dog)
        except Exception as raised:
            error = _describe(raised)
        try:
            connection.send((value, error, dog.trips, dog.failures))
        except OSError:
            return
        if name == "close":
            return


def _carry_out(name: str, arguments: list[Any], arm: StoppableArm, dog: Watchdog) -> Any:
    if name == "read":
        return arm.read()
    if name == "command":
        velocity, trips = arguments
        # A loop that does not know of a stop would make the arm jump to its velocity.
        if trips == dog.trips:
            arm.command(velocity)
        dog.feed()
    elif name == "feed":
        dog.feed()
    elif name == "move":
        arm.move(*arguments)
    elif name == "stop":
        arm.stop()
    elif name == "close":
        return bring_to_rest(arm.stop, _PATIENCE)
    else:
        raise ValueError(f"no request {name!r}")
    return None


def _describe(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
