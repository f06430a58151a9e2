"""Look at the demonstrations of a LeRobot dataset: a Rerun recording of all of them.

Paths of the hand in 3D with the arm (a Panda; of other robots the paths alone), every joint of
all demonstrations over one another, and for each what else was recorded: image feature, the
person's effort, gripper.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from hrc_learn import cli
from hrc_learn.demos import load_demos
from hrc_learn.learning.fit_recordings import demonstrations_recording
from hrc_learn.viz.demonstration_dashboard import record_demonstrations


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to look at."""

    dataset: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset, version 2.0, 2.1 or 3.0."""
    out: Path
    """Recording to write, as .rrd; replaces an older one."""
    episodes: tuple[int, ...] = ()
    """Episodes to show; all when empty."""
    units: dict[str, str] = field(default_factory=dict)
    """Units on disk by quantity, such as: joint_position deg position mm."""
    json: Path | None = None
    """File for the counts."""


def main(args: Args) -> None:
    demos = load_demos(args.dataset, episodes=args.episodes or None, units=args.units or None)
    title = f"Demonstrations in {args.dataset.resolve().name}"
    shown = demonstrations_recording(demos, title)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    record_demonstrations(args.out, shown)
    print(f"{len(demos)} demonstrations: rerun {args.out}")
    if args.json is not None:
        seconds = sum(demo.duration for demo in demos)
        cli.write_json(args.json, {"episodes": len(demos), "seconds": seconds})


if __name__ == "__main__":
    cli.run(main, Args)
