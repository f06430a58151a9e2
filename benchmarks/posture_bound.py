"""How much of the blocking of an arm near a worker another posture could avoid at best.

At each moment of its cycle, the arm may take any posture that leaves the tool where it is, at
once. The worker's hand is at a point of the bench. The arm is blocked if the worker is nearer
than the distance that separation monitoring keeps. The difference between the planned and the
best posture bounds what any null-space motion can gain, also by somebody who knows the future.

    python benchmarks/posture_bound.py --placing outputs/demo/placing \
        --aiming outputs/demo/aiming --figure outputs/posture_bound.png
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import torch
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from posture_plans import FIRST_MOVING, TURNS, all_postures
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor
from worker_job import random_cycles
from worker_study import REACH, WorkerStudyConfig

from hrc_learn import cli
from hrc_learn.kinematics import CapsuleArm, panda, separation
from hrc_learn.sim import Worker, whole_arm
from hrc_learn.sim.worker import Posture
from hrc_learn.sim.worker_visit import HAND_OVER_BENCH, in_worker_frame
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.placing import PlacingSkill
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.store import new_file
from hrc_learn.viz import palette
from hrc_learn.viz.figures import STYLE, WIDTH

# Speed of the arm [m/s], and speeds of the worker towards it [m/s].
_SLOW, _SPEEDS = 0.1, (0.0, 1.0)
# y beyond which the tool is above the bench [m].
_AT_BENCH = 0.25
# Interval between two moments of a cycle [s].
_EVERY = 0.5
# Spacing of the points on the bench, and their distance from its edges [m].
_GRID, _EDGE = 0.08, 0.06
# Distance of a worker's spine from the edge of the bench, as a fraction of the stature.
_STAND = 0.13
SIDES = ("far side", "end at the elbow", "end at the tool")
"""Edges of the bench at which a worker may stand: that opposite the arm, -x and +x."""


@dataclass(frozen=True, kw_only=True)
class Args:
    placing: Path
    """Folder of the placing skill."""
    aiming: Path
    """Folder of the visual-servoing skill, whose orientation above the table is used."""
    cycles: int = 3
    """Different cycles of the job."""
    seed: int = 0
    """Seed of the objects."""
    figure: Path | None = None
    """Receives the map, as .png or .svg."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


def main(args: Args) -> None:
    """Print the largest gains for each side, and draw the map."""
    torch.set_num_threads(1)
    workplace = Workplace().approached(VisualServoSkill.load(args.aiming).approach)
    placing = PlacingSkill.load(args.placing, workplace.robot)
    config, arm = WorkerStudyConfig(), whole_arm(workplace.scene.arm)
    rules = config.imperfections.plant(config.cell.safety).separation
    slow, speeds = torch.full((len(_SPEEDS),), _SLOW).double(), torch.tensor(_SPEEDS).double()
    kept = rules.protective_distance(slow, speeds)
    with torch.inference_mode():
        rng = np.random.default_rng([args.seed, 0, 1])
        drawn = random_cycles(workplace, placing, args.cycles, REACH, rng, config.cell.dt)
        every = round(_EVERY / config.cell.dt)
        q = torch.cat([torch.from_numpy(cycle.path[::every]) for cycle in drawn])
        postures, valid = all_postures(workplace, q)
        x, y, bodies, radius = workers_on_grid(workplace)
        found = torch.stack(
            [
                blocked(arm, postures, valid, body, radius, kept)
                for body in track(bodies, "measuring", console=Console(stderr=True))
            ]
        )
    # (side, x, y, speed, posture)
    grid = found.view(len(SIDES), len(x), len(y), len(_SPEEDS), 2).numpy()
    figures = show(grid, kept)
    if args.figure is not None:
        with new_file(args.figure) as part:
            draw(grid[..., -1, :], x, y, places_at_bench(q)).savefig(part, dpi=150)
    if args.json is not None:
        cli.write_json(args.json, figures)


def workers_on_grid(
    workplace: Workplace,
) -> tuple[np.ndarray, np.ndarray, Float[Tensor, "bodies H 2 3"], Float[Tensor, " H"]]:
    """Coordinates of the grid on the bench [m], and a worker with a hand at each point.

    Returns:
        x and y of the grid; ends of the capsules of each body, by side, x and y, NaN where the
        point is out of reach; and their radii [m].
    """
    worker, table = Worker(), workplace.scene.table
    (cx, cy, cz), (hx, hy, hz) = table.centre, table.half_size
    x, y = (
        np.arange(c - h + _EDGE, c + h - _EDGE + 1e-9, _GRID) for c, h in ((cx, hx), (cy, hy))
    )
    away = _STAND * worker.config.stature
    bodies = []
    for side in SIDES:
        for px in x:
            for py in y:
                stand, facing = {
                    "far side": (np.array([px, cy + hy + away]), -np.pi / 2),
                    "end at the elbow": (np.array([cx - hx - away, py]), 0.0),
                    "end at the tool": (np.array([cx + hx + away, py]), np.pi),
                }[side]
                # Slightly aside, so that the right hand is in front of its shoulder.
                point = np.array([px, py, cz + hz + HAND_OVER_BENCH])
                bodies.append(_reaching(worker, stand, facing, point))
    return x, y, torch.from_numpy(np.stack(bodies)), torch.from_numpy(worker.radius)


def _reaching(
    worker: Worker, stand: np.ndarray, facing: float, point: np.ndarray
) -> Float[np.ndarray, "H 2 3"]:
    """Capsules of a worker whose right hand is at a point; NaN if it is out of reach."""
    target, hands = in_worker_frame(worker, stand, facing, point), worker.hanging_hands()
    lean, zero = worker.lean_to(target, 1), np.zeros(())
    hands[1] = target
    posture = Posture(
        place=stand,
        heading=zero + facing,
        lean=zero + (lean or 0.0),
        stride=zero,
        swing=zero,
        hands=hands,
    )
    return worker.ends(posture) * (np.nan if lean is None else 1.0)


def blocked(
    arm: CapsuleArm,
    postures: Float[Tensor, "postures moments 7"],
    valid: Bool[Tensor, "postures moments"],
    body: Float[Tensor, "H 2 3"],
    radius: Float[Tensor, " H"],
    kept: Float[Tensor, " speeds"],
) -> Float[Tensor, "speeds 2"]:
    """Fractions of moments at which a worker is nearer than each kept distance [m], for the
    planned and for the best posture; NaN for a body of NaN.
    """
    if bool(body.isnan().any()):
        return body.new_full((len(kept), 2), torch.nan)
    moving = [k for k, link in enumerate(arm.links) if link >= FIRST_MOVING]
    distance = separation(arm, postures, body, radius).distance[..., moving, :].amin((-2, -1))
    least = torch.stack([distance[TURNS], distance.masked_fill(~valid, -torch.inf).amax(0)])
    return (least < kept[:, None, None]).double().mean(-1)


def show(grid: Float[np.ndarray, "side x y speed 2"], kept: Tensor) -> dict[str, float]:
    """Print means and largest gains, and return them by name."""
    figures: dict[str, float] = {}
    table = Table(
        "worker at the", "moves at", "kept", "planned", "best", "largest gain",
        title=f"moments at which an arm at {_SLOW:g} m/s is blocked",
    )  # fmt: skip
    for number, side in enumerate(SIDES):
        for k, speed in enumerate(_SPEEDS):
            planned, best = grid[number, ..., k, :].reshape(-1, 2).T
            gain = planned - best
            at = int(np.nanargmax(gain))
            table.add_row(
                side,
                f"{speed:g} m/s",
                f"{1e3 * kept[k]:.0f} mm",
                f"{np.nanmean(planned):.1%}",
                f"{np.nanmean(best):.1%}",
                f"{planned[at]:.0%} to {best[at]:.0%}",
            )
            name = f"{side.replace(' ', '_')}_{speed:g}"
            figures |= {
                f"{name}_planned": float(np.nanmean(planned)),
                f"{name}_best": float(np.nanmean(best)),
                f"{name}_largest_gain": float(gain[at]),
                f"{name}_planned_there": float(planned[at]),
            }
    Console().print(table)
    return figures


def places_at_bench(q: Float[Tensor, "moments 7"]) -> dict[str, Float[np.ndarray, "2"]]:
    """Mean places of elbow and tool while the tool is above the bench [m]."""
    tool = panda.forward(q).position
    elbow = panda.joint_origins(q)[:, panda.elbow - 1]
    there = tool[:, 1] > _AT_BENCH
    return {
        name: points[there, :2].mean(0).numpy()
        for name, points in (("elbow", elbow), ("tool", tool))
    }


def draw(
    grid: Float[np.ndarray, "side x y 2"],
    x: Float[np.ndarray, " x"],
    y: Float[np.ndarray, " y"],
    places: dict[str, Float[np.ndarray, "2"]],
) -> Figure:
    """Maps of the moments that are blocked, and of those that the best posture avoids."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 4.4), layout="constrained")
        axes = figure.subplots(2, len(SIDES), sharex=True, sharey=True)
        rows = (
            ("blocked", grid[..., 0], "Greys"),
            ("avoidable by posture", grid[..., 0] - grid[..., 1], "Oranges"),
        )
        for row, (name, values, colours) in zip(axes, rows, strict=True):
            for side, (axis, panel) in enumerate(zip(row, values, strict=True)):
                image = axis.pcolormesh(x, y, 100 * panel.T, cmap=colours, vmin=0, vmax=100)
                axis.set_aspect("equal")
                axis.set_title(f"{name}:\nworker at the {SIDES[side]}", fontsize=8)
                for mark, (place, point) in zip("o^", places.items(), strict=True):
                    label = f"{place}, mean at the bench"
                    axis.plot(*point, mark, color=palette.SERIES[0], ms=5, label=label)
            figure.colorbar(image, ax=list(row), label="moments of the cycle [%]")
        axes[0, 0].legend(loc="lower left", fontsize=6)
        for axis in axes[-1]:
            axis.set_xlabel("x of the hand [m]")
        for axis in axes[:, 0]:
            axis.set_ylabel("y of the hand [m]")
    return figure


if __name__ == "__main__":
    cli.run(main, Args)
