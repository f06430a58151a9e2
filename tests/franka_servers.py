"""Simulators of Franka's control interface.

Each has a process and a loopback address of its own: libfranka knows one port only.
"""

import os
import random
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, TextIO

import numpy as np
import pytest

_ROOT = Path(__file__).parents[1]
_FRANKA_SIM = _ROOT / ".venv-franka-sim" / "bin" / "python"
_SAMPLE = 23  # numbers, as in tools/franka_sim_server.py

needs_franka_sim = pytest.mark.skipif(
    not _FRANKA_SIM.exists(), reason="franka-sim has no environment: tools/make_franka_sim.sh"
)


def loopback() -> str:
    """An address that nobody else is likely to use."""
    # Of the system: the generators of tests are seeded alike, so that they would draw the same.
    chance = random.SystemRandom()
    return (
        f"127.{chance.randrange(16, 240)}.{chance.randrange(1, 250)}.{chance.randrange(1, 250)}"
    )


class Trace(NamedTuple):
    """What a simulated arm did, a sample each millisecond or so."""

    moment: np.ndarray
    """By time.monotonic() [s]."""
    time: np.ndarray
    """Simulated [s]."""
    position: np.ndarray
    """(samples, 7) [rad]"""
    velocity: np.ndarray
    """(samples, 7) [rad/s]"""
    commanded: np.ndarray
    """(samples, 7): what the control box has as the commanded velocity [rad/s]."""

    @classmethod
    def read(cls, path: Path) -> "Trace":
        """All that has been written so far."""
        numbers = np.fromfile(path)
        table = numbers[: len(numbers) // _SAMPLE * _SAMPLE].reshape(-1, _SAMPLE)
        parts = np.split(table, (1, 2, 9, 16), axis=1)
        return cls(parts[0][:, 0], parts[1][:, 0], *parts[2:])

    def rest_after(self, moment: float, watched: float = np.inf) -> float:
        """Simulated time from a moment until no joint moves any more [s].

        By the way within 20 ms, as joint 7 of this model trembles by 0.08 mrad a step.

        Args:
            moment: By time.monotonic() [s].
            watched: For how long from then on [s].
        """
        first, end = np.searchsorted(self.moment, [moment, moment + watched])
        time, position = self.time[first:end], self.position[first:end]
        later = np.searchsorted(time, time + 0.02)
        here = np.flatnonzero(later < len(time))
        later = later[here]
        way = np.abs(position[later] - position[here]).max(axis=1)
        moving = np.flatnonzero(way > 0.02 * (time[later] - time[here]))
        return float(time[later[moving[-1]]] - time[0]) if len(moving) else 0.0


@contextmanager
def franka_sim(host: str, trace: Path, *options: str) -> Iterator[subprocess.Popen]:
    """A server of franka-sim that enforces limits and counts lost packets.

    What it complains of goes beside the trace, into a file that ends in ".log".
    """
    program = _ROOT / "tools" / "franka_sim_server.py"
    arguments = [_FRANKA_SIM, program, "--host", host, "--trace", trace, *options]
    with trace.with_suffix(".log").open("w") as log, _running(arguments, log) as process:
        yield process


@contextmanager
def franky_sim(host: str) -> Iterator[subprocess.Popen]:
    """A server of franky-sim, which enforces nothing."""
    with _running([sys.executable, __file__, host]) as process:
        yield process


@contextmanager
def _running(arguments: list, log: TextIO | None = None) -> Iterator[subprocess.Popen]:
    process = subprocess.Popen(
        [str(x) for x in arguments],
        stdout=subprocess.PIPE,
        stderr=log,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        text=True,
    )
    assert process.stdout is not None
    try:
        line = process.stdout.readline()
        assert "listening" in line, f"{arguments[1]} did not start: {line}"
        yield process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def _serve_franky_sim(host: str) -> None:
    from franky_sim.mujoco_simulator import MujocoSimulator
    from franky_sim.simulation_server import SimulationServer

    simulator = MujocoSimulator()
    simulator.init()
    simulator.add_robot()
    with SimulationServer(simulator, hostname_candidates=[host]) as server:
        print("listening", flush=True)
        server.run_forever()


if __name__ == "__main__":
    _serve_franky_sim(sys.argv[1])
