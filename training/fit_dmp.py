"""Fit movement primitives to the demonstrations of a LeRobot dataset.

Learns the motion of the joints, of any robot, and that of the hand where its pose is recorded.
Several demonstrations give one primitive each and their mean, which is what is saved. Writes a
folder with the primitives, the measured errors, demonstrations beside reproductions as a
figure and a Rerun recording, and what it was made from.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from rich.console import Console

from hrc_learn import cli
from hrc_learn.demos import load_demos
from hrc_learn.output import new_folder
from hrc_learn.tasks.fit_primitives import fit_primitives, fit_recording
from hrc_learn.viz.figures import fit_joints_figure
from hrc_learn.viz.fit_dashboard import record_fit


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to learn from."""

    dataset: Path
    """LeRobot dataset with the demonstrations."""
    out: Path
    """Folder for the model."""
    n_basis: int = 60
    """Number of basis functions."""
    method: Literal["trajectory", "ridge", "lwr"] = "trajectory"
    """Least squares on the motion, ridge regression on its force, or the paper's locally
    weighted regression."""
    episodes: tuple[int, ...] = ()
    """Episodes to learn from; all when empty."""
    joint_names: tuple[str, ...] = ()
    """Joints to learn, by name and in this order; all when empty."""
    overwrite: bool = False
    """Replace an older model in that folder."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> None:
    console = Console()
    demos = load_demos(
        args.dataset,
        episodes=args.episodes or None,
        joint_names=args.joint_names or None,
    )
    for note in demos.notes:
        console.print(f"note: {note}")
    made_by = asdict(args) | {"dataset": args.dataset.resolve()}
    with new_folder(args.out, made_by, args.overwrite) as folder:
        with console.status(
            f"Fitting {len(demos)} demonstrations, {args.n_basis} basis functions"
        ):
            fitted = fit_primitives(demos, args.n_basis, args.method)
            metrics = fitted.metrics()
        fitted.save(folder)
        cli.write_json(folder / "metrics.json", metrics)
        if fitted.joint is not None:
            shown = fit_recording(fitted, f"Fit of {args.dataset.name}")
            record_fit(folder / "fit.rrd", shown)
            fit_joints_figure(shown).savefig(folder / "joints.png", dpi=120)
    cli.show_values(f"Fit of {args.dataset}", metrics)
    console.print(f"Model in {args.out}")
    if args.json is not None:
        cli.write_json(args.json, metrics)


if __name__ == "__main__":
    cli.run(main, Args)
