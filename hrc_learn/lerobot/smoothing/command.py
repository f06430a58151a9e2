"""The command `lerobot-smooth`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from .action_limits import ActionLimits, gathered_limits
from .processor import add_smoothing, remove_smoothing


def main(arguments: Sequence[str] | None = None) -> int:
    """Run it; returns the exit status."""
    options = _parser().parse_args(arguments)
    try:
        options.run(options)
    except (OSError, ValueError) as error:
        print(f"lerobot-smooth: {error}", file=sys.stderr)
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("lerobot-smooth", description="Smooth actions in LeRobot.")
    commands = parser.add_subparsers(required=True)
    limits = commands.add_parser("limits", help="write a file of limits")
    limits.add_argument("--dataset", type=Path, required=True, help="how demonstrators moved")
    limits.add_argument(
        "--scale",
        type=float,
        default=1.0,
        help="fraction of the demonstrated limits to allow (default 1)",
    )
    limits.add_argument("--urdf", type=Path, help="positions and velocities of joints")
    limits.add_argument("--calibration", type=Path, help="positions, of LeRobot's calibration")
    limits.add_argument("--degrees", action="store_true", help="actions are in degrees")
    limits.add_argument("--out", type=Path, required=True, help="file to write")
    limits.set_defaults(run=_limits)
    add = commands.add_parser("add", help="smooth the actions of a checkpoint wherever it runs")
    add.add_argument("--checkpoint", type=Path, required=True, help="folder pretrained_model")
    add.add_argument("--limits", type=Path, required=True, help="file of limits")
    add.set_defaults(run=_add)
    remove = commands.add_parser("remove", help="take that out again")
    remove.add_argument(
        "--checkpoint", type=Path, required=True, help="folder pretrained_model"
    )
    remove.set_defaults(run=lambda options: remove_smoothing(options.checkpoint))
    return parser


def _limits(options: argparse.Namespace) -> None:
    limits = gathered_limits(
        options.dataset,
        scale=options.scale,
        urdf=options.urdf,
        calibration=options.calibration,
        degrees=options.degrees,
    )
    limits.save(options.out)
    print(f"{'value':24} {'lowest':>9} {'highest':>9} {'1/s':>9} {'1/s^2':>9} {'1/s^3':>9}")
    kinds = (limits.velocity, limits.acceleration, limits.jerk)
    for name, *values in zip(limits.names, *limits.positions(), *kinds, strict=True):
        print(f"{name:24}", *(f"{value:9.3g}" for value in values))


def _add(options: argparse.Namespace) -> None:
    add_smoothing(options.checkpoint, ActionLimits.load(options.limits))
