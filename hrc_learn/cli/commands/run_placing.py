"""`hrc run placing`: the paper's first experiment, a motion repeated for other shelves."""

import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from hrc_learn.cli._options import resolved
from hrc_learn.cli._values import command_line, refuse_existing, write_json
from hrc_learn.cli.arguments.run import RunPlacing as Args
from hrc_learn.cli.commands._common_figures import Figure, common_figures, p95, total
from hrc_learn.cli.commands.demo import model
from hrc_learn.demos import load_demos
from hrc_learn.experiments.monte_carlo import Run, Summary, Trial, repeat
from hrc_learn.experiments.placing.experiment import (
    SPACES,
    BodyShapeTrials,
    PlacingExperiment,
    PlacingTrials,
    run_placing_experiment,
)
from hrc_learn.experiments.placing.metrics import (
    evaluate_lessons,
    evaluate_placing,
    evaluate_random_starts,
)
from hrc_learn.experiments.placing.report import record_placing
from hrc_learn.experiments.run_recording import serving, unwatched
from hrc_learn.sim import RenderingUnavailableError
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.placing import PlacingSkill
from hrc_learn.store import new_folder, read_made_by
from hrc_learn.viz.report import Measurement, show_measurements, write_report
from hrc_learn.viz.run_dashboard import record_run

# On each of the shelves: the names of their values begin with theirs.
COMMON = {
    "joint_limit_violations": Figure("_limit_violations", total),
    "contacts": Figure("_contacts", total),
    "place_error_p95_mm": Figure("_goal_error_mm", p95),
}


def run(args: Args) -> int:
    _check(args)
    refuse_existing(args.out, args.overwrite)
    console = Console()
    placing = model(args.placing, "placing", console)
    args = replace(resolved(args), placing=placing)
    skill, dataset = PlacingSkill.load(placing), args.demonstrations or _dataset(placing)
    demonstration = load_demos(dataset, episodes=[0])[0]

    def opened(address: str) -> None:
        console.print(f"Dashboard at [bold]{address}[/]")

    with new_folder(args.out, asdict(args), args.overwrite) as folder:
        with console.status("Placing") as status:
            experiment = run_placing_experiment(
                skill,
                demonstration,
                Workplace(),
                speed=args.speed,
                seed=args.seed,
                on_step=lambda what: status.update(f"Placing: {what}"),
                watch=serving("Placing", args.serving, opened) if args.serve else unwatched,
            )
        table = evaluate_placing(experiment)
        starts = _repeat(
            args,
            "starts",
            args.trials,
            PlacingTrials(
                placing=placing.resolve(),
                demonstrations=dataset.resolve(),
                speed=args.speed,
                noise=args.noise,
            ),
        )
        lessons = _repeat(
            args, "lessons", args.lessons, BodyShapeTrials(shelf=experiment.shown_shelf)
        )
        table += evaluate_random_starts(starts, Workplace().shelf_names()) if starts else []
        table += evaluate_lessons(lessons) if lessons else []
        with console.status("Writing recordings and report"):
            _write(args, folder, experiment, table, starts)
        values = _values(experiment, table, starts)
        values |= common_figures(starts or [_alone(args, experiment)], COMMON)
        write_json(folder / "measured.json", values)
    for name in ("starts", "lessons"):
        _trial_file(args, name).unlink(missing_ok=True)
    if args.json is not None:
        write_json(args.json, values)
    console.print(_side_by_side(experiment))
    show_measurements(table)
    if starts:
        console.print(Summary.of(starts).table("Placing on all shelves from random starts"))
    console.print(f"Recordings rerun {args.out / 'run*.rrd'}")
    console.print(f"Report     {args.out / 'report.html'}")
    return 1 if any(m.ok is False for m in table) else 0


def _alone(args: Args, experiment: PlacingExperiment) -> Trial:
    """The recorded run as a trial, planned in task space."""
    of_shelves = {
        shelf: figures
        for (space, shelf), figures in experiment.figures.items()
        if space == "pose"
    }
    values = {
        f"{shelf}_{name}": value
        for shelf, figures in of_shelves.items()
        for name, value in figures.row().items()
    }
    faults = [fault for figures in of_shelves.values() for fault in figures.faults]
    return Trial.of(args.seed, {**values, "failure": "; ".join(faults)})


def _check(args: Args) -> None:
    if args.speed <= 0 or args.noise < 0 or min(args.trials, args.lessons) < 0:
        raise ValueError(
            "--speed must be positive, --noise, --trials and --lessons not negative, but are "
            f"{args.speed:g}, {args.noise:g}, {args.trials} and {args.lessons}."
        )


def _dataset(placing: Path) -> Path:
    """The dataset that the motion was learned from."""
    path = Path(read_made_by(placing)["dataset"])
    if not path.is_dir():
        raise FileNotFoundError(
            f"{path}, which {placing} was learned from, is not there any more: name the "
            "dataset with --demonstrations."
        )
    return path


def _trial_file(args: Args, name: str) -> Path:
    """Beside the folder, which is there only when all is done: a stopped run goes on."""
    return args.out.with_name(f"{args.out.name}.{name}.jsonl")


def _repeat(args: Args, name: str, count: int, run: Run) -> list[Trial]:
    if not count:
        return []
    return repeat(
        run,
        range(args.seed, args.seed + count),
        _trial_file(args, name),
        made_by=asdict(run),  # pyright: ignore[reportArgumentType]
        processes=args.processes,
        title=name.capitalize(),
    )


def _write(
    args: Args,
    folder: Path,
    experiment: PlacingExperiment,
    table: Sequence[Measurement],
    starts: Sequence[Trial],
) -> None:
    from hrc_learn.experiments.placing.report import placing_report  # matplotlib takes a second

    for (space, shelf), run in experiment.runs.items():
        if space == "pose":
            suffix = "" if shelf == experiment.shown_shelf else f"_{shelf}"
            record_run(folder / f"run{suffix}.rrd", record_placing(run, experiment))
    report = placing_report(
        experiment,
        table,
        trials=starts,
        pictures=_pictures(experiment) if args.pictures else None,
        configuration=asdict(args),
        command=command_line(),
    )
    write_report(folder, report)
    for name in ("starts", "lessons"):
        if (file := _trial_file(args, name)).exists():
            shutil.copy(file, folder / f"{name}.jsonl")


def _pictures(experiment: PlacingExperiment) -> Mapping[str, Any] | None:
    from hrc_learn.experiments.placing.snapshots import take_pictures

    try:
        return take_pictures(experiment)
    except RenderingUnavailableError as error:
        print(f"note: no pictures of the arm, as {error}", file=sys.stderr)
        return None


def _values(
    experiment: PlacingExperiment, table: Sequence[Measurement], starts: Sequence[Trial]
) -> dict[str, float | int]:
    values: dict[str, float | int] = {m.key: m.value for m in table}
    for (space, shelf), figures in experiment.figures.items():
        values |= {f"{space}_{shelf}_{name}": v for name, v in figures.row().items()}
    if starts:
        summary = Summary.of(starts).figures()
        values |= {f"random_starts_{name}": value for name, value in summary.items()}
    return values


def _side_by_side(experiment: PlacingExperiment) -> Table:
    """The two ways to other shelves."""
    columns = ("bend [mm]", "goal [mm]", "goal [deg]", "contacts", "limits", "speed", "jerk")
    table = Table("planned in", "shelf", title="Three shelves")
    for column in columns:
        table.add_column(column, justify="right")
    for (space, shelf), f in experiment.figures.items():
        row = f.row()
        table.add_row(
            SPACES[space],
            shelf,
            f"{row['bend_mm']:.1f}",
            f"{row['goal_error_mm']:.2f}",
            f"{row['goal_error_deg']:.3f}",
            f"{row['contacts']}",
            f"{row['limit_violations']}",
            f"{row['peak_speed_share']:.2f}",
            f"{row['jerk_share']:.0e}",
        )
    return table
