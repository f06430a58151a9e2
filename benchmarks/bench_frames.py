"""Prediction of motions from one object to another, for new places of the objects.

Synthetic planar motions lead between two frames about a metre apart (varied by 0.3 m), each
rotated by up to one radian. A motion leaves the first frame along its x axis and enters the
second along its x axis, over a distance that varies by 10 %. Models are fitted to a few motions
and compared with the true motions in fifty other places.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from hrc_learn import cli
from hrc_learn.dmp import FramedDMP, Frames, JointDMP, fit_ridge, mean_primitive

SAMPLES, PLACES = 100, 50


@dataclass(frozen=True, kw_only=True)
class Args:
    counts: tuple[int, ...] = (3, 4, 6, 8, 12)
    """Numbers of demonstrations."""
    seeds: int = 10
    """Number of sets of demonstrations for each count."""
    n_basis: int = 30
    """Number of basis functions of each primitive."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


def main(args: Args) -> None:
    """Predict, print a table, and write the measured values."""
    torch.set_num_threads(1)
    figures: dict[str, float] = {}
    for count in args.counts:
        errors: dict[str, list[float]] = defaultdict(list)
        for seed in range(args.seeds):
            rng = torch.Generator().manual_seed(seed)
            with torch.no_grad():
                for name, error in predict(count, args.n_basis, rng).items():
                    errors[name].append(error)
        for name, values in errors.items():
            figures[f"{name}_{count}"] = sum(values) / len(values)
    show(figures, args.counts)
    if args.json:
        cli.write_json(args.json, figures)


def predict(count: int, n_basis: int, rng: torch.Generator) -> dict[str, float]:
    """Median RMSE over the places [mm], by each method."""
    shown, others = made_up_frames(count, rng), made_up_frames(PLACES, rng)
    time, position = made_up_motions(shown, 0.1, rng)
    _, wanted = made_up_motions(others, 0.0, rng)
    start, goal = others.b.unbind(1)
    each = JointDMP.fit(time, position, n_basis, approach=1.0)
    mean, function = mean_primitive(each), regression(each, context(shown), context(others))
    framed = FramedDMP.fit(time, position, shown, n_basis)
    made = {
        "mean": mean.rollout(time, start, goal).position,
        "function": function.rollout(time, start, goal).position,
        "moments": product_of_moments(position, shown, others),
        "framed": framed.at(others).rollout(time).position,
    }
    return {
        name: 1e3 * (y - wanted).square().sum(-1).mean(-1).sqrt().median().item()
        for name, y in made.items()
    }


def made_up_frames(n: int, rng: torch.Generator) -> Frames:
    """Two frames in each of n places."""
    angle = 2 * torch.rand(n, 2, generator=rng, dtype=torch.float64) - 1
    c, s = angle.cos(), angle.sin()
    A = torch.stack([torch.stack([c, -s], -1), torch.stack([s, c], -1)], -2)
    off = 0.3 * torch.randn(n, 2, 2, generator=rng, dtype=torch.float64)
    return Frames(A, off + torch.tensor([[0.0, 0.0], [1.0, 0.0]]))


def made_up_motions(
    frames: Frames, differ: float, rng: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Time (T,) and Bezier curves (n, T, 2), at the speed of minimum jerk."""
    n = len(frames.b)
    reach = 0.4 * (1 + differ * torch.randn(n, 2, 1, generator=rng, dtype=torch.float64))
    (first, last), (out, into) = frames.b.unbind(1), (reach * frames.A[..., 0]).unbind(1)
    s = torch.linspace(0, 1, SAMPLES, dtype=torch.float64)
    m = s**3 * (10 - 15 * s + 6 * s**2)
    handles = first, first + out, last - into, last
    shares = (1 - m) ** 3, 3 * m * (1 - m) ** 2, 3 * m**2 * (1 - m), m**3
    ways = [p[:, None] * w[:, None] for p, w in zip(handles, shares, strict=True)]
    return 2 * s, torch.stack(ways).sum(0)


def context(frames: Frames) -> Tensor:
    """Positions and directions of the frames, as numbers."""
    return torch.cat([frames.b, frames.A[..., 0]], dim=-1).flatten(1)


def regression(each: JointDMP, shown: Tensor, asked: Tensor) -> JointDMP:
    """Primitives for new contexts, linear in the contexts of the demonstrations."""
    x = each.coordinates().detach()
    fit = fit_ridge(shown, x.flatten(1), 1e-6)
    features = torch.nn.functional.pad((asked - fit.mean) / fit.scale, (1, 0), value=1.0)
    made = (features @ fit.coefficients).unflatten(-1, x.shape[1:])
    return mean_primitive(each).with_coordinates(made)


def product_of_moments(position: Tensor, shown: Frames, others: Frames) -> Tensor:
    """Product of the frames' Gaussians at each moment separately, for frames at new places."""
    seen = torch.linalg.solve(shown.A, (position[:, None] - shown.b[:, :, None]).mT).mT
    mean = seen.mean(0)
    off = (seen - mean)[..., None]
    least = 1e-3**2 * torch.eye(2, dtype=torch.float64)
    covariance = (off @ off.mT).sum(0) / (len(position) - 1) + least
    A, b = others.A[:, :, None], others.b[:, :, None]
    precision = torch.linalg.inv(A @ covariance @ A.mT)
    there = (A @ mean[..., None])[..., 0] + b
    together = (precision @ there[..., None]).sum(1)
    return torch.linalg.solve(precision.sum(1), together)[..., 0]


LABELS = {
    "mean": "mean, adapted (approach=1)",
    "function": "ridge regression on the places",
    "moments": "product at each moment",
    "framed": "FramedDMP",
}


def show(figures: dict[str, float], counts: tuple[int, ...]) -> None:
    """Print the errors by method and number of demonstrations."""
    table = Table("RMSE [mm]", title="Motions between two frames")
    for count in counts:
        table.add_column(f"{count} shown", justify="right")
    for name, label in LABELS.items():
        table.add_row(label, *(f"{figures[f'{name}_{count}']:.0f}" for count in counts))
    Console().print(table)


if __name__ == "__main__":
    cli.run(main, Args)
