"""`hrc evaluate primitives`: primitives on demonstrations held out."""

from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from rich.console import Console
from rich.table import Table

from hrc_learn.cli._values import write_json
from hrc_learn.cli.arguments.learn import EvaluatePrimitives as Args
from hrc_learn.cli.arguments.learn import FitPrimitives
from hrc_learn.cli.commands import fit_primitives
from hrc_learn.demos import DemonstrationSet, load_demos, open_demos
from hrc_learn.learning.channels import (
    CHANNELS,
    Motions,
    ReproductionError,
    load_primitive,
    reproduction_error,
)
from hrc_learn.store import new_folder, read_made_by
from hrc_learn.viz.figures import measures_figure

UNITS = {
    "nrmse": "",
    "largest": "rad or m",
    "goal_error": "rad or m",
    "jerk": "of the demonstration's",
    "turn_rmse": "deg",
    "turn_at_goal": "deg",
}


def run(args: Args) -> int:
    if args.model is not None:
        return _evaluate(args, args.model)
    if not args.dataset.is_dir():
        raise FileNotFoundError(f"there is no dataset at {args.dataset}")
    with TemporaryDirectory() as temporary:
        model = Path(temporary) / "model"
        _fit_most(args, model)
        return _evaluate(args, model)


def _fit_most(args: Args, model: Path) -> None:
    """Fit the demonstrations that are not to be evaluated on, into a folder."""
    count = len(open_demos(args.dataset))
    # Every fifth is held out, the last one of few; a single one cannot be.
    held_out = set(args.episodes or range(count)[4::5] or range(count)[1:][-1:])
    episodes = tuple(i for i in range(count) if i not in held_out)
    fit_primitives.run(FitPrimitives(dataset=args.dataset, out=model, episodes=episodes))


def _evaluate(args: Args, model: Path) -> int:
    console = Console()
    channels = [channel for channel in CHANNELS if (model / channel).is_dir()]
    if not channels:
        raise FileNotFoundError(f"{model} holds no model of `hrc fit`")
    demos = _demonstrations(args, model, console)
    motions = Motions.of(demos)
    figures: dict[str, float] = {"demonstrations": float(len(demos))}
    errors: dict[str, ReproductionError] = {}
    for channel in channels:
        motions.require(channel)
        primitive = load_primitive(model / channel, channel)
        made = motions.adapted(channel, primitive)
        errors[channel] = reproduction_error(channel, motions, made)
        figures |= errors[channel].summary(channel)
        figures[f"{channel}_duration_ratio_median"] = _duration_ratio(
            motions, primitive.duration
        )
        console.print(_table(channel, demos, errors[channel]))
    if args.out is not None:
        with new_folder(args.out, asdict(args), args.overwrite) as folder:
            write_json(folder / "metrics.json", figures)
            for channel, error in errors.items():
                columns = {name: x.numpy() for name, x in error.columns().items()}
                figure = measures_figure(columns, [demo.episode for demo in demos], UNITS)
                figure.savefig(folder / f"{channel}.png", dpi=120)
    if args.json is not None:
        write_json(args.json, figures)
    limit = torch.inf if args.most_nrmse is None else args.most_nrmse
    return int(any(figures.get(f"{channel}_nrmse_median", 0.0) > limit for channel in channels))


def _demonstrations(args: Args, model: Path, console: Console) -> DemonstrationSet:
    """Those asked for, with the joints that were learned."""
    made_by = read_made_by(model)
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
