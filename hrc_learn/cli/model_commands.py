"""`hrc evaluate` and `hrc smooth`: errors of models, and limits on the actions of policies."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from hrc_learn.cli._run import refuse_repeats, write_values
from hrc_learn.cli.arguments import Evaluate, FitPrimitives, Smooth, columns, refuse_given
from hrc_learn.cli.fit_command import fit_silently, open_moving
from hrc_learn.cli.tokens_command import held_out
from hrc_learn.demos import DemonstrationSet
from hrc_learn.kinematics import panda
from hrc_learn.learning.model_choice import best_models, predict
from hrc_learn.learning.primitive_fitting import CHANNELS, Motions, load_primitive, sampled
from hrc_learn.learning.reproduction_error import ReproductionError
from hrc_learn.store import MADE_BY, new_folder, read_made_by, read_toml, write_json
from hrc_learn.viz import palette
from hrc_learn.viz.figures import Figure, plots_figure
from hrc_learn.viz.panels import Plot, single

UNITS: dict[str, str] = read_toml(Path(__file__).with_name("reproduction_units.toml"))
"""Units of the measures of `ReproductionError`."""


def evaluate(args: Evaluate) -> int:
    """Evaluate a model, or primitives that are fitted to most of the dataset first.

    Raises:
        FileNotFoundError: There is no dataset, or no model.
        ValueError: The model does not name its dataset, an episode is named twice, or no
            episode is left to fit.
    """
    refuse_repeats(args.episodes)
    if args.most_nrmse is not None and not args.most_nrmse >= 0:
        raise ValueError(f"--most-nrmse must not be negative, but is {args.most_nrmse}")
    if args.model is not None and not args.model.is_dir():
        raise FileNotFoundError(f"there is no model at {args.model}")
    if not args.dataset.is_dir():
        raise FileNotFoundError(f"there is no dataset at {args.dataset}")
    if args.model is None:
        with TemporaryDirectory() as temporary:
            model = Path(temporary) / "model"
            _fit_most(args, model)
            return _evaluate_primitives(args, model)
    if (args.model / "jacobian").is_dir():
        # Imported here: primitives do not need MuJoCo.
        from hrc_learn.cli.image_jacobian_commands import evaluate_image_jacobian

        return evaluate_image_jacobian(args, args.model)
    return _evaluate_primitives(args, args.model)


def _fit_most(args: Evaluate, model: Path) -> None:
    """Fit the demonstrations that are not held out for the evaluation.

    Raises:
        ValueError: All demonstrations are held out.
    """
    every = [entry.index for entry in open_moving(args.dataset, ())[0].entries]
    unseen = args.episodes or held_out(every, 5)
    episodes = tuple(i for i in every if i not in unseen)
    if not episodes and len(every) > 1:
        raise ValueError(
            f"--episodes names all {len(every)} episodes of {args.dataset} and leaves none to "
            f"fit: name fewer, or give --model"
        )
    wanted = FitPrimitives(dataset=args.dataset, out=model, episodes=episodes)
    with Console().status(f"Fitting {len(episodes) or 1} demonstrations"):
        fit_silently(wanted)


def _evaluate_primitives(args: Evaluate, model: Path) -> int:
    console = Console()
    channels = [channel for channel in CHANNELS if (model / channel).is_dir()]
    if not channels:
        raise FileNotFoundError(f"{model} holds no model: give a folder of `hrc fit`")
    demos = _demonstrations(args, model, console)
    for note in demos.notes:
        console.print(f"note: {note}")
    motions = Motions.of(demos)
    figures: dict[str, float] = {"demonstrations": float(len(demos))}
    errors: dict[str, ReproductionError] = {}
    for channel, better in best_models(model).items():
        console.print(f"note: the {better} model predicts {channel} instead of the mean")
    for channel in channels:
        motions.require(channel)
        with console.status(f"Predicting {channel} of {len(demos)} demonstrations"):
            errors[channel] = motions.error(channel, predict(model, channel, motions, demos))
        figures |= errors[channel].summary(channel)
        console.print(_table(channel, demos, errors[channel]))
    if args.out is not None:
        with new_folder(args.out, asdict(args), args.overwrite) as folder:
            write_json(folder / "metrics.json", figures)
            for channel, error in errors.items():
                _figure(demos, error).savefig(folder / f"{channel}.png", dpi=120)
    write_values(args.json, figures)
    if args.most_nrmse is None:
        return 0
    medians = [figures.get(f"{channel}_nrmse_median", 0.0) for channel in channels]
    # NaN does not meet the limit.
    return int(not all(median <= args.most_nrmse for median in medians))


def _figure(demos: DemonstrationSet, error: ReproductionError) -> Figure:
    """Figure of each error measure over the episodes, with its median."""
    plots = []
    for name, values in error.columns().items():
        median = values.quantile(0.5).expand_as(values)
        curves = (
            single("", name, values.numpy(), palette.RUN_ON_DARK),
            single("", "median", median.numpy(), palette.LIMIT),
        )
        plots.append(Plot(title=_with_unit(name), curves=curves))
    episodes = np.array([float(demo.episode) for demo in demos])
    return plots_figure(episodes, plots, columns=2, axis="episode (red: median)")


def _with_unit(name: str) -> str:
    return name.replace("_", " ") + (f" [{UNITS[name]}]" if UNITS[name] else "")


def _demonstrations(args: Evaluate, model: Path, console: Console) -> DemonstrationSet:
    """Demonstrations to evaluate on, read with the same options as for the fit."""
    made_by = fitted_from(model)
    learned = {int(i) for i in made_by.get("episodes") or ()}
    wanted = as_fitted(made_by)
    episodes = list(args.episodes)
    if Path(made_by["dataset"]).resolve() == args.dataset.resolve():
        if not episodes and learned:
            every = [
                entry.index for entry in open_moving(args.dataset, (), **wanted)[0].entries
            ]
            episodes = [i for i in every if i not in learned]
            if episodes:
                console.print(f"note: {len(episodes)} episodes that were not learned from")
            else:
                console.print("note: all of these demonstrations were learned from")
        elif not learned or set(episodes) & learned:
            console.print("note: some of these demonstrations were learned from")
    elif (model / "joint").is_dir():
        # Another dataset may hold other joints, or the same joints in another order.
        names = load_primitive(model / "joint", "joint").joint_names
        wanted["joint_names"] = names or wanted["joint_names"]
    source, notes = open_moving(args.dataset, episodes, **wanted)
    for note in notes:
        console.print(f"note: {note}")
    return sampled(source)


def as_fitted(made_by: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments for `open_demos` that read a dataset as for the fit of a model."""
    return {
        "joint_names": tuple(made_by.get("joint_names") or ()) or None,
        "mapping": columns(made_by.get("mapping") or {}),
        "units": made_by.get("units") or {},
    }


def fitted_from(model: Path) -> dict[str, Any]:
    """Dataset and options that a model was made from.

    Raises:
        ValueError: The model's folder does not name its dataset.
    """
    made_by = read_made_by(model)
    if not isinstance(made_by.get("dataset"), str):
        raise ValueError(
            f"{model / MADE_BY} does not name the model's dataset: give a folder of hrc fit"
        )
    return made_by


_ROWS = 8
"""Number of demonstrations in a table, which lists the worst ones."""


def _table(channel: str, demos: DemonstrationSet, error: ReproductionError) -> Table:
    """Table of the demonstrations, ordered by the first measure, the worst first."""
    measures = error.columns()
    order = next(iter(measures.values())).argsort(descending=True).tolist()
    shown = order[:_ROWS]
    table = Table(title=f"{channel}: predicted from start, goal and duration")
    table.add_column("episode", justify="right")
    for name in measures:
        # Text, as rich would take the brackets around a unit for markup.
        table.add_column(Text(_with_unit(name)), justify="right")
    for i in shown:
        table.add_row(str(demos[i].episode), *(f"{x[i]:.3g}" for x in measures.values()))
    table.add_section()
    if others := len(order) - len(shown):
        table.caption = f"{others} more, none worse"
    table.add_row("median", *(f"{x.quantile(0.5):.3g}" for x in measures.values()))
    return table


def smooth(args: Smooth) -> None:
    """Add limits to a checkpoint or a file, or remove them."""
    if args.checkpoint is not None and not args.checkpoint.is_dir():
        raise FileNotFoundError(f"there is no folder {args.checkpoint}")
    if args.checkpoint is None and (args.remove or args.limits is None):
        raise ValueError("give --checkpoint, or --limits to write only a file.")
    if args.dataset is None and not args.remove:
        raise ValueError("give --dataset: the limits are taken from its demonstrations.")
    with Console().status("Importing LeRobot, which takes seconds"):
        from hrc_learn.lerobot.arm_values import ArmValues
        from hrc_learn.lerobot.smoothing import add_smoothing, gathered_limits, remove_smoothing

    if args.remove and args.checkpoint is not None:
        others = ["dataset", "scale", "urdf", "calibration", "degrees", "limits"]
        refuse_given(args, others, "is not used by --remove: leave it out")
        remove_smoothing(args.checkpoint)
        print(f"limits removed from {args.checkpoint}")
        return
    assert args.dataset is not None
    given = {name: getattr(args, name) for name in ("scale", "urdf", "calibration", "degrees")}
    with Console().status(f"Reading {args.dataset}"):
        limits = gathered_limits(args.dataset, **given)
    if args.urdf is None and args.calibration is None:
        ends = zip(panda.limits.lower.tolist(), panda.limits.upper.tolist(), strict=True)
        limits = limits.within(dict(zip(ArmValues(panda).joints, ends, strict=True)))
    if args.checkpoint is not None:
        add_smoothing(args.checkpoint, limits)
    if args.limits is not None:
        limits.save(args.limits)
    values = asdict(limits)
    table = Table("value", "velocity [1/s]", "acceleration [1/s^2]", "jerk [1/s^3]")
    kinds = ("velocity", "acceleration", "jerk")
    for i, name in enumerate(limits.names):
        table.add_row(name, *(f"{values[kind][i]:.3g}" for kind in kinds))
    Console().print(table)
    if args.checkpoint is not None:
        print(f"{args.checkpoint} keeps its actions within these limits")
    figures = {
        f"{kind}_{name}": float(v)
        for kind in kinds
        for name, v in zip(limits.names, np.array(values[kind]), strict=True)
    }
    write_values(args.json, figures)
