"""Grasp an object beside a person, carry it to the cabinet and put it on a shelf.

In simulation: the learned skills run on MuJoCo's arm, an uncalibrated camera watches, and a
scripted person pulls the elbow aside while the arm aims. Writes a Rerun recording, a report
and the measured values. Exit status 1 if a target was missed.
"""

import json
import shlex
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from hrc_learn import cli
from hrc_learn.demos import load_demos
from hrc_learn.human import PullSpell, ScriptedPuller
from hrc_learn.kinematics import panda
from hrc_learn.output import new_folder
from hrc_learn.sim import CameraKind, World, open_camera
from hrc_learn.tasks import (
    AimingSkill,
    Collaboration,
    CollaborationConfig,
    Eye,
    PlacingSkill,
    Plan,
    Station,
    Workplace,
    check_plan,
    random_object_pose,
)
from hrc_learn.tasks.collaboration_report import write_collaboration_report
from hrc_learn.tasks.evaluation import evaluate
from hrc_learn.tasks.recording import WorldLog, record
from hrc_learn.viz.report import Measurement

# A worker reaches under the arm: the elbow is drawn aside, and let back.
PULLS = (
    PullSpell(start=0.5, duration=4.5, towards=(0.40, 0.00, 0.50), strongest=60.0),
    PullSpell(start=5.5, duration=4.5, towards=(-0.10, 0.25, 0.60), strongest=60.0),
)


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
    camera: CameraKind = "auto"
    """Camera: rendered by "egl", or "synthetic", which needs no OpenGL; "auto" renders where
    it can."""
    person: bool = True
    """Whether the scripted person pulls the elbow."""
    config: CollaborationConfig = field(default_factory=CollaborationConfig)
    """How the job is done."""
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
    demo_path = _demonstrated_path(args.placing)
    workplace, rng = Workplace(), np.random.default_rng(args.seed)
    workplace.shelf(args.shelf)
    item = workplace.scene.objects[0]
    world = World(workplace.scene)
    reach = (0.10, 0.08, 0.0)
    world.reset(
        workplace.home_joints().numpy(), {item.name: random_object_pose(workplace, reach, rng)}
    )
    person = ScriptedPuller(panda, PULLS if args.person else (), begin=None)
    moved = WorldLog(world)

    def on_phase(phase: str, time: float) -> None:
        console.print(f"  {time:6.2f} s  {phase}")
        if phase == "interact":
            person.begin(time)

    def check(plan: Plan) -> None:
        check_plan(plan, world, item.name if world.holds(item.name) else None)

    with new_folder(args.out, asdict(args), args.overwrite) as folder, torch.inference_mode():
        station = Station(
            chain=panda,
            arm=world.arm,
            gripper=world.arm,
            eye=Eye.on(open_camera(world, args.camera, rng=rng), workplace.scene),
            human=person,
            advance=moved.advance,
            on_phase=on_phase,
        )
        task = Collaboration(station, workplace, aiming, placing, check, args.config)
        console.print(f"Placing the {item.name} on the {args.shelf} shelf:")
        result = task.run(item, args.shelf)
        table = evaluate(result, station, world, item, args.shelf, fit)
        with console.status("Writing recording and report"):
            run = record(
                f"Collaboration, {args.shelf} shelf",
                station,
                world,
                moved,
                result.grasp.interaction,
                result.plan,
                demo_path,
            )
            from hrc_learn.viz.run_dashboard import record_run

            record_run(folder / "run.rrd", run)
            command = shlex.join(["python", *sys.argv])
            write_collaboration_report(
                folder / "report.html", run, table, asdict(args), command
            )
        station.log.save(folder / "log.npz")
        values = {_key(m): m.value for m in table}
        cli.write_json(folder / "measured.json", values)
    if args.json is not None:
        cli.write_json(args.json, values)
    _show(console, table)
    console.print(f"Recording  {args.out / 'run.rrd'}   (rerun {args.out / 'run.rrd'})")
    console.print(f"Report     {args.out / 'report.html'}")
    return 1 if any(m.ok is False for m in table) else 0


def _demonstrated_path(placing: Path) -> np.ndarray | None:
    """Hand along the first demonstration that the placing motion was learned from."""
    dataset = Path(json.loads((placing / "made_by.json").read_text())["dataset"])
    return load_demos(dataset, episodes=[0])[0].position if dataset.is_dir() else None


def _key(m: Measurement) -> str:
    unit = f"_{m.unit}" if m.unit else ""
    return m.name.replace(",", "").replace(" ", "_").lower() + unit


def _show(console: Console, table: list[Measurement]) -> None:
    shown = Table("measured", "value", "target", "", title="Measured")
    marks = {True: "[green]ok[/]", False: "[red]missed[/]", None: ""}
    for m in table:
        bound = (
            "" if m.target is None else f"{'>=' if m.at_least else '<='} {m.target:g} {m.unit}"
        )
        shown.add_row(m.name, f"{m.value:.4g} {m.unit}", bound, marks[m.ok])
    console.print(shown)


if __name__ == "__main__":
    cli.run(main, Args)
