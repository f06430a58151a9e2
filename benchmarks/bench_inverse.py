"""Find the posture nearest to a given one among all that reach a pose: in a batch or a loop.

The loop over the redundant joint calls the same inverse for each of its positions. CPU time on
one thread, calls made in turn. Arms whose package is not installed are left out.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table
from timing import time_calls
from torch import Tensor

from hrc_learn import cli
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import Arm, ArmChoice, UnreachableError
from hrc_learn.kinematics.inverse import solutions_from
from hrc_learn.kinematics.registry import MissingModelError

_SAMPLES = 57  # number of positions of joint 7, or of starts


@dataclass(frozen=True, kw_only=True)
class Args:
    arms: tuple[str, ...] = ("panda", "fr3", "xarm7", "ur5", "iiwa7")
    """Names of registered arms."""
    repeats: int = 10
    """Number of timed calls of each kind."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


def main(args: Args) -> None:
    """Measure, print a table, and write the measured values."""
    torch.set_num_threads(1)
    figures: dict[str, float] = {}
    for name in args.arms:
        try:
            robot = ArmChoice(name).work_arm()
        except MissingModelError:
            continue
        chain, ready = robot.chain, robot.chain.ready
        pose = chain.forward(ready)
        timings = time_calls(
            {
                "batched": partial(robot.inverse, pose, near=ready, samples=_SAMPLES),
                "loop": partial(_one_by_one, robot, pose, ready),
            },
            args.repeats,
        )
        batch, loop = timings["batched"].median, timings["loop"].median
        figures |= {f"{name}_ms": 1e3 * batch, f"{name}_over_one_by_one": batch / loop}
    table = Table("figure", "value")
    for name, value in figures.items():
        table.add_row(name, f"{value:.3g}")
    Console().print(table)
    if args.json is not None:
        cli.write_json(args.json, figures)


def _one_by_one(robot: Arm, pose: Pose, near: Tensor) -> Tensor:
    """The nearest solution, from a loop over the positions of joint 7 or over the starts."""
    chain, found = robot.chain, []
    low, high = chain.limits.lower, chain.limits.upper
    if robot.is_franka:
        for q7 in torch.linspace(float(low[6]), float(high[6]), _SAMPLES):
            try:
                found.append(robot.chain.inverse(pose, float(q7), near=near))
            except UnreachableError:
                continue
    else:
        rng = torch.Generator().manual_seed(0)
        share = torch.rand(_SAMPLES, robot.joints, generator=rng, dtype=torch.float64)
        for start in low + (high - low) * share:
            q = solutions_from(chain, pose, start[None])[0]
            found += [q] if bool(q.isfinite().all()) else []
    return min(found, key=lambda q: float((q - near).norm()))


if __name__ == "__main__":
    cli.run(main, Args)
