"""The command `lerobot-smooth`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from hrc_learn.lerobot.smoothing import (
    ActionLimits,
    add_smoothing,
    gathered_limits,
    remove_smoothing,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    parser = argparse.ArgumentParser("lerobot-smooth", description="Smooth actions in LeRobot.")
    commands = parser.add_subparsers(dest="command", required=True)
    limits = commands.add_parser("limits", help="write a file of limits")
    limits.add_argument("--dataset", type=Path, required=True, help="demonstrations")
    limits.add_argument(
        "--scale", type=float, default=1.0, help="fraction of the demonstrated limits"
    )
    limits.add_argument("--urdf", type=Path, help="positions and velocities of joints")
    limits.add_argument("--calibration", type=Path, help="positions, of LeRobot's calibration")
    limits.add_argument("--degrees", action="store_true", help="actions are in degrees")
    limits.add_argument("--out", type=Path, required=True, help="file to write")
    add = commands.add_parser("add", help="smooth the actions of a checkpoint wherever it runs")
    remove = commands.add_parser("remove", help="remove that from a checkpoint")
    for command in (add, remove):
        command.add_argument("--checkpoint", type=Path, required=True, help="pretrained_model")
    add.add_argument("--limits", type=Path, required=True, help="file of limits")
    options = vars(parser.parse_args(arguments))
    try:
        match options.pop("command"):
            case "limits":
                out = options.pop("out")
                gathered_limits(options.pop("dataset"), **options).save(out)
            case "add":
                add_smoothing(options["checkpoint"], ActionLimits.load(options["limits"]))
            case _:
                remove_smoothing(options["checkpoint"])
    except (OSError, ValueError) as error:
        print(f"lerobot-smooth: {error}", file=sys.stderr)
        return 1
    return 0
