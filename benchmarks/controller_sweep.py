"""Run thousands of simulated grasps as batches; compare success, time and safety with targets.

Starts, targets and uncalibrated cameras are random; cameras are rotated by up to 180 degrees
from the controller's initial assumption. The arm is simulated kinematically. The exit status is
1 if a target was missed. `controller_experiments.py` lists the experiments and their targets.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import matplotlib
import numpy as np
import torch
from controller_experiments import (
    CRITERIA,
    EXPERIMENTS,
    Criterion,
    chunks,
    compared,
    join,
    run_chunk,
    takes_another_arm,
)
from grasp_trials import ROLL_CLASSES, TrialConfig, TrialResult
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from hrc_learn import cli
from hrc_learn.kinematics import ArmChoice
from hrc_learn.store import new_file, new_folder, write_json
from hrc_learn.viz import palette
from hrc_learn.viz.figures import STYLE, WIDTH

CHUNK = 250
"""Number of trials in one batch: their tensors stay in the cache."""
TABLE_WIDTH = 132
"""Width of a printed table [characters]; a log file has no width."""
PANELS = 4
"""Number of panels in a row of the figure."""


@dataclass(frozen=True, kw_only=True)
class Args:
    suite: Literal["acceptance", "estimators", "paper", "mujoco", "stress", "all"] = (
        "acceptance"
    )
    """Experiments with acceptance figures; rival estimators; the paper's law as printed and the
    cost of each of its faults; both laws in MuJoCo; or random runs that search for violated
    limits."""
    only: tuple[str, ...] = ()
    """Names of single experiments, instead of a suite."""
    trials: int = 1000
    """Trials of the main experiments (near, global, fixed, the printed laws, stress tests)."""
    variants: int = 400
    """Trials of each other experiment."""
    seed: int = 0
    """Seed of starts, targets, cameras and noise, the same for all experiments."""
    robot: str = "panda"
    """Arm, for experiments about kinematics alone."""
    ray: bool = False
    """Distribute the trials over processes or machines with Ray; the results stay the same."""
    out: Path | None = None
    """Folder for the measured values and the picture."""
    overwrite: bool = False
    """Replace that folder."""
    figure: Path | None = None
    """File for a picture of the times to the target, as .png or .svg."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


def main(args: Args) -> int:
    names = chosen_experiments(args)
    robot = ArmChoice(args.robot)
    if robot != ArmChoice() and (fixed := [n for n in names if not takes_another_arm(n)]):
        raise ValueError(
            f"--robot {args.robot}: {', '.join(fixed)} run with a Panda only; choose grasping "
            "experiments with --only, such as near, global or fixed."
        )
    torch.set_num_threads(1)
    jobs: list[Job] = [
        (*job, robot)
        for name in names
        for job in chunks(
            name, args.trials if EXPERIMENTS[name].main else args.variants, args.seed, CHUNK
        )
    ]
    results = run_jobs(jobs, run_with_ray if args.ray else run_in_turn)
    figures: dict[str, float] = {}
    for name, result in results.items():
        figures |= {f"{name}_{key}": value for key, value in result.summary().items()}
    figures |= compared(figures)
    missed = show_tables(names, figures)
    if args.out is not None:
        with new_folder(args.out, vars(args), args.overwrite) as folder:
            write_json(folder / "metrics.json", figures)
            if any(map(is_grasp, names)):
                draw(folder / "times.png", results)
    if args.json is not None:
        write_json(args.json, figures)
    if args.figure is not None:
        draw(args.figure, results)
    return 1 if missed else 0


def chosen_experiments(args: Args) -> list[str]:
    """Names of the experiments to run.

    Raises:
        ValueError: If a number of trials is below 1, a name is unknown, or a figure is asked
            for that no experiment has data for.
    """
    for option in ("trials", "variants"):
        if getattr(args, option) < 1:
            raise ValueError(f"--{option} must be at least 1, but is {getattr(args, option)}")
    if unknown := [name for name in args.only if name not in EXPERIMENTS]:
        raise ValueError(f"no experiment {unknown[0]!r}; there are {', '.join(EXPERIMENTS)}")
    names = list(args.only) or [
        name
        for name, experiment in EXPERIMENTS.items()
        if args.suite in (experiment.suite, "all")
    ]
    if args.figure is not None and not any(map(is_grasp, names)):
        raise ValueError(
            f"--figure shows grasps, but {', '.join(names)} have none: add a grasp experiment."
        )
    return names


def is_grasp(name: str) -> bool:
    """True if an experiment measures the time to a target."""
    return isinstance(EXPERIMENTS[name].config, TrialConfig)


type Job = tuple[str, int, int, ArmChoice]


def run_jobs(jobs: list[Job], spread: Callable[[list[Job]], Iterator[Any]]) -> dict[str, Any]:
    """Run all jobs; returns the joined results by experiment."""
    parts: dict[str, list[Any]] = {}
    with Progress(transient=True) as progress:
        task = progress.add_task("trials", total=len(jobs))
        for (name, *_), part in zip(jobs, spread(jobs), strict=True):
            parts.setdefault(name, []).append(part)
            progress.update(task, advance=1, description=name)
    return {name: join(results) for name, results in parts.items()}


def run_in_turn(jobs: list[Job]) -> Iterator[Any]:
    return (run_chunk(*job) for job in jobs)


def run_with_ray(jobs: list[Job]) -> Iterator[Any]:
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


def show_tables(names: list[str], figures: dict[str, float]) -> list[Criterion]:
    """Print the values next to their targets; returns the missed criteria."""
    console = Console()
    console = Console(width=max(console.width, TABLE_WIDTH))
    grasps = [name for name in names if f"{name}_success" in figures]
    if grasps:
        console.print(grasp_table(grasps, figures))
    table = Table(title="Measured values and targets")
    for column in ("figure", "experiment", "quantity", "measured", "target", ""):
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
    return missed


def grasp_table(names: list[str], figures: dict[str, float]) -> Table:
    rolls = ", ".join(f"{low}-{high}" for low, high in ROLL_CLASSES)
    table = Table(
        title="On target: final pixel error below 5 px. Success: tool in its box as well, no "
        f"limit violated. Rates [%] by camera roll of {rolls} degrees, and over all"
    )
    table.add_column("experiment", no_wrap=True)
    columns = (
        *("on target", "all", "success", "all", "touch\n[%]"),
        *("t50\n[s]", "t95\n[s]", "vision\n[s]", "J err\n[%]", "viol."),
    )
    for column in columns:
        table.add_column(column, no_wrap=True, justify="right")
    for name in names:

        def rates(figure: str, name: str = name) -> tuple[str, str]:
            by_roll = [figures[f"{name}_{figure}_roll_{a}_{b}"] for a, b in ROLL_CLASSES]
            overall = f"{100 * figures[f'{name}_{figure}']:.1f}"
            return " ".join(f"{100 * part:.0f}" for part in by_roll), overall

        contacts = EXPERIMENTS[name].config.contacts
        table.add_row(
            name,
            *rates("on_target"),
            *rates("success"),
            f"{100 * figures[f'{name}_touched']:.1f}" if contacts else "",
            *(f"{figures[f'{name}_{key}']:.2f}" for key in ("t50", "t95", "vision_phase")),
            f"{100 * figures[f'{name}_jacobian_error']:.0f}",
            f"{figures[f'{name}_violations']:.0f}",
        )
    return table


def draw(path: Path, results: dict[str, Any]) -> None:
    grasps = {name: r for name, r in results.items() if isinstance(r, TrialResult)}
    with new_file(path) as part:
        arrival_figure(grasps).savefig(part, dpi=150)


def arrival_figure(results: dict[str, TrialResult]) -> Figure:
    """Fraction of the trials on target over time: a panel per experiment, a curve per class.

    The dots at the end are the success rates.
    """
    arrivals = np.concatenate([result.time.numpy() for result in results.values()])
    end = 1.05 * arrivals[np.isfinite(arrivals)].max(initial=0.0) or 1.0
    rows = -(-len(results) // PANELS)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 0.9 + 1.5 * rows))
        grid = figure.subplots(rows, PANELS, sharex=True, sharey=True, squeeze=False)
        panels = grid.ravel()
        for axes, (name, result) in zip(panels, results.items(), strict=False):
            for k, (low, high) in enumerate(ROLL_CLASSES):
                members = (result.roll_class == k).numpy()
                if not members.any():
                    continue
                colour = palette.SERIES[k % len(palette.SERIES)]
                arrival = np.sort(result.time.numpy()[members])
                times = np.concatenate([[0.0], arrival[np.isfinite(arrival)], [end]])
                arrived = np.searchsorted(arrival, times, side="right") / len(arrival)
                label = f"{low}-{high} deg"
                axes.step(times, 100 * arrived, where="post", color=colour, label=label)
                success = 100 * result.success.numpy()[members].mean()
                axes.plot(end, success, "o", color=colour, ms=4, clip_on=False, zorder=5 - k)
            axes.set_title(name.replace("_", " "))
        for axes in panels[len(results) :]:
            axes.set_axis_off()
        for axes in panels[max(len(results) - PANELS, 0) : len(results)]:
            axes.tick_params(labelbottom=True)
        panels[0].set(xlim=(0, end), ylim=(0, 103), yticks=(0, 50, 100))
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=len(labels))
        figure.supylabel("on target [%]", fontsize=9)
        figure.supxlabel("time [s]", fontsize=9)
    return figure


if __name__ == "__main__":
    cli.run(main, Args)
