"""Drive grippers by threads, so that no control loop waits for the fingers."""

import atexit
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Protocol, final, runtime_checkable

from hrc_learn.hardware.driver_process import (
    Connected,
    DriverError,
    DriverProcess,
    answer_calls,
    opened,
)

_NARROW = 0.005
"""Opening below which the fingers squeeze, and change of the opening below which a new request
is ignored [m]. A typical object is ten times as wide."""
_BETWEEN_READINGS = 0.02
"""Period of the width readings [s]: fingers at 0.1 m/s move 2 mm per period, and skills act on
motions of millimetres.
"""
_BEFORE_NEXT_TRY = 1.0
"""Delay before reconnecting [s]: a control box takes some seconds to restart."""
_ENDING = 2.0
"""Longest wait for each thread to end [s]: twice libfranka's timeout for a reading."""


class GripperError(DriverError):
    """A gripper failed to move, or cannot be reached."""


@runtime_checkable
class GripperDriver(Protocol):
    """A gripper whose `move` and `squeeze` block until the fingers stop.

    One thread reads the width while another waits in `move` or `squeeze`.
    """

    def read_width(self) -> float:
        """Return the opening [m]; waits for the next reading."""
        ...

    def move(self, width: float) -> bool:
        """Move the fingers to an opening [m] and wait; False if they do not reach it."""
        ...

    def squeeze(self) -> bool:
        """Close the fingers on an object and wait; False if they do not press on one."""
        ...

    def close(self) -> None:
        """Close the connection; a call in progress may fail."""
        ...


@final
class GripperThread(Connected):
    """A `Gripper` that neither blocks nor raises within an arm's control loop.

        with GripperThread(open_driver) as gripper:
            gripper.move(0.0)  # does not wait; 0 squeezes
            gripper.width  # newest reading
            gripper.check()  # raises what has failed since `move`

    One thread reads the width. Another thread executes the requests: after each request, it
    continues with the newest one. A lost connection is reopened. Failures are printed on stderr
    and kept until the next move, so that a task can check for failures at a suitable moment
    while the control loop continues.

    Attributes:
        failure: Failure since the last new opening was requested; None if there was none.
    """

    def __init__(self, open_driver: Callable[[], GripperDriver], *, startup: float = 5.0):
        """Connect and wait for the first reading.

        Args:
            open_driver: Connects to the gripper.
            startup: Timeout for connecting [s].

        Raises:
            GripperError: The gripper cannot be reached.
        """
        self._open = open_driver
        self._width: float | None = None
        self.failure: GripperError | None = None
        self._driver: GripperDriver | None = None
        self._wanted: float | None = None
        self._last: float | None = None
        self._news = threading.Condition()
        self._closed = False
        self._threads = [
            threading.Thread(target=work, name=f"gripper {name}", daemon=True)
            for name, work in (("reader", self._read), ("mover", self._carry_out))
        ]
        # Join the threads before the interpreter exits: if it ended a thread inside driver
        # code, a signal would kill the process.
        atexit.register(self.close)
        for thread in self._threads:
            thread.start()
        with self._news:
            self._news.wait_for(lambda: self._width is not None or self.failure, startup)
            if self._width is not None:
                return
            failure = self.failure
        self.close()
        raise failure or GripperError(
            f"the gripper has not reported its width for {startup:g} s: is it mounted, "
            "switched on and homed?"
        )

    @property
    def width(self) -> float:
        """Newest reading of the opening [m]."""
        assert self._width is not None  # the constructor waits for the first
        return self._width

    def check(self) -> None:
        """Raise the failure since the last new opening was requested, if any.

        Raises:
            GripperError: A move failed, or the gripper cannot be reached.
        """
        if (failure := self.failure) is not None:
            raise failure

    def move(self, width: float) -> None:
        """Request an opening [m]; below 5 mm, and at negative values, the fingers squeeze.

        A loop may repeat a request in every step: it is executed once. A failed request is not
        retried until another opening is requested: fingers that move by themselves after a
        reconnection would surprise a person nearby.

        Raises:
            ValueError: The opening is not finite.
        """
        if not abs(width) < float("inf"):
            raise ValueError(f"width must be finite [m], but is {width}.")
        with self._news:
            if self._last is not None and abs(width - self._last) < _NARROW:
                return
            self._last = self._wanted = width
            if self._driver is not None:
                self.failure = None
            self._news.notify_all()

    def close(self) -> None:
        """Close the connection and end the threads, without moving the fingers."""
        atexit.unregister(self.close)
        with self._news:
            self._closed = True
            self._news.notify_all()
        self._disconnect()
        for thread in self._threads:
            thread.join(_ENDING)

    def _read(self) -> None:
        while not self._closed:
            pause = _BETWEEN_READINGS
            try:
                width = (self._driver or self._connect()).read_width()
                with self._news:
                    self._width = float(width)
                    self._news.notify_all()
            except Exception as error:  # drivers may raise anything
                self._disconnect()
                self._fail("cannot be reached; reconnecting", error)
                pause = _BEFORE_NEXT_TRY
            with self._news:
                self._news.wait_for(lambda: self._closed, pause)

    def _connect(self) -> GripperDriver:
        driver = self._open()
        with self._news:
            self._driver = driver
            self._news.notify_all()
        if self._closed:  # during the connection attempt
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
            known = str(self.failure) == str(failure)
            self.failure = failure
            self._news.notify_all()
        if not known and not self._closed:
            print(f"gripper: {failure}", file=sys.stderr)


@final
class GripperProcess:
    """A gripper driver whose calls are made in another process, one at a time.

    This suits drivers that hold the GIL during a call, as pylibfranka does. While the fingers
    move, `read_width` waits.
    """

    def __init__(self, open_driver: Callable[[], GripperDriver]):
        """Start the process and connect.

        Args:
            open_driver: Connects to the gripper in the new process; must be picklable.

        Raises:
            DriverError: The gripper cannot be reached.
            WatchdogError: The process dies or times out.
        """
        self._driver = DriverProcess(_serve, open_driver, name="gripper")

    def read_width(self) -> float:
        return self._driver.call("read_width")

    def move(self, width: float) -> bool:
        return self._driver.call("move", width)

    def squeeze(self) -> bool:
        return self._driver.call("squeeze")

    def close(self) -> None:
        """Kill the process, even during a call."""
        self._driver.kill()


def _serve(connection: Connection, open_driver: Callable[[], GripperDriver]) -> None:
    driver = opened(connection, open_driver)
    if driver is not None:
        answer_calls(connection, lambda name, *arguments: getattr(driver, name)(*arguments))
