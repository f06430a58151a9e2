"""Fit the image Jacobian of an uncalibrated camera to demonstrations of aiming.

Learns how the image of the hand's marker moves with the hand, as a radial basis function
network over the workspace, and where that image should be to stand right above an object.
"""

from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console

from hrc_learn import cli
from hrc_learn.demos import load_demos
from hrc_learn.jacobian import grid
from hrc_learn.output import new_folder
from hrc_learn.tasks.fit_aiming import fit_aiming


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to learn from."""

    dataset: Path
    """LeRobot dataset with the demonstrations."""
    out: Path
    """Folder for the model."""
    x: tuple[float, float, int] = (0.05, 0.35, 3)
    """Neurons along x: first and last centre [m], and how many (paper, Table I)."""
    y: tuple[float, float, int] = (0.35, 0.65, 3)
    """Neurons along y."""
    width: float = 0.1
    """Standard deviation of a neuron [m]."""
    overwrite: bool = False
    """Replace an older model in that folder."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> None:
    console = Console()
    demos = load_demos(args.dataset)
    for note in demos.notes:
        console.print(f"note: {note}")
    with new_folder(args.out, asdict(args), args.overwrite) as folder:
        with console.status(f"Fitting {len(demos)} demonstrations"):
            skill = fit_aiming(demos, grid(args.x, args.y), args.width)
        skill.save(folder)
        metrics = skill.metrics()
        cli.write_json(folder / "metrics.json", metrics)
    cli.show_values(f"Image Jacobian from {args.dataset}", metrics)
    console.print(f"Model in {args.out}")
    if args.json is not None:
        cli.write_json(args.json, metrics)


if __name__ == "__main__":
    cli.run(main, Args)
