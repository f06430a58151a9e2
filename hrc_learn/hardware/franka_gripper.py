"""A gripper whose calls take seconds, in a process of its own: nothing waits for it.

A driver's `move` returns when the fingers have arrived, and pylibfranka holds the interpreter
until then. So the calls are made elsewhere, one at a time; while one runs the newest wish
waits, and the width last read stands.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from multiprocessing.sharedctypes import RawArray
from typing import Protocol, final

import numpy as np

from hrc_learn.hardware.franka_loop import import_pylibfranka
from hrc_learn.hardware.franka_memory import TEXT, Mailbox

NARROW = 0.005
"""Openings below this are a wish to squeeze; smaller changes of a wish are none [m]."""
_READ_EVERY = 0.02
"""Between two readings of the width [s]: the gripper's own state comes at some 50 Hz."""
_STARTUP = 60.0
"""Longest that connecting may take [s]."""


class GripperCalls(Protocol):
    """Calls of a gripper's driver; each may take seconds."""

    def width(self) -> float:
        """Read the opening [m]."""
        ...

    def move(self, width: float) -> None:
        """Open or close to a width [m]."""
        ...

    def grasp(self) -> None:
        """Squeeze what is between the fingers."""
        ...


@final
class FrankaHand:
    """The gripper of a Franka arm, by pylibfranka."""

    def __init__(self, ip: str, *, speed: float, force: float):
        """Connect.

        Args:
            ip: Address of the control box.
            speed: Of the fingers [m/s].
            force: To squeeze with [N].

        Raises:
            ImportError: The driver is not installed.
        """
        self._gripper = import_pylibfranka().Gripper(ip)
        self._speed, self._force = speed, force

    def width(self) -> float:
        return float(self._gripper.read_once().width)

    def move(self, width: float) -> None:
        if not self._gripper.move(width, self._speed):
            raise RuntimeError(f"the gripper has not reached {width:g} m.")

    def grasp(self) -> None:
        # Whatever is between the fingers is a grasp; nothing is one of width zero.
        self._gripper.grasp(0.0, self._speed, self._force, 0.1, 0.1)


@final
class GripperProcess:
    """A gripper that takes wishes and tells its width, both at once."""

    def __init__(self, open_gripper: Callable[[], GripperCalls]):
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
            target=_serve,
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
        if abs(width - self._width) < NARROW:
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


def _serve(
    wish: Mailbox,
    status: Mailbox,
    text: object,
    open_gripper: Callable[[], GripperCalls],
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
                if line[1] < NARROW:
                    gripper.grasp()
                else:
                    gripper.move(float(line[1]))
            width = gripper.width()
        except Exception as error:
            note(error)
            failures += 1
        status.write(np.array([width, failures, done]))
        time.sleep(max(0.0, begin + _READ_EVERY - time.monotonic()))
