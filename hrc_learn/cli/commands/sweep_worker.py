"""`hrc sweep worker`: jobs beside a worker as batches."""

from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Table

from hrc_learn.cli._run import configuration, refuse_existing, write_values
from hrc_learn.cli.arguments.run import SweepWorker
from hrc_learn.experiments.collaboration.job_cycle import random_cycles
from hrc_learn.experiments.collaboration.trial import OBJECT_REACH
from hrc_learn.experiments.collaboration.worker_runs import WorkerRuns
from hrc_learn.experiments.collaboration.worker_study import (
    WorkerStudy,
    WorkerStudyConfig,
    run_study,
    smallest_distance,
)
from hrc_learn.sim import Imperfections
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.placing import PlacingSkill
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.store import new_file, new_folder, write_json

_COLUMNS = (
    ("viol.\nruns", "violated_runs", "{:.0f}"),
    ("least\nmargin", "margin_least_mm", "{:.0f}"),
    ("closing\n least", "closing_least_mm", "{:.0f}"),
    ("p5", "closing_p5_mm", "{:.0f}"),
    ("median", "closing_median_mm", "{:.0f}"),
    ("elbow\np5", "elbow_p5_mm", "{:.0f}"),
    ("room\n[%]", "roomy", "{:.1%}"),
    ("cycle\n[s]", "cycle_s", "{:.1f}"),
    ("p95", "cycle_p95_s", "{:.1f}"),
    ("x undis-\nturbed", "over_undisturbed", "{:.2f}"),
    ("waited\n[s]", "waited_s", "{:.1f}"),
    ("off path\np95", "off_path_p95_mm", "{:.1f}"),
    ("less, same\ndistance", "shorter_at_same_distance", "{:.1%}"),
    ("less,\nsafe stop", "shorter_than_safe_stop", "{:.1%}"),
)
# Of the table: a log file has no width of its own.
_WIDTH = 150


def sweep_worker(args: SweepWorker) -> int:
    """Run the study, print its table, write the figures."""
    if args.out is not None:
        refuse_existing(args.out, args.overwrite)
    if args.robot != "panda":
        raise ValueError(
            f"--robot {args.robot}: hrc sweep worker is about a Panda, as are its workers."
        )
    if args.cycles < 1:
        raise ValueError(f"--cycles must be at least 1, but is {args.cycles}.")
    if any(not distance > 0 for distance in args.stop_distances):
        raise ValueError("--stop-distances must be positive.")
    torch.set_num_threads(1)
    sizes = Imperfections.nominal().scaled(0.0 if args.ideal else args.imperfections)
    config = WorkerStudyConfig(runs=args.runs, seed=args.seed, imperfections=sizes)
    workplace = Workplace().approached(VisualServoSkill.load(args.aiming).approach)
    placing = PlacingSkill.load(args.placing)
    with Progress() as progress, torch.inference_mode():
        planning = progress.add_task("planning", total=args.cycles)
        # Of another length than the seeds of the runs.
        rng = np.random.default_rng([args.seed, 0, 1])
        reach, cycles = (OBJECT_REACH[0], OBJECT_REACH[1]), []
        for cycle in random_cycles(workplace, placing, args.cycles, reach, rng, config.cell.dt):
            cycles.append(cycle)
            progress.update(planning, advance=1)
        tasks = {}

        def tell(name: str, done: float) -> None:
            if name not in tasks:
                tasks[name] = progress.add_task(name, total=args.runs)
            progress.update(tasks[name], completed=done)

        study = run_study(
            workplace,
            cycles,
            config,
            modes=args.modes,
            stop_distances=args.stop_distances,
            tell=tell,
        )
    figures = study.figures()
    _show(study, figures)
    if args.out is not None:
        with new_folder(args.out, configuration(args), args.overwrite) as folder:
            write_json(folder / "metrics.json", figures)
            _draw(folder / "worker.png", study)
    write_values(args.json, figures)
    if args.figure is not None:
        _draw(args.figure, study)
    return int(any(bool(runs.violations.any()) for runs in study.making_way.values()))


def _show(study: WorkerStudy, figures: dict[str, float]) -> None:
    console = Console()
    console = Console(width=max(console.width, _WIDTH))
    table = Table(
        title=f"{next(iter(figures.values())):.0f} jobs beside a worker; distances in mm are "
        "true ones, `closing` those from parts of him that the arm closed in on"
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


def _draw(path: Path, study: WorkerStudy) -> None:
    from hrc_learn.viz.figures import cycle_time_figure  # matplotlib takes a second

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
