"""Where null-space motion saves time: arm and worker at one bench, each with work of its own.

The arm does a cycle of its job, while a worker fetches parts that lie beside the gripper, under
the forearm, under the elbow, or away from the arm. The worker reacts to the arm
(`working_worker.py`). Compared are reactions to people (monitored stop, separation, force
limiting), each with an arm that does not use its null space, with an expert who pulls the elbow
away, with automatic way-making, and with both. The time of the team ends when both have done
their work.

    python benchmarks/complementarity_map.py --placing outputs/demo/placing \
        --aiming outputs/demo/aiming --results outputs/complementarity.jsonl
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from posture_plans import planned_cycles
from rich.console import Console
from rich.progress import Progress, TaskID
from rich.table import Table
from torch import Tensor
from worker_job import JobCycle, random_cycles
from worker_runs import Job, Reaction, run_near_workers
from worker_study import (
    MODES,
    REACH,
    READINGS,
    Mode,
    WorkerStudyConfig,
    key,
    measure_contacts,
)
from working_worker import PLACES, WatchingExperts, Where, Work, WorkingWorkers, draw_work

from hrc_learn import cli
from hrc_learn.controller import WayMakingConfig
from hrc_learn.controller.contact_limits import PersonMode
from hrc_learn.sim import whole_arm
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.placing import PlacingSkill
from hrc_learn.skills.visual_skill import VisualServoSkill

# Speeds of arm and worker towards each other whose protective distance plans keep [m/s].
_ARM, _WORKER = 0.1, 1.0
# The longest time of a run [s]: several cycles.
_LIMIT = 120.0
# Work of a worker without an arm lasts as long as the arm's cycle without a worker [s].
_WORK = 34.0
_RESAMPLES = 4000


@dataclass(frozen=True, kw_only=True)
class Args:
    placing: Path
    """Folder of the placing skill."""
    aiming: Path
    """Folder of the visual-servoing skill, whose orientation above the table is used."""
    runs: int = 16
    """Runs of each place and pause, the same for all reactions."""
    seed: int = 0
    """Seed of workers, parts, trackers and encoders."""
    cycles: int = 12
    """Different cycles of the job."""
    places: tuple[Where, ...] = PLACES
    """Places of the parts."""
    pauses: tuple[float, ...] = (0.5, 5.0)
    """Times between two parts of a worker [s]."""
    people: tuple[PersonMode, ...] = ("ssm", "ssm+pfl")
    """Reactions to people."""
    modes: tuple[Mode, ...] = MODES
    """Sources of null-space motion."""
    planned: bool = True
    """Also plan postures that avoid the parts of each worker, as a bound: the planner knows
    where they are."""
    stop_distances: tuple[float, ...] = (0.2,)
    """Distances within which arms without another reaction stop and wait [m]."""
    results: Path = Path("outputs/complementarity.jsonl")
    """Receives a line for each reaction; those that are there are not repeated."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


def main(args: Args) -> None:
    """Run every reaction that is missing, and print the map."""
    torch.set_num_threads(1)
    cells: list[tuple[Where, float]] = [
        (place, pause) for place in args.places for pause in args.pauses
    ]
    reactions = {
        key(mode, person): Reaction(way_making=WayMakingConfig(mode=mode), mode=person)
        for person, mode in product(args.people, args.modes)
    }
    still = WayMakingConfig(mode="none")
    if args.planned:
        reactions |= {
            f"planned_{person}": Reaction(way_making=still, mode=person)
            for person in args.people
        }
    for distance in args.stop_distances:
        reactions[f"stop_{distance:g}"] = Reaction(way_making=still, stop_distance=distance)
    done = _read(args.results)
    missing = [name for name in reactions if name not in done]
    if missing:
        workplace = Workplace().approached(VisualServoSkill.load(args.aiming).approach)
        placing = PlacingSkill.load(args.placing, workplace.robot)
        config = WorkerStudyConfig(runs=args.runs, seed=args.seed)
        with Progress() as progress, torch.inference_mode():
            rng = np.random.default_rng([args.seed, 0, 1])
            drawn = random_cycles(workplace, placing, args.cycles, REACH, rng, config.cell.dt)
            cycles = list(progress.track(drawn, args.cycles, description="planning"))
            works = draw_works(workplace, cells, args.runs, args.seed)
            for name in missing:
                report = partial(_report, progress, progress.add_task(name, total=1.0))
                job = make_job(workplace, cycles, works, config, name.startswith("planned"))
                found = run_job(job, reactions[name], config, report)
                line = {"reaction": name, "cells": cells, "runs": args.runs} | found
                args.results.parent.mkdir(parents=True, exist_ok=True)
                with args.results.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(line) + "\n")
        done = _read(args.results)
    figures = show({name: done[name] for name in reactions}, cells, args.runs)
    if args.json is not None:
        cli.write_json(args.json, figures)


def draw_works(
    workplace: Workplace, cells: Sequence[tuple[Where, float]], runs: int, seed: int
) -> list[Work]:
    """Works of the runs of each cell, one cell after another.

    Args:
        workplace: Table, shelves and arm.
        cells: Place of the parts, and time between two parts [s].
        runs: Runs of each cell.
        seed: Seed of all works.
    """
    return [
        _work(workplace, *cell, [seed, run, number])
        for number, cell in enumerate(cells)
        for run in range(runs)
    ]


def _work(workplace: Workplace, place: Where, pause: float, seed: list[int]) -> Work:
    """Work of the first worker drawn who reaches all parts: short ones may not."""
    for attempt in range(100):
        rng = np.random.default_rng([*seed, attempt])
        try:
            return draw_work(workplace, place, pause, _WORK, rng)
        except ValueError:
            continue
    raise ValueError(f"no worker can reach the parts at {place!r}.")


def make_job(
    workplace: Workplace,
    cycles: Sequence[JobCycle],
    works: Sequence[Work],
    config: WorkerStudyConfig,
    planned: bool = False,
) -> Job:
    """Arms with their workers at the beginning of the work.

    Args:
        workplace: Table, shelves and arm.
        cycles: Cycles of the job, done in turn.
        works: Work near each arm.
        config: Settings of the runs.
        planned: True to plan postures that avoid the parts of each worker.
    """
    sizes, dt, arm = config.imperfections, config.cell.dt, whole_arm(workplace.scene.arm)
    if planned:
        slow, fast = torch.tensor([[_ARM], [_WORKER]], dtype=torch.float64)
        kept = sizes.plant(config.cell.safety).separation.protective_distance(slow, fast)
        cycles = planned_cycles(workplace, arm, cycles, works, float(kept))
    workers = WorkingWorkers(works, sizes, arm, dt, config.seed)
    offset, noise = [], []
    for run in range(len(works)):
        rng = np.random.default_rng([config.seed, run])
        offset.append(sizes.draw(rng).encoder_offset)
        noise.append(sizes.encoder_noise * rng.standard_normal((READINGS, 7)))
    return Job(
        workplace=workplace,
        arm=arm,
        cycles=cycles,
        cycle=torch.arange(len(works)) % len(cycles),
        workers=workers,
        bodies=[work.visit.worker.config for work in works],
        experts=WatchingExperts(workers, dt),
        encoder_offset=torch.from_numpy(np.stack(offset)),
        encoder_noise=torch.from_numpy(np.stack(noise)),
        sizes=sizes,
    )


def _report(progress: Progress, task: TaskID, fraction: float) -> None:
    progress.update(task, completed=fraction)


def run_job(
    job: Job, reaction: Reaction, config: WorkerStudyConfig, report: Callable[[float], None]
) -> dict[str, list[float]]:
    """Let arms and workers work; lists with a number for each run.

    Args:
        job: Arms and workers at the beginning of the work.
        reaction: Reaction of the arms to the workers.
        config: Settings of the runs.
        report: Called now and then with the fraction of the runs that have ended.
    """
    assert isinstance(job.workers, WorkingWorkers)
    trace: list[tuple[Tensor, Tensor]] = []
    found = run_near_workers(job, reaction, config.cell, _LIMIT, report, trace)
    measure_contacts(job, trace, found, config.cell.dt)
    arm = found.cycle_time.clamp(max=_LIMIT)
    # The arm rests away from the bench after its cycle, so nothing hinders the worker any more.
    worker = torch.minimum(job.workers.done_at, arm + job.workers.left)
    return {
        "arm": arm.tolist(),
        "worker": worker.tolist(),
        "unhindered": job.workers.unhindered.tolist(),
        "undisturbed": found.undisturbed.tolist(),
        "arm_waited": found.waited.tolist(),
        "violations": found.violations.tolist(),
        "exceedances": found.exceedances.tolist(),
        "touches": found.touches.tolist(),
        "off_path": found.off_path.tolist(),
        "least": found.least.tolist(),
    }


def _read(path: Path) -> dict[str, dict]:
    if not path.exists():
        return {}
    lines = (json.loads(line) for line in path.read_text(encoding="utf-8").splitlines())
    return {line.pop("reaction"): line for line in lines}


def _interval(values: Float[np.ndarray, " runs"]) -> tuple[float, float]:
    """95 % bootstrap interval of a mean."""
    rng = np.random.default_rng(0)
    means = values[rng.integers(0, len(values), (_RESAMPLES, len(values)))].mean(-1)
    return float(np.quantile(means, 0.025)), float(np.quantile(means, 0.975))


def show(
    results: dict[str, dict], cells: Sequence[tuple[Where, float]], runs: int
) -> dict[str, float]:
    """Print the map, and return its figures by name."""
    figures: dict[str, float] = {}
    console = Console(width=150)
    for number, (place, pause) in enumerate(cells):
        part = slice(number * runs, (number + 1) * runs)
        team = {
            name: np.maximum(found["arm"], found["worker"])[part]
            for name, found in results.items()
        }
        plain = {n: t for n, t in team.items() if n.startswith(("none", "stop"))}
        best = min(plain, key=lambda name: plain[name].mean())
        table = Table(
            title=f"parts at the {place}, {pause:g} s between two, n = {runs}; plain: {best}"
        )
        for title in (
            "reaction",
            "team [s]",
            "shorter than best [%]",
            "arm [s]",
            "worker [s]",
            "arm waited [s]",
            "worker waited [s]",
            "off path p95 [mm]",
            "least [mm]",
            "violations",
            "over limit",
        ):
            table.add_column(title)
        for name, found in results.items():
            gain = 1 - team[name] / team[best]
            low, high = _interval(gain)
            waited = np.subtract(found["worker"], found["unhindered"])[part]
            row = {
                "team_s": team[name].mean(),
                "shorter": gain.mean(),
                "shorter_low": low,
                "shorter_high": high,
                "arm_s": np.mean(found["arm"][part]),
                "worker_s": np.mean(found["worker"][part]),
                "arm_waited_s": np.mean(found["arm_waited"][part]),
                "worker_waited_s": waited.mean(),
                "off_path_p95_mm": 1e3 * np.quantile(found["off_path"][part], 0.95),
                "least_mm": 1e3 * np.min(found["least"][part]),
                "violations": np.count_nonzero(found["violations"][part]),
                "exceedances": np.sum(found["exceedances"][part]),
            }
            figures |= {f"{place}_{pause:g}_{name}_{k}": float(v) for k, v in row.items()}
            table.add_row(
                name,
                f"{row['team_s']:.1f}",
                f"{100 * gain.mean():.1f} ({100 * low:.1f} to {100 * high:.1f})",
                f"{row['arm_s']:.1f}",
                f"{row['worker_s']:.1f}",
                f"{row['arm_waited_s']:.1f}",
                f"{row['worker_waited_s']:.1f}",
                f"{row['off_path_p95_mm']:.1f}",
                f"{row['least_mm']:.0f}",
                str(row["violations"]),
                str(row["exceedances"]),
            )
        console.print(table)
    return figures


if __name__ == "__main__":
    cli.run(main, Args)
