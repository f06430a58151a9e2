"""Thousands of simulated grasps as batches: how often, how fast and how safely.

Random starts, targets and uncalibrated cameras, turned by up to 180 degrees from what the
controller believes, against the kinematics of the arm. Prints a table of what was measured
beside its target. Exit status 1 if a target was missed.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from hrc_learn import cli
from hrc_learn.controller.effort_trials import EffortConfig, run_effort_trials
from hrc_learn.controller.trials import ROLL_CLASSES, TrialConfig, run_trials
from hrc_learn.jacobian import (
    CompositeEstimator,
    FixedEstimator,
    ImageJacobianEstimator,
    KalmanEstimator,
    PaperEstimator,
    RBFImageJacobian,
)

CAMERA = TrialConfig().imperfections
# Of the table: a log file has no width of its own.
_WIDTH = 100


def flip_row(J: Tensor) -> Tensor:
    """The sign of the first image row turned round."""
    return J * J.new_tensor([[-1.0], [1.0]])


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """One batch of trials and what it is to reach."""

    says: str
    config: TrialConfig
    estimator: Callable[[RBFImageJacobian], ImageJacobianEstimator] = KalmanEstimator
    success: float | None = None
    """Least share of successes; None: shown beside the others."""
    t50: float | None = None
    """Latest median time [s]."""
    t95: float | None = None
    """Latest time of 95 % of the trials [s]."""


NEAR = TrialConfig()
EXPERIMENTS: dict[str, Experiment] = {
    "near": Experiment(
        says="starts near the ready posture", config=NEAR, success=0.99, t50=5.5, t95=8.0
    ),
    "global": Experiment(
        says="starts anywhere within the limits",
        config=replace(NEAR, starts="global"),
        success=0.98,
    ),
    "fixed": Experiment(says="no adaptation", config=NEAR, estimator=FixedEstimator),
    "composite": Experiment(
        says="composite adaptation", config=NEAR, estimator=CompositeEstimator
    ),
    "paper": Experiment(
        says="the paper's adaptation in our loop", config=NEAR, estimator=PaperEstimator
    ),
    "printed": Experiment(
        says="the paper's law and Table I as printed, behind the safety filter",
        config=replace(NEAR, law="printed"),
        estimator=PaperEstimator,
    ),
    "jacobian_0.3": Experiment(
        says="initial Jacobian times 0.3",
        config=replace(NEAR, initial_jacobian=lambda J: 0.3 * J),
        success=0.98,
    ),
    "jacobian_3": Experiment(
        says="initial Jacobian times 3",
        config=replace(NEAR, initial_jacobian=lambda J: 3 * J),
        success=0.98,
    ),
    "row_flipped": Experiment(
        says="a row of the initial Jacobian with the wrong sign",
        config=replace(NEAR, initial_jacobian=flip_row),
        success=0.98,
    ),
    "rows_swapped": Experiment(
        says="rows of the initial Jacobian swapped",
        config=replace(NEAR, initial_jacobian=lambda J: J.flip(0)),
        success=0.98,
    ),
    "noise": Experiment(
        says="noise of 2 px",
        config=replace(NEAR, imperfections=replace(CAMERA, noise=2.0)),
        success=0.98,
    ),
    "latency": Experiment(
        says="images late by 3 frames",
        config=replace(NEAR, imperfections=replace(CAMERA, latency_frames=3)),
        success=0.98,
    ),
    "slow_camera": Experiment(
        says="images at 15 Hz",
        config=replace(NEAR, imperfections=replace(CAMERA, frame_steps=8)),
        success=0.98,
    ),
    "tilt": Experiment(
        says="camera tilted by 45 to 75 degrees",
        config=replace(NEAR, tilt=(0.785, 1.309)),
        success=0.98,
    ),
    "marker_lost": Experiment(
        says="marker covered for up to 3 s, every 3 s on average",
        config=replace(
            NEAR, duration=20.0, imperfections=replace(CAMERA, loss_rate=1 / 3, loss_time=3.0)
        ),
        success=0.97,
    ),
    "faulty_images": Experiment(
        says="1 % of measurements NaN",
        config=replace(NEAR, imperfections=replace(CAMERA, nan_share=0.01)),
        success=0.98,
    ),
}
"""What is run, by name, with the acceptance figures."""

EFFORTS: dict[str, tuple[EffortConfig, dict[str, float]]] = {
    "effort": (
        EffortConfig(),
        {"deviation_mm": 0.2, "turn_deg": 0.05, "deviation_p95_mm": 1.5, "turn_p95_deg": 0.5},
    ),
    "effort_noise": (EffortConfig(noise=0.5), {"deviation_p95_mm": 2.5}),
}
"""A person pulls the elbow away for 7 s and back for 4 s: what may at most happen."""
LEAST_ELBOW_MM = 100.0
"""In the median, or the trial shows nothing."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to run."""

    only: tuple[str, ...] = ()
    """Names of the experiments; none: all of them."""
    trials: int = 1000
    """Trials of each experiment."""
    seed: int = 0
    """Seed of starts, targets, cameras and noise, the same for all experiments."""
    json: Path | None = None
    """Receives all figures as one flat object."""


def main(args: Args) -> int:
    """Run the experiments, print a line for each, write the figures."""
    names = _checked(args.only) or (*EXPERIMENTS, *EFFORTS)
    torch.set_num_threads(1)
    console = Console()
    console = Console(width=max(console.width, _WIDTH))
    figures: dict[str, float] = {}
    grasps = _grasp([name for name in names if name in EXPERIMENTS], args, figures, console)
    efforts = _pull([name for name in names if name in EFFORTS], args, figures, console)
    missed = grasps + efforts
    for miss in missed:
        console.print(f"missed  {miss}", style="red")
    if args.json is not None:
        cli.write_json(args.json, figures)
    return 1 if missed else 0


def _checked(names: tuple[str, ...]) -> tuple[str, ...]:
    known = (*EXPERIMENTS, *EFFORTS)
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"no experiment {unknown[0]!r}; there are {', '.join(known)}")
    return names


def _grasp(
    names: list[str], args: Args, figures: dict[str, float], console: Console
) -> list[str]:
    """Run grasping experiments; returns what was missed."""
    table, missed = _grasp_table(), []
    for name in names:
        experiment = EXPERIMENTS[name]
        config = replace(experiment.config, count=args.trials, seed=args.seed)
        began = time.monotonic()
        summary = run_trials(experiment.estimator, config).summary()
        took = time.monotonic() - began
        console.print(f"{name}: {experiment.says}; took {took:.0f} s", style="dim")
        figures |= {f"{name}_{key}": value for key, value in summary.items()}
        misses = _misses(experiment, summary)
        missed += [f"{name}: {miss}" for miss in misses]
        table.add_row(*_row(name, summary), "missed" if misses else "")
    if names:
        console.print(table)
    return missed


def _pull(
    names: list[str], args: Args, figures: dict[str, float], console: Console
) -> list[str]:
    """Run trials with a person; returns what was missed."""
    table, missed = Table(title="A person pulls the elbow"), []
    for column in ("experiment", "elbow [mm]", "tool [mm]", "p95", "tool [deg]", "p95"):
        table.add_column(column, no_wrap=True, justify="right")
    for name in names:
        config, bounds = EFFORTS[name]
        summary = run_effort_trials(replace(config, seed=args.seed)).summary()
        figures |= {f"{name}_{key}": value for key, value in summary.items()}
        table.add_row(name, *(f"{value:.3g}" for value in summary.values()))
        if summary["elbow_mm"] < LEAST_ELBOW_MM:
            missed.append(f"{name}: elbow moved {summary['elbow_mm']:.0f} mm only")
        missed += [
            f"{name}: {key} {summary[key]:.3g} > {bound:g}"
            for key, bound in bounds.items()
            if summary[key] > bound
        ]
    if names:
        console.print(table)
    return missed


def _misses(experiment: Experiment, summary: dict[str, float]) -> list[str]:
    """Which targets were missed, in words."""
    misses = []
    if experiment.success is not None and summary["success"] < experiment.success:
        misses.append(f"success {summary['success']:.1%} < {experiment.success:.0%}")
    for key in ("t50", "t95"):
        latest = getattr(experiment, key)
        if latest is not None and summary[key] > latest:
            misses.append(f"{key} {summary[key]:.2f} s > {latest} s")
    if summary["violations"]:
        misses.append(f"{summary['violations']:.0f} steps beyond a limit")
    return misses


def _grasp_table() -> Table:
    rolls = ", ".join(f"{low}-{high}" for low, high in ROLL_CLASSES)
    table = Table(title=f"Grasping; success [%] by camera roll of {rolls} degrees")
    table.add_column("experiment", no_wrap=True)
    for column in ("by roll", "all", "t50 [s]", "t95 [s]", "vision [s]", "violations", ""):
        table.add_column(column, no_wrap=True, justify="right")
    return table


def _row(name: str, summary: dict[str, float]) -> list[str]:
    rolls = [summary[f"success_roll_{low}_{high}"] for low, high in ROLL_CLASSES]
    times = [summary[key] for key in ("t50", "t95", "vision_phase")]
    return [
        name,
        " ".join(f"{100 * share:.0f}" for share in rolls),
        f"{100 * summary['success']:.1f}",
        *(f"{seconds:.2f}" for seconds in times),
        f"{summary['violations']:.0f}",
    ]


if __name__ == "__main__":
    cli.run(main, Args)
