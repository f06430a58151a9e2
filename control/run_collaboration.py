"""Grasp an object beside a person, carry it to the cabinet and put it on a shelf.

In simulation: the learned skills run on MuJoCo's arm, an uncalibrated camera watches, and a
scripted person pulls the elbow aside while the arm aims. Writes a Rerun recording, a report
and the measured values. Exit status 1 if the job failed or a target was missed.
"""

import json
import shlex
import sys
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from rich.console import Console

from hrc_learn import cli
from hrc_learn.demos import Demonstration, load_demos
from hrc_learn.human.page import PageConfig
from hrc_learn.output import MADE_BY, new_folder
from hrc_learn.sim import CameraKind
from hrc_learn.tasks.collaboration import CollaborationConfig
from hrc_learn.tasks.collaboration_report import collaboration_report
from hrc_learn.tasks.evaluation import evaluate
from hrc_learn.tasks.fit_aiming import AimingSkill
from hrc_learn.tasks.gains import with_gains
from hrc_learn.tasks.placing import PlacingSkill
from hrc_learn.tasks.recording import record
from hrc_learn.tasks.simulated_job import PULLS, simulate_collaboration
from hrc_learn.tasks.watching import ServeConfig, serving, unwatched
from hrc_learn.tasks.workplace import Workplace
from hrc_learn.viz import Box
from hrc_learn.viz.report import show_measurements, write_report
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
    shelf_x: float = 0.40
    """Where along the board [m], in the robot's base frame."""
    shelf_depth: float = 0.10
    """How far behind the board's front edge [m]."""
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
    config: CollaborationConfig = field(default_factory=CollaborationConfig)
    """How the job is done."""
    gains: Path | None = None
    """gains.json of training/tune_controller.py, in place of those of the controller."""
    seed: int = 0
    """Seed of where the object lies and of image noise."""
    overwrite: bool = False
    """Replace an older run in that folder."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> int:
    console = Console()
    aiming, placing = AimingSkill.load(args.aiming), PlacingSkill.load(args.placing)
    fit = json.loads((args.placing / "metrics.json").read_text())
    demonstration = _demonstration(args.placing)
    controller = with_gains(args.config.grasping.controller, args.gains)
    grasping = replace(args.config.grasping, controller=controller)
    title = f"Collaboration, {args.shelf} shelf"

    def opened(address: str) -> None:
        console.print(f"Dashboard at [bold]{address}[/]")

    with new_folder(args.out, asdict(args), args.overwrite) as folder:
        console.print(f"Placing on the {args.shelf} shelf:")
        job = simulate_collaboration(
            aiming,
            placing,
            args.shelf,
            workplace=Workplace(shelf_x=args.shelf_x, shelf_depth=args.shelf_depth),
            camera=args.camera,
            pulls=PULLS if args.person else (),
            config=replace(args.config, grasping=grasping),
            seed=args.seed,
            page=PageConfig(port=args.port) if args.page else None,
            watch=serving(title, args.serving, opened) if args.serve else unwatched,
            on_phase=lambda phase, time: console.print(f"  {time:6.2f} s  {phase}"),
            on_page=lambda address: console.print(f"Page at [bold]{address}[/]"),
        )
        table = [] if job.result is None else evaluate(job, fit)
        with console.status("Writing recording and report"):
            run = record(
                title,
                job.station,
                job.world,
                job.motion,
                plan=None if job.result is None else job.result.plan,
                region=_region(job.workplace, args.config.grasping.aiming.half_size),
                demonstration=demonstration,
            )
            record_run(folder / "run.rrd", run)
            if table:
                command = shlex.join(["python", *sys.argv])
                write_report(folder, collaboration_report(run, table, asdict(args), command))
        job.station.log.save(folder / "log.npz")
        values = {m.key: m.value for m in table}
        cli.write_json(folder / "measured.json", values)
    if args.json is not None:
        cli.write_json(args.json, values)
    if job.failure:
        print(f"failed: {job.failure}", file=sys.stderr)
    else:
        show_measurements(table)
    console.print(f"Recording  rerun {args.out / 'run.rrd'}")
    if table:
        console.print(f"Report     {args.out / 'report.html'}")
    return 1 if job.failure or any(m.ok is False for m in table) else 0


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
