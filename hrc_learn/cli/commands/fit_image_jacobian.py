"""`hrc fit image-jacobian`: image Jacobian, and where to aim."""

from dataclasses import asdict
from pathlib import Path

from rich.console import Console

from hrc_learn import distributed
from hrc_learn.cli._options import resolved
from hrc_learn.cli._values import show_values, write_json
from hrc_learn.cli.arguments.learn import FitImageJacobian as Args
from hrc_learn.demos import DemonstrationSource, open_demos
from hrc_learn.jacobian import CellErrors, RBFCenters, grid
from hrc_learn.learning.visual_servo_fitting import fit_visual_servo, learning_recording
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.store import new_folder
from hrc_learn.viz.figures import learning_figure, workspace_figure
from hrc_learn.viz.learning_dashboards import record_learning


def run(args: Args) -> None:
    args = resolved(args)
    with distributed.processes() as rank:
        console = Console(quiet=rank != 0)
        demos = open_demos(args.dataset, episodes=args.episodes or None)
        for note in demos.notes:
            console.print(f"note: {note}")
        if args.learn and len(demos) < args.learning.hold_out:
            console.print(
                f"note: {len(demos)} demonstrations are too few to learn the neurons from; "
                f"fitted as they are (--learning.hold-out {args.learning.hold_out})"
            )
        with console.status(f"Fitting {len(demos)} demonstrations") as status:
            skill = fit_visual_servo(
                demos,
                None if args.neurons == "around" else _grid(args),
                args.fit,
                args.learning if args.learn else None,
                lambda number, state: status.update(
                    f"Learning, round {number}: held-out error {state.held_out_error:.3f} px"
                ),
            )
        if rank == 0:
            _write(args, skill, demos, console)


def _grid(args: Args) -> RBFCenters:
    return RBFCenters(centers=grid(args.x, args.y), width=args.width)


def _write(
    args: Args, skill: VisualServoSkill, demos: DemonstrationSource, console: Console
) -> None:
    metrics = skill.metrics()
    with new_folder(args.folder, asdict(args) | {"out": args.folder}, args.overwrite) as folder:
        skill.save(folder)
        write_json(folder / "metrics.json", metrics)
        if skill.cells is not None:
            _error_map(skill.cells, folder / "error_map.png")
        if skill.learned is not None:
            held_out = [state.held_out_error for state in skill.learned.rounds]
            figure = learning_figure(held_out, skill.learned.best, "px")
            figure.savefig(folder / "learning.png", dpi=120)
        title = f"Image Jacobian from {args.dataset.name}"
        record_learning(folder / "fit.rrd", learning_recording(skill, demos, title))
    show_values(f"Image Jacobian from {args.dataset}", metrics)
    console.print(f"Model in {args.folder}")
    console.print(f"Recording  rerun {args.folder / 'fit.rrd'}")
    if args.json is not None:
        write_json(args.json, metrics)


def _error_map(cells: CellErrors, path: Path) -> None:
    """Held-out error and posterior uncertainty over the horizontal plane."""
    maps = [
        ("Held-out error over image motion", cells.relative.numpy()),
        ("Uncertainty of the Jacobian", cells.uncertainty.numpy()),
    ]
    x, y = cells.edges.mT.numpy()
    workspace_figure(maps, x, y).savefig(path, dpi=120)
