"""Fit the image Jacobian of an uncalibrated camera to demonstrations.

Learns how the image of the hand's marker moves with the hand, as a radial basis function
network over the workspace, with its uncertainty; and, where an object was watched, where that
image should be to stand right above it. Neurons, noise and prior are learned by the gradient
of the evidence until demonstrations held out say stop. Writes the model, the measured errors,
figures of them and a Rerun recording of how learning converged. Under torchrun each process
reads its share of the demonstrations.
"""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from rich.console import Console

from hrc_learn import cli, distributed
from hrc_learn.demos import DemonstrationSource, open_demos
from hrc_learn.jacobian import CellErrors, ImageJacobianFitConfig, LearningConfig, Neurons, grid
from hrc_learn.learning.fit_recordings import learning_recording
from hrc_learn.learning.visual_servo_fitting import fit_visual_servo
from hrc_learn.output import new_folder
from hrc_learn.skills.visual_servoing import VisualServoSkill
from hrc_learn.viz.figures import learning_figure, workspace_figure
from hrc_learn.viz.fit_dashboard import record_learning


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to learn from."""

    dataset: Path
    """LeRobot dataset with the demonstrations."""
    out: Path
    """Folder for the model."""
    episodes: tuple[int, ...] = ()
    """Episodes to learn from; all when empty."""
    neurons: Literal["around", "grid"] = "around"
    """Thirteen that see all of the hand's pose, placed about what was shown; or a grid that
    sees x and y, as in the paper."""
    x: tuple[float, float, int] = (0.05, 0.35, 3)
    """Of a grid: first and last centre along x [m], and how many (paper, Table I)."""
    y: tuple[float, float, int] = (0.35, 0.65, 3)
    """Of a grid: along y."""
    width: float = 0.1
    """Of a grid: standard deviation of a neuron [m]."""
    learn: bool = True
    """Whether neurons, noise and prior are learned. Needs --learning.hold-out demonstrations,
    fewer are fitted without."""
    learning: LearningConfig = field(default_factory=LearningConfig)
    """How they are learned."""
    fit: ImageJacobianFitConfig = field(default_factory=ImageJacobianFitConfig)
    """What is compared, and what is believed before; where learning starts."""
    overwrite: bool = False
    """Replace an older model in that folder."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> None:
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


def _grid(args: Args) -> Neurons:
    return Neurons(centers=grid(args.x, args.y), width=args.width)


def _write(
    args: Args, skill: VisualServoSkill, demos: DemonstrationSource, console: Console
) -> None:
    metrics = skill.metrics()
    with new_folder(args.out, asdict(args), args.overwrite) as folder:
        skill.save(folder)
        cli.write_json(folder / "metrics.json", metrics)
        if skill.cells is not None:
            _error_map(skill.cells, folder / "error_map.png")
        if skill.learned is not None:
            held_out = [state.held_out_error for state in skill.learned.rounds]
            figure = learning_figure(held_out, skill.learned.best, "px")
            figure.savefig(folder / "learning.png", dpi=120)
        title = f"Image Jacobian from {args.dataset.name}"
        record_learning(folder / "fit.rrd", learning_recording(skill, demos, title))
    cli.show_values(f"Image Jacobian from {args.dataset}", metrics)
    console.print(f"Model in {args.out}")
    console.print(f"Recording  rerun {args.out / 'fit.rrd'}")
    if args.json is not None:
        cli.write_json(args.json, metrics)


def _error_map(cells: CellErrors, path: Path) -> None:
    """Held-out error and posterior uncertainty over the horizontal plane."""
    maps = [
        ("Held-out error over image motion", cells.relative.numpy()),
        ("Uncertainty of the Jacobian", cells.uncertainty.numpy()),
    ]
    x, y = cells.edges.mT.numpy()
    workspace_figure(maps, x, y).savefig(path, dpi=120)


if __name__ == "__main__":
    cli.run(main, Args)
