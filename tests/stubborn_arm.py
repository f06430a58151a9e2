"""An arm that writes down what it is told, and fails when it is meant to."""

import os
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hrc_learn.protocols import ArmState


@dataclass
class StubbornArm:
    log: Path
    """Receives a line for each event: time [s], process, what."""
    failing_stops: int = 0
    """Stops that raise before one works."""
    failing_commands: tuple[int, ...] = ()
    """Numbers of the commands that raise, from 0."""
    hanging_read: float = 0.0
    """How long a reading takes [s]."""
    commands: int = 0

    def note(self, what: str) -> None:
        with self.log.open("a") as file:
            file.write(f"{time.monotonic():.6f} {os.getpid()} {what}\n")

    def read(self) -> ArmState:
        time.sleep(self.hanging_read)
        zeros = np.zeros(7)
        return ArmState(
            time=time.monotonic(), joint_position=zeros, joint_velocity=zeros, gripper_width=0.0
        )

    def command(self, joint_velocity: np.ndarray) -> None:
        self.commands += 1
        if self.commands - 1 in self.failing_commands:
            raise OSError("the control box is offline")
        self.note(f"command {joint_velocity[0]}")

    def stop(self) -> None:
        if self.failing_stops > 0:
            self.failing_stops -= 1
            self.note("failed stop")
            raise OSError("the control box is offline")
        self.note("stop")

    def move(self, width: float) -> None:
        self.note(f"move {width}")


def events(log: Path) -> list[tuple[float, int, str]]:
    """Time [s], process and what happened, in order."""
    lines = log.read_text().splitlines() if log.exists() else []
    return [(float(t), int(pid), what) for t, pid, what in (x.split(" ", 2) for x in lines)]


def wait_for(log: Path, what: str, after: int = 0, patience: float = 60.0) -> float:
    """When something happened, events before number `after` left out [s]."""
    end = time.monotonic() + patience
    while time.monotonic() < end:
        for moment, _, event in events(log)[after:]:
            if event == what:
                return moment
        time.sleep(0.005)
    raise AssertionError(f"no {what!r} in {events(log)[after:]}")
