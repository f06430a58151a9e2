"""Accuracy of `learn` on demonstrations that it was not fitted to, compared with fixed models.

Each demonstration of a task is predicted from its start, goal and duration by a model of all
other demonstrations; `learn` chooses its model anew for each. Recordings are folders
SET/TASK.npy of shape (demonstrations, samples, D), evenly sampled.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor

from hrc_learn import cli
from hrc_learn.dmp import JointDMP, LearnedMotion
from hrc_learn.dmp.learned_motion import APPROACHES, choose

FIXED = {
    "straight line": ("kernel", math.inf, 0.0),
    "nearest": ("kernel", 0.0, 1.0),
    "mean": ("kernel", math.inf, 1.0),
    "kernel": ("kernel", 0.5, 1.0),
    "regression": ("ridge", 1e-2, 1.0),
}
"""Family, strength and shrinkage of fixed models, with approach 1."""


@dataclass(frozen=True, kw_only=True)
class Args:
    recordings: Path
    """Folder that contains folders SET with files TASK.npy."""
    n_basis: int = 40
    """Number of basis functions of each primitive."""
    most: int = 8
    """Largest number of tasks of each set; the first tasks by name are used."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


def main(args: Args) -> None:
    """Predict, print a table, and write the measured values."""
    torch.set_num_threads(1)
    sets = sorted(p for p in args.recordings.iterdir() if p.is_dir())
    errors: dict[str, dict[str, list[float]]] = {}
    for folder in sets:
        for file in track(
            sorted(folder.glob("*.npy"))[: args.most], folder.name, transient=True
        ):
            for name, found in predict_each(np.load(file), args.n_basis).items():
                errors.setdefault(folder.name, {}).setdefault(name, []).extend(found)
    table = Table(
        "% of range, p50 / p90", *(f"{k} ({len(v['mean'])})" for k, v in errors.items())
    )
    figures: dict[str, float] = {}
    for name in ("learn", *FIXED):
        cells = []
        for each, found in errors.items():
            p50, p90 = 100 * np.quantile(found[name], [0.5, 0.9])
            cells.append(f"{p50:.1f} / {p90:.1f}")
            key = f"{each}_{name.replace(' ', '_')}"
            figures |= {f"{key}_p50_percent": float(p50), f"{key}_p90_percent": float(p90)}
        table.add_row(name, *cells)
    Console(width=max(Console().width, 160)).print(table)
    cli.write_json(args.json, figures) if args.json else None


@torch.no_grad()
def predict_each(recorded: np.ndarray, n_basis: int) -> dict[str, list[float]]:
    """Error of each demonstration relative to its largest range, by model."""
    shown = torch.from_numpy(recorded).double()
    n, T, _ = shown.shape
    time = torch.linspace(0, 1, T, dtype=torch.float64)
    fits = [JointDMP.fit(time, shown, n_basis, approach=b) for b in APPROACHES]
    errors: dict[str, list[float]] = {name: [] for name in ("learn", *FIXED)}
    for i in range(n):
        rest = torch.arange(n) != i
        learned = choose([each[rest] for each in fits])
        models: dict[str, LearnedMotion] = {"learn": learned}
        for name, (family, strength, shrinkage) in FIXED.items():
            form = replace(
                learned.chosen,
                family=family,
                strength=strength,
                shrinkage=shrinkage,
                approach=1.0,
            )
            models[name] = replace(learned, each=fits[0][rest], chosen=form)
        for name, model in models.items():
            made = model.rollout(time, shown[i, 0], shown[i, -1], 1.0).position
            errors[name].append(error(made, shown[i]))
    return errors


def error(made: Tensor, shown: Tensor) -> float:
    """RMSE relative to the largest range."""
    span = (shown.amax(0) - shown.amin(0)).max()
    return float((made - shown).square().mean().sqrt() / span)


if __name__ == "__main__":
    cli.run(main, Args)
