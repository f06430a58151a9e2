"""Check a LeRobot dataset: what is broken, and what is odd enough to look at before training.

Every finding names the file, episode, frame and column as closely as is known. Exit status:
0 no errors, 1 errors in the data, 2 no dataset there.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from hrc_learn import cli
from hrc_learn.demos import check_dataset


@dataclass(frozen=True, kw_only=True)
class Args:
    path: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset, version 2.0, 2.1 or 3.0."""
    units: dict[str, str] = field(default_factory=dict)
    """Units on disk by quantity, such as: joint_position deg position mm."""
    speed_limits: dict[str, float] = field(default_factory=dict)
    """Fastest each joint can turn [rad/s], such as: joint1 2.1 joint2 2.1."""
    strict: bool = False
    """Count warnings as errors in the exit status."""
    findings: Path | None = None
    """Receives every finding: a JSON list of kind, message, file, episode, frame, key."""
    json: Path | None = None
    """Receives the counts as one flat object."""


def main(args: Args) -> int:
    """Check the dataset and print the findings."""
    if not args.path.is_dir():
        raise FileNotFoundError(f"there is no dataset at {args.path}")
    report = check_dataset(args.path, units=args.units, speed_limits=args.speed_limits)
    print(report)
    if args.findings:
        cli.write_text(args.findings, json.dumps(report.records(), indent=2) + "\n")
    if args.json:
        counts = {
            "errors": len(report.errors),
            "warnings": len(report.warnings),
            "episodes": report.episodes,
            "frames": report.frames,
        }
        cli.write_json(args.json, counts)
    return int(bool(report.errors or (args.strict and report.warnings)))


if __name__ == "__main__":
    cli.run(main, Args)
