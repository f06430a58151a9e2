"""`hrc run collaboration`: the paper's third experiment, the whole job."""

import json
import shutil
import sys
from dataclasses import asdict, replace
from pathlib import Path

from rich.console import Console

from hrc_learn.cli._options import resolved
from hrc_learn.cli._values import command_line, refuse_existing, write_json
from hrc_learn.cli.arguments.run import RunCollaboration as Args
from hrc_learn.cli.commands._common_figures import Figure, common_figures, median, p95, total
from hrc_learn.cli.commands._demo_models import model
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
    measured,
    verdict,
    workplace_for,
)
from hrc_learn.experiments.collaboration.report import collaboration_report
from hrc_learn.experiments.monte_carlo import Summary, Trial, repeat
from hrc_learn.experiments.run_recording import record, serving, unwatched
from hrc_learn.geometry import Box
from hrc_learn.learning.tuning import with_gains
from hrc_learn.sim import OcclusionInterval
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.marker_sensor import LatencyConfig
from hrc_learn.skills.placing import PlacingSkill
from hrc_learn.skills.visual_servoing import VisualServoSkill
from hrc_learn.skills.work_cell import WorkCellConfig
from hrc_learn.store import new_folder, read_made_by
from hrc_learn.teleoperation.page import PageConfig
from hrc_learn.viz.report import Measurement, show_measurements, write_report
from hrc_learn.viz.run_dashboard import record_run

COMMON = {
    "joint_limit_violations": Figure("limit_violations", total),
    "contacts": Figure("collisions", total),
    "place_error_p95_mm": Figure("goal_error_mm", p95),
    "cycle_time_median_s": Figure("time_s", median),
}
# Nobody pulls without a person.
PULLED = {
    "end_effector_deviation_p95_mm": Figure("moved_by_person_mm", p95),
    "elbow_moved_median_mm": Figure("elbow_moved_mm", median),
}


def run(args: Args) -> int:
    refuse_existing(args.out, args.overwrite)
    console = Console()
    placing = model(args.placing, "placing", console)
    aiming = model(args.aiming, "aiming", console)
    args = replace(resolved(args), placing=placing, aiming=aiming)
    trials = _trials(args, placing, aiming)
    fit = json.loads((placing / "metrics.json").read_text(encoding="utf-8"))
    with new_folder(args.out, asdict(args), args.overwrite) as folder:
        console.print(f"Placing on the {_shelves(args)}:")
        job = _run(args, trials, console)
        delivered = any(errand.release is not None for errand in job.errands)
        table = evaluate(job, fit) if delivered else []
        repeated = _repeat(args, trials)
        with console.status("Writing recording and report"):
            _write(args, trials.placing, folder, job, table, repeated)
        values = _values(table, repeated) | _common(args, job, repeated)
        write_json(folder / "measured.json", values)
    _trial_file(args).unlink(missing_ok=True)
    if args.json is not None:
        write_json(args.json, values)
    show_measurements(table)
    if repeated:
        console.print(Summary.of(repeated).table("PickAndPlace"))
    if job.failure:
        print(f"failed: {job.failure}", file=sys.stderr)
    console.print(f"Recording  rerun {args.out / 'run.rrd'}")
    if table:
        console.print(f"Report     {args.out / 'report.html'}")
    return 1 if job.failure or any(m.ok is False for m in table) else 0


def _trials(args: Args, placing: Path, aiming: Path) -> CollaborationTrials:
    """The job as it is to be done, once or many times."""
    controller = with_gains(args.config.grasping.controller, args.gains)
    grasping = replace(args.config.grasping, controller=controller)
    transport = LatencyConfig(latency=args.latency, dropped=args.drop)
    return CollaborationTrials(
        aiming=aiming.resolve(),
        placing=placing.resolve(),
        shelves=args.shelves or (args.shelf,),
        shelf_x=args.shelf_x,
        shelf_depth=args.shelf_depth,
        person=args.person,
        disturbances=Disturbances(
            occlusions=tuple(OcclusionInterval(start=s, duration=d) for s, d in args.occlusion),
            camera_change=args.camera_change if args.camera_moved else None,
        ),
        station=WorkCellConfig(keep_every=0, transport=transport),
        config=replace(args.config, grasping=grasping),
    )


def _run(args: Args, trials: CollaborationTrials, console: Console) -> SimulatedJob:
    """Once, watched and recorded."""

    def opened(address: str) -> None:
        console.print(f"Dashboard at [bold]{address}[/]")

    # As many images whatever the number of objects: a gigabyte of memory holds 200.
    keep_every = WorkCellConfig().keep_every * len(trials.shelves)
    return simulate_collaboration(
        VisualServoSkill.load(trials.aiming),
        PlacingSkill.load(trials.placing),
        trials.shelves,
        workplace=workplace_for(trials.shelves, args.shelf_x, args.shelf_depth),
        camera=args.camera,
        pulls=PULLS if args.person else (),
        disturbances=trials.disturbances,
        config=trials.config,
        station_config=replace(trials.station, keep_every=keep_every),
        seed=args.seed,
        page=PageConfig(port=args.port) if args.page else None,
        watch=serving(_title(args), args.serving, opened) if args.serve else unwatched,
        on_phase=lambda phase, time: console.print(f"  {time:6.2f} s  {phase}"),
        on_page=lambda address: console.print(f"Page at [bold]{address}[/]"),
    )


def _repeat(args: Args, trials: CollaborationTrials) -> list[Trial]:
    if args.trials < 0:
        raise ValueError(f"--trials must not be negative, but is {args.trials}.")
    if not args.trials:
        return []
    return repeat(
        trials,
        range(args.seed, args.seed + args.trials),
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
    placing: Path,
    folder: Path,
    job: SimulatedJob,
    table: list[Measurement],
    repeated: list[Trial],
) -> None:
    run = record(
        _title(args),
        job.station,
        job.world,
        job.motion,
        plans=[errand.plan for errand in job.errands if errand.plan is not None],
        cameras=job.cameras,
        region=_region(job.workplace, args.config.grasping.aiming.half_size),
        demonstration=_demonstration(placing),
    )
    record_run(folder / "run.rrd", run)
    if table:
        command = command_line()
        report = collaboration_report(run, job, table, asdict(args), command, repeated)
        write_report(folder, report)
    job.station.log.save(folder / "log.npz")
    if (trials := _trial_file(args)).exists():
        shutil.copy(trials, folder / "trials.jsonl")


def _values(table: list[Measurement], repeated: list[Trial]) -> dict[str, float | int]:
    values: dict[str, float | int] = {m.key: m.value for m in table}
    if repeated:
        figures = Summary.of(repeated).figures()
        values |= {f"repeated_{name}": value for name, value in figures.items()}
    return values


def _common(args: Args, job: SimulatedJob, repeated: list[Trial]) -> dict[str, float | int]:
    alone = Trial.of(args.seed, {**measured(job), "failure": verdict(job)})
    figures = COMMON | (PULLED if args.person else {})
    return common_figures(repeated or [alone], figures)


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
    dataset = Path(read_made_by(placing)["dataset"])
    return load_demos(dataset, episodes=[0])[0] if dataset.is_dir() else None
