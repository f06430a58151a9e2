"""Record demonstrations of placing an object on a shelf, with the null-space posture.

The scripted expert guides the simulated arm from home into the cabinet while pulling its elbow
past the open door. Demonstrations that touch the cabinet are discarded and repeated.
Writes a LeRobot dataset of version 3.0.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.progress import track

from hrc_learn import cli
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.work_cell import TaskFailedError
from hrc_learn.teleoperation.hand_guiding import Frame
from hrc_learn.teleoperation.scripted_demonstrations import (
    PlacingDemonstrationConfig,
    demonstrate_placing_without_contact,
    write_demonstrations,
)


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to record."""

    out: Path
    """Folder of the new dataset."""
    episodes: int = 3
    """Demonstrations to record."""
    shelf: str = "middle"
    """Shelf to place on: lower, middle or upper."""
    demonstration: PlacingDemonstrationConfig = field(
        default_factory=PlacingDemonstrationConfig
    )
    """How the expert demonstrates."""
    seed: int = 0
    """Seed of the tremor and of initial positions."""
    overwrite: bool = False
    """Replace an older dataset in that folder."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> int:
    if args.episodes < 1:
        raise ValueError(f"--episodes must be at least 1, but is {args.episodes}.")
    workplace = Workplace()
    goal = workplace.shelf(args.shelf).position.numpy()
    world = World(workplace.scene)
    rng = np.random.default_rng(args.seed)
    thrown_away, errors = [], []

    def demonstrations() -> Iterator[list[Frame]]:
        for _ in track(range(args.episodes), description="Placing demonstrations"):
            frames, thrown = demonstrate_placing_without_contact(
                world, workplace, args.shelf, args.demonstration, rng
            )
            thrown_away.append(thrown)
            errors.append(float(np.linalg.norm(frames[-1]["position"] - goal)))
            yield frames

    try:
        write_demonstrations(
            args.out,
            demonstrations(),
            f"place the box on the {args.shelf} shelf",
            args.demonstration.fps,
            details={"shelf": args.shelf, "scene": "hrc_learn workplace"},
            overwrite=args.overwrite,
        )
    except TaskFailedError as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1
    print(f"{args.episodes} demonstrations in {args.out} ({sum(thrown_away)} discarded)")
    if args.json is not None:
        values = {
            "episodes": args.episodes,
            "thrown_away": sum(thrown_away),
            "final_error_mm_max": 1e3 * max(errors),
        }
        cli.write_json(args.json, values)
    return 0


if __name__ == "__main__":
    cli.run(main, Args)
