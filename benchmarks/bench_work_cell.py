"""Cost of a step of the simulated work cell: alone, with pulls, with a worker, and with both.

The arm holds its pose with nominal imperfections, while the simulated world, the worker and the
tracker advance and everything is logged, as in `hrc run collaboration` outside its servoing.
The floor is a step of the same world alone. Reported are medians and 95th percentiles of CPU
time on one thread, for steps made in turn, and the number of PyTorch operations per step, which
does not depend on the load of the machine.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from bench_dmp import read_figures
from operations import count_operations
from rich.console import Console
from rich.table import Table
from timing import time_calls

from hrc_learn import cli
from hrc_learn.experiments.surroundings import draw_visit
from hrc_learn.kinematics import panda
from hrc_learn.sim import Imperfections, MotionLog, WorkerSensor, World, whole_arm
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills import WorkCell, WorkCellConfig
from hrc_learn.skills.person_watch import PersonWatch
from hrc_learn.teleoperation import ScriptedForce, ScriptedPerturbation

_CASES = {"alone": (), "pulled": ("pulls",), "worker": ("worker",), "both": ("pulls", "worker")}
# To each side in turn, for one second: the elbow never comes to rest.
_PULLS = tuple(
    ScriptedForce(
        start=float(k), duration=1.2, towards=(0.4, (-10.0, 10.0)[k % 2], 0.5), max_force=60.0
    )
    for k in range(600)
)


@dataclass(frozen=True, kw_only=True)
class Args:
    repeats: int = 300
    """Number of timed steps of each kind."""
    seed: int = 0
    """Seed of the worker, the visit and all errors."""
    save: Path | None = None
    """File that keeps the measured values for a later --compare."""
    compare: Path | None = None
    """File of an earlier --save, shown next to the new values."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


def main(args: Args) -> None:
    """Measure, print a table, and write the measured values."""
    torch.set_num_threads(1)
    earlier = read_figures(args.compare) if args.compare else {}
    with torch.inference_mode():
        steps = {name: work_cell_step(args.seed, *parts) for name, parts in _CASES.items()}
        operations = {name: count_operations(step) for name, step in steps.items()}
        timings = time_calls({"physics": bare_step(args.seed), **steps}, args.repeats)
    floor, figures = timings["physics"].median, {}
    for name, timing in timings.items():
        figures[f"{name}_median_ms"] = 1e3 * timing.median
        figures[f"{name}_p95_ms"] = 1e3 * timing.p95
        if name in operations:
            figures[f"{name}_over_physics"] = timing.median / floor
            figures[f"{name}_operations"] = float(operations[name])
    table = Table("figure", "now", *(["earlier"] if earlier else []))
    for name, value in figures.items():
        before = [f"{earlier[name]:.3g}" if name in earlier else ""] if earlier else []
        table.add_row(name, f"{value:.4g}", *before)
    Console().print(table)
    for path in (args.json, args.save):
        if path is not None:
            cli.write_json(path, figures)


def bare_step(seed: int) -> Callable[[], None]:
    """A step of the world alone."""
    world = _world(Workplace(), seed)
    return lambda: world.advance(WorkCellConfig().dt)


def work_cell_step(seed: int, *parts: str) -> Callable[[], None]:
    """A step of the work cell, with the worker, if any, while the worker puts an object down.

    Args:
        seed: Seed of the worker, the visit and all errors.
        parts: Activities in the cell: "pulls", "worker".
    """
    workplace, sizes = Workplace(), Imperfections.nominal()
    rng = np.random.default_rng([seed, 2])
    visit = draw_visit(workplace, rng) if "worker" in parts else None
    if visit is not None:
        person = visit.worker.config
        workplace = replace(workplace, scene=replace(workplace.scene, worker=person))
    world = _world(workplace, seed)
    config = WorkCellConfig(command_delay=sizes.following_delay)
    config = replace(config, safety=sizes.plant(config.safety))
    watch = None
    if visit is not None:
        # Skip the approach: start two seconds before the worker releases the object.
        world.data.time = visit.released - 2.0
        tracker = WorkerSensor(
            visit.ends_at, visit.worker.radius, lambda: world.time, sizes, rng
        )
        watch = PersonWatch(tracker, whole_arm(workplace.scene.arm), config.safety.separation)
    motion = MotionLog(world)

    def advance(duration: float) -> None:
        motion.advance(duration)
        if visit is not None:
            ends = visit.ends_at(world.time)
            world.move_worker(ends, visit.item_at(world.time, ends))

    cell = WorkCell(
        chain=panda,
        arm=world.arm,
        gripper=world.arm,
        human=ScriptedPerturbation(panda, _PULLS if "pulls" in parts else ()),
        advance=advance,
        config=config,
        clearance=workplace.arm_clearance,
        watch=watch,
    )
    cell.hold_pose(0.5)  # until the worker is observed, and the first pull has begun
    return lambda: cell.hold_pose(config.dt)


def _world(workplace: Workplace, seed: int) -> World:
    """World with the arm at home, with the imperfections of a laboratory."""
    errors = Imperfections.nominal().draw(np.random.default_rng(seed))
    world = World(workplace.scene, errors)
    world.reset(workplace.home_joints().numpy())
    return world


if __name__ == "__main__":
    cli.run(main, Args)
