"""`hrc run grasping`: the paper's second experiment, a grasp with an uncalibrated camera."""

import math
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from rich.console import Console

from hrc_learn.cli._options import resolved
from hrc_learn.cli._values import command_line, refuse_existing, write_json
from hrc_learn.cli.arguments.run import RunGrasping as Args
from hrc_learn.cli.commands._common_figures import Figure, common_figures, median, p95, total
from hrc_learn.cli.commands.demo import model
from hrc_learn.experiments.grasping.experiment import (
    VARIANTS,
    GraspingExperiment,
    GraspingTrials,
)
from hrc_learn.experiments.grasping.metrics import evaluate_grasping, evaluate_many
from hrc_learn.experiments.grasping.report import record_grasp
from hrc_learn.experiments.grasping.trial import GraspingSettingConfig
from hrc_learn.experiments.monte_carlo import Summary, Trial, repeat
from hrc_learn.experiments.run_recording import serving, unwatched
from hrc_learn.learning.tuning import with_gains
from hrc_learn.store import new_folder
from hrc_learn.viz.report import Measurement, show_measurements, write_report
from hrc_learn.viz.run_dashboard import record_run

COMMON = {
    "joint_limit_violations": Figure("violations", total),
    "contacts": Figure("touches", total),
    "grasp_offset_p95_mm": Figure("place_error", p95, 1e3),
    "cycle_time_median_s": Figure("duration", median),
}


def run(args: Args) -> int:
    others = _others(args)
    refuse_existing(args.out, args.overwrite)
    console = Console()
    aiming = model(args.aiming, "aiming", console)
    args = replace(resolved(args), aiming=aiming)
    controller = with_gains(args.config.controller, args.gains)
    trials = GraspingTrials(
        aiming=aiming.resolve(),
        setting=GraspingSettingConfig(
            camera_roll=math.radians(args.camera_roll), random_camera=args.random_camera
        ),
        camera=args.camera,
        config=replace(args.config, controller=controller),
    )

    def opened(address: str) -> None:
        console.print(f"Dashboard at [bold]{address}[/]")

    with new_folder(args.out, asdict(args), args.overwrite) as folder:
        with console.status("Grasping") as status:
            experiment = GraspingExperiment.run(
                trials,
                args.seed,
                others,
                lambda what: status.update(f"Grasping: {what}"),
                serving("Grasping", args.serving, opened) if args.serve else unwatched,
            )
        many = _repeat(args, trials)
        table = evaluate_grasping(experiment) + (evaluate_many(many) if many else [])
        with console.status("Writing recordings and report"):
            _write(args, folder, experiment, table, many)
        values = {m.key: m.value for m in table}
        if many:
            figures = Summary.of(many).figures()
            values |= {f"grasps_{name}": value for name, value in figures.items()}
        alone = Trial.of(args.seed, experiment.outcome.values())
        if experiment.outcome.failure:
            alone = replace(alone, failure=experiment.outcome.failure)
        values |= common_figures(many or [alone], COMMON)
        write_json(folder / "measured.json", values)
    _trial_file(args).unlink(missing_ok=True)
    if args.json is not None:
        write_json(args.json, values)
    show_measurements(table)
    if many:
        console.print(Summary.of(many).table("Grasps in random settings"))
    failure = experiment.outcome.failure
    if failure:
        print(f"failed: {failure}", file=sys.stderr)
    console.print(f"Recording  rerun {args.out / 'run.rrd'}")
    console.print(f"Report     {args.out / 'report.html'}")
    return 1 if failure or any(m.ok is False for m in table) else 0


def _others(args: Args) -> Sequence[str]:
    """Variants to compare the default with."""
    names = [] if args.variants == ("none",) else args.variants
    if args.trials < 0:
        raise ValueError(f"--trials must not be negative, but is {args.trials}.")
    return names


def _trial_file(args: Args) -> Path:
    """Beside the folder, which is there only when all is done: a stopped run goes on."""
    return args.out.with_name(f"{args.out.name}.grasps.jsonl")


def _repeat(args: Args, trials: GraspingTrials) -> list[Trial]:
    if not args.trials:
        return []
    setting = replace(trials.setting, random_camera=True)
    run = replace(trials, setting=setting, camera="synthetic")
    return repeat(
        run,
        range(args.seed, args.seed + args.trials),
        _trial_file(args),
        made_by=asdict(run),
        processes=args.processes,
        title="Grasps",
    )


def _write(
    args: Args,
    folder: Path,
    experiment: GraspingExperiment,
    table: Sequence[Measurement],
    many: Sequence[Trial],
) -> None:
    from hrc_learn.experiments.grasping.report import (
        grasping_report,  # matplotlib takes a second
    )

    runs = {"run": ("Grasping", experiment.grasp)} | {
        f"compared_{name}": (f"Aiming, {VARIANTS[name].says}", run)
        for name, run in experiment.compared.items()
    }
    for name, (title, run) in runs.items():
        recording = record_grasp(run, experiment.trials.config.aiming, title)
        record_run(folder / f"{name}.rrd", recording)
    report = grasping_report(
        experiment,
        table,
        trials=many,
        configuration=asdict(args),
        command=command_line(),
    )
    write_report(folder, report)
    experiment.grasp.station.log.save(folder / "log.npz")
    if many:
        shutil.copy(_trial_file(args), folder / "grasps.jsonl")
