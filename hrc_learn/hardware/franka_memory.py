"""Memory through which a Franka arm's 1 kHz loop and the process that commands it communicate.

Orders go to the loop, and reports come back. Two mailboxes hold the newest order and the newest
report, each as a line of numbers. Neither process ever waits for the other.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from multiprocessing.sharedctypes import RawArray
from typing import Any, final

import numpy as np
from jaxtyping import Float

JOINTS = 7
_TEXT = 2000
"""Longest message about a fault [bytes]."""


class Phase(IntEnum):
    """Activity of the loop."""

    STARTING = 0
    IDLE = 1
    MOVING = 2
    FAULTED = 3
    RECOVERING = 4
    ENDED = 5


def _zeros() -> Float[np.ndarray, "7"]:
    return np.zeros(JOINTS)


class Numbers:
    """Base of dataclasses that are stored as a line of numbers: all fields in order. Each field
    has a default.
    """

    def line(self) -> Float[np.ndarray, " size"]:
        """All fields as one line of numbers."""
        return np.concatenate([np.ravel(value) for value in vars(self).values()], dtype=float)

    @classmethod
    def of[Line: Numbers](cls: type[Line], line: Float[np.ndarray, " size"]) -> Line:
        """Read the fields from a line."""
        new, begin = cls(), 0
        for name, default in vars(new).items():
            end = begin + np.size(default)
            numbers = line[begin:end]
            joints = isinstance(default, np.ndarray)
            setattr(new, name, numbers if joints else type(default)(numbers[0]))
            begin = end
        return new


@final
class Mailbox[Line: Numbers]:
    """The newest line of numbers that one process writes and others read, without a lock.

    The memory holds two lines and the number of lines written so far. The parity of this number
    selects the newest line. The writer overwrites the older line, then increases the number. A
    reader therefore always finds a complete line, even if the writer is suspended or dies while
    writing.
    """

    def __init__(self, line: Line):
        """Allocate shared memory for lines of this type, and store this line."""
        self.__setstate__((type(line), RawArray("d", 2 * len(line.line()) + 1)))
        self.write(line)

    def __getstate__(self) -> tuple[type[Line], Any]:
        return self._kind, self._memory

    def __setstate__(self, state: tuple[type[Line], Any]) -> None:
        self._kind, self._memory = state
        numbers = np.frombuffer(self._memory, dtype=float)
        self._written, self._lines = numbers[:1], numbers[1:].reshape(2, -1)

    def write(self, line: Line) -> None:
        """Replace the newest line. Only one process may write at a time."""
        self._lines[int(self._written[0] + 1) % 2] = line.line()
        self._written += 1

    def read(self) -> Line:
        """Return the newest line."""
        while True:
            written = self._written[0]
            line = self._lines[int(written) % 2].copy()
            # If a newer line was written meanwhile, this one may be half overwritten.
            if self._written[0] == written:
                return self._kind.of(line)


@dataclass
class Orders(Numbers):
    """Orders of the commanding process."""

    stamp: float = -np.inf
    """Time at which the velocity was set, on `time.monotonic` [s]."""
    stop: bool = False
    """True: brake to rest, whatever the velocity."""
    recoveries: int = 0
    """Number of recoveries requested."""
    end: bool = False
    """True: bring the arm to rest and end the loop."""
    joint_velocity: Float[np.ndarray, "7"] = field(default_factory=_zeros)
    """Wanted joint velocity [rad/s]."""


@dataclass
class Report(Numbers):
    """State of the loop."""

    phase: Phase = Phase.STARTING
    stamp: float = -np.inf
    """Time at which the state was read, on `time.monotonic` [s]."""
    time: float = 0.0
    """Robot's clock [s]."""
    recoveries: int = 0
    """Number of recoveries that have been carried out, successfully or not."""
    faults: int = 0
    """Number of faults so far."""
    cycles: int = 0
    """Number of cycles answered during motions."""
    lost: int = 0
    """Number of cycles whose state could not be answered in time."""
    cost: float = 0.0
    """Time from reading the last answered state to sending its answer [s]."""
    resting: bool = True
    """True if the velocity sent last is practically zero, or a fault has stopped the arm."""
    joint_position: Float[np.ndarray, "7"] = field(default_factory=_zeros)
    """Joint positions [rad]."""
    joint_velocity: Float[np.ndarray, "7"] = field(default_factory=_zeros)
    """Joint velocities [rad/s]."""
    external_torque: Float[np.ndarray, "7"] = field(default_factory=_zeros)
    """External torques at the joints, as the control box estimates them [N m]."""


@final
class Shared:
    """Memory that both processes can access."""

    def __init__(self):
        self.orders, self.report = Mailbox(Orders()), Mailbox(Report())
        self._text = RawArray("c", _TEXT)

    @property
    def message(self) -> str:
        """Message about the last fault."""
        return self._text.value.decode("utf-8", "replace")

    @message.setter
    def message(self, text: str) -> None:
        self._text.value = text.encode()[: _TEXT - 1]
