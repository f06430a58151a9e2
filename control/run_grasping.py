"""Grasp an object from afar with a camera that nobody calibrated.

In simulation: the arm starts anywhere within its joint limits, the camera was turned or moved
since the image Jacobian was learned, and the controller is not told. The learned Jacobian with
a Kalman filter has to do it; the paper's law, no adaptation and other estimators are run on
the same setting for comparison. Writes Rerun recordings, a report and the measured values.
Exit status 1 if the default failed or a target was missed.
"""

import math
import shlex
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from rich.console import Console

from hrc_learn import cli
from hrc_learn.experiments.grasping.experiment import (
    VARIANTS,
    GraspingExperiment,
    GraspingTrials,
)
from hrc_learn.experiments.grasping.metrics import evaluate_grasping, evaluate_many
from hrc_learn.experiments.grasping.report import record_grasp
from hrc_learn.experiments.grasping.trial import GraspingSettingConfig
from hrc_learn.experiments.monte_carlo import Summary, Trial, repeat
from hrc_learn.experiments.run_recording import ServeConfig, serving, unwatched
from hrc_learn.learning.tuning import with_gains
from hrc_learn.output import new_folder
from hrc_learn.sim import CameraKind
from hrc_learn.skills.grasping import GraspingConfig
from hrc_learn.viz.report import Measurement, show_measurements, write_report
from hrc_learn.viz.run_dashboard import record_run


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to run."""

    aiming: Path
    """Folder of training/fit_image_jacobian.py."""
    out: Path
    """Folder for recordings, report and measured values."""
    camera_roll: float = 60.0
    """By how much the camera was turned about its axis since the demonstrations [deg]."""
    random_camera: bool = False
    """Draw where the camera stands, how it is tilted and turned, instead."""
    variants: tuple[str, ...] = ("learned", "kalman", "composite", "paper", "fixed")
    """What to compare: a Kalman filter from the learned Jacobian and from the paper's guess;
    from that guess also the composite law, the paper's law and no adaptation; "unadapted", the
    learned Jacobian as it is. "none" for nothing."""
    camera: CameraKind = "auto"
    """Camera: rendered by "egl", or "synthetic", which needs no OpenGL; "auto" renders where
    it can."""
    serve: bool = False
    """Serve the dashboard of the grasp in the browser while it goes on."""
    serving: ServeConfig = field(default_factory=ServeConfig)
    """Where, with --serve."""
    config: GraspingConfig = field(default_factory=GraspingConfig)
    """How objects are grasped."""
    gains: Path | None = None
    """gains.json of training/tune_controller.py, in place of those of the controller."""
    seed: int = 0
    """Seed of camera, start, object and image noise; the first one of many."""
    seeds: int = 0
    """Grasps besides, each with a random camera, start and object, by the default alone."""
    processes: int = 1
    """Of these grasps, at once. They are seen by the synthetic camera."""
    overwrite: bool = False
    """Replace an older run in that folder."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> int:
    others = _others(args)
    console = Console()
    controller = with_gains(args.config.controller, args.gains)
    trials = GraspingTrials(
        aiming=args.aiming.resolve(),
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
        cli.write_json(folder / "measured.json", values)
    _trial_file(args).unlink(missing_ok=True)
    if args.json is not None:
        cli.write_json(args.json, values)
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
    unknown = [name for name in names if name not in VARIANTS]
    if unknown:
        raise ValueError(f"no variant {unknown[0]!r}; there are {', '.join(VARIANTS)}.")
    if args.seeds < 0:
        raise ValueError(f"--seeds must not be negative, but is {args.seeds}.")
    return names


def _trial_file(args: Args) -> Path:
    """Beside the folder, which is there only when all is done: a stopped run goes on."""
    return args.out.with_name(f"{args.out.name}.grasps.jsonl")


def _repeat(args: Args, trials: GraspingTrials) -> list[Trial]:
    if not args.seeds:
        return []
    setting = replace(trials.setting, random_camera=True)
    run = replace(trials, setting=setting, camera="synthetic")
    return repeat(
        run,
        range(args.seed, args.seed + args.seeds),
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
        recording = record_grasp(run, experiment.trials.config.servo, title)
        record_run(folder / f"{name}.rrd", recording)
    report = grasping_report(
        experiment,
        table,
        trials=many,
        configuration=asdict(args),
        command=shlex.join(["python", *sys.argv]),
    )
    write_report(folder, report)
    experiment.grasp.cell.log.save(folder / "log.npz")
    if many:
        shutil.copy(_trial_file(args), folder / "grasps.jsonl")


if __name__ == "__main__":
    cli.run(main, Args)
