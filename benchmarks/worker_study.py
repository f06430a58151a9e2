"""A thousand jobs near a worker: cost of the protective distance, and benefit of way-making.

In each run, a different worker comes, puts an object down, reaches for markers under the arm
and walks away. Some arms keep the protective distance of ISO 10218-2:2025 from the tracked
worker, with or without null-space motion that makes way. For comparison, others stop and wait
while the worker is within a fixed distance. The exit status is 1 if an arm that keeps the
protective distance violated it, or touched a worker with more than the allowed force or
pressure.
"""

from __future__ import annotations

import math
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import matplotlib
import numpy as np
import torch
from contact_forces import Motion, contacts
from jaxtyping import Float
from matplotlib.figure import Figure
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Table
from torch import Tensor
from worker_job import JobCycle, random_cycles
from worker_runs import Job, Reaction, ScriptedExperts, WorkerRuns, run_near_workers
from worker_tables import WorkerTables

from hrc_learn import cli
from hrc_learn.controller import WayMakingConfig
from hrc_learn.controller.arm_loop_state import ArmLoopConfig
from hrc_learn.controller.contact_limits import PersonMode
from hrc_learn.sim import (
    Imperfections,
    Worker,
    WorkerConfig,
    WorkerVisit,
    random_visit,
    whole_arm,
)
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.placing import PlacingSkill
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.store import new_file, new_folder, write_json
from hrc_learn.teleoperation import ScriptedForce
from hrc_learn.viz import palette
from hrc_learn.viz.figures import STYLE, WIDTH

Mode = Literal["none", "expert", "automatic", "both"]
MODES: tuple[Mode, ...] = ("none", "expert", "automatic", "both")
"""Sources of null-space motion: `WayMakingConfig.mode`."""

# Number of parallel runs: their tables of visits need about 2 GB.
_BATCH = 250
READINGS = 1000
"""Readings of the encoders after which their noise repeats."""
# Reaction time of the expert after the worker begins to reach [s]: as in bench_constraints.py.
_REACTION = 0.4
# Force with which the expert pulls the elbow away [N], and distance of the point towards which
# it is pulled [m]: so far that the direction stays constant (`random_pulls`).
_FORCE, _FAR_AWAY = 60.0, 10.0
REACH = (0.10, 0.08)
"""Largest distance of the object from the middle of the table, along x and y [m]."""
_COLUMNS = (
    ("viol.\nruns", "violated_runs", "{:.0f}"),
    ("least\nmargin", "margin_least_mm", "{:.0f}"),
    ("closing\n least", "closing_least_mm", "{:.0f}"),
    ("p5", "closing_p5_mm", "{:.0f}"),
    ("median", "closing_median_mm", "{:.0f}"),
    ("elbow\np5", "elbow_p5_mm", "{:.0f}"),
    ("free\n[%]", "roomy", "{:.1%}"),
    ("cycle\n[s]", "cycle_s", "{:.1f}"),
    ("p95", "cycle_p95_s", "{:.1f}"),
    ("x undis-\nturbed", "over_undisturbed", "{:.2f}"),
    ("waited\n[s]", "waited_s", "{:.1f}"),
    ("off path\np95", "off_path_p95_mm", "{:.1f}"),
    ("con-\ntacts", "contacts", "{:.0f}"),
    ("over\nlimit", "exceedances", "{:.0f}"),
    ("of\nlimit", "force_of_limit_max", "{:.2f}"),
    ("less, same\ndistance", "shorter_at_same_distance", "{:.1%}"),
    ("less,\nsafe stop", "shorter_than_safe_stop", "{:.1%}"),
)
# Width of the table: a log file has no width.
_WIDTH = 150


@dataclass(frozen=True, kw_only=True)
class Args:
    placing: Path
    """Folder of the placing skill."""
    aiming: Path
    """Folder of the visual-servoing skill, whose orientation above the table is used."""
    runs: int = 1000
    """Runs of each reaction, with the same workers in all of them."""
    seed: int = 0
    """Seed of workers, trackers, encoders and objects."""
    modes: tuple[Mode, ...] = MODES
    """Sources of null-space motion to compare."""
    people: tuple[PersonMode, ...] = ("ssm",)
    """Reactions to people to compare, each with every source of null-space motion: separation
    monitoring, power and force limiting, or both."""
    padding: float = math.inf
    """Stiffness of a padding of the arm [N/mm]; infinite: none."""
    stop_distances: tuple[float, ...] = (0.1, 0.2, 0.3, 0.5, 0.8)
    """Distances within which arms stop and wait [m]."""
    cycles: int = 24
    """Different cycles of the job, to one shelf after the other; several arms do each."""
    imperfections: float = 1.0
    """Size of the imperfections, relative to the nominal ones; 0: none."""
    out: Path | None = None
    """Folder for the measured values and the picture."""
    overwrite: bool = False
    """Replace that folder."""
    figure: Path | None = None
    """Receives the picture, as .png or .svg."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


def main(args: Args) -> int:
    """Run the study, print its table, and write the measured values."""
    if args.cycles < 1 or any(not distance > 0 for distance in args.stop_distances):
        raise ValueError("--cycles and --stop-distances must be positive.")
    torch.set_num_threads(1)
    sizes = Imperfections.nominal().scaled(args.imperfections)
    config = WorkerStudyConfig(runs=args.runs, seed=args.seed, imperfections=sizes)
    workplace = Workplace().approached(VisualServoSkill.load(args.aiming).approach)
    placing = PlacingSkill.load(args.placing, workplace.robot)
    with Progress() as progress, torch.inference_mode():
        # A seed of another length than those of the runs.
        rng = np.random.default_rng([args.seed, 0, 1])
        drawn = random_cycles(workplace, placing, args.cycles, REACH, rng, config.cell.dt)
        cycles = list(progress.track(drawn, args.cycles, description="planning"))
        tasks = {}

        def report(name: str, done: float) -> None:
            if name not in tasks:
                tasks[name] = progress.add_task(name, total=args.runs)
            progress.update(tasks[name], completed=done)

        study = run_study(
            workplace,
            cycles,
            config,
            modes=args.modes,
            people=args.people,
            padding=args.padding,
            stop_distances=args.stop_distances,
            report=report,
        )
    figures = study.figures()
    show(study, figures)
    if args.out is not None:
        with new_folder(args.out, asdict(args), args.overwrite) as folder:
            write_json(folder / "metrics.json", figures)
            draw(folder / "worker.png", study)
    if args.figure is not None:
        draw(args.figure, study)
    if args.json is not None:
        cli.write_json(args.json, figures)
    return int(
        any(
            bool((runs.violations > 0).any() | (runs.exceedances > 0).any())
            for runs in study.making_way.values()
        )
    )


def show(study: WorkerStudy, figures: dict[str, float]) -> None:
    """Print the table."""
    console = Console()
    console = Console(width=max(console.width, _WIDTH))
    table = Table(
        title=f"{next(iter(figures.values())):.0f} jobs near a worker; true distances in mm, "
        "`closing` between parts that approached each other"
    )
    table.add_column("arm", no_wrap=True)
    for title, *_ in _COLUMNS:
        table.add_column(escape(title), justify="right", no_wrap=True)
    names = [(mode, f"null space: {mode}") for mode in study.making_way]
    names += [(f"stop_{round(1e3 * d)}_mm", f"stops within {d:g} m") for d in study.stopping]
    for key, name in names:
        found = (figures.get(f"{key}_{column}") for _, column, _ in _COLUMNS)
        shown = (
            "" if value is None else form.format(value)
            for value, (*_, form) in zip(found, _COLUMNS, strict=True)
        )
        table.add_row(name, *shown)
    console.print(table)


def draw(path: Path, study: WorkerStudy) -> None:
    """Draw cycle times over smallest distances."""

    def point(runs: WorkerRuns) -> tuple[float, float]:
        return smallest_distance(runs), float(runs.cycle_time.median())

    first = next(iter([*study.making_way.values(), *study.stopping.values()]))
    figure = cycle_time_figure(
        {mode: point(runs) for mode, runs in study.making_way.items()},
        {distance: point(runs) for distance, runs in study.stopping.items()},
        undisturbed=float(first.undisturbed.median()),
    )
    with new_file(path) as part:
        figure.savefig(part, dpi=150)


@dataclass(frozen=True, kw_only=True)
class WorkerStudyConfig:
    """Settings of the runs."""

    runs: int = 1000
    seed: int = 0
    """Seed of workers, visits, trackers and encoders; the same for all reactions."""
    limit: float = 180.0
    """Longest time of a run [s]: five cycles."""
    imperfections: Imperfections = field(default_factory=Imperfections.nominal)
    """Imperfections of encoders, commands, servos, drivers and trackers."""
    cell: ArmLoopConfig = field(default_factory=ArmLoopConfig)

    def __post_init__(self) -> None:
        if self.runs < 1:
            raise ValueError(f"runs must be at least 1, but is {self.runs}.")


def draw_job(
    workplace: Workplace,
    cycles: Sequence[JobCycle],
    runs: Sequence[int],
    config: WorkerStudyConfig,
) -> Job:
    """Workers near arms that do their cycles; each run is the same in any batch.

    Args:
        workplace: Table, shelves and arm.
        cycles: Cycles of the job, done in turn.
        runs: Numbers of the runs.
        config: Settings of the runs.
    """
    sizes, dt, visits, chances = config.imperfections, config.cell.dt, [], []
    offset, noise = [], []
    for run in runs:
        rng = np.random.default_rng([config.seed, run])
        worker = Worker(WorkerConfig.draw(rng))
        table, centre = workplace.scene.table, workplace.table_centre
        visits.append(random_visit(worker, rng, bench=table, under=centre))
        drawn = sizes.draw(rng)
        offset.append(drawn.encoder_offset)
        noise.append(sizes.encoder_noise * rng.standard_normal((READINGS, 7)))
        chances.append(rng)
    return Job(
        workplace=workplace,
        arm=whole_arm(workplace.scene.arm),
        cycles=cycles,
        cycle=torch.tensor([run % len(cycles) for run in runs]),
        workers=WorkerTables.of(visits, sizes, chances, dt),
        bodies=[visit.worker.config for visit in visits],
        experts=ScriptedExperts([expert_pull(visit) for visit in visits]),
        encoder_offset=torch.from_numpy(np.stack(offset)),
        encoder_noise=torch.from_numpy(np.stack(noise)),
        sizes=sizes,
    )


def expert_pull(visit: WorkerVisit) -> ScriptedForce:
    """Pull of an expert: joint 4 away from the worker during the reach under the arm.

    As in Experiment 3 of the paper.
    """
    # The last three motions of a visit: hands down, turn, walk away.
    begin, end = visit.released + _REACTION, float(visit.time[-4]) + _REACTION
    k = int(np.searchsorted(visit.time, visit.released))
    place, heading = visit.poses[k, :2], visit.poses[k, 2]
    x, y = place + _FAR_AWAY * np.array([np.cos(heading), np.sin(heading)])
    return ScriptedForce(
        start=begin, duration=end - begin, towards=(float(x), float(y), 0.5), max_force=_FORCE
    )


@dataclass(frozen=True, kw_only=True)
class WorkerStudy:
    """Runs with each reaction."""

    making_way: Mapping[str, WorkerRuns]
    """Runs by the source of null-space motion, and the reaction to people if that is not "ssm"
    (`key`)."""
    stopping: Mapping[float, WorkerRuns]
    """Runs of arms that stop and wait, by the distance within which they rest [m]."""

    def figures(self) -> dict[str, float]:
        """All figures by name; lengths in mm, times in s."""
        figures: dict[str, float] = {}
        for mode, runs in self.making_way.items():
            own = summary(runs) | self._compared(runs)
            figures |= {f"{mode}_{key}": value for key, value in own.items()}
        for distance, runs in self.stopping.items():
            name = f"stop_{round(1e3 * distance)}_mm"
            figures |= {f"{name}_{key}": value for key, value in summary(runs).items()}
        return figures

    def stop_and_wait(self, smallest: float) -> float:
        """Median cycle time of stop-and-wait at a smallest distance [s].

        Interpolated between the distances that were tried; NaN beyond them.

        Args:
            smallest: 5 % quantile over the runs, see `smallest_distance` [m].
        """
        if not self.stopping:
            return np.nan
        kept = [smallest_distance(runs) for runs in self.stopping.values()]
        times = [float(runs.cycle_time.median()) for runs in self.stopping.values()]
        # Except for chance, arms that stop at a larger distance keep more distance.
        order = np.argsort(kept)
        return float(
            np.interp(
                smallest, np.take(kept, order), np.take(times, order), left=np.nan, right=np.nan
            )
        )

    def _compared(self, runs: WorkerRuns) -> dict[str, float]:
        """Reduction of the cycle time relative to arms that stop and wait."""
        ours = float(runs.cycle_time.median())
        figures = {
            "shorter_at_same_distance": 1 - ours / self.stop_and_wait(smallest_distance(runs))
        }
        safe = [stop for stop in self.stopping.values() if not bool(stop.violations.any())]
        if safe:
            shortest = min(float(stop.cycle_time.median()) for stop in safe)
            figures["shorter_than_safe_stop"] = 1 - ours / shortest
        return {key: value for key, value in figures.items() if np.isfinite(value)}


def measure_contacts(
    job: Job,
    trace: Sequence[tuple[Tensor, Tensor]],
    runs: WorkerRuns,
    dt: float,
    padding: float = math.inf,
) -> None:
    """Force and pressure of the contacts of each run, from an independent evaluation."""
    scene = job.workplace.scene
    for run, body in enumerate(job.bodies):
        # A cycle that has not ended lasts for ever.
        steps = int((runs.cycle_time[run] / dt).round().clamp(max=len(trace)))
        number = torch.tensor([run])
        motion = Motion(
            dt=dt,
            joints=np.stack([q[run].double().numpy() for q, _ in trace[:steps]]),
            holding=np.array([bool(held[run]) for _, held in trace[:steps]]),
            ends=np.stack([job.workers.truth(k, number).ends[0].numpy() for k in range(steps)]),
        )
        found = contacts(motion, scene, body, load=scene.objects[0].mass, padding=padding)
        moved = [contact for contact in found if contact.by_arm]
        runs.touches[run] = len(moved)
        runs.run_into[run] = len(found) - len(moved)
        runs.exceedances[run] = sum(contact.of_limit > 1 for contact in moved)
        runs.of_limit[run] = max((contact.of_limit for contact in moved), default=0.0)


def key(mode: Mode, person: PersonMode) -> str:
    """Name of a reaction, which is also the prefix of the names of its values."""
    return mode if person == "ssm" else f"{mode}_{person.replace('+', '_')}"


def smallest_distance(runs: WorkerRuns) -> float:
    """5 % quantile over the runs of the smallest distance to which the arm approached the
    worker [m].
    """
    return float(runs.closing.quantile(0.05))


def summary(runs: WorkerRuns) -> dict[str, float]:
    """Counts, medians and quantiles over the runs; lengths in mm, times in s."""

    def quantile(values: Float[Tensor, " runs"], q: float) -> float:
        return float(values.quantile(q, interpolation="nearest"))

    present = runs.present.clamp(min=1e-9)
    return {
        "runs": float(len(runs.cycle_time)),
        "violated_runs": float((runs.violations > 0).sum()),
        "violated_steps": float(runs.violations.sum()),
        "margin_least_mm": 1e3 * float(runs.margin.amin()),
        "closing_least_mm": 1e3 * float(runs.closing.amin()),
        "closing_p5_mm": 1e3 * smallest_distance(runs),
        "closing_median_mm": 1e3 * quantile(runs.closing, 0.5),
        "least_median_mm": 1e3 * quantile(runs.least, 0.5),
        "elbow_p5_mm": 1e3 * quantile(runs.elbow, 0.05),
        "elbow_median_mm": 1e3 * quantile(runs.elbow, 0.5),
        "roomy": float((1 - runs.crowded / present).mean()),
        "cycle_s": quantile(runs.cycle_time, 0.5),
        "cycle_p95_s": quantile(runs.cycle_time, 0.95),
        "over_undisturbed": quantile(runs.cycle_time / runs.undisturbed, 0.5),
        "waited_s": quantile(runs.waited, 0.5),
        "waited_p95_s": quantile(runs.waited, 0.95),
        "off_path_median_mm": 1e3 * quantile(runs.off_path, 0.5),
        "off_path_p95_mm": 1e3 * quantile(runs.off_path, 0.95),
        "unfinished": float(runs.cycle_time.isinf().sum()),
        "unsolved_steps": float(runs.unsolved.sum()),
        "contacts": float(runs.touches.sum()),
        "run_into": float(runs.run_into.sum()),
        "exceedances": float(runs.exceedances.sum()),
        "force_of_limit_max": float(runs.of_limit.amax()),
    }


def run_study(
    workplace: Workplace,
    cycles: Sequence[JobCycle],
    config: WorkerStudyConfig,
    *,
    modes: Sequence[Mode] = MODES,
    people: Sequence[PersonMode] = ("ssm",),
    padding: float = math.inf,
    stop_distances: Sequence[float] = (),
    report: Callable[[str, float], None] = lambda name, done: None,
) -> WorkerStudy:
    """Let arms do their cycles near workers, with one reaction after the other.

    Args:
        workplace: Table, shelves and arm.
        cycles: Cycles of the job, done in turn.
        config: Settings of the runs.
        modes: Sources of null-space motion.
        people: Reactions to people.
        padding: Stiffness of a padding of the arm [N/mm]; infinite: none.
        stop_distances: Distances of stop-and-wait [m].
        report: Called with a reaction and the number of its runs that have ended.
    """
    reactions: dict[str, Reaction] = {
        key(mode, person): Reaction(
            way_making=WayMakingConfig(mode=mode), mode=person, padding=padding
        )
        for person in people
        for mode in modes
    }
    ways = list(reactions)
    stops = {f"stop at {d:g} m": d for d in sorted(stop_distances)}
    still = WayMakingConfig(mode="none")
    for name, distance in stops.items():
        reactions[name] = Reaction(way_making=still, stop_distance=distance)
    parts: dict[str, list[WorkerRuns]] = {name: [] for name in reactions}
    for first in range(0, config.runs, _BATCH):
        batch = range(first, min(first + _BATCH, config.runs))
        job = draw_job(workplace, cycles, batch, config)
        for name, reaction in reactions.items():

            def ended(fraction: float, name: str = name, batch: range = batch) -> None:
                report(name, batch.start + fraction * len(batch))

            trace: list[tuple[Tensor, Tensor]] = []
            runs = run_near_workers(job, reaction, config.cell, config.limit, ended, trace)
            measure_contacts(job, trace, runs, config.cell.dt, reaction.padding)
            parts[name].append(runs)
    joined = {name: WorkerRuns.joined(part) for name, part in parts.items()}
    return WorkerStudy(
        making_way={name: joined[name] for name in ways},
        stopping={distance: joined[name] for name, distance in stops.items()},
    )


def cycle_time_figure(
    making_way: Mapping[str, tuple[float, float]],
    stopping: Mapping[float, tuple[float, float]],
    *,
    undisturbed: float,
) -> Figure:
    """Cycle time over the smallest distance from a worker.

    Args:
        making_way: Smallest distance [m] and cycle time [s] of arms that keep the protective
            distance, by the source of null-space motion.
        stopping: Smallest distance and cycle time of arms that stop and wait, by the distance
            within which they rest [m].
        undisturbed: Cycle time without a worker [s].
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 3.2))
        axes = figure.subplots()
        if stopping:
            x, y = np.array(list(stopping.values())).T
            axes.plot(1e3 * x, y, "o-", color=palette.GREY, ms=4, label="stops and waits")
            for distance, (nearest, time) in stopping.items():
                axes.annotate(
                    f"{distance:g} m",
                    (1e3 * nearest, time),
                    xytext=(5, -9),
                    textcoords="offset points",
                    fontsize=7,
                )
        for k, (mode, (nearest, time)) in enumerate(making_way.items()):
            colour = palette.SERIES[k % len(palette.SERIES)]
            axes.plot(1e3 * nearest, time, "D", color=colour, label=f"null space: {mode}")
        axes.axhline(undisturbed, color=palette.BLACK, lw=1, ls="--", label="undisturbed")
        axes.set_xlabel("smallest distance to which the arm approached, 5 % of the runs [mm]")
        axes.set_ylabel("cycle time, median [s]")
        axes.legend(loc="upper left", fontsize=8)
    return figure


if __name__ == "__main__":
    cli.run(main, Args)
