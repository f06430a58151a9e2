"""Grippers on threads, so that no loop waits for their fingers."""

from __future__ import annotations

import atexit
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Protocol, final, runtime_checkable

from hrc_learn.hardware.driver_process import (
    DriverError,
    DriverProcess,
    answer_calls,
    opened,
)

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


class GripperError(DriverError):
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

    def close(self) -> None:
        """End the connection; a call under way may fail."""
        ...


@final
class GripperThread:
    """A `Gripper` that neither blocks nor raises within an arm's control loop.

        with GripperThread(open_driver) as gripper:
            gripper.move(0.0)  # returns at once; 0 squeezes
            gripper.width  # newest reading
            gripper.check()  # raises what has failed since `move`

    One thread reads the width; another carries out moves, always the newest request after the
    current one. A dropped connection is opened again. Failures are printed on stderr and kept
    until the next move, so that a task can check for them at a suitable moment while the
    control loop continues.
    """

    def __init__(self, open_driver: Callable[[], GripperDriver], *, startup: float = 5.0):
        """Connect and wait for the first reading.

        Args:
            open_driver: Connects to the gripper.
            startup: Longest time for connecting [s].

        Raises:
            GripperError: The gripper cannot be reached.
        """
        self._open = open_driver
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
        """End the connection and the threads; the fingers stay."""
        atexit.unregister(self.close)
        with self._news:
            self._closed = True
            self._news.notify_all()
        self._disconnect()
        for thread in self._threads:
            thread.join(_ENDING)

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
                self._disconnect()
                self._fail("cannot be reached, and is tried again", error)
                pause = _BEFORE_NEXT_TRY
            with self._news:
                self._news.wait_for(lambda: self._closed, pause)

    def _connect(self) -> GripperDriver:
        driver = self._open()
        with self._news:
            self._driver = driver
            self._news.notify_all()
        if self._closed:  # while it was opened
            self._disconnect()
        return driver

    def _disconnect(self) -> None:
        with self._news:
            driver, self._driver = self._driver, None
        if driver is not None:
            driver.close()

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
            print(f"gripper: {failure}", file=sys.stderr)


@final
class GripperProcess:
    """A gripper driver whose calls are made in another process, one at a time.

    For drivers that hold the interpreter during a call, as pylibfranka does. The width is read
    again after the fingers have moved.
    """

    def __init__(self, open_driver: Callable[[], GripperDriver]):
        """Start the process and connect.

        Args:
            open_driver: Connects, in the process; it is pickled.

        Raises:
            DriverError: The gripper cannot be reached.
            WatchdogError: The process died, or takes too long.
        """
        self._driver = DriverProcess(_serve, open_driver, name="gripper")

    def read_width(self) -> float:
        return self._driver.call("read_width")

    def move(self, width: float) -> bool:
        return self._driver.call("move", width)

    def squeeze(self) -> bool:
        return self._driver.call("squeeze")

    def close(self) -> None:
        """End the process, whatever call it is in."""
        self._driver.kill()


def _serve(connection: Connection, open_driver: Callable[[], GripperDriver]) -> None:
    driver = opened(connection, open_driver)
    if driver is not None:
        answer_calls(connection, lambda name, *arguments: getattr(driver, name)(*arguments))
