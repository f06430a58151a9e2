"""`hrc fit primitives`: movement primitives of joints and hand."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console

from hrc_learn import distributed
from hrc_learn.cli._values import show_values, write_json
from hrc_learn.cli.arguments.learn import FitPrimitives as Args
from hrc_learn.demos import load_demos, open_demos
from hrc_learn.learning.primitive_fitting import (
    FittedPrimitives,
    fit_contextual,
    fit_primitives,
    fit_recording,
    fit_streamed,
)
from hrc_learn.store import new_folder
from hrc_learn.viz.figures import fit_joints_figure, residual_figure
from hrc_learn.viz.learning_dashboards import record_fit


def run(args: Args) -> None:
    torch.manual_seed(args.seed)
    console = Console()
    if args.as_lerobot_policy:
        _fit_policy(args, console)
        return
    if args.several == "streamed":
        _fit_streamed(args)
        return
    demos = load_demos(
        args.dataset, episodes=args.episodes or None, joint_names=args.joint_names or None
    )
    for note in demos.notes:
        console.print(f"note: {note}")
    with new_folder(args.folder, _made_by(args), args.overwrite) as folder:
        with console.status(f"Fitting {len(demos)} demonstrations"):
            # Not every channel takes a scaling.
            scaled: dict[str, Any] = {} if args.scaling == "none" else {"scaling": args.scaling}
            fitted = fit_primitives(
                demos,
                args.n_basis,
                args.method,
                channels=args.channels,
                robust=args.robust,
                **scaled,
            )
            metrics = fitted.metrics()
            if args.several == "contextual":
                metrics |= fit_contextual(fitted, demos, args.context, folder)
        fitted.save(folder, each=args.several == "distribution")
        if args.several == "distribution":
            metrics |= {f"{k}_spread": _spread(fitted, k) for k in fitted.each}
        _show(fitted, args, folder)
        _finish(args, metrics, folder)


def _fit_streamed(args: Args) -> None:
    with distributed.processes() as rank:
        demos = open_demos(
            args.dataset, episodes=args.episodes or None, joint_names=args.joint_names or None
        )
        fits, metrics = fit_streamed(demos, args.n_basis or 60, channels=args.channels)
        if rank:
            return
        with new_folder(args.folder, _made_by(args), args.overwrite) as folder:
            for channel, fit in fits.items():
                fit.primitive.save(folder / channel)
            _finish(args, metrics, folder)


def _fit_policy(args: Args, console: Console) -> None:
    # LeRobot takes ten seconds to import.
    from hrc_learn.lerobot.policy.modeling_dmp import write_closed_form_policy

    given = (args.channels, args.context, args.joint_names, args.robust)
    if any(given) or (args.several, args.method, args.scaling) != (
        "mean",
        "trajectory",
        "none",
    ):
        raise ValueError(
            "--as-lerobot-policy learns the dataset's actions from its observations: of what "
            "to learn and how, it takes --n-basis and --episodes alone"
        )
    if args.n_basis is None:
        raise ValueError("--as-lerobot-policy needs a number of basis functions: --n-basis 50")
    with new_folder(args.folder, _made_by(args), args.overwrite) as folder:
        with console.status("Fitting a policy"):
            metrics = write_closed_form_policy(
                args.dataset, folder, n_basis=args.n_basis, episodes=args.episodes or None
            )
        _finish(args, metrics, folder)


def _made_by(args: Args) -> dict:
    return asdict(args) | {"dataset": args.dataset.resolve(), "out": args.folder}


def _spread(fitted: FittedPrimitives, channel: str) -> float:
    """Standard deviation of the motion over demonstrations, root mean square [rad or m]."""
    distribution = fitted.distribution(channel)
    durations = fitted.demonstrations.time.amax(dim=1)
    time = torch.linspace(0, float(durations.mean()), 100, dtype=torch.float64)
    return float(np.sqrt(np.square(distribution.position(time)[1].numpy()).mean()))


def _show(fitted: FittedPrimitives, args: Args, folder: Path) -> None:
    if set(fitted.each) == {"orientation"}:
        return
    shown = fit_recording(fitted, f"Fit of {args.dataset.name}")
    record_fit(folder / "fit.rrd", shown)
    name = "joints" if "joint" in fitted.each else "position"
    fit_joints_figure(shown).savefig(folder / f"{name}.png", dpi=120)
    if shown.residual:
        residual_figure(shown).savefig(folder / "n_basis.png", dpi=120)


def _finish(args: Args, metrics: dict[str, float], folder: Path) -> None:
    write_json(folder / "metrics.json", metrics)
    show_values(f"Fit of {args.dataset}", metrics)
    print(f"Model in {args.folder}")
    if args.json is not None:
        write_json(args.json, metrics)
