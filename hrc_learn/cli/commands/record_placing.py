"""`hrc record placing`: paired demonstrations of placing, in simulation."""

import sys
from collections.abc import Iterator

import numpy as np
from rich.progress import track

from hrc_learn.cli._options import resolved
from hrc_learn.cli._values import configuration, write_json
from hrc_learn.cli.arguments.record import RecordPlacing as Args
from hrc_learn.sim import PhysicsError, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.work_cell import TaskFailedError
from hrc_learn.teleoperation.hand_guiding import Frame
from hrc_learn.teleoperation.scripted_demonstrations import (
    demonstrate_placing_without_contact,
    write_demonstrations,
)


def run(args: Args) -> int:
    args = resolved(args)
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
            details={
                "shelf": args.shelf,
                "scene": "hrc_learn workplace",
                "recorded with": configuration(args),
            },
            overwrite=args.overwrite,
        )
    except (TaskFailedError, PhysicsError) as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1
    print(f"{args.episodes} demonstrations in {args.out} ({sum(thrown_away)} discarded)")
    if args.json is not None:
        values = {
            "episodes": args.episodes,
            "thrown_away": sum(thrown_away),
            "final_error_mm_max": 1e3 * max(errors),
        }
        write_json(args.json, values)
    return 0
