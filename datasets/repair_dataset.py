"""Repair a LeRobot dataset into a new copy, and say what was changed in which episode.

Standing still is trimmed, repeated frames are dropped, angles unwrapped and signs of
quaternions fixed; more on request. Any version is read, version 3.0 is written; the old
dataset is left as it is. Check the copy with check_dataset.py.

    repair_dataset.py broken repaired
    repair_dataset.py broken repaired --fps 50 --drop-bad-episodes --no-videos
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.progress import track

from hrc_learn import cli
from hrc_learn.demos.repair import RepairOptions, repair_dataset


@dataclass(frozen=True, kw_only=True)
class Args:
    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OLD")]
    """Folder of the dataset to repair, version 2.0, 2.1 or 3.0."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="NEW")]
    """Folder of the new one; must not exist."""
    options: Annotated[RepairOptions, tyro.conf.arg(name="")] = field(
        default_factory=RepairOptions
    )
    """What may be changed."""
    units: dict[str, str] = field(default_factory=dict)
    """Units on disk by quantity, such as: joint_position deg position mm."""
    json: Path | None = None
    """Receives the counts as one flat object."""


def main(args: Args) -> None:
    """Repair the dataset and print what was changed."""
    report = repair_dataset(
        args.path,
        args.out,
        args.options,
        units=args.units,
        progress=lambda episodes: track(episodes, description="Repairing"),
    )
    print(report)
    if args.json:
        counts = {
            "episodes": len(report.changes),
            "episodes_changed": report.changed,
            "episodes_left_out": len(report.left_out),
            "frames_before": report.frames_before,
            "frames": report.frames,
        }
        cli.write_json(args.json, counts)


if __name__ == "__main__":
    cli.run(main, Args)
