"""Prediction of demonstrations that take one of several routes.

The sets of planar demonstrations come from the LASA handwriting dataset (seven demonstrations
each; four of the thirty sets have several routes), or they are synthetic and similar: seven to
nine strokes to a common end, from starts that scatter by 7 % of the length, along one, two or
three routes. Each demonstration is left out in turn and predicted from the others, given only
its start and goal.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from recordings import read_recordings
from rich.console import Console
from rich.table import Table
from torch import Tensor

from hrc_learn import cli
from hrc_learn.dmp import JointDMP, MixtureDMP, mean_primitive

SAMPLES = 150


@dataclass(frozen=True, kw_only=True)
class Args:
    lasa: Path | None = None
    """Folder of the LASA set's .mat files. None: synthetic sets."""
    sets: int = 32
    """Number of synthetic sets; half of them have one route."""
    n_basis: int = 30
    """Number of basis functions of each primitive."""
    seed: int = 0
    """Seed of the synthetic demonstrations."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


class Set(NamedTuple):
    """Demonstrations of one task."""

    time: Tensor
    """(n, T) [s]."""
    position: Tensor
    """(n, T, 2)."""
    ways: int | None
    """Number of routes; None: several, the exact number is not known."""


def main(args: Args) -> None:
    """Predict, print a table, and write the measured values."""
    torch.set_num_threads(1)
    errors: dict[str, list[float]] = {"nearest": [], "mean": [], "mixture": []}
    several, right = [], []
    with torch.no_grad():
        for shown in made_up_sets(args) if args.lasa is None else drawn_sets(args.lasa):
            primitives = JointDMP.fit(shown.time, shown.position, args.n_basis)
            for i in range(len(shown.position)):
                found = predict(primitives, i, shown.position, errors)
                several.append(shown.ways != 1)
                right.append(found > 1 if shown.ways is None else found == shown.ways)
    figures = summarise(errors, np.array(several)) | {"modes_right": float(np.mean(right))}
    show(figures)
    if args.json:
        cli.write_json(args.json, figures)


def made_up_sets(args: Args) -> Iterator[Set]:
    """Synthetic sets, in the requested number."""
    rng = torch.Generator().manual_seed(args.seed)
    for k in range(args.sets):
        ways = 1 if k % 2 == 0 else 2 + int(torch.randint(2, (), generator=rng))
        yield Set(*made_up(ways, rng), ways)


def drawn_sets(folder: Path) -> Iterator[Set]:
    """Sets of the LASA dataset; the names of four of them show several routes."""
    for name, shown in read_recordings(folder).items():
        time, position = (
            torch.from_numpy(np.stack(x))
            for x in ([r.time for r in shown], [r.position for r in shown])
        )
        yield Set(time, position, None if name.startswith("Multi_Models") else 1)


def made_up(ways: int, rng: torch.Generator) -> tuple[Tensor, Tensor]:
    """Times (n, T) [s] and positions (n, T, 2) of one set."""
    shapes = [stroke(rng) for _ in range(ways)]
    shown = [demonstration(*shapes[i % ways], rng) for i in range(7 if ways < 3 else 9)]
    time, position = zip(*shown, strict=True)
    return torch.stack(time), torch.stack(position)


def stroke(rng: torch.Generator) -> tuple[Tensor, Tensor]:
    """Start of a stroke, and the amplitudes of its bend: three sines of each coordinate."""
    start = torch.randn(2, generator=rng, dtype=torch.float64)
    length = 0.7 + 0.6 * torch.rand(1, generator=rng, dtype=torch.float64)
    bend = torch.randn(3, 2, generator=rng, dtype=torch.float64)
    return length * start / start.norm(), bend * torch.tensor([0.5, 0.35, 0.2])[:, None]


def demonstration(start: Tensor, bend: Tensor, rng: torch.Generator) -> tuple[Tensor, Tensor]:
    """A demonstration of a stroke: with another start, another bend (by 15 %) and another
    timing.
    """
    start = start + 0.07 * torch.randn(2, generator=rng, dtype=torch.float64)
    bend = bend * (1 + 0.15 * torch.randn(bend.shape, generator=rng, dtype=torch.float64))
    s = torch.linspace(0, 1, SAMPLES, dtype=torch.float64)
    duration = 2 + torch.rand(1, generator=rng, dtype=torch.float64)
    warped = s + 0.15 * torch.randn(1, generator=rng, dtype=torch.float64) * s * (1 - s)
    way = 1 - warped**3 * (10 - 15 * warped + 6 * warped**2)
    waves = torch.sin(torch.pi * torch.arange(1, 4) * warped[:, None]) @ bend
    return duration * s, way[:, None] * start + (4 * warped * (1 - warped))[:, None] * waves


def predict(
    primitives: JointDMP, i: int, position: Tensor, errors: dict[str, list[float]]
) -> int:
    """Add the errors by method [% of the largest range of the set]; returns the number of
    modes.
    """
    others = primitives[[j for j in range(len(position)) if j != i]]
    start, goal = position[i, 0], position[i, -1]
    away = (others.start - start).norm(dim=-1) + (others.goal - goal).norm(dim=-1)
    mixture = MixtureDMP.fit(others)
    context = torch.stack([start, goal], dim=-1).flatten()
    predictions = {
        "nearest": others[int(away.argmin())],
        "mean": mean_primitive(others),
        "mixture": mixture.at(context).mean_primitive(),
    }
    low, high = position.flatten(0, 1).aminmax(dim=0)
    # Samples of all sets are evenly spaced in time.
    s = torch.linspace(0, 1, position.shape[1], dtype=torch.float64)
    for name, dmp in predictions.items():
        path = dmp.with_boundary(start, goal).rollout(s * dmp.duration).position
        off = (path - position[i]).square().mean().sqrt()
        errors[name].append(100 * (off / (high - low).max()).item())
    return len(mixture.modes)


def summarise(errors: dict[str, list[float]], several: np.ndarray) -> dict[str, float]:
    """Median and 90th percentile over all sets, over sets with one route, and over those with
    several.
    """
    figures = {}
    for name, values in errors.items():
        which = {"all": several | True, "one_way": ~several, "several_ways": several}
        for group, rows in which.items():
            for share, quantile in (("median", 0.5), ("p90", 0.9)):
                chosen = np.array(values)[rows]
                figures[f"{name}_{group}_{share}"] = float(np.quantile(chosen, quantile))
    return figures


def show(figures: dict[str, float]) -> None:
    """Print a row for each method."""
    groups = ("all", "one_way", "several_ways")
    title = f"RMSE, % of range: median / p90 (modes right: {figures['modes_right']:.0%})"
    table = Table("predicted by", *groups, title=title)
    for name in ("nearest", "mean", "mixture"):
        cells = [
            f"{figures[f'{name}_{group}_median']:.1f} / {figures[f'{name}_{group}_p90']:.1f}"
            for group in groups
        ]
        table.add_row(name, *cells)
    Console().print(table)


if __name__ == "__main__":
    cli.run(main, Args)
