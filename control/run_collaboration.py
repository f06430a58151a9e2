"""Grasp objects beside a person, carry them to the cabinet and put them on shelves.

In simulation: the learned skills run on MuJoCo's arm, an uncalibrated camera watches, and a
scripted person pulls the elbow aside while the arm aims. The camera may be moved between two
objects, the marker may be hidden, images may be late or lost. Writes a Rerun recording, a
report and the measured values. Exit status 1 if the job failed or a target was missed.

The paper's third experiment: --shelves lower middle upper --occlusion 0 4.
"""

import json
import shlex
import shutil
import sys
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from rich.console import Console

from hrc_learn import cli
from hrc_learn.demos import Demonstration, load_demos
from hrc_learn.experiments.collaboration.experiment import (
    PULLS,
    Disturbances,
    SimulatedJob,
    simulate_collaboration,
)
from hrc_learn.experiments.collaboration.metrics import (
    CollaborationTrials,
    evaluate,
    workplace_for,
)
from hrc_learn.experiments.collaboration.report import collaboration_report
from hrc_learn.experiments.monte_carlo import Summary, Trial, repeat
from hrc_learn.experiments.run_recording import ServeConfig, record, serving, unwatched
from hrc_learn.geometry import Box
from hrc_learn.learning.tuning import with_gains
from hrc_learn.output import MADE_BY, new_folder
from hrc_learn.sim import CameraChange, CameraKind, OcclusionInterval
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.marker_sensor import LatencyConfig
from hrc_learn.skills.pick_and_place import PickAndPlaceConfig
from hrc_learn.skills.placing import PlacingSkill
from hrc_learn.skills.visual_servoing import VisualServoSkill
from hrc_learn.skills.work_cell import WorkCellConfig
from hrc_learn.teleoperation.page import PageConfig
from hrc_learn.viz.report import Measurement, show_measurements, write_report
from hrc_learn.viz.run_dashboard import record_run


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to run."""

    placing: Path
    """Folder of training/fit_dmp.py, from demonstrations of placing."""
    aiming: Path
    """Folder of training/fit_image_jacobian.py."""
    out: Path
    """Folder for recording, report and measured values."""
    shelf: str = "middle"
    """Where to put the object: lower, middle or upper."""
    shelves: tuple[str, ...] = ()
    """Where to put each of two or three objects, in place of --shelf."""
    shelf_x: float = 0.40
    """Where along the board [m], in the robot's base frame."""
    shelf_depth: float = 0.10
    """How far behind the board's front edge [m]."""
    occlusion: tuple[tuple[float, float], ...] = ()
    """Spells in which a board hides the hand's marker: start and duration [s]."""
    camera_moved: bool = False
    """Move and turn the camera between two objects."""
    camera_change: CameraChange = field(default_factory=CameraChange)
    """How far, with --camera-moved."""
    latency: float = 0.0
    """From an image being taken until its markers are known [s]."""
    drop: float = 0.0
    """Share of the images that are lost."""
    camera: CameraKind = "auto"
    """Camera: rendered by "egl", or "synthetic", which needs no OpenGL; "auto" renders where
    it can."""
    person: bool = True
    """Whether the scripted person pulls the elbow."""
    page: bool = False
    """Serve a page in the browser, from which people watch and pull at the body too. The run
    takes as long as it would on a real arm then."""
    port: int = 8080
    """Port of that page."""
    serve: bool = False
    """Serve the dashboard in the browser while the run goes on."""
    serving: ServeConfig = field(default_factory=ServeConfig)
    """Where, with --serve."""
    config: PickAndPlaceConfig = field(default_factory=PickAndPlaceConfig)
    """How the job is done."""
    gains: Path | None = None
    """gains.json of training/tune_controller.py, in place of those of the controller."""
    seed: int = 0
    """Seed of where the objects lie and of image noise."""
    seeds: int = 0
    """Do the job so many times more, with this seed and those after it, and sum up."""
    processes: int = 1
    """Of the repetitions, at once."""
    overwrite: bool = False
    """Replace an older run in that folder."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> int:
    console = Console()
    trials = _trials(args)
    fit = json.loads((args.placing / "metrics.json").read_text())
    with new_folder(args.out, asdict(args), args.overwrite) as folder:
        console.print(f"Placing on the {_shelves(args)}:")
        job = _run(args, trials, console)
        delivered = any(pick.release is not None for pick in job.picks)
        table = evaluate(job, fit) if delivered else []
        repeated = _repeat(args, trials)
        with console.status("Writing recording and report"):
            _write(args, folder, job, table, repeated)
        values = _values(table, repeated)
        cli.write_json(folder / "measured.json", values)
    _trial_file(args).unlink(missing_ok=True)
    if args.json is not None:
        cli.write_json(args.json, values)
    show_measurements(table)
    if repeated:
        console.print(Summary.of(repeated).table("Collaboration"))
    if job.failure:
        print(f"failed: {job.failure}", file=sys.stderr)
    console.print(f"Recording  rerun {args.out / 'run.rrd'}")
    if table:
        console.print(f"Report     {args.out / 'report.html'}")
    return 1 if job.failure or any(m.ok is False for m in table) else 0


def _trials(args: Args) -> CollaborationTrials:
    """The job as it is to be done, once or many times."""
    controller = with_gains(args.config.grasping.controller, args.gains)
    grasping = replace(args.config.grasping, controller=controller)
    latency = LatencyConfig(delay=args.latency, frame_loss=args.drop)
    return CollaborationTrials(
        aiming=args.aiming.resolve(),
        placing=args.placing.resolve(),
        shelves=args.shelves or (args.shelf,),
        shelf_x=args.shelf_x,
        shelf_depth=args.shelf_depth,
        person=args.person,
        disturbances=Disturbances(
            occlusions=tuple(OcclusionInterval(start=s, duration=d) for s, d in args.occlusion),
            camera_change=args.camera_change if args.camera_moved else None,
        ),
        cell=WorkCellConfig(keep_image_every=0, latency=latency),
        config=replace(args.config, grasping=grasping),
    )


def _run(args: Args, trials: CollaborationTrials, console: Console) -> SimulatedJob:
    """Once, watched and recorded."""

    def opened(address: str) -> None:
        console.print(f"Dashboard at [bold]{address}[/]")

    # As many images whatever the number of objects: a gigabyte of memory holds 200.
    keep_image_every = WorkCellConfig().keep_image_every * len(trials.shelves)
    return simulate_collaboration(
        VisualServoSkill.load(args.aiming),
        PlacingSkill.load(args.placing),
        trials.shelves,
        workplace=workplace_for(trials.shelves, args.shelf_x, args.shelf_depth),
        camera=args.camera,
        pulls=PULLS if args.person else (),
        disturbances=trials.disturbances,
        config=trials.config,
        cell_config=replace(trials.cell, keep_image_every=keep_image_every),
        seed=args.seed,
        page=PageConfig(port=args.port) if args.page else None,
        watch=serving(_title(args), args.serving, opened) if args.serve else unwatched,
        on_phase=lambda phase, time: console.print(f"  {time:6.2f} s  {phase}"),
        on_page=lambda address: console.print(f"Page at [bold]{address}[/]"),
    )


def _repeat(args: Args, trials: CollaborationTrials) -> list[Trial]:
    if args.seeds < 0:
        raise ValueError(f"--seeds must not be negative, but is {args.seeds}.")
    if not args.seeds:
        return []
    return repeat(
        trials,
        range(args.seed, args.seed + args.seeds),
        _trial_file(args),
        made_by=asdict(trials),
        processes=args.processes,
        title="Collaborations",
    )


def _trial_file(args: Args) -> Path:
    """Beside the folder, which is there only when all is done: a stopped run goes on."""
    return args.out.with_name(f"{args.out.name}.trials.jsonl")


def _write(
    args: Args,
    folder: Path,
    job: SimulatedJob,
    table: list[Measurement],
    repeated: list[Trial],
) -> None:
    run = record(
        _title(args),
        job.cell,
        job.world,
        job.motion,
        plans=[pick.plan for pick in job.picks if pick.plan is not None],
        cameras=job.cameras,
        region=_region(job.workplace, args.config.grasping.servo.half_size),
        demonstration=_demonstration(args.placing),
    )
    record_run(folder / "run.rrd", run)
    if table:
        command = shlex.join(["python", *sys.argv])
        report = collaboration_report(run, job, table, asdict(args), command, repeated)
        write_report(folder, report)
    job.cell.log.save(folder / "log.npz")
    if (trials := _trial_file(args)).exists():
        shutil.copy(trials, folder / "trials.jsonl")


def _values(table: list[Measurement], repeated: list[Trial]) -> dict[str, float | int]:
    values: dict[str, float | int] = {m.key: m.value for m in table}
    if repeated:
        figures = Summary.of(repeated).figures()
        values |= {f"repeated_{name}": value for name, value in figures.items()}
    return values


def _shelves(args: Args) -> str:
    names = args.shelves or (args.shelf,)
    return f"{names[0]} shelf" if len(names) == 1 else f"shelves {', '.join(names)}"


def _title(args: Args) -> str:
    return f"Collaboration, {_shelves(args)}"


def _region(workplace: Workplace, half_size: tuple[float, float, float]) -> Box:
    """Box above the table in which the camera takes over, to be drawn."""
    x, y, z = workplace.hover().position.tolist()
    return Box(centre=(x, y, z), half_size=half_size)


def _demonstration(placing: Path) -> Demonstration | None:
    """The first demonstration the placing motion was learned from, if it is still there."""
    dataset = Path(json.loads((placing / MADE_BY).read_text())["dataset"])
    return load_demos(dataset, episodes=[0])[0] if dataset.is_dir() else None


if __name__ == "__main__":
    cli.run(main, Args)
