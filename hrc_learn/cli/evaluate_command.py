"""`hrc evaluate`: errors of primitives on held-out demonstrations, and of image Jacobians."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from rich.text import Text

from hrc_learn.cli._run import refuse_repeats, write_values
from hrc_learn.cli._tables import named
from hrc_learn.cli.arguments import Evaluate, FitPrimitives, columns
from hrc_learn.cli.fit_commands import fit_silently
from hrc_learn.demos import DemonstrationSet, load_demos, open_demos
from hrc_learn.jacobian import RBFImageJacobian
from hrc_learn.learning.channels import (
    CHANNELS,
    Motions,
    ReproductionError,
    load_primitive,
    reproduction_error,
)
from hrc_learn.learning.model_choice import best_models, predict
from hrc_learn.learning.primitive_fitting import sampled
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.store import MADE_BY, new_folder, read_made_by, write_json
from hrc_learn.viz.figures import measures_figure
from hrc_learn.viz.report import show_measurements

UNITS = {
    "nrmse": "",
    "largest": "rad or m",
    "goal_error": "rad or m",
    "jerk": "of the demonstration's",
    "turn_rmse": "deg",
    "turn_at_goal": "deg",
}
"""Units of the measures of `ReproductionError`."""


def evaluate(args: Evaluate) -> int:
    """Evaluate a model, or primitives that are fitted to most of the dataset first.

    Raises:
        FileNotFoundError: There is no dataset, or no model.
        ValueError: The model does not name its dataset, or the episodes contradict it.
    """
    refuse_repeats(args.episodes)
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
        return _evaluate_image_jacobian(args, args.model)
    return _evaluate_primitives(args, args.model)


def _fit_most(args: Evaluate, model: Path) -> None:
    """Fit the demonstrations that are not held out for the evaluation.

    Raises:
        ValueError: All of them are held out.
    """
    source = open_demos(args.dataset)
    count = len(source)
    # Every fifth is held out, or the last one of fewer than five.
    held_out = set(args.episodes or range(count)[4::5] or range(count)[1:][-1:])
    episodes = tuple(i for i in range(count) if i not in held_out)
    if not episodes and count > 1:
        raise ValueError(
            f"--episodes names all {count} episodes of {args.dataset} and leaves none to fit: "
            f"name fewer, or give --model"
        )
    wanted = FitPrimitives(dataset=args.dataset, out=model, episodes=episodes)
    with Console().status(f"Fitting {len(episodes) or count} demonstrations"):
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
        console.print(f"note: the {better} model predicts {channel}, not the mean")
    for channel in channels:
        motions.require(channel)
        primitive = load_primitive(model / channel, channel)
        made = predict(model, channel, motions, demos)
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
                measures = {name: x.numpy() for name, x in error.columns().items()}
                figure = measures_figure(measures, [demo.episode for demo in demos], UNITS)
                figure.savefig(folder / f"{channel}.png", dpi=120)
    write_values(args.json, figures)
    if args.most_nrmse is None:
        return 0
    medians = [figures.get(f"{channel}_nrmse_median", 0.0) for channel in channels]
    # NaN does not meet the limit.
    return int(not all(median <= args.most_nrmse for median in medians))


def _demonstrations(args: Evaluate, model: Path, console: Console) -> DemonstrationSet:
    """Demonstrations to evaluate on, read in the way they were read for the fit."""
    made_by = _made_by(model)
    learned = {int(i) for i in made_by.get("episodes") or ()}
    names = tuple(made_by.get("joint_names") or ())
    wanted: dict[str, Any] = {
        "joint_names": names or None,
        "mapping": columns(made_by.get("mapping") or {}),
        "units": made_by.get("units") or {},
    }
    episodes = list(args.episodes)
    if Path(made_by["dataset"]).resolve() == args.dataset.resolve():
        if not episodes and learned:
            every = range(len(open_demos(args.dataset, **wanted)))
            episodes = [i for i in every if i not in learned]
            if episodes:
                console.print(f"note: {len(episodes)} episodes that were not learned from")
            else:
                console.print("note: all of these demonstrations were learned from")
        elif not learned or set(episodes) & learned:
            console.print("note: some of these demonstrations were learned from")
    return sampled(open_demos(args.dataset, episodes=episodes or None, **wanted))


def _made_by(model: Path) -> dict[str, Any]:
    """Dataset and options that a model was made from.

    Raises:
        ValueError: The model's folder does not name its dataset.
    """
    try:
        made_by = read_made_by(model)
    except json.JSONDecodeError as error:
        raise ValueError(f"{model / MADE_BY}: not valid JSON ({error})") from None
    if not isinstance(made_by, dict) or not isinstance(made_by.get("dataset"), str):
        raise ValueError(
            f"{model / MADE_BY} does not name the model's dataset: give a folder of hrc fit"
        )
    return made_by


def _duration_ratio(motions: Motions, duration: torch.Tensor) -> float:
    """Median ratio of the primitive's duration to that of each demonstration."""
    last = (motions.demos.length - 1)[:, None]
    return float((duration / motions.demos.time.take_along_dim(last, dim=1)[:, 0]).median())


_ROWS = 8
"""Demonstrations in a table: the worst."""


def _table(channel: str, demos: DemonstrationSet, error: ReproductionError) -> Table:
    """Table of the demonstrations, ordered by the first measure, the worst first."""
    measures = error.columns()
    order = next(iter(measures.values())).argsort(descending=True).tolist()
    shown = order[:_ROWS]
    table = Table(title=f"{channel}: predicted from start, goal and duration")
    table.add_column("episode", justify="right")
    for name in measures:
        unit = f" [{UNITS[name]}]" if UNITS[name] else ""
        # Text, as rich would take the brackets around a unit for markup.
        table.add_column(Text(name.replace("_", " ") + unit), justify="right")
    for i in shown:
        table.add_row(str(demos[i].episode), *(f"{x[i]:.3g}" for x in measures.values()))
    table.add_section()
    if others := len(order) - len(shown):
        table.caption = f"{others} more, none worse"
    table.add_row("median", *(f"{x.quantile(0.5):.3g}" for x in measures.values()))
    return table


MOST_ERROR = 0.05
"""Largest median error of an image Jacobian relative to the true one."""
_TILT = 0.1
"""Tilt of the end effector in the second grid of poses [rad]; in the first it points down."""


def _evaluate_image_jacobian(args: Evaluate, model: Path) -> int:
    """Compare an image Jacobian with the simulator's true one."""
    torch.set_num_threads(1)
    figures = _image_jacobian_figures(args, VisualServoSkill.load(model).jacobian)
    bounded = "upright_relative_error_median"
    row = replace(named(bounded, figures[bounded]), target=MOST_ERROR)
    others = [named(name, value) for name, value in figures.items() if name != bounded]
    show_measurements([row, *others], title=f"Image Jacobian {model}", elsewhere="--json FILE")
    write_values(args.json, figures)
    return int(row.ok is False)


def _image_jacobian_figures(args: Evaluate, network: RBFImageJacobian) -> dict[str, float]:
    """Errors on two grids of poses."""
    # MuJoCo, which the evaluation of primitives does not need.
    from hrc_learn.experiments.grasping_metrics import (
        compare_with_truth,
        held_out_grid,
    )
    from hrc_learn.sim import World
    from hrc_learn.sim.workplace import Workplace

    demos = load_demos(args.dataset)
    if demos[0].position is None:
        raise ValueError(f"{args.dataset}: no end-effector positions to place a grid around.")
    shown = torch.cat([torch.from_numpy(demo.position) for demo in demos]).double()
    workplace = Workplace()
    world = World(workplace.scene)
    world.reset(workplace.home_joints().numpy(), {})
    camera, offset = workplace.scene.camera, world.hand_marker_offset()
    figures: dict[str, float] = {}
    for name, tilt in (("upright", 0.0), ("tilted", _TILT)):
        measured = compare_with_truth(network, held_out_grid(shown, tilt=tilt), camera, offset)
        figures |= {f"{name}_{key}": value for key, value in measured.items()}
    return figures
