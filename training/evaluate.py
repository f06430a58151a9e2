"""Evaluate fitted movement primitives on demonstrations, such as those held out.

Each demonstration is predicted by the common primitive of training/fit_dmp.py, told its start,
goal and duration. Prints error, goal error, smoothness and orientation error of every
demonstration, and writes figures of them. Exit status 1 if --most-nrmse was missed.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from rich.console import Console
from rich.table import Table

from hrc_learn import cli
from hrc_learn.demos import DemonstrationSet, load_demos, open_demos
from hrc_learn.learning.channels import CHANNELS, Motions, load_primitive
from hrc_learn.learning.reproduction_metrics import ReproductionError, reproduction_error
from hrc_learn.output import MADE_BY, new_folder
from hrc_learn.viz.figures import measures_figure

UNITS = {
    "nrmse": "",
    "largest": "rad or m",
    "goal_error": "rad or m",
    "jerk": "of the demonstration's",
    "turn_rmse": "deg",
    "turn_at_goal": "deg",
}


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to evaluate on."""

    model: Annotated[Path, tyro.conf.Positional]
    """Folder of training/fit_dmp.py."""
    dataset: Annotated[Path, tyro.conf.Positional]
    """LeRobot dataset with the demonstrations."""
    out: Path | None = None
    """Folder for figures and measured values; none are kept without."""
    episodes: tuple[int, ...] = ()
    """Episodes to evaluate on; when empty those that were not learned from, or all."""
    most_nrmse: float | None = None
    """Largest median error that passes."""
    overwrite: bool = False
    """Replace an older evaluation in that folder."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> int:
    console = Console()
    channels = [channel for channel in CHANNELS if (args.model / channel).is_dir()]
    if not channels:
        raise FileNotFoundError(f"{args.model} holds no model of training/fit_dmp.py")
    demos = _demonstrations(args, console)
    motions = Motions.of(demos)
    figures: dict[str, float] = {"demonstrations": float(len(demos))}
    errors: dict[str, ReproductionError] = {}
    for channel in channels:
        motions.require(channel)
        primitive = load_primitive(args.model / channel, channel)
        made = motions.adapted(channel, primitive)
        errors[channel] = reproduction_error(channel, motions, made)
        figures |= errors[channel].summary(channel)
        figures[f"{channel}_duration_ratio_median"] = _duration_ratio(
            motions, primitive.duration
        )
        console.print(_table(channel, demos, errors[channel]))
    if args.out is not None:
        with new_folder(args.out, asdict(args), args.overwrite) as folder:
            cli.write_json(folder / "metrics.json", figures)
            for channel, error in errors.items():
                columns = {name: x.numpy() for name, x in error.columns().items()}
                figure = measures_figure(columns, [demo.episode for demo in demos], UNITS)
                figure.savefig(folder / f"{channel}.png", dpi=120)
    if args.json is not None:
        cli.write_json(args.json, figures)
    limit = torch.inf if args.most_nrmse is None else args.most_nrmse
    return int(any(figures.get(f"{channel}_nrmse_median", 0.0) > limit for channel in channels))


def _demonstrations(args: Args, console: Console) -> DemonstrationSet:
    """Those asked for, with the joints that were learned."""
    made_by = json.loads((args.model / MADE_BY).read_text())
    learned = [int(i) for i in made_by.get("episodes") or ()]
    episodes = list(args.episodes)
    same = Path(made_by["dataset"]).resolve() == args.dataset.resolve()
    if not episodes and learned and same:
        every = range(len(open_demos(args.dataset)))
        episodes = [i for i in every if i not in learned]
        console.print(f"note: {len(episodes)} episodes that were not learned from")
    names = tuple(made_by.get("joint_names") or ())
    if same and (not learned or set(episodes) & set(learned)):
        console.print("note: some of these demonstrations were learned from")
    return load_demos(args.dataset, episodes=episodes or None, joint_names=names or None)


def _duration_ratio(motions: Motions, duration: torch.Tensor) -> float:
    """Duration of the primitive over that of each demonstration, median."""
    last = (motions.demos.length - 1)[:, None]
    return float((duration / motions.demos.time.take_along_dim(last, dim=1)[:, 0]).median())


def _table(channel: str, demos: DemonstrationSet, error: ReproductionError) -> Table:
    columns = error.columns()
    table = Table(title=f"{channel}: predicted from start, goal and duration")
    table.add_column("episode", justify="right")
    for name in columns:
        unit = f" [{UNITS[name]}]" if UNITS[name] else ""
        table.add_column(name.replace("_", " ") + unit, justify="right")
    for i, demo in enumerate(demos):
        table.add_row(str(demo.episode), *(f"{x[i]:.3g}" for x in columns.values()))
    table.add_section()
    table.add_row("median", *(f"{x.quantile(0.5):.3g}" for x in columns.values()))
    return table


if __name__ == "__main__":
    cli.run(main, Args)
