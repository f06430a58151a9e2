"""Cost of a cycle of Franka's control interface: our loop and a minimal loop in one run.

Both run against franka-sim with all its checks. Without its environment
(tools/make_franka_sim.sh), nothing is measured. The minimal loop only reads a state and writes
a velocity of zero: the least work that pylibfranka allows in Python. Ours is the loop of
`FrankaArm`, with compiled and uncompiled step: read the state, compute the filtered step, send
the answer. The loops take turns. On a shared machine, their ratio is more reliable than each
time; the load of the machine is reported, too. Costs are wall time from reading the state to
sending the answer.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import multiprocessing
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from hrc_learn import cli
from hrc_learn.hardware import DriverError, FrankaArm, FrankaConfig
from hrc_learn.kinematics import panda

ROOT = Path(__file__).parents[1]
PYTHON = ROOT / ".venv-franka-sim" / "bin" / "python"
CYCLE = 1e-3
LOOPS = ("bare", "compiled", "uncompiled")


@dataclass(frozen=True, kw_only=True)
class Args:
    """Command line."""

    seconds: float = 10.0
    """Motion time of each loop in each turn."""
    turns: int = 2
    """Number of measurements of each loop."""
    host: str = "127.0.2.1"
    """Address of the simulator."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> None:
    """Measure, print a table, and write the measured values."""
    if args.turns < 1 or not args.seconds > 0:
        raise ValueError(f"nothing to measure in {args.turns} turns of {args.seconds} s")
    if not PYTHON.exists():
        Console().print("franka-sim has no environment: run tools/make_franka_sim.sh")
        return
    with simulator(args.host):
        figures = measure(args)
    show(figures)
    if args.json:
        cli.write_json(args.json, figures)


@contextmanager
def simulator(host: str) -> Iterator[None]:
    """Run a server of franka-sim."""
    program = ROOT / "tools" / "franka_sim_server.py"
    with subprocess.Popen(
        [PYTHON, program, "--host", host, "--log", "ERROR"], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        try:
            yield
        finally:
            process.kill()


def measure(args: Args) -> dict[str, float]:
    """Cost [us] and answered fraction of each loop, their ratio, and the load."""
    costs: dict[str, list[np.ndarray]] = {name: [] for name in LOOPS}
    answered: dict[str, list[float]] = {name: [] for name in LOOPS}
    reflexes = dict.fromkeys(LOOPS, 0)
    for _ in range(args.turns):
        for name in LOOPS:
            cost, share, stops = (
                bare_loop(args.host, args.seconds)
                if name == "bare"
                else our_loop(args.host, args.seconds, compiled=name == "compiled")
            )
            costs[name].append(cost)
            answered[name].append(share)
            reflexes[name] += stops
    figures = {}
    for name in LOOPS:
        total = np.sum(costs[name], axis=0)
        for percent in (50, 99):
            figures[f"{name}_p{percent}_us"] = percentile(total, percent)
        figures[f"{name}_answered"] = float(np.mean(answered[name]))
        figures[f"{name}_reflexes"] = float(reflexes[name])
    for name in LOOPS[1:]:
        for percent in (50, 99):
            mine, floor = (figures[f"{x}_p{percent}_us"] for x in (name, "bare"))
            figures[f"{name}_of_bare_p{percent}"] = mine / floor
    return figures | {"load": os.getloadavg()[0], "cores": float(os.cpu_count() or 0)}


def percentile(histogram: np.ndarray, percent: float) -> float:
    """Percentile of a histogram with bins of a microsecond [us]."""
    reached = np.cumsum(histogram) >= percent / 100 * histogram.sum()
    return float(np.argmax(reached)) + 1.0


def our_loop(host: str, seconds: float, *, compiled: bool) -> tuple[np.ndarray, float, int]:
    """Histogram of cycle costs by microsecond, answered fraction, and number of reflexes."""
    # The Panda's limits exceed an FR3's: this stays within both.
    config = FrankaConfig(realtime=False, gripper=False, compiled=compiled, dynamics=0.15)
    with FrankaArm(host, panda, config) as arm:
        begin, due, cycles, costs = time.monotonic(), 0.0, 0, np.zeros(2000)
        while (t := time.monotonic() - begin) < seconds:
            if t >= due:
                due = t + 0.02
                try:
                    arm.command(0.2 * np.cos(2 * t) * np.array([1, -1, 1, -1, 1, 1, 1]))
                except DriverError:  # too many cycles were missed
                    arm.recover()
            report = arm.report
            if report.cycles != cycles:  # some cycles are missed in any case
                cycles = report.cycles
                costs[min(int(1e6 * report.cost), len(costs) - 1)] += 1
            time.sleep(5e-4)
        report = arm.report
    return costs, report.cycles / (report.cycles + report.lost), report.faults


def bare_loop(host: str, seconds: float) -> tuple[np.ndarray, float, int]:
    """The same values for the minimal loop, which runs in a process of the same kind."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_bare_loop, args=(theirs, host, seconds))
    process.start()
    result = ours.recv()
    process.join()
    return result


def _bare_loop(connection: Connection, host: str, seconds: float) -> None:
    import pylibfranka

    with suppress(PermissionError):
        highest = os.sched_get_priority_max(os.SCHED_FIFO)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(highest))
    robot = pylibfranka.Robot(host, pylibfranka.RealtimeConfig.kIgnore)
    robot.automatic_error_recovery()
    control = robot.start_joint_velocity_control(pylibfranka.ControllerMode.JointImpedance)
    cost, lost, cycles = np.zeros(2000), 0, 0
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        _, period = control.readOnce()
        begin = time.perf_counter()
        control.writeOnce(pylibfranka.JointVelocities([0.0] * 7))
        cost[min(int(1e6 * (time.perf_counter() - begin)), len(cost) - 1)] += 1
        cycles += 1
        lost += max(0, round(period.to_sec() / CYCLE) - 1) if cycles > 1 else 0
    connection.send((cost, cycles / (cycles + lost), 0))


def show(figures: dict[str, float]) -> None:
    """Print all measured values."""
    table = Table("figure", "measured", title="Cycles of 1 ms")
    for name, value in figures.items():
        table.add_row(name, f"{value:.4g}")
    Console().print(table)


if __name__ == "__main__":
    cli.run(main, Args)
