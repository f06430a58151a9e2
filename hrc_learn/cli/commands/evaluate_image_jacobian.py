"""`hrc evaluate image-jacobian`: an image Jacobian against the simulator's true one."""

import torch
from rich.console import Console

from hrc_learn.cli._options import resolved
from hrc_learn.cli._values import show_values, write_json
from hrc_learn.cli.arguments.learn import EvaluateImageJacobian as Args
from hrc_learn.demos import load_demos
from hrc_learn.experiments.initialization_study import (
    ClosedLoops,
    compare_starts,
    compare_with_truth,
    held_out_grid,
)
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.visual_skill import VisualServoSkill

MOST_ERROR = 0.05
LEAST_SPEED_UP = 1.5


def run(args: Args) -> int:
    args = resolved(args)
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
    show_values(f"Image Jacobian {args.model}", figures)
    if args.json is not None:
        write_json(args.json, figures)
    missed = figures["upright_relative_error_median"] > MOST_ERROR
    missed |= figures.get("speed_up_over_fixed", LEAST_SPEED_UP) < LEAST_SPEED_UP
    return int(missed)
