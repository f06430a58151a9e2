"""Settings of a Franka arm's control box, and the memory of its loop.

The loop shares the memory with the process that commands it. Orders go one way, reports the
other, each as the newest line of numbers in a mailbox: neither side ever waits for the other.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from multiprocessing.sharedctypes import RawArray
from typing import Any, final

import numpy as np
from jaxtyping import Float

JOINTS = 7
TEXT = 2000
"""Longest message about a fault [bytes]."""
COST_BINS = 2000
"""Number of bins of the histogram of cycle costs, each 1 us wide; the last holds all longer
ones.
"""

_TRIES = 100
"""Readings of a mailbox before its writer is taken for dead in the middle of a line: a line is
written within a microsecond or two."""


@dataclass(frozen=True, kw_only=True)
class Load:
    """A load on the flange, in addition to the end effector that the arm is configured for."""

    mass: float = 0.0
    """[kg]"""
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre of mass, in the flange's frame [m]."""
    inertia: tuple[tuple[float, ...], ...] = ((0.0,) * 3,) * 3
    """About that centre, along the flange's axes [kg m^2]."""

    def __post_init__(self) -> None:
        if not 0 <= self.mass < float("inf"):
            raise ValueError(f"mass of a load must not be negative, but is {self.mass} kg.")
        if not np.isfinite(self.centre).all():
            raise ValueError(f"centre of a load must be finite, but is {self.centre} m.")
        tensor = np.array(self.inertia)
        if tensor.shape != (3, 3) or not np.allclose(tensor, tensor.T, rtol=1e-9, atol=0):
            raise ValueError(
                f"inertia of a load must be a symmetric matrix, 3 by 3, but is {self.inertia}."
            )
        if np.linalg.eigvalsh(tensor).min() < 0:
            raise ValueError(
                f"inertia of a load must not be negative about any axis, but is {self.inertia}."
            )


@dataclass(frozen=True, kw_only=True)
class CollisionConfig:
    """Estimated external load from which on the arm stops by a reflex.

    The default is that of the maker's own example of joint velocities (libfranka,
    examples/generate_joint_velocity_motion.cpp), for contacts and collisions alike.
    """

    torque: tuple[float, ...] = (20.0, 20.0, 18.0, 18.0, 16.0, 14.0, 12.0)
    """On each joint [N m]."""
    force: tuple[float, ...] = (20.0, 20.0, 20.0, 25.0, 25.0, 25.0)
    """Threshold at the end effector: forces along x, y, z [N], torques about them [N m]."""

    def __post_init__(self) -> None:
        for name, number in (("torque", 7), ("force", 6)):
            values = getattr(self, name)
            if len(values) != number or not all(0 < v < float("inf") for v in values):
                raise ValueError(
                    f"{name} of a collision must be {number} positive numbers, but is {values}."
                )


class Phase(IntEnum):
    """Activity of the loop."""

    STARTING = 0
    IDLE = 1
    MOVING = 2
    FAULTED = 3
    RECOVERING = 4
    ENDED = 5


@final
class Mailbox:
    """The newest line of numbers that one process writes and others read, without a lock.

    The first number counts: odd while a line is being written. A reader takes a line only if
    the count was even and has not changed meanwhile, and never waits for a writer.
    """

    def __init__(self, size: int):
        """Take shared memory for lines of a length."""
        self._memory = RawArray("d", size + 1)
        self._attach()

    def _attach(self) -> None:
        self._line = np.frombuffer(self._memory, dtype=float)

    def __getstate__(self) -> object:
        return self._memory

    def __setstate__(self, memory: Any) -> None:
        self._memory = memory
        self._attach()

    def write(self, line: Float[np.ndarray, " size"]) -> None:
        """Replace the line. There is one writer at a time."""
        self._line[0] += 1
        self._line[1:] = line
        self._line[0] += 1

    def read(self) -> Float[np.ndarray, " size"] | None:
        """Return the newest line; None: its writer stays in the middle of one."""
        for _ in range(_TRIES):
            before = self._line[0]
            line = self._line[1:].copy()
            if before % 2 == 0 and self._line[0] == before:
                return line
        return None


def _zeros() -> Float[np.ndarray, "7"]:
    return np.zeros(JOINTS)


@dataclass
class Orders:
    """Orders of the commanding process, as a line of a mailbox."""

    stamp: float = -np.inf
    """Time at which the velocity was set, on `time.monotonic` [s]."""
    stop: bool = False
    """True brakes to rest, whatever the velocity."""
    recoveries: int = 0
    """Number of recoveries requested."""
    end: bool = False
    """True brings the arm to rest and ends the loop."""
    joint_velocity: Float[np.ndarray, "7"] = field(default_factory=_zeros)
    """Wanted [rad/s]."""

    SIZE = 4 + JOINTS

    def line(self) -> Float[np.ndarray, " size"]:
        """The numbers."""
        numbers = [self.stamp, self.stop, self.recoveries, self.end, *self.joint_velocity]
        return np.array(numbers, dtype=float)

    @classmethod
    def of(cls, line: Float[np.ndarray, " size"]) -> Orders:
        """Read the orders from a line."""
        return cls(float(line[0]), bool(line[1]), int(line[2]), bool(line[3]), line[4:])


@dataclass
class Report:
    """State of the loop, as a line of a mailbox."""

    phase: Phase = Phase.STARTING
    stamp: float = -np.inf
    """Time at which the state was read, on `time.monotonic` [s]."""
    time: float = 0.0
    """Robot's clock [s]."""
    recoveries: int = 0
    """Requests for recovery that have been dealt with."""
    faults: int = 0
    """So far."""
    cycles: int = 0
    """Answered in motion."""
    lost: int = 0
    """Cycles whose state could not be answered in time."""
    resting: bool = True
    """True if the velocity sent last is zero."""
    joint_position: Float[np.ndarray, "7"] = field(default_factory=_zeros)
    """[rad]"""
    joint_velocity: Float[np.ndarray, "7"] = field(default_factory=_zeros)
    """[rad/s]"""
    external_torque: Float[np.ndarray, "7"] = field(default_factory=_zeros)
    """[N m]"""

    SIZE = 8 + 3 * JOINTS

    def line(self) -> Float[np.ndarray, " size"]:
        """The numbers."""
        head = [
            self.phase, self.stamp, self.time, self.recoveries, self.faults, self.cycles,
            self.lost, self.resting,
        ]  # fmt: skip
        return np.array(
            [*head, *self.joint_position, *self.joint_velocity, *self.external_torque],
            dtype=float,
        )

    @classmethod
    def of(cls, line: Float[np.ndarray, " size"]) -> Report:
        """Read the report from a line."""
        q, dq, torque = line[8:].reshape(3, JOINTS)
        return cls(
            phase=Phase(int(line[0])),
            stamp=float(line[1]),
            time=float(line[2]),
            recoveries=int(line[3]),
            faults=int(line[4]),
            cycles=int(line[5]),
            lost=int(line[6]),
            resting=bool(line[7]),
            joint_position=q,
            joint_velocity=dq,
            external_torque=torque,
        )


@final
class Shared:
    """The memory that both processes have."""

    def __init__(self):
        self.orders, self.report = Mailbox(Orders.SIZE), Mailbox(Report.SIZE)
        self.orders.write(Orders().line())
        self.report.write(Report().line())
        self._text = RawArray("c", TEXT)
        self._costs = RawArray("d", COST_BINS)

    @property
    def message(self) -> str:
        """About the last fault."""
        return self._text.value.decode("utf-8", "replace")

    @message.setter
    def message(self, text: str) -> None:
        self._text.value = text.encode()[: TEXT - 1]

    @property
    def costs(self) -> Float[np.ndarray, " bins"]:
        """Number of cycles by their cost [us], from reading a state to answering it."""
        return np.frombuffer(self._costs, dtype=float)
