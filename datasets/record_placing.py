"""Record demonstrations of placing a thing on a shelf, hand and body shape at once.

The scripted expert leads the simulated arm from home into the cabinet while pulling its elbow
past the open door. Demonstrations that touch the cabinet are thrown away and shown again.
Writes a LeRobot dataset of version 3.0.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.progress import track

from hrc_learn import cli
from hrc_learn.demos import DatasetWriter
from hrc_learn.kinematics import panda
from hrc_learn.output import replacing
from hrc_learn.sim import World
from hrc_learn.tasks.teach_placing import PlacingLesson, teach_placing
from hrc_learn.tasks.workplace import Workplace


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to record."""

    out: Path
    """Folder of the new dataset."""
    episodes: int = 3
    """Demonstrations to record."""
    shelf: str = "middle"
    """Shelf to place on: lower, middle or upper."""
    lesson: PlacingLesson = field(default_factory=PlacingLesson)
    """How the expert teaches."""
    seed: int = 0
    """Seed of the hand's unsteadiness and of where demonstrations start."""
    overwrite: bool = False
    """Replace an older dataset in that folder."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> None:
    workplace = Workplace()
    goal = workplace.shelf(args.shelf)
    if args.episodes < 1:
        raise ValueError(f"--episodes must be at least 1, but is {args.episodes}.")
    world = World(workplace.scene)
    rng = np.random.default_rng(args.seed)
    thrown_away, errors = 0, []
    with (
        replacing(args.out, "meta/info.json", args.overwrite) as folder,
        DatasetWriter(
            folder,
            fps=args.lesson.fps,
            robot_type="panda",
            joint_names=panda.joint_names,
            frames={"base": "panda_link0", "ee": "panda_hand_tcp"},
            details={"shelf": args.shelf, "scene": "hrc_learn workplace"},
        ) as writer,
    ):
        for _ in track(range(args.episodes), description="Placing demonstrations"):
            for _attempt in range(3):
                frames, touches = teach_placing(world, workplace, args.shelf, args.lesson, rng)
                if not touches:
                    break
                thrown_away += 1
            else:
                raise RuntimeError(
                    f"three demonstrations in a row hit the cabinet: {touches[0]}"
                )
            writer.start_episode(f"place the box on the {args.shelf} shelf")
            for frame in frames:
                writer.add_frame(images=None, **frame)
            writer.save_episode()
            errors.append(float(np.linalg.norm(frames[-1]["position"] - goal.position.numpy())))
    print(f"{args.episodes} demonstrations in {args.out} ({thrown_away} thrown away)")
    if args.json is not None:
        values = {
            "episodes": args.episodes,
            "thrown_away": thrown_away,
            "final_error_mm_max": 1e3 * max(errors),
        }
        cli.write_json(args.json, values)


if __name__ == "__main__":
    cli.run(main, Args)
