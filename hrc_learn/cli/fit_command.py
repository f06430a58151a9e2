"""`hrc fit`: movement primitives from demonstrations."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from hrc_learn import distributed
from hrc_learn.cli._run import command_line, configuration, refuse_repeats, write_values
from hrc_learn.cli.arguments import FitPrimitives, columns, refuse_given
from hrc_learn.demos import DemonstrationSet, DemonstrationSource, open_demos
from hrc_learn.demos.read.dataset_folder import EpisodeEntry
from hrc_learn.demos.read.source import open_dataset
from hrc_learn.learning.fit_dashboards import fit_report, record_fit, shown_fit
from hrc_learn.learning.model_choice import best_models, keep_best
from hrc_learn.learning.primitive_fitting import (
    CHANNELS,
    FittedPrimitives,
    fit_streamed,
    sampled,
)
from hrc_learn.learning.primitive_fitting import fit_primitives as fit
from hrc_learn.store import new_folder, write_json
from hrc_learn.viz.report import (
    PAGE,
    Measurement,
    Row,
    measured,
    show_command,
    show_measurements,
    write_report,
)


def fit_primitives(args: FitPrimitives) -> None:
    """Fit movement primitives of joints and end effector.

    Raises:
        ValueError: Options contradict each other, or an episode is named twice.
    """
    torch.manual_seed(0)
    console = Console()
    refuse_repeats(args.episodes)
    _refuse_contradictions(args)
    if args.as_lerobot_policy:
        _fit_policy(args, console)
        return
    if args.several == "streamed":
        _fit_streamed(args)
        return
    source, left_out = _open(args)
    demos = sampled(source)
    print(*(f"note: {note}\n" for note in (*left_out, *demos.notes)), sep="", end="")
    with new_folder(args.folder, _made_by(args), args.overwrite) as folder:
        with console.status(f"Fitting {len(demos)} demonstrations"):
            fitted, metrics = _learn(args, demos, folder)
            _draw(fitted, args, metrics, folder)
        _finish(args, metrics, folder)
    if (args.folder / PAGE).is_file():
        print(f"Report: {shlex.quote(str(args.folder / PAGE))}")
        print(f"Dashboard: {show_command(args.folder)}")


def fit_silently(args: FitPrimitives) -> None:
    """Fit the models of `fit_primitives` without report or messages.

    Raises:
        ValueError: The demonstrations hold no motion, or lack a column that a channel needs.
    """
    torch.manual_seed(0)
    source, _ = _open(args)
    with new_folder(args.folder, _made_by(args), args.overwrite) as folder:
        _learn(args, sampled(source), folder)


def _learn(
    args: FitPrimitives, demos: DemonstrationSet, folder: Path
) -> tuple[FittedPrimitives, dict[str, float]]:
    """Fit and save the models.

    Returns:
        The fit and its measured values.
    """
    # Only some channels take a scaling.
    scaled: dict[str, Any] = {} if args.scaling == "none" else {"scaling": args.scaling}
    fitted = fit(demos, args.n_basis, args.method, channels=args.channels, **scaled)
    metrics = fitted.metrics()
    # The compared models need motions that are linear in start and goal; scaled ones are not.
    if args.several in ("best", "contextual") and args.scaling == "none":
        only = args.several == "contextual"
        metrics |= keep_best(fitted, demos, args.context, folder, regression_only=only)
    fitted.save(folder, each=args.several == "distribution")
    return fitted, metrics


def _refuse_contradictions(args: FitPrimitives) -> None:
    """Refuse options that the chosen model would ignore."""
    if args.as_lerobot_policy:
        model, others = "--as-lerobot-policy", ["channels", "joint_names", "units", "mapping"]
        others += ["context", "several", "method", "scaling"]
    elif args.several == "streamed":
        model, others = "--several streamed", ["context", "method", "scaling"]
    elif args.several not in ("best", "contextual"):
        model, others = f"--several {args.several}", ["context"]
    elif args.scaling != "none":
        model, others = f"--scaling {args.scaling}", ["context"]
        others += ["several"] * (args.several == "contextual")
    else:
        return
    refuse_given(args, others, f"is not used by {model}: leave one of them out")
    if args.n_basis is None and (args.as_lerobot_policy or args.several == "streamed"):
        raise ValueError(f"{model} needs a number of basis functions: --n-basis 60")


def _open(args: FitPrimitives) -> tuple[DemonstrationSource, list[str]]:
    """The demonstrations, and notes on what is left out.

    Raises:
        DatasetError: The dataset cannot be read, or a unit is doubtful.
    """
    source, notes = open_moving(
        args.dataset,
        args.episodes,
        mapping=columns(args.mapping),
        units=args.units,
        joint_names=args.joint_names or None,
        refuse_doubt=True,
    )
    if "gripper" in source.units:
        notes.append("no primitive is fitted to the gripper (--as-lerobot-policy includes it)")
    return source, notes


def open_moving(
    dataset: Path, episodes: Sequence[int], **options: Any
) -> tuple[DemonstrationSource, list[str]]:
    """Demonstrations of the given episodes, or of all episodes with at least two frames.

    Args:
        dataset: Folder of the dataset.
        episodes: Episodes to read; empty: all.
        options: Further arguments of `open_demos`.

    Returns:
        The demonstrations, and notes on what is left out.
    """
    left_out: list[int] = []

    def moves(entry: EpisodeEntry) -> bool:
        if entry.length < 2 and not episodes:
            left_out.append(entry.index)
            return False
        return True

    source = open_demos(dataset, episodes or None, where=moves, **options)
    listed = ", ".join(map(str, left_out))
    return source, [f"episodes of a single frame are left out: {listed}"] if left_out else []


def _fit_streamed(args: FitPrimitives) -> None:
    assert args.n_basis is not None
    with distributed.processes() as rank:
        demos, left_out = _open(args)
        for note in () if rank else (*left_out, *demos.notes):
            print(f"note: {note}")
        fits, metrics = fit_streamed(demos, args.n_basis, channels=args.channels)
        if rank:
            return
        with new_folder(args.folder, _made_by(args), args.overwrite) as folder:
            for channel, primitive in fits.items():
                primitive.save(folder / channel)
            _finish(args, metrics, folder)


def _fit_policy(args: FitPrimitives, console: Console) -> None:
    # LeRobot takes ten seconds to import.
    from hrc_learn.lerobot.policy.dmp_policy import write_closed_form_policy

    assert args.n_basis is not None
    known = (args.dataset / "meta/info.json").is_file()
    if known and (note := open_dataset(args.dataset).contract_note):
        print(f"note: {note}")
    with new_folder(args.folder, _made_by(args), args.overwrite) as folder:
        with console.status("Fitting a policy"):
            metrics = write_closed_form_policy(
                args.dataset, folder, n_basis=args.n_basis, episodes=args.episodes or None
            )
        _finish(args, metrics, folder)


def _made_by(args: FitPrimitives) -> dict:
    return asdict(args) | {"dataset": args.dataset.resolve(), "out": args.folder}


def _draw(
    fitted: FittedPrimitives, args: FitPrimitives, metrics: dict[str, float], folder: Path
) -> None:
    """Write report and recording of the fit, unless only orientations were learned."""
    if set(fitted.each) == {"orientation"}:
        return
    shown = shown_fit(fitted, f"Fit of {args.dataset.name}")
    record_fit(folder / "fit.rrd", shown)
    write_report(folder, fit_report(shown, _rows(metrics), configuration(args), command_line()))


def _finish(args: FitPrimitives, metrics: dict[str, float], folder: Path) -> None:
    write_json(folder / "metrics.json", metrics)
    rows = _rows(metrics)
    title, more = f"Fit of {args.dataset}", len(metrics) - len(rows)
    show_measurements(rows, title=title, more=more, elsewhere="metrics.json")
    for channel, better in best_models(folder).items():
        error = 100 * metrics[f"held_out_{channel}_{better}_nrmse_median"]
        mean = 100 * metrics[f"held_out_{channel}_mean_nrmse_median"]
        print(
            f"{channel}: {_MODELS[better]} predicts held-out demonstrations best (NRMSE "
            f"{error:.1f} %, mean: {mean:.1f} %); hrc evaluate uses this model"
        )
    print(f"Model in {shlex.quote(str(args.folder))}")
    write_values(args.json, metrics)


_MODELS = {
    "mean": "the mean",
    "contextual": "a regression",
    "nearest": "the nearest demonstration",
    "kernel": "nearby demonstrations",
    "line": "a straight line",
}
"""Kinds of model that predict held-out demonstrations."""


_COUNTS: tuple[Row, ...] = (
    ("demonstrations", "demonstrations", 1, "", None, 0.0),
    ("left_out_error", "held-out error, relative to the spread of actions", 100, "%", None, 0),
)
# Key of a channel, name, factor, unit and largest value that passes: 2 % is a deviation of a
# centimetre in a motion of half a metre.
_ROWS = (
    # The maximum: a mean would hide one demonstration that its primitive misses.
    ("{}_nrmse_max", "worst NRMSE of a demonstration", 100, "%", 2.0),
    ("mean_{}_nrmse_median", "median NRMSE of the common model", 100, "%", None),
    ("{}_turn_rmse_max", "worst rotation error", 1, "deg", None),
)
_WORDS = {"joint": "joints", "orientation": "orientation"}
_RESOLUTION = 0.01
"""Resolution of NRMSE [%] and of rotation errors [deg]: an encoder resolves 1e-4 rad."""


def _rows(metrics: Mapping[str, float]) -> list[Measurement]:
    """Main measured values; the NRMSE is relative to the range of motion."""
    rows = [*_COUNTS]
    for channel in CHANNELS:
        held_out = [
            (key, f"held-out NRMSE, by {words}", 100, "%", None)
            for kind, words in _MODELS.items()
            if (key := f"held_out_{channel}_{kind}_nrmse_median") in metrics
        ]
        best = sorted(held_out, key=lambda row: metrics[row[0]])[:1]
        words = _WORDS.get(channel, "end effector")
        rows += [
            (key.format(channel), f"{words}: {name}", factor, unit, target, _RESOLUTION)
            for key, name, factor, unit, target in (*_ROWS, *best)
        ]
    return measured(rows, metrics)
