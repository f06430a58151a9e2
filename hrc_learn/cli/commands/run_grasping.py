"""`hrc run grasping`: the paper's second experiment."""

import math
from dataclasses import asdict, replace

from rich.console import Console

from hrc_learn.cli._options import resolved
from hrc_learn.cli._values import command_line, refuse_existing
from hrc_learn.cli.arguments.run import RunGrasping as Args
from hrc_learn.cli.commands._demo_models import model
from hrc_learn.experiments.frame import RunOptions, conduct
from hrc_learn.experiments.grasping.experiment import GraspingExperiment
from hrc_learn.experiments.grasping.trial import GraspingSceneConfig
from hrc_learn.learning.tuning import with_gains


def run(args: Args) -> int:
    refuse_existing(args.out, args.overwrite)
    aiming = model(args.aiming, "aiming", Console())
    args = replace(resolved(args), aiming=aiming)
    controller = with_gains(args.config.controller, args.gains)
    experiment = GraspingExperiment(
        aiming=aiming.resolve(),
        variants=() if args.variants == ("none",) else args.variants,
        scene=GraspingSceneConfig(
            camera_roll=math.radians(args.camera_roll), random_camera=args.random_camera
        ),
        camera=args.camera,
        config=replace(args.config, controller=controller),
    )
    return conduct(
        experiment, RunOptions.of(args), configuration=asdict(args), command=command_line()
    )
