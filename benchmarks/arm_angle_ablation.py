"""Arm-angle ablation: the same motion demonstrated with and without a null-space posture.

The end effector moves alike in both demonstrations of a pair. Without the posture, the open
door of the cabinet stops the arm. With the posture, the expert also moves the elbow aside.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console

from hrc_learn import cli
from hrc_learn.kinematics import ArmChoice
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.store import write_json
from hrc_learn.teleoperation.scripted_demonstrations import (
    PlacingDemonstrationConfig,
    guided_frames,
    placing_expert,
)


@dataclass(frozen=True, kw_only=True)
class Args:
    pairs: int = 20
    """Number of paired demonstrations, each with its own tremor and start."""
    shelf: str = "middle"
    """Shelf at which the motion ends."""
    robot: str = "panda"
    seed: int = 0
    """Seed of the first pair."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


class Outcome(NamedTuple):
    """Outcome of one demonstration."""

    arm_hit: bool
    """True if a link of the arm touched the cabinet."""
    anything_hit: bool
    """True if the arm or its load touched the cabinet."""
    goal_error: float
    """Final distance of the end effector from its goal [m]."""


def main(args: Args) -> int:
    workplace = Workplace.of(ArmChoice(args.robot).work_arm())
    world = World(workplace.scene)
    with_posture, without_posture = (
        [
            demonstrate(world, workplace, args.shelf, moves_elbow, seed)
            for seed in range(args.seed, args.seed + args.pairs)
        ]
        for moves_elbow in (True, False)
    )
    figures = {
        "pairs": float(args.pairs),
        "without_posture_arm_hit": float(sum(o.arm_hit for o in without_posture)),
        "with_posture_hit": float(sum(o.anything_hit for o in with_posture)),
        "with_posture_goal_error_mm": 1e3 * max(o.goal_error for o in with_posture),
    }
    for name, value in figures.items():
        Console().print(f"{name.replace('_', ' ')}: {value:.4g}")
    if args.json is not None:
        write_json(args.json, figures)
    return int(figures["with_posture_hit"] > 0)


def demonstrate(
    world: World, workplace: Workplace, shelf: str, moves_elbow: bool, seed: int
) -> Outcome:
    config = PlacingDemonstrationConfig(pull_elbow=moves_elbow)
    rng = np.random.default_rng(seed)
    expert = placing_expert(world, workplace, shelf, config, rng)
    frames = list(guided_frames(world, expert, config))
    touches = world.cabinet_contacts.touches + world.object_contacts.touches
    goal = workplace.shelf(shelf).position.numpy()
    return Outcome(
        arm_hit=any(touch.first.startswith("link") for touch in touches),
        anything_hit=bool(touches),
        goal_error=float(np.linalg.norm(frames[-1]["position"] - goal)),
    )


if __name__ == "__main__":
    cli.run(main, Args)
