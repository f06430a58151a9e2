"""`hrc smooth`: limits on what any LeRobot policy asks for."""

from dataclasses import asdict

import numpy as np
from rich.console import Console
from rich.table import Table

from hrc_learn.cli._run import write_values
from hrc_learn.cli.arguments.learn import Smooth


def smooth(args: Smooth) -> None:
    if not args.checkpoint.is_dir():
        raise FileNotFoundError(f"there is no folder {args.checkpoint}")
    # LeRobot takes seconds to import.
    from hrc_learn.lerobot.action_limits import demonstrated_limits
    from hrc_learn.lerobot.processor import add_smoothing, remove_smoothing

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
    figures = {
        f"{kind}_{name}": float(v)
        for kind in kinds
        for name, v in zip(limits.names, np.array(values[kind]), strict=True)
    }
    write_values(args.json, figures)
