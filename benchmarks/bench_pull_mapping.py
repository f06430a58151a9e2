"""Compare two mappings of pulls at the elbow: forces (transposed Jacobian) and the paper's
velocities (pseudo-inverse).

Measured are the speed and displacement of the elbow, and motion against the pull. A gizmo with
the same displacement requests a force (150 N/m, at most 45 N) or a velocity (2 1/s, at most
0.25 m/s). The arm follows exactly, and its end effector stays in place.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from hrc_learn import cli
from hrc_learn.experiments.collaboration_trial import NULL_SPACE_FORCES
from hrc_learn.geometry.numerics import null_projection
from hrc_learn.kinematics import panda
from hrc_learn.sim.workplace import Workplace
from hrc_learn.teleoperation import InteractionForceConfig, ScriptedForce, random_pulls
from hrc_learn.teleoperation.hand_guiding import ForceMapping, force_to_nullspace_input
from hrc_learn.teleoperation.scripted_demonstrations import ELBOW_FORCES

_MAPPINGS: tuple[ForceMapping, ...] = get_args(ForceMapping)
_ELBOW = 4  # pulled joint, counted from 1
_FORCE = InteractionForceConfig().max_force  # force [N]
_STILL = 1e-4  # speed below which the elbow counts as at rest [m/s]
# Simulated motion: step [s], largest joint speed [rad/s], distance kept from joint limits
# [rad].
_DT, _FASTEST, _ROOM = 0.01, 1.0, 0.05


@dataclass(frozen=True, kw_only=True)
class Args:
    directions: int = 2000
    """Number of pull directions at each place."""
    seeds: int = 10
    """Number of seeds of random pulls, 40 s each."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


def main(args: Args) -> None:
    """Measure, print tables, and write the measured values."""
    torch.set_num_threads(1)
    console, figures = Console(), {}
    workplace = Workplace()
    table = Table("pulls in all directions", "mapping", "against the pull [%]", "mm/s, median")
    with torch.inference_mode():
        for place, postures in (
            ("anywhere", []),
            ("above the table", workplace.hover_postures()),
            ("home", [workplace.home_joints()]),
        ):
            for mapping in _MAPPINGS:
                against, speed = _all_directions(postures, mapping, args.directions)
                table.add_row(place, mapping, f"{against:.1f}", f"{speed:.0f}")
                key = f"{place.replace(' ', '_')}_{mapping}"
                figures |= {f"{key}_against_percent": against, f"{key}_mm_s": speed}
        console.print(table)
        console.print(_scripts(workplace, args.seeds, figures))
    if args.json is not None:
        cli.write_json(args.json, figures)


def _all_directions(
    postures: Sequence[Tensor], mapping: ForceMapping, count: int
) -> tuple[float, float]:
    """Fraction of the pulls that move the elbow against the pull [%], and median elbow speed
    [mm/s].
    """
    rng, config = np.random.default_rng(0), InteractionForceConfig(mapping=mapping)
    lower, upper = panda.limits.lower.numpy(), panda.limits.upper.numpy()
    against, speeds = 0, []
    for k in range(count):
        anywhere = torch.from_numpy(rng.uniform(lower, upper))
        q = postures[k % len(postures)] if postures else anywhere
        way = rng.normal(size=3)
        way /= np.linalg.norm(way)
        velocity = _elbow_velocity(q, _null_velocity(q, _ELBOW, _FORCE * way, config))
        speeds.append(1e3 * np.linalg.norm(velocity))
        against += bool(speeds[-1] > 1e3 * _STILL and velocity @ way < -_STILL)
    return 100 * against / count, float(np.median(speeds))


def _scripts(workplace: Workplace, seeds: int, figures: dict[str, float]) -> Table:
    """Pulls of scripted people, one after another or each alone."""
    table = Table("scripted pulls", "mapping", "elbow mm, median", "p95", "time against [%]")
    alone = [
        (replace(pull, start=0.0),)
        for seed in range(seeds)
        for pull in random_pulls(np.random.default_rng(seed), 40.0)
    ]
    cases = (
        ("collaboration", workplace.hover_joints(), [NULL_SPACE_FORCES]),
        ("demonstration", workplace.home_joints(), [ELBOW_FORCES]),
        ("random", workplace.hover_joints(), alone),
    )
    for name, start, scripts in cases:
        for mapping in _MAPPINGS:
            runs = np.array([_pulled(start, script, mapping) for script in scripts])
            elbow, p95 = np.percentile(runs[:, 0], (50, 95))
            against = runs[:, 1].mean()
            table.add_row(name, mapping, f"{elbow:.0f}", f"{p95:.0f}", f"{against:.1f}")
            key = f"{name}_{mapping}"
            figures |= {f"{key}_elbow_mm": elbow, f"{key}_against_percent": against}
    return table


def _pulled(
    start: Tensor, script: Sequence[ScriptedForce], mapping: ForceMapping
) -> tuple[float, float]:
    """Displacement of the elbow by pulls [mm], and fraction of the time of motion against them
    [%].
    """
    q, pose, config = start, panda.forward(start), InteractionForceConfig(mapping=mapping)
    first, limits = panda.joint_origins(q)[_ELBOW - 1], panda.limits
    furthest, moving, against = 0.0, 0, 0
    for k in range(round(max(force.end for force in script) / _DT)):
        elbow, total, velocity = panda.joint_origins(q)[_ELBOW - 1], np.zeros(3), 0.0
        for scripted in script:
            force = scripted.force(k * _DT, elbow.numpy())
            total += force
            velocity = velocity + _null_velocity(q, scripted.joint, force, config)
        velocity = torch.as_tensor(velocity)
        velocity = velocity / max(1.0, float(velocity.abs().max()) / _FASTEST)
        then = q + _DT * velocity
        if bool(((then < limits.lower + _ROOM) | (then > limits.upper - _ROOM)).any()):
            velocity, then = torch.zeros_like(q), q
        motion = _elbow_velocity(q, velocity)
        if np.linalg.norm(motion) > _STILL and total.any():
            moving, against = moving + 1, against + int(motion @ total < 0)
        q = then + torch.linalg.pinv(panda.jacobian(then)) @ panda.forward(then).twist_to(pose)
        furthest = max(furthest, float((panda.joint_origins(q)[_ELBOW - 1] - first).norm()))
    return 1e3 * furthest, 100 * against / max(moving, 1)


def _null_velocity(
    q: Tensor, joint: int, force: np.ndarray, config: InteractionForceConfig
) -> Tensor:
    d = force_to_nullspace_input(panda, q.numpy(), joint, force, config)
    return null_projection(panda.jacobian(q), torch.from_numpy(d) / config.damping)


def _elbow_velocity(q: Tensor, velocity: Tensor) -> np.ndarray:
    return (panda.joint_jacobian(q, _ELBOW)[:3] @ velocity).numpy()


if __name__ == "__main__":
    cli.run(main, Args)
