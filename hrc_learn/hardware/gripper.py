"""Grippers on threads or in a process, so that no loop waits for their fingers."""

from __future__ import annotations

import atexit
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from multiprocessing.sharedctypes import RawArray
from typing import Protocol, final, runtime_checkable

import numpy as np

from hrc_learn.hardware.franka_memory import TEXT, Mailbox

_NARROW = 0.005
"""Openings below this are a request to squeeze, and smaller changes are no new request [m]: a
tenth of the width of an object that two fingers take."""
_BETWEEN_READINGS = 0.02
"""Period of the width readings [s]: skills read it every 10 ms and act on millimetres, for
which fingers at 0.1 m/s take 20 ms.
"""
_BEFORE_NEXT_TRY = 1.0
"""After the connection failed [s]: a control box takes some seconds to start again."""
_ENDING = 2.0
"""Longest wait for each thread to end [s]: twice what libfranka waits for a reading."""
_STARTUP = 60.0
"""Longest time for connecting in a new process [s]."""


class GripperError(RuntimeError):
    """A gripper failed to move, or cannot be reached."""


@runtime_checkable
class GripperDriver(Protocol):
    """A gripper whose calls take as long as its fingers do.

    The width is read by one thread while another waits in `move` or `squeeze`.
    """

    def read_width(self) -> float:
        """Return the opening [m]; waits for the next reading."""
        ...

    def move(self, width: float) -> bool:
        """Bring the fingers to an opening [m] and wait; False: they did not get there."""
        ...

    def squeeze(self) -> bool:
        """Close on what is between the fingers and wait; False: they do not press on it."""
        ...


def report_failure(failure: GripperError) -> None:
    """Print a failure of the gripper on stderr."""
    print(f"gripper: {failure}", file=sys.stderr)


@final
class GripperThread:
    """A `Gripper` that neither blocks nor raises within an arm's control loop.

        with GripperThread(open_driver) as gripper:
            gripper.move(0.0)  # returns at once; 0 squeezes
            gripper.width  # newest reading
            gripper.check()  # raises what has failed since `move`

    One thread reads the width; another carries out moves, always the newest request after the
    current one. A dropped connection is opened again. Failures are passed to `report` and kept
    until the next move, so that a task can check for them at a suitable moment while the
    control loop continues.
    """

    def __init__(
        self,
        open_driver: Callable[[], GripperDriver],
        *,
        startup: float = 5.0,
        report: Callable[[GripperError], object] = report_failure,
    ):
        """Connect and wait for the first reading.

        Args:
            open_driver: Connects to the gripper.
            startup: Longest time for connecting [s].
            report: Called with each failure, by the thread that met it.

        Raises:
            GripperError: The gripper cannot be reached.
        """
        self._open, self._report = open_driver, report
        self._width: float | None = None
        self._failure: GripperError | None = None
        self._driver: GripperDriver | None = None
        self._wanted: float | None = None
        self._last: float | None = None
        self._news = threading.Condition()
        self._closed = False
        self._threads = [
            threading.Thread(target=work, name=f"gripper {name}", daemon=True)
            for name, work in (("reader", self._read), ("mover", self._carry_out))
        ]
        # A thread within a driver's own code must not be cut off by the end of the interpreter:
        # that ends the whole process by a signal.
        atexit.register(self.close)
        for thread in self._threads:
            thread.start()
        with self._news:
            self._news.wait_for(lambda: self._width is not None or self._failure, startup)
            if self._width is not None:
                return
            failure = self._failure
        self.close()
        raise failure or GripperError(
            f"the gripper has not reported its width for {startup:g} s: is it mounted, "
            "switched on and homed?"
        )

    @property
    def width(self) -> float:
        """Newest opening known [m]."""
        assert self._width is not None  # the constructor waits for the first
        return self._width

    @property
    def failure(self) -> GripperError | None:
        """Failure since the last new opening was requested; None if there was none."""
        return self._failure

    def check(self) -> None:
        """Raise what failed since the last new opening was asked for.

        Raises:
            GripperError: A move failed, or the gripper cannot be reached.
        """
        with self._news:
            failure = self._failure
        if failure is not None:
            raise failure

    def move(self, width: float) -> None:
        """Ask for an opening, or to squeeze what is between the fingers [m].

        Taken once for each new opening, so that it may be asked for in every step of a loop.
        One that failed is not tried again before another has been asked for: fingers that move
        by themselves, once a connection is back, would surprise whoever went to look.

        Raises:
            ValueError: The opening is not finite, or negative.
        """
        if not 0 <= width < float("inf"):
            raise ValueError(f"width must be finite and not negative [m], but is {width}.")
        with self._news:
            if self._last is not None and abs(width - self._last) < _NARROW:
                return
            self._last = self._wanted = width
            if self._driver is not None:
                self._failure = None
            self._news.notify_all()

    def close(self) -> None:
        """End the threads, once the driver returns to them; the fingers stay."""
        atexit.unregister(self.close)
        with self._news:
            self._closed = True
            self._news.notify_all()
        for thread in self._threads:
            thread.join(_ENDING)
        self._driver = None  # which ends its connection

    def __enter__(self) -> GripperThread:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _read(self) -> None:
        while not self._closed:
            pause = _BETWEEN_READINGS
            try:
                width = (self._driver or self._connect()).read_width()
                with self._news:
                    self._width = float(width)
                    self._news.notify_all()
            except Exception as error:  # a driver's, of whatever kind
                self._driver = None
                self._fail("cannot be reached, and is tried again", error)
                pause = _BEFORE_NEXT_TRY
            with self._news:
                self._news.wait_for(lambda: self._closed, pause)

    def _connect(self) -> GripperDriver:
        driver = self._open()
        with self._news:
            self._driver = driver
            self._news.notify_all()
        return driver

    def _carry_out(self) -> None:
        while True:
            with self._news:
                self._news.wait_for(
                    lambda: self._closed or not (self._wanted is None or self._driver is None)
                )
                if self._closed:
                    return
                driver, width, self._wanted = self._driver, self._wanted, None
            assert driver is not None
            assert width is not None
            squeezes = width < _NARROW
            what = "close on anything" if squeezes else f"open to {1e3 * width:.0f} mm"
            try:
                done = driver.squeeze() if squeezes else driver.move(width)
                error = None
            except Exception as raised:
                done, error = False, raised
            if not done:
                self._fail(f"did not {what}", error)

    def _fail(self, what: str, error: Exception | None) -> None:
        because = "" if error is None else f" ({type(error).__name__}: {error})"
        failure = GripperError(f"the gripper {what}{because}.")
        with self._news:
            known = str(self._failure) == str(failure)
            self._failure = failure
            self._news.notify_all()
        if not known and not self._closed:
            self._report(failure)


@final
class GripperProcess:
    """A gripper whose calls are made in another process, one at a time.

    For drivers that hold the interpreter during a call, as pylibfranka does. While a call runs,
    the newest request waits, and the width last read stands.
    """

    def __init__(self, open_gripper: Callable[[], GripperDriver]):
        """Start the process and connect.

        Args:
            open_gripper: Connects, in the process; it is pickled.

        Raises:
            RuntimeError: The gripper cannot be reached; it says why.
        """
        self._wish, self._status = Mailbox(2), Mailbox(3)
        self._wish.write(np.array([0.0, np.nan]))
        self._status.write(np.array([np.nan, 0.0, 0.0]))
        self._text = RawArray("c", TEXT)
        self._wishes, self._seen, self._width = 0, 0.0, np.nan
        context = multiprocessing.get_context("spawn")
        self._process = context.Process(
            target=_serve_gripper,
            args=(self._wish, self._status, self._text, open_gripper, os.getpid()),
            name="gripper",
            daemon=True,
        )
        self._process.start()
        end = time.monotonic() + _STARTUP
        while np.isnan(self.width):
            if not self._process.is_alive() or time.monotonic() > end:
                self.close()
                text = self._message or f"no answer for {_STARTUP:g} s."
                raise RuntimeError(f"the gripper cannot be reached: {text}")
            time.sleep(0.01)

    @property
    def width(self) -> float:
        """Opening, as last read; NaN before the first reading [m]."""
        line = self._status.read()
        return np.nan if line is None else float(line[0])

    @property
    def busy(self) -> bool:
        """True while the newest request is not yet done."""
        line = self._status.read()
        return line is not None and bool(line[2] < self._wishes)

    def move(self, width: float) -> None:
        """Open to a width, or squeeze what is between the fingers [m]; returns at once.

        Sent once for each new width.

        Raises:
            ValueError: The width is not a number.
            RuntimeError: The call before has failed, or the process has ended; the message
                says why. The next is tried anew.
        """
        if not np.isfinite(width):
            raise ValueError(f"width must be finite, but is {width}.")
        if not self._process.is_alive():
            raise RuntimeError(f"the process of the gripper has ended. {self._message}")
        line = self._status.read()
        if line is not None and line[1] > self._seen:
            self._seen, self._width = line[1], np.nan
            raise RuntimeError(f"the gripper has failed: {self._message}")
        if abs(width - self._width) < _NARROW:
            return
        self._width = width
        self._wishes += 1
        self._wish.write(np.array([float(self._wishes), width]))

    def close(self) -> None:
        """End the process, whatever call it is in."""
        if self._process.is_alive():
            self._process.kill()
        self._process.join()

    @property
    def _message(self) -> str:
        return self._text.value.decode("utf-8", "replace")


def _serve_gripper(
    wish: Mailbox,
    status: Mailbox,
    text: object,
    open_gripper: Callable[[], GripperDriver],
    parent: int,
) -> None:
    """Serve the gripper in its process until the parent has gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def note(error: Exception) -> None:
        message = f"{type(error).__name__}: {error}"
        text.value = message.encode()[: TEXT - 1]  # pyright: ignore[reportAttributeAccessIssue]

    try:
        gripper = open_gripper()
    except Exception as error:
        note(error)
        return
    width, failures, done = np.nan, 0, 0.0
    while os.getppid() == parent:
        begin = time.monotonic()
        try:
            line = wish.read()
            if line is not None and line[0] > done:
                done = line[0]
                squeezes = line[1] < _NARROW
                if not (gripper.squeeze() if squeezes else gripper.move(float(line[1]))):
                    raise GripperError(f"it has not reached {line[1]:g} m.")
            width = gripper.read_width()
        except Exception as error:
            note(error)
            failures += 1
        status.write(np.array([width, failures, done]))
        time.sleep(max(0.0, begin + _BETWEEN_READINGS - time.monotonic()))
