"""Let a trained LeRobot policy's actions be smoothed: any policy, wherever it is run.

Adds two steps to the processors of a checkpoint. They keep actions within limits of position,
velocity, acceleration and jerk, and blend the seams between chunks. The limits are how abruptly
the demonstrators of its dataset moved. Weights stay as they are; --remove takes the steps out.
"""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from hrc_learn import cli


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to smooth, and how much."""

    checkpoint: Path
    """Folder `pretrained_model` of the checkpoint."""
    dataset: Path | None = None
    """LeRobot dataset it was trained on; not needed to remove the steps."""
    share: float = 1.0
    """Share of the demonstrators' velocity, acceleration and jerk to allow."""
    remove: bool = False
    """Take the steps out again."""
    json: Path | None = None
    """File for the limits."""


def main(args: Args) -> None:
    from hrc_learn.lerobot.processor import add_smoothing
    from hrc_learn.lerobot.processor.action_limits import demonstrated_limits
    from hrc_learn.lerobot.processor.checkpoint_steps import remove_smoothing

    if not args.checkpoint.is_dir():
        raise FileNotFoundError(f"there is no folder {args.checkpoint}")
    if args.remove:
        remove_smoothing(args.checkpoint)
        print(f"{args.checkpoint} is as it was trained")
        return
    if args.dataset is None:
        raise ValueError("--dataset is needed: limits are those of its demonstrators.")
    if not args.share > 0:
        raise ValueError(f"--share must be positive, but is {args.share}.")
    limits = demonstrated_limits(args.dataset, args.share)
    add_smoothing(args.checkpoint, limits)
    values = asdict(limits)
    table = Table("value", "velocity [1/s]", "acceleration [1/s^2]", "jerk [1/s^3]")
    kinds = ("velocity", "acceleration", "jerk")
    for i, name in enumerate(limits.names):
        table.add_row(name, *(f"{values[kind][i]:.3g}" for kind in kinds))
    Console().print(table)
    print(f"actions of {args.checkpoint} are kept within these limits")
    if args.json is not None:
        figures = {
            f"{kind}_{name}": float(v)
            for kind in kinds
            for name, v in zip(limits.names, np.array(values[kind]), strict=True)
        }
        cli.write_json(args.json, figures)


if __name__ == "__main__":
    cli.run(main, Args)
