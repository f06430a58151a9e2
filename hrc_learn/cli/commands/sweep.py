"""`hrc sweep`: thousands of simulated grasps as batches."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from hrc_learn.cli._run import configuration, refuse_existing, write_values
from hrc_learn.cli.arguments.run import Sweep
from hrc_learn.experiments.controller.grasp_trials import ROLL_CLASSES, TrialConfig
from hrc_learn.experiments.controller.sweep import (
    CRITERIA,
    EXPERIMENTS,
    Criterion,
    chunks,
    compared,
    join,
    run_chunk,
    takes_another_arm,
)
from hrc_learn.kinematics import ArmChoice
from hrc_learn.store import new_file, new_folder, write_json
from hrc_learn.viz import SweepRecording, SweptTrials

CHUNK = 250
"""Trials in one batch: their tensors stay in the cache."""
# Of the tables: a log file has no width of its own.
_WIDTH = 132


def sweep(args: Sweep) -> int:
    """Run the experiments, print their figures beside the targets, write the figures."""
    if args.out is not None:
        refuse_existing(args.out, args.overwrite)
    names = _chosen(args)
    for option in ("figure", "recording"):
        if getattr(args, option) is not None and not any(map(_is_grasp, names)):
            raise ValueError(
                f"--{option} shows grasps, but {', '.join(names)} are none: choose one of them "
                "too, or leave it out."
            )
    robot = ArmChoice(args.robot, args.base, args.tip)
    if robot != ArmChoice() and (fixed := [n for n in names if not takes_another_arm(n)]):
        raise ValueError(
            f"--robot {args.robot}: {', '.join(fixed)} are about a Panda; --only near, global, "
            "fixed and others of grasping servo with any arm."
        )
    torch.set_num_threads(1)
    jobs: list[Job] = [
        (*job, robot)
        for name in names
        for job in chunks(
            name, args.trials if EXPERIMENTS[name].main else args.variants, args.seed, CHUNK
        )
    ]
    results = _run(jobs, _with_ray if args.ray else _in_turn)
    figures: dict[str, float] = {}
    for name, result in results.items():
        figures |= {f"{name}_{key}": value for key, value in result.summary().items()}
    figures |= compared(figures)
    missed = _show(names, figures)
    if args.out is not None:
        with new_folder(args.out, configuration(args), args.overwrite) as folder:
            write_json(folder / "metrics.json", figures)
            if any(map(_is_grasp, names)):
                _draw(folder / "times.png", results)
                _record(folder / "sweep.rrd", results)
    write_values(args.json, figures)
    if args.figure is not None:
        _draw(args.figure, results)
    if args.recording is not None:
        _record(args.recording, results)
    return 1 if missed else 0


def _is_grasp(name: str) -> bool:
    """Whether an experiment is about reaching a target, which pictures and recordings show."""
    return isinstance(EXPERIMENTS[name].config, TrialConfig)


def _grasps(results: dict[str, Any]) -> SweepRecording:
    trials = {
        name: SweptTrials(
            success=r.success.numpy(), arrival=r.time.numpy(), group=r.roll_class.numpy()
        )
        for name, r in results.items()
        if hasattr(r, "roll_class")
    }
    groups = tuple(f"{low}-{high} deg" for low, high in ROLL_CLASSES)
    title = "Grasping, by how far the camera is turned from what the controller believes"
    return SweepRecording(title=title, groups=groups, experiments=trials)


def _draw(path: Path, results: dict[str, Any]) -> None:
    from hrc_learn.viz.figures import arrival_figure  # matplotlib takes a second

    with new_file(path) as part:
        arrival_figure(_grasps(results)).savefig(part, dpi=150)


def _record(path: Path, results: dict[str, Any]) -> None:
    from hrc_learn.viz.sweep_dashboard import record_sweep  # rerun takes a second

    record_sweep(path, _grasps(results))


def _chosen(args: Sweep) -> list[str]:
    for name in ("trials", "variants"):
        if getattr(args, name) < 1:
            raise ValueError(f"--{name} must be at least 1, but is {getattr(args, name)}")
    return list(args.only) or [
        name
        for name, experiment in EXPERIMENTS.items()
        if args.suite in (experiment.suite, "all")
    ]


type Job = tuple[str, int, int, ArmChoice]


def _run(jobs: list[Job], spread: Callable[[list[Job]], Iterator[Any]]) -> dict[str, Any]:
    """Joined results by experiment."""
    parts: dict[str, list[Any]] = {}
    with Progress(transient=True) as progress:
        task = progress.add_task("trials", total=len(jobs))
        for (name, *_), part in zip(jobs, spread(jobs), strict=True):
            parts.setdefault(name, []).append(part)
            progress.update(task, advance=1, description=name)
    return {name: join(results) for name, results in parts.items()}


def _in_turn(jobs: list[Job]) -> Iterator[Any]:
    return (run_chunk(*job) for job in jobs)


def _with_ray(jobs: list[Job]) -> Iterator[Any]:
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ValueError("--ray needs Ray: pip install ray") from error

    @ray.remote
    def run(*job: Any) -> Any:
        torch.set_num_threads(1)
        return run_chunk(*job)

    ray.init(log_to_driver=False)
    waiting = [run.remote(*job) for job in jobs]
    return (ray.get(result) for result in waiting)


def _show(names: list[str], figures: dict[str, float]) -> list[Criterion]:
    """Print tables; returns what was missed."""
    console = Console()
    console = Console(width=max(console.width, _WIDTH))
    grasps = [name for name in names if f"{name}_success" in figures]
    if grasps:
        console.print(_grasp_table(grasps, figures))
    table = Table(title="Measured and wanted")
    for column in ("figure", "experiment", "what", "measured", "target", ""):
        right = column in ("measured", "target")
        table.add_column(column, no_wrap=True, justify="right" if right else "left")
    missed = []
    for criterion in CRITERIA:
        measured = criterion.metric.measure(figures)
        if criterion.experiment not in names or measured is None:
            continue
        if not measured.ok:
            missed.append(criterion)
        table.add_row(
            criterion.number,
            criterion.experiment,
            measured.name,
            measured.shown,
            measured.bound,
            "met" if measured.ok else "missed",
        )
    if table.rows:
        console.print(table)
    if "near" in names:
        console.print(
            "Figures 6 and 8 need the simulator: hrc run placing --trials 40 and "
            "hrc run collaboration --trials 50"
        )
    return missed


def _grasp_table(names: list[str], figures: dict[str, float]) -> Table:
    rolls = ", ".join(f"{low}-{high}" for low, high in ROLL_CLASSES)
    table = Table(
        title="Marker on target by the image alone; success: tool in its box besides, no limit "
        f"broken. [%] by camera roll of {rolls} degrees, and of all"
    )
    table.add_column("experiment", no_wrap=True)
    columns = (
        "on target",
        "all",
        "success",
        "all",
        "touch\n[%]",
        "t50\n[s]",
        "t95\n[s]",
        "vision\n[s]",
        "J err\n[%]",
        "viol.",
    )
    for column in columns:
        table.add_column(column, no_wrap=True, justify="right")
    for name in names:

        def shares(figure: str, name: str = name) -> tuple[str, str]:
            by_roll = [figures[f"{name}_{figure}_roll_{a}_{b}"] for a, b in ROLL_CLASSES]
            whole = f"{100 * figures[f'{name}_{figure}']:.1f}"
            return " ".join(f"{100 * part:.0f}" for part in by_roll), whole

        looked = EXPERIMENTS[name].config.contacts
        table.add_row(
            name,
            *shares("on_target"),
            *shares("success"),
            f"{100 * figures[f'{name}_touched']:.1f}" if looked else "",
            *(f"{figures[f'{name}_{key}']:.2f}" for key in ("t50", "t95", "vision_phase")),
            f"{100 * figures[f'{name}_jacobian_error']:.0f}",
            f"{figures[f'{name}_violations']:.0f}",
        )
    return table
