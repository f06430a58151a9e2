"""`hrc run collaboration`: the paper's third experiment, the whole job."""

from dataclasses import asdict, replace

from rich.console import Console

from hrc_learn.cli._options import resolved
from hrc_learn.cli._values import command_line, refuse_existing
from hrc_learn.cli.arguments.run import RunCollaboration as Args
from hrc_learn.cli.commands._demo_models import model
from hrc_learn.experiments.collaboration.experiment import CollaborationExperiment
from hrc_learn.experiments.collaboration.trial import Disturbances
from hrc_learn.experiments.frame import RunOptions, conduct
from hrc_learn.learning.tuning import with_gains
from hrc_learn.sim import OcclusionInterval
from hrc_learn.skills.marker_sensor import LatencyConfig
from hrc_learn.skills.work_cell import WorkCellConfig
from hrc_learn.teleoperation.page import PageConfig


def run(args: Args) -> int:
    refuse_existing(args.out, args.overwrite)
    console = Console()
    placing = model(args.placing, "placing", console)
    aiming = model(args.aiming, "aiming", console)
    args = replace(resolved(args), placing=placing, aiming=aiming)
    controller = with_gains(args.config.grasping.controller, args.gains)
    grasping = replace(args.config.grasping, controller=controller)
    experiment = CollaborationExperiment(
        aiming=aiming.resolve(),
        placing=placing.resolve(),
        shelves=args.shelves or (args.shelf,),
        shelf_x=args.shelf_x,
        shelf_depth=args.shelf_depth,
        person=args.person,
        disturbances=Disturbances(
            occlusions=tuple(OcclusionInterval(start=s, duration=d) for s, d in args.occlusion),
            camera_change=args.camera_change if args.camera_moved else None,
        ),
        cell=WorkCellConfig(
            latency=LatencyConfig(delay=args.latency, frame_loss=args.frame_loss)
        ),
        config=replace(args.config, grasping=grasping),
        camera=args.camera,
        page=PageConfig(port=args.port) if args.page else None,
    )
    return conduct(
        experiment, RunOptions.of(args), configuration=asdict(args), command=command_line()
    )
