"""Measure a learned image Jacobian against the truth, which the simulator knows.

For models of training/fit_image_jacobian.py from demonstrations of
datasets/record_servoing.py. Prints the error against the true Jacobian on a grid inside the
demonstrated workspace, how honest its uncertainty is, and how much sooner the hand's marker
reaches its target than from the paper's fixed initial Jacobian, over many starts and with the
camera turned by any angle. Exit status 1 if a target was missed.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
import tyro
from rich.console import Console

from hrc_learn import cli
from hrc_learn.demos import load_demos
from hrc_learn.experiments.initialization_study import (
    ClosedLoops,
    StartsConfig,
    compare_starts,
    compare_with_truth,
    held_out_grid,
)
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.visual_servoing import VisualServoSkill

MOST_ERROR = 0.05
LEAST_SPEED_UP = 1.5


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to measure."""

    model: Annotated[Path, tyro.conf.Positional]
    """Folder of training/fit_image_jacobian.py."""
    dataset: Annotated[Path, tyro.conf.Positional]
    """The demonstrations it was learned from."""
    tilt: float = 0.1
    """Of the hand, in the second of two grids [rad]; the first has it pointing down."""
    closed_loop: bool = True
    """Whether to run the closed loops, which take a minute or more."""
    starts: StartsConfig = field(default_factory=StartsConfig)
    """How starts are drawn."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> int:
    torch.set_num_threads(1)
    network = VisualServoSkill.load(args.model).jacobian
    demos = load_demos(args.dataset)
    if demos[0].position is None:
        raise ValueError(f"{args.dataset}: no end-effector positions to place a grid by.")
    shown = torch.cat([torch.from_numpy(demo.position) for demo in demos]).double()
    workplace = Workplace()
    world = World(workplace.scene)
    world.reset(workplace.home_joints().numpy(), {})
    camera, offset = workplace.scene.camera, world.hand_marker_offset()
    figures: dict[str, float] = {}
    for name, tilt in (("upright", 0.0), ("tilted", args.tilt)):
        measured = compare_with_truth(network, held_out_grid(shown, tilt=tilt), camera, offset)
        figures |= {f"{name}_{key}": value for key, value in measured.items()}
    if args.closed_loop:
        workspace = torch.stack([shown.quantile(0.05, dim=0), shown.quantile(0.95, dim=0)])
        near = workplace.hover_joints()
        with Console().status("Closed loops") as status:
            loops = ClosedLoops.draw(camera, offset, workspace, near, args.starts)
            figures |= compare_starts(
                network,
                loops,
                on_run=lambda name: status.update(f"Closed loops, {name} Jacobian"),
            )
    cli.show_values(f"Image Jacobian {args.model}", figures)
    if args.json is not None:
        cli.write_json(args.json, figures)
    missed = figures["upright_relative_error_median"] > MOST_ERROR
    missed |= figures.get("speed_up_over_fixed", LEAST_SPEED_UP) < LEAST_SPEED_UP
    return int(missed)


if __name__ == "__main__":
    cli.run(main, Args)
