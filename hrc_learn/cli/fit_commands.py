"""`hrc fit`: movement primitives and image Jacobians from demonstrations."""

import shlex
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console

from hrc_learn import distributed
from hrc_learn.cli._run import command_line, configuration, refuse_repeats, write_values
from hrc_learn.cli._settings import with_settings
from hrc_learn.cli._tables import image_jacobian_rows, primitive_rows, show_values
from hrc_learn.cli.arguments import FitImageJacobian, FitPrimitives
from hrc_learn.demos import DemonstrationSet, DemonstrationSource, open_demos
from hrc_learn.demos.read.source import open_dataset
from hrc_learn.jacobian import (
    CellErrors,
    EvidenceConfig,
    ImageJacobianFitConfig,
    RBFCenters,
    paper_grid,
)
from hrc_learn.learning.fit_recordings import fit_recording, fit_report, learning_recording
from hrc_learn.learning.model_choice import best_models, fit_contextual, keep_best
from hrc_learn.learning.primitive_fitting import (
    FittedPrimitives,
    fit_all,
    fit_streamed,
    sampled,
)
from hrc_learn.learning.primitive_fitting import fit_primitives as fit
from hrc_learn.learning.visual_servo_fitting import fit_visual_servo
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.store import new_folder, write_json
from hrc_learn.viz.figures import learning_figure, workspace_figure
from hrc_learn.viz.learning_dashboards import record_fit, record_learning
from hrc_learn.viz.report import PAGE, show_command, write_report


def fit_primitives(args: FitPrimitives) -> None:
    """Fit movement primitives of joints and end effector.

    Raises:
        ValueError: Options contradict each other, or an episode is named twice.
    """
    torch.manual_seed(0)
    console = Console()
    refuse_repeats(args.episodes)
    if args.as_lerobot_policy:
        _fit_policy(args, console)
        return
    if args.several == "streamed":
        _fit_streamed(args, console)
        return
    _refuse_unused_context(args)
    source = open_demos(args.dataset, **_wanted(args), keep_contract=args.keep_contract)
    demos = sampled(source)
    for note in demos.notes:
        console.print(f"note: {note}", soft_wrap=True)
    if _is_sample(demos, source):
        console.print(f"note: {_SAMPLE_NOTE}", soft_wrap=True)
    with new_folder(args.folder, _made_by(args), args.overwrite) as folder:
        with console.status(f"Fitting {len(source)} demonstrations"):
            fitted, metrics = _learn(args, source, demos, folder)
        _draw(fitted, args, metrics, folder)
        _finish(args, metrics, folder)
    if (args.folder / PAGE).is_file():
        print(f"Report: {shlex.quote(str(args.folder / PAGE))}")
        print(f"Dashboard: {show_command(args.folder)}")


def fit_silently(args: FitPrimitives) -> None:
    """Fit the models of `fit_primitives` without contract, report or messages.

    Raises:
        ValueError: The demonstrations hold no motion, or lack a column that a channel needs.
    """
    torch.manual_seed(0)
    source = open_demos(args.dataset, **_wanted(args))
    with new_folder(args.folder, _made_by(args), args.overwrite) as folder:
        _learn(args, source, sampled(source), folder)


def _learn(
    args: FitPrimitives, source: DemonstrationSource, demos: DemonstrationSet, folder: Path
) -> tuple[FittedPrimitives, dict[str, float]]:
    """Fit and save the models.

    Returns:
        The fit and its measured values.
    """
    # Only some channels take a scaling.
    scaled: dict[str, Any] = {} if args.scaling == "none" else {"scaling": args.scaling}
    fitted = fit(
        demos,
        args.n_basis,
        args.method,
        channels=args.channels,
        **scaled,
    )
    if _is_sample(demos, source):
        fitted = fit_all(fitted, source)
    metrics = fitted.metrics()
    if args.several == "contextual":
        metrics |= fit_contextual(fitted, demos, args.context, folder)
    # Scaled motions are linear neither in the mean nor in a context.
    if args.several == "best" and args.scaling == "none":
        metrics |= keep_best(fitted, demos, args.context, folder)
    fitted.save(folder, each=args.several == "distribution")
    if args.several == "distribution":
        metrics |= {f"{k}_spread": _spread(fitted, k) for k in fitted.each}
    return fitted, metrics


def _is_sample(demos: DemonstrationSet, source: DemonstrationSource) -> bool:
    return len(demos) < len(source) or demos.frames < source.frames


def _refuse_unused_context(args: FitPrimitives) -> None:
    """Refuse --context with models that are no function of it."""
    if not args.context:
        return
    if args.several not in ("best", "contextual"):
        raise ValueError(
            f"--several {args.several} does not use --context: leave it out, or learn a "
            f"function of it with --several contextual"
        )
    if args.several == "best" and args.scaling != "none":
        raise ValueError(
            f"--scaling {args.scaling} does not use --context: leave one of them out, or give "
            f"--several contextual"
        )


_SAMPLE_NOTE = (
    "the mean is fitted to all demonstrations; its error, the comparison of models and all "
    "other models use a sample of them"
)


def _wanted(args: FitPrimitives) -> dict[str, Any]:
    """Arguments of `open_demos`."""
    return {
        "episodes": args.episodes or None,
        "joint_names": args.joint_names or None,
        "mapping": args.columns(),
        "units": args.units,
    }


def _fit_streamed(args: FitPrimitives, console: Console) -> None:
    given = (args.context, args.method != "trajectory", args.scaling != "none")
    if any(given):
        raise ValueError(
            "--several streamed is an unscaled least-squares fit: it takes neither --method "
            "nor --scaling nor --context"
        )
    if args.n_basis is None:
        raise ValueError("--several streamed needs a number of basis functions: --n-basis 60")
    with distributed.processes() as rank:
        demos = open_demos(args.dataset, **_wanted(args))
        for note in () if rank else demos.notes:
            console.print(f"note: {note}")
        fits, metrics = fit_streamed(demos, args.n_basis, channels=args.channels)
        if rank:
            return
        with new_folder(args.folder, _made_by(args), args.overwrite) as folder:
            for channel, fit in fits.items():
                fit.primitive.save(folder / channel)
            _finish(args, metrics, folder)


def _fit_policy(args: FitPrimitives, console: Console) -> None:
    # LeRobot takes ten seconds to import.
    from hrc_learn.lerobot.policy.dmp_policy import write_closed_form_policy

    given = (args.channels, args.context, args.joint_names, args.units, args.mapping)
    if any(given) or (args.several, args.method, args.scaling) != (
        "best",
        "trajectory",
        "none",
    ):
        raise ValueError(
            "--as-lerobot-policy learns the dataset's actions from its observations: it takes "
            "--n-basis and --episodes only"
        )
    if args.n_basis is None:
        raise ValueError("--as-lerobot-policy needs a number of basis functions: --n-basis 50")
    if (args.dataset / "meta/info.json").is_file():
        dataset, kept = open_dataset(args.dataset), ""
        if args.keep_contract:
            dataset, kept = dataset.keep_first_contract()
        for note in filter(None, (kept, dataset.contract_note)):
            console.print(f"note: {note}", soft_wrap=True)
    with new_folder(args.folder, _made_by(args), args.overwrite) as folder:
        with console.status("Fitting a policy"):
            metrics = write_closed_form_policy(
                args.dataset, folder, n_basis=args.n_basis, episodes=args.episodes or None
            )
        _finish(args, metrics, folder)


def _made_by(args: FitPrimitives) -> dict:
    return asdict(args) | {"dataset": args.dataset.resolve(), "out": args.folder}


def _spread(fitted: FittedPrimitives, channel: str) -> float:
    """Standard deviation over demonstrations, root mean square along the motion [rad or m]."""
    distribution = fitted.distribution(channel)
    durations = fitted.demonstrations.time.amax(dim=1)
    time = torch.linspace(0, float(durations.mean()), 100, dtype=torch.float64)
    return float(np.sqrt(np.square(distribution.position(time)[1].numpy()).mean()))


def _draw(
    fitted: FittedPrimitives,
    args: FitPrimitives,
    metrics: dict[str, float],
    folder: Path,
) -> None:
    """Write report and recording of the fit, unless only orientations were learned."""
    if set(fitted.each) == {"orientation"}:
        return
    shown = fit_recording(fitted, f"Fit of {args.dataset.name}")
    record_fit(folder / "fit.rrd", shown)
    rows = primitive_rows(metrics)
    write_report(folder, fit_report(shown, rows, configuration(args), command_line()))


def _finish(args: FitPrimitives, metrics: dict[str, float], folder: Path) -> None:
    write_json(folder / "metrics.json", metrics)
    show_values(f"Fit of {args.dataset}", metrics, primitive_rows(metrics))
    for channel, better in best_models(folder).items():
        error = 100 * metrics[f"held_out_{channel}_{better}_nrmse_median"]
        mean = 100 * metrics[f"held_out_{channel}_mean_nrmse_median"]
        print(
            f"{channel}: {_MODELS[better]} predicts held-out demonstrations best, NRMSE "
            f"{error:.1f} %, mean {mean:.1f} %; hrc evaluate uses it"
        )
    print(f"Model in {shlex.quote(str(args.folder))}")
    write_values(args.json, metrics)


_MODELS = {
    "contextual": "a function of start and goal (or of --context)",
    "nearest": "the demonstration of the nearest start and goal",
}


@dataclass(frozen=True, kw_only=True)
class _JacobianSettings:
    """Settings of the fit of an image Jacobian."""

    learning: EvidenceConfig = field(default_factory=EvidenceConfig)
    fit: ImageJacobianFitConfig = field(default_factory=ImageJacobianFitConfig)


_PAPER_NEURONS = RBFCenters(centers=paper_grid(), width=0.1)


def fit_image_jacobian(args: FitImageJacobian) -> None:
    """Fit the image Jacobian and the target in the image.

    Raises:
        ValueError: An episode is named twice.
    """
    settings = with_settings(args.config, _JacobianSettings())
    learning = settings.learning
    refuse_repeats(args.episodes)
    with distributed.processes() as rank:
        console = Console(quiet=rank != 0)
        demos = open_demos(args.dataset, episodes=args.episodes or None)
        for note in demos.notes:
            console.print(f"note: {note}")
        if args.learn and len(demos) < learning.hold_out:
            console.print(
                f"note: {len(demos)} demonstrations are too few to learn the neurons; they "
                f"stay as they are (--config learning.hold_out={learning.hold_out})"
            )
        with console.status(f"Fitting {len(demos)} demonstrations") as status:
            skill = fit_visual_servo(
                demos,
                None
                if args.neurons == "around"
                else RBFCenters(centers=paper_grid(), width=0.1),
                settings.fit,
                learning if args.learn else None,
                lambda number, state: status.update(
                    f"Learning, round {number}: held-out error {state.held_out_error:.3f} px"
                ),
            )
        if rank == 0:
            _write(args, skill, demos, console)


def _write(
    args: FitImageJacobian,
    skill: VisualServoSkill,
    demos: DemonstrationSource,
    console: Console,
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
    rows = image_jacobian_rows(metrics)
    show_values(f"Image Jacobian from {args.dataset}", metrics, rows)
    print(f"Model in {shlex.quote(str(args.folder))}")
    print(f"Dashboard: {show_command(args.folder)}")
    write_values(args.json, metrics)


def _error_map(cells: CellErrors, path: Path) -> None:
    """Held-out error and posterior uncertainty over the horizontal plane."""
    maps = [
        ("Held-out error over image motion", cells.relative.numpy()),
        ("Uncertainty of the Jacobian", cells.uncertainty.numpy()),
    ]
    x, y = cells.edges.mT.numpy()
    workspace_figure(maps, x, y).savefig(path, dpi=120)
