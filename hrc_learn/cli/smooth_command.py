"""`hrc smooth`: limits on the motion that a LeRobot policy commands."""

from dataclasses import asdict

import numpy as np
from rich.console import Console
from rich.table import Table

from hrc_learn.cli._run import write_values
from hrc_learn.cli.arguments import Smooth
from hrc_learn.kinematics import panda


def smooth(args: Smooth) -> None:
    """Add limits to a checkpoint or a file, or remove them."""
    if args.checkpoint is not None and not args.checkpoint.is_dir():
        raise FileNotFoundError(f"there is no folder {args.checkpoint}")
    if args.checkpoint is None and (args.remove or args.limits is None):
        raise ValueError("give --checkpoint, or --limits to write only a file.")
    # LeRobot takes seconds to import.
    from hrc_learn.lerobot.arm_values import ArmValues
    from hrc_learn.lerobot.smoothing import add_smoothing, gathered_limits, remove_smoothing

    if args.remove and args.checkpoint is not None:
        remove_smoothing(args.checkpoint)
        print(f"limits removed from {args.checkpoint}")
        return
    if args.dataset is None:
        raise ValueError("give --dataset: the limits are those of its demonstrators.")
    if not args.scale > 0:
        raise ValueError(f"--scale must be positive, got {args.scale}")
    limits = gathered_limits(
        args.dataset,
        scale=args.scale,
        urdf=args.urdf,
        calibration=args.calibration,
        degrees=args.degrees,
    )
    if args.urdf is None and args.calibration is None:
        ends = zip(panda.limits.lower.tolist(), panda.limits.upper.tolist(), strict=True)
        limits = limits.within(dict(zip(ArmValues(panda).joints, ends, strict=True)))
    if args.limits is not None:
        limits.save(args.limits)
    if args.checkpoint is not None:
        add_smoothing(args.checkpoint, limits)
    values = asdict(limits)
    table = Table("value", "velocity [1/s]", "acceleration [1/s^2]", "jerk [1/s^3]")
    kinds = ("velocity", "acceleration", "jerk")
    for i, name in enumerate(limits.names):
        table.add_row(name, *(f"{values[kind][i]:.3g}" for kind in kinds))
    Console().print(table)
    if args.checkpoint is not None:
        print(f"{args.checkpoint} keeps its actions within these limits")
    figures = {
        f"{kind}_{name}": float(v)
        for kind in kinds
        for name, v in zip(limits.names, np.array(values[kind]), strict=True)
    }
    write_values(args.json, figures)
