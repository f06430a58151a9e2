"""Run the drivers of arms and grippers in separate processes, and call them from a loop.

An arm is brought to rest when its program ends, and when its control loop stalls, is suspended
or dies. Each command shows the driver's process that the loop is alive, and each answer shows
the loop that the process is alive. Each side notices within the timeout if the other is gone.
"""

from __future__ import annotations

import importlib
import math
import multiprocessing
import signal
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection
from types import FrameType
from typing import Any, Protocol, final, runtime_checkable

import numpy as np
from jaxtyping import Float

from hrc_learn.distributed import ByValue
from hrc_learn.protocols import Arm, ArmState, Gripper
from hrc_learn.watchdog import Watchdog, WatchdogError, bring_to_rest

_STARTUP = 180.0
"""Timeout for connecting [s]."""


class DriverError(RuntimeError):
    """The driver of a device raised an exception, which the message quotes."""


class ArmFaultError(RuntimeError):
    """The arm has stopped and takes no commands until `recover` is called."""


def imported(name: str, advice: str) -> Any:
    """Import the library of a driver when its device is opened.

    Raises:
        ImportError: The library is not installed; the message contains the advice.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"{advice} ({error})") from error


class Connected(ABC):
    """A device that is connected from its construction until its `with` block ends."""

    @abstractmethod
    def close(self) -> None:
        """Disconnect."""

    def __enter__[Device](self: Device) -> Device:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def checked_velocity(
    velocity: Float[np.ndarray, "..."], names: Sequence[str], fastest: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Check joint velocities, and clip them to the largest allowed ones [rad/s].

    Args:
        velocity: Joint velocities [rad/s].
        names: Names of the joints.
        fastest: Largest allowed velocity of each joint [rad/s].

    Raises:
        ValueError: The velocities have another shape, are not finite, or exceed `fastest` by
            more than rounding.
    """
    velocity = np.asarray(velocity, dtype=float)
    if velocity.shape != (len(names),) or not np.isfinite(velocity).all():
        raise ValueError(f"joint_velocity must be {len(names)} finite numbers, not {velocity}.")
    # A filter that follows a limit may exceed it by rounding.
    for i in np.flatnonzero(np.abs(velocity) > fastest * (1 + 1e-6)):
        text = f"{names[i]}: {velocity[i]:.3f} rad/s is beyond its limit"
        raise ValueError(f"{text} of {fastest[i]:.3f} rad/s.")
    return np.clip(velocity, -fastest, fastest)


@final
class DriverProcess:
    """Starts the process of a driver and calls it, from any thread.

    Attributes:
        process: The process.
        news: Number that the process sent with its last answer (see `answer_calls`).
    """

    def __init__(self, serve: Callable[..., None], *arguments: object, name: str):
        """Start the process and wait until its driver is connected.

        Args:
            serve: Function that runs in the process; must be picklable. Its arguments are the
                process's end of the connection, then `arguments`. See `opened` and
                `answer_calls`.
            arguments: Further arguments of `serve`.
            name: Name of the device.

        Raises:
            DriverError: The device cannot be reached.
            WatchdogError: The process died or took too long.
        """
        self.news = 0
        self._name, self._lost, self._number = name, "", 0
        self._calling = threading.Lock()
        # A forked process would inherit locks, but not the threads that hold them.
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self.process = context.Process(
            target=serve, args=(theirs, *map(ByValue, arguments)), name=name, daemon=True
        )
        self.process.start()
        theirs.close()  # otherwise the end of the process would go unnoticed
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
        """Close the connection, and kill the process if a call was left unanswered.

        Args:
            timeout: Longest wait for the process to end by itself [s].
        """
        hangs = self._lost != ""
        self._lost = self._lost or f"the process of the {self._name} is closed."
        self._connection.close()
        self.process.join(timeout)
        if hangs:
            self.kill()

    def kill(self) -> None:
        """Kill the process, even during a call."""
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
    """Connect to a device, in the driver's process. If this fails, send the error and return
    None.
    """
    # Ctrl-C reaches all processes of a terminal: the calling process decides what to do.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        return open_driver()
    except Exception as error:
        connection.send((0, None, _described(error), 0))
        return None


def answer_calls(
    connection: Connection, carry_out: Callable[..., object], news: Callable[[], int] = int
) -> None:
    """Answer calls until the calling process closes the connection or dies.

    Args:
        connection: The process's end of the connection.
        carry_out: Carries out a call, given its name and arguments.
        news: Returns the number to send with each answer.
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


_PATIENCE = 60.0
"""Longest time for which the process keeps trying to stop an arm whose loop has died [s]. A
control box needs less time to restart.
"""
SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGTERM", "SIGINT", "SIGHUP") if hasattr(signal, name)
)
"""Signals that end a program: from its supervisor, from Ctrl-C, from a closed terminal."""


@contextmanager
def ending_at_rest(stop: Callable[[], object], *, patience: float = 5.0) -> Iterator[None]:
    """Bring the arm to rest however this block ends.

        with ending_at_rest(arm.stop):
            while servoing():
                arm.command(runner.step())

    SIGTERM and SIGHUP end the block as `SystemExit` with status 128 + signal number, SIGINT as
    `KeyboardInterrupt`; further signals have no effect until the arm is at rest. An ignored
    signal stays ignored. Outside the main thread, signals are not handled.

    Args:
        stop: Brings the arm to rest.
        patience: Longest time for which a failing stop is repeated [s].

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
    try:
        try:
            yield
        finally:
            ending = True
    finally:  # also if the signal came in the line above
        stopped = bring_to_rest(stop, patience)
        for number, handler in before.items():
            signal.signal(number, handler)
        if not stopped:
            print(f"the arm could not be stopped within {patience:g} s", file=sys.stderr)
    if not stopped:
        raise RuntimeError(f"the arm could not be stopped within {patience:g} s.")


def _handled_by(handler: Callable[[int, FrameType | None], None]) -> dict[int, Any]:
    """Set a handler for the signals, and return the previous handlers."""
    before: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for number in SIGNALS:
            # None: the handler was set by a library, outside Python.
            if signal.getsignal(number) not in (signal.SIG_IGN, None):
                before[number] = signal.signal(number, handler)
    return before


@runtime_checkable
class StoppableArm(Arm, Gripper, Protocol):
    """An arm with a gripper, as drivers implement it."""

    def stop(self) -> None:
        """Bring the arm to rest."""


@final
class ArmProcess:
    """An `Arm` and a `Gripper` whose driver runs in another process.

    with ArmProcess(partial(FrankyArm, ip), timeout=0.15) as arm:
        while servoing():
            arm.command(velocity(arm.read()))

    The driver's process stops the arm if no command comes within the timeout, even if the
    loop's own process blocks its interpreter, is suspended or is killed. The driver's process
    ignores Ctrl-C; on SIGTERM it stops the arm and ends. If it dies, its connection to the arm
    is lost: this ends the motion of any arm with a control box, and the loop's next request
    raises `WatchdogError`.

    After the process has stopped the arm (a trip), it ignores commands until the loop has
    received the new value of `trips`. From this value, the loop knows that it has to start from
    rest.

    Every method raises `DriverError` with the driver's own exception, and `WatchdogError` if
    the process does not answer within the timeout.
    """

    def __init__(self, open_arm: Callable[[], StoppableArm], *, timeout: float):
        """Start the process and connect.

        Args:
            open_arm: Connects to the arm, in the process; must be picklable.
            timeout: Longest time without a sign of life from the loop, and longest wait for an
                answer [s].

        Raises:
            ValueError: The timeout is not positive or not finite.
            DriverError: The arm cannot be reached.
            WatchdogError: The process died or took too long.
        """
        if not 0 < timeout < math.inf:
            raise ValueError(f"timeout must be positive and finite, but is {timeout}")
        self._timeout = timeout
        self._driver = DriverProcess(_serve, open_arm, timeout, name="arm")
        self._call = partial(self._driver.call, timeout=timeout)

    @property
    def pid(self) -> int | None:
        """ID of the process."""
        return self._driver.process.pid

    @property
    def trips(self) -> int:
        """Number of times that the process has stopped the arm, as of its last answer."""
        return self._driver.news

    def read(self) -> ArmState:
        """Return the newest state."""
        return self._call("read")

    def command(self, joint_velocity: Float[np.ndarray, " joints"]) -> None:
        """Set the joint velocities [rad/s]. This counts as a sign of life, unless it raises an
        error.
        """
        self._call("command", np.asarray(joint_velocity, dtype=float), self.trips)

    def move(self, width: float) -> None:
        """Set the opening of the gripper [m]."""
        self._call("move", float(width))

    def feed(self) -> None:
        """Report that the loop is alive, without a command."""
        self._call("feed")

    def stop(self) -> None:
        """Bring the arm to rest."""
        self._call("stop")

    def close(self) -> None:
        """Bring the arm to rest and end the process.

        Raises:
            WatchdogError: The arm could not be stopped, or the process has ended.
        """
        try:
            if not self._driver.call("close", timeout=_PATIENCE + self._timeout):
                raise WatchdogError(f"the arm could not be stopped within {_PATIENCE:g} s.")
        finally:
            self._driver.end(self._timeout + 1.0)

    def __enter__(self) -> ArmProcess:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
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
                # A loop that does not know of the last stop would make the arm jump.
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
            answer_calls(connection, carry_out, lambda: dog.trips)
        finally:
            dog.close()
