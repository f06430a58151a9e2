"""Success and errors of an experiment over the size of its imperfections.

Runs `hrc run EXPERIMENT --trials N --imperfections S` for each size S, and draws the success
rates with their intervals (Wilson, 95 %), and median and 95th percentile of three errors.
"""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from hrc_learn import cli
from hrc_learn.experiments.metric_table import Summary, wilson_interval
from hrc_learn.experiments.trials import Trial
from hrc_learn.store import write_json
from hrc_learn.viz import palette
from hrc_learn.viz.figures import STYLE, WIDTH

SHOWN = {
    "placing": ("place_error_mm", "place_tilt_deg"),
    "grasping": (
        "servoing_time_from_the_remote_start_s",
        "grasp_offset_mm",
    ),
    "collaboration": ("end_effector_deviation_mm", "grasp_offset_mm", "place_error_mm"),
}
"""Keys of the errors drawn for each experiment."""


@dataclass(frozen=True, kw_only=True)
class Args:
    experiment: Literal["placing", "grasping", "collaboration"] = "grasping"
    sizes: tuple[float, ...] = (0.0, 1.0, 2.0, 4.0)
    """Sizes of the imperfections, as multiples of the nominal ones."""
    trials: int = 50
    """Trials of each size."""
    processes: int = 1
    """Number of parallel trials."""
    out: Path = Path("outputs/imperfections")
    """Folder of the runs and of `curve.png`."""
    json: Path | None = None
    """Receives success rates and errors as one flat object."""


def main(args: Args) -> int:
    summaries: dict[float, Summary] = {}
    for size in args.sizes:
        folder = args.out / f"size_{size:g}"
        words = ["run", args.experiment, "--out", str(folder), "--trials", str(args.trials)]
        words += ["--imperfections", str(size)]
        # Exit status 1 means that a target was missed, as expected for large sizes.
        command = [sys.executable, "-m", "hrc_learn.cli", *words, "--overwrite", "--config"]
        command += ["film=false", f"processes={args.processes}"]
        subprocess.run(command, check=False)
        lines = (folder / "trials.jsonl").read_text(encoding="utf-8").splitlines()
        # The first line holds the settings.
        summaries[size] = Summary.of([Trial.from_line(line) for line in lines[1:]])
        Console().print(f"{size:g} times nominal: {summaries[size].rate}")
    keys = SHOWN[args.experiment]
    curve_figure(summaries, keys).savefig(args.out / "curve.png", dpi=150)
    if args.json is not None:
        write_json(args.json, figures_of(summaries, keys))
    return 0


def figures_of(summaries: dict[float, Summary], keys: tuple[str, ...]) -> dict[str, float]:
    """Success rates, and 95th percentiles of the errors, by size."""
    figures: dict[str, float] = {}
    for size, summary in summaries.items():
        figures[f"success_rate_at_{size:g}"] = summary.successes / summary.trials
        for key in keys:
            if key in summary.spread:
                figures[f"{key}_p95_at_{size:g}"] = summary.spread[key]["p95"]
    return figures


def curve_figure(summaries: dict[float, Summary], keys: tuple[str, ...]) -> Figure:
    """Success rate with its interval, and errors, over the size of the imperfections."""
    sizes = np.array(list(summaries))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 2.4))
        first, *others = figure.subplots(1, 1 + len(keys))
        rates = np.array([s.successes / s.trials for s in summaries.values()])
        low, high = np.array(
            [wilson_interval(s.successes, s.trials) for s in summaries.values()]
        ).T
        error = 100 * np.abs(np.stack([rates - low, high - rates]))
        first.errorbar(sizes, 100 * rates, error, fmt="o-", color=palette.RUN, capsize=3)
        first.set(title="success [%]", ylim=(0, 104))
        for axes, key in zip(others, keys, strict=True):
            for kind, style in (("p95", "o--"), ("median", "o-")):
                values = [
                    s.spread[key][kind] if key in s.spread else np.nan
                    for s in summaries.values()
                ]
                axes.plot(sizes, values, style, color=palette.RUN, label=kind)
            name, _, unit = key.rpartition("_")
            axes.set(title=f"{name.replace('_', ' ')} [{unit}]", ylim=(0, None))
        for axes in (first, *others):
            axes.set_xticks(sizes, [f"{size:g}" for size in sizes])
        figure.supxlabel("size of the imperfections [nominal]", fontsize=9)
    return figure


if __name__ == "__main__":
    cli.run(main, Args)
