"""Real arms end at rest: when their program ends, and when its loop stalls, is stopped or dies.

A driver in a process of its own stops the arm then.

Each request of the loop is its heartbeat, each answer that of the process: both learn within
the timeout that the other is gone.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import Connection
from types import FrameType, TracebackType
from typing import Any, Protocol, final, runtime_checkable

import numpy as np
from jaxtyping import Float

from hrc_learn.hardware.driver_process import DriverProcess, answer_calls, opened
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

    Every method raises `DriverError` with the driver's own exception, and `WatchdogError` if
    the process does not answer within the timeout.
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
        self._timeout = timeout
        self._driver = DriverProcess(_serve, open_arm, timeout, name="arm")
        self._call = partial(self._driver.call, timeout=timeout)

    @property
    def pid(self) -> int | None:
        """Number of the process."""
        return self._driver.process.pid

    @property
    def trips(self) -> int:
        """Number of times that the process had stopped the arm, as of its last answer."""
        return self._driver.news[0]

    @property
    def failures(self) -> int:
        """Number of its stops that had failed, as of its last answer."""
        return self._driver.news[1]

    def read(self) -> ArmState:
        """Return the newest state."""
        return self._call("read")

    def command(self, joint_velocity: Float[np.ndarray, " joints"]) -> None:
        """Set the joint velocities [rad/s]. One that the driver accepts is a sign of life."""
        self._call("command", np.asarray(joint_velocity, dtype=float), self.trips)

    def move(self, width: float) -> None:
        """Set the opening of the gripper [m]."""
        self._call("move", float(width))

    def feed(self) -> None:
        """Report that the loop is alive, with no command."""
        self._call("feed")

    def stop(self) -> None:
        """Bring the arm to rest."""
        self._call("stop")

    def close(self) -> None:
        """Bring the arm to rest and end the process.

        Raises:
            WatchdogError: The arm could not be stopped, or the process was gone.
        """
        try:
            if not self._driver.call("close", timeout=_PATIENCE + self._timeout):
                raise WatchdogError(f"the arm could not be stopped for {_PATIENCE:g} s.")
        finally:
            self._driver.end(self._timeout + 1.0)

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


def _serve(
    connection: Connection, open_arm: Callable[[], StoppableArm], timeout: float
) -> None:
    """Answer requests in the driver's process until the loop's process closes or dies."""
    arm = opened(connection, open_arm)
    if arm is None:
        return
    dog = Watchdog(timeout, arm.stop)

    def carry_out(name: str, *arguments: Any) -> object:
        match name:
            case "close":
                return bring_to_rest(arm.stop, _PATIENCE)
            case "command":
                velocity, trips = arguments
                # A loop that does not know of a stop would make the arm jump to its velocity.
                if trips == dog.trips:
                    arm.command(velocity)
                dog.feed()
            case "feed":
                dog.feed()
            case _:
                return getattr(arm, name)(*arguments)
        return None

    with ending_at_rest(arm.stop, patience=_PATIENCE):
        dog.start()
        try:
            answer_calls(connection, carry_out, lambda: (dog.trips, dog.failures))
        finally:
            dog.close()
