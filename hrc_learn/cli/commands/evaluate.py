"""`hrc evaluate`: what was learned, on demonstrations held out and against the truth."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from rich.text import Text

from hrc_learn.cli._options import resolved
from hrc_learn.cli._run import refuse_repeats, write_values
from hrc_learn.cli._tables import named
from hrc_learn.cli.arguments.learn import (
    EvaluateImageJacobian,
    EvaluatePrimitives,
    FitPrimitives,
)
from hrc_learn.cli.commands.check import columns
from hrc_learn.cli.commands.fit import fit_silently
from hrc_learn.demos import DemonstrationSet, load_demos, open_demos
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


def evaluate_primitives(args: EvaluatePrimitives) -> int:
    """Primitives on demonstrations held out.

    Raises:
        FileNotFoundError: There is no dataset, or no model.
        ValueError: The model does not say what it learned from, or the episodes make no sense.
    """
    refuse_repeats(args.episodes)
    if args.model is not None:
        return _evaluate(args, args.model)
    if not args.dataset.is_dir():
        raise FileNotFoundError(f"there is no dataset at {args.dataset}")
    with TemporaryDirectory() as temporary:
        model = Path(temporary) / "model"
        _fit_most(args, model)
        return _evaluate(args, model)


def _fit_most(args: EvaluatePrimitives, model: Path) -> None:
    """Fit the demonstrations that are not to be evaluated on, into a folder.

    Raises:
        ValueError: All are to be evaluated on.
    """
    source = open_demos(args.dataset, mapping=columns(args.mapping), units=args.units)
    count = len(source)
    # Every fifth is held out, the last one of few; a single one cannot be.
    held_out = set(args.episodes or range(count)[4::5] or range(count)[1:][-1:])
    episodes = tuple(i for i in range(count) if i not in held_out)
    if not episodes and count > 1:
        raise ValueError(
            f"--episodes names all {count} episodes of {args.dataset} and leaves none to fit: "
            f"name fewer, or give --model"
        )
    wanted = FitPrimitives(
        dataset=args.dataset,
        out=model,
        episodes=episodes,
        units=args.units,
        mapping=args.mapping,
    )
    with Console().status(f"Fitting {len(episodes) or count} demonstrations"):
        fit_silently(wanted)


def _evaluate(args: EvaluatePrimitives, model: Path) -> int:
    console = Console()
    channels = [channel for channel in CHANNELS if (model / channel).is_dir()]
    if not channels:
        raise FileNotFoundError(f"{model} holds no model of `hrc fit`")
    demos = _demonstrations(args, model, console)
    for note in demos.notes:
        console.print(f"note: {note}")
    motions = Motions.of(demos)
    figures: dict[str, float] = {"demonstrations": float(len(demos))}
    errors: dict[str, ReproductionError] = {}
    for channel, better in best_models(model).items():
        console.print(f"note: {channel} is predicted by the {better} model, not by the mean")
    for channel in channels:
        motions.require(channel)
        primitive = load_primitive(model / channel, channel)
        made = predict(model, channel, motions, demos)
        errors[channel] = reproduction_error(channel, motions, made)
        figures |= errors[channel].summary(channel)
        figures[f"{channel}_duration_ratio_median"] = _duration_ratio(
            motions, primitive.duration
        )
        console.print(_table(channel, demos, errors[channel], args.verbose))
    if args.out is not None:
        with new_folder(args.out, asdict(args), args.overwrite) as folder:
            write_json(folder / "metrics.json", figures)
            for channel, error in errors.items():
                columns = {name: x.numpy() for name, x in error.columns().items()}
                figure = measures_figure(columns, [demo.episode for demo in demos], UNITS)
                figure.savefig(folder / f"{channel}.png", dpi=120)
    write_values(args.json, figures)
    if args.most_nrmse is None:
        return 0
    medians = [figures.get(f"{channel}_nrmse_median", 0.0) for channel in channels]
    # An error that is no number has not met the limit either.
    return int(not all(median <= args.most_nrmse for median in medians))


def _demonstrations(
    args: EvaluatePrimitives, model: Path, console: Console
) -> DemonstrationSet:
    """Those asked for, with the joints that were learned."""
    made_by = _made_by(model)
    learned = {int(i) for i in made_by.get("episodes") or ()}
    names = tuple(made_by.get("joint_names") or ())
    wanted: dict[str, Any] = {
        "joint_names": names or None,
        "mapping": columns(args.mapping or made_by.get("mapping") or {}),
        "units": args.units or made_by.get("units") or {},
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
    """What a model was made from.

    Raises:
        ValueError: It does not say of which dataset, and where that should stand.
    """
    try:
        made_by = read_made_by(model)
    except json.JSONDecodeError as error:
        raise ValueError(f"{model / MADE_BY}: not valid JSON ({error})") from None
    if not isinstance(made_by, dict) or not isinstance(made_by.get("dataset"), str):
        raise ValueError(
            f"{model / MADE_BY} names no dataset that was learned from: give a folder of "
            f"hrc fit"
        )
    return made_by


def _duration_ratio(motions: Motions, duration: torch.Tensor) -> float:
    """Duration of the primitive over that of each demonstration, median."""
    last = (motions.demos.length - 1)[:, None]
    return float((duration / motions.demos.time.take_along_dim(last, dim=1)[:, 0]).median())


_ROWS = 8
"""Demonstrations in a table, unless all are asked for."""


def _table(
    channel: str, demos: DemonstrationSet, error: ReproductionError, everything: bool
) -> Table:
    """The worst demonstrations first, by the first of the measures."""
    columns = error.columns()
    order = next(iter(columns.values())).argsort(descending=True).tolist()
    shown = order if everything else order[:_ROWS]
    table = Table(title=f"{channel}: predicted from start, goal and duration")
    table.add_column("episode", justify="right")
    for name in columns:
        unit = f" [{UNITS[name]}]" if UNITS[name] else ""
        # As text: brackets around a unit are no markup.
        table.add_column(Text(name.replace("_", " ") + unit), justify="right")
    for i in shown:
        table.add_row(str(demos[i].episode), *(f"{x[i]:.3g}" for x in columns.values()))
    table.add_section()
    if others := len(order) - len(shown):
        table.caption = f"{others} more, none worse: --verbose"
    table.add_row("median", *(f"{x.quantile(0.5):.3g}" for x in columns.values()))
    return table


MOST_ERROR = 0.05
LEAST_SPEED_UP = 1.5


def evaluate_image_jacobian(args: EvaluateImageJacobian) -> int:
    """An image Jacobian against the simulator's true one."""
    # MuJoCo, which the evaluation of primitives does without.
    from hrc_learn.experiments.jacobian_evaluation import (
        ClosedLoops,
        compare_starts,
        compare_with_truth,
        held_out_grid,
    )
    from hrc_learn.sim import World
    from hrc_learn.sim.workplace import Workplace

    args = resolved(args)
    torch.set_num_threads(1)
    network = VisualServoSkill.load(args.model).jacobian
    demos = load_demos(args.dataset)
    if demos[0].position is None:
        raise ValueError(f"{args.dataset}: no end-effector positions to place a grid by.")
    shown = torch.cat([torch.from_numpy(demo.position) for demo in demos]).double()
    workplace = Workplace()
    world = World(workplace.scene)
    world.reset(workplace.home_joints().numpy(), {})
    camera, offset = workplace.scene.camera, world.hand_marker_offset()
    figures: dict[str, float] = {}
    for name, tilt in (("upright", 0.0), ("tilted", args.tilt)):
        measured = compare_with_truth(network, held_out_grid(shown, tilt=tilt), camera, offset)
        figures |= {f"{name}_{key}": value for key, value in measured.items()}
    if args.closed_loop:
        workspace = torch.stack([shown.quantile(0.05, dim=0), shown.quantile(0.95, dim=0)])
        near = workplace.hover_joints()
        with Console().status("Closed loops") as status:
            loops = ClosedLoops.draw(camera, offset, workspace, near, args.starts)
            figures |= compare_starts(
                network,
                loops,
                on_run=lambda name: status.update(f"Closed loops, {name} Jacobian"),
            )
    targets = {
        "upright_relative_error_median": (MOST_ERROR, False),
        "speed_up_over_fixed": (LEAST_SPEED_UP, True),
    }
    rows = [
        replace(named(name, figures[name]), target=target, at_least=at_least)
        for name, (target, at_least) in targets.items()
        if name in figures
    ]
    others = [named(name, value) for name, value in figures.items() if name not in targets]
    show_measurements(
        [*rows, *others], title=f"Image Jacobian {args.model}", elsewhere="--json FILE"
    )
    write_values(args.json, figures)
    return int(any(row.ok is False for row in rows))
