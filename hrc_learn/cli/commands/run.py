"""`hrc run`, `hrc demo`: the paper's experiments, and the whole job from the demonstrations on.

An experiment that is given no model takes the demo's, learned first where they are missing.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from hrc_learn.cli._options import resolved
from hrc_learn.cli._run import command_line, refuse_existing
from hrc_learn.cli.arguments.learn import FitImageJacobian, FitPrimitives
from hrc_learn.cli.arguments.record import RecordPlacing, RecordServoing
from hrc_learn.cli.arguments.run import (
    Demo,
    Imperfect,
    RunCollaboration,
    RunExperiment,
    RunGrasping,
    RunPlacing,
    RunServoing,
)
from hrc_learn.experiments.collaboration.experiment import CollaborationExperiment
from hrc_learn.experiments.collaboration.trial import Disturbances
from hrc_learn.experiments.frame import Experiment, RunOptions, conduct
from hrc_learn.experiments.grasping.experiment import GraspingExperiment
from hrc_learn.experiments.grasping.trial import GraspingSceneConfig
from hrc_learn.experiments.placing.experiment import ABLATION, PlacingExperiment, dataset_of
from hrc_learn.learning.tuning import with_gains
from hrc_learn.protocols import DrawnRegion
from hrc_learn.sim import Imperfections, OcclusionInterval
from hrc_learn.skills.marker_sensor import LatencyConfig
from hrc_learn.skills.work_cell import WorkCellConfig
from hrc_learn.store import write_text
from hrc_learn.teleoperation import DrawnInterval
from hrc_learn.teleoperation.page import PageConfig

MODELS = Path("outputs/demo")
"""Where commands that are given no model look for those of the demo."""


def run_placing(args: RunPlacing) -> int:
    """The paper's first experiment."""
    args = _with_models(args)
    assert args.placing is not None
    dataset = args.demonstrations or dataset_of(args.placing)
    experiment = PlacingExperiment(
        placing=args.placing.resolve(),
        demonstrations=dataset.resolve(),
        speed=args.speed,
        noise=args.noise,
        imperfections=_imperfections(args),
        curve=args.curve,
        taught=args.taught,
        snapshots=args.pictures,
    )
    return _conduct(experiment, args, counts={ABLATION: args.ablation})


def run_grasping(args: RunGrasping) -> int:
    """The paper's second experiment."""
    args = _with_models(args)
    assert args.aiming is not None
    controller = with_gains(args.config.controller, args.gains)
    experiment = GraspingExperiment(
        aiming=args.aiming.resolve(),
        variants=() if args.variants == ("none",) else args.variants,
        scene=GraspingSceneConfig(
            camera_roll=math.radians(args.camera_roll), random_camera=args.random_camera
        ),
        imperfections=_imperfections(args),
        curve=args.curve,
        camera=args.camera,
        config=replace(args.config, controller=controller),
        drawings=_drawings(args),
        page=PageConfig(port=args.port) if args.page else None,
    )
    return _conduct(experiment, args)


def run_collaboration(args: RunCollaboration) -> int:
    """The paper's third experiment, the whole job."""
    args = _with_models(args)
    assert args.aiming is not None
    assert args.placing is not None
    controller = with_gains(args.config.grasping.controller, args.gains)
    grasping = replace(args.config.grasping, controller=controller)
    experiment = CollaborationExperiment(
        aiming=args.aiming.resolve(),
        placing=args.placing.resolve(),
        shelves=args.shelves or (args.shelf,),
        shelf_x=args.shelf_x,
        shelf_depth=args.shelf_depth,
        pulls=args.pulls,
        mapping=args.mapping,
        worker=args.worker,
        imperfections=_imperfections(args),
        curve=args.curve,
        disturbances=Disturbances(
            occlusions=tuple(OcclusionInterval(start=s, duration=d) for s, d in args.occlusion),
            camera_change=args.camera_change if args.camera_moved else None,
        ),
        cell=WorkCellConfig(
            latency=LatencyConfig(delay=args.latency, frame_loss=args.frame_loss)
        ),
        config=replace(args.config, grasping=grasping),
        camera=args.camera,
        drawings=_drawings(args),
        page=PageConfig(port=args.port) if args.page else None,
    )
    return _conduct(experiment, args)


def _drawings(args: RunServoing) -> tuple[DrawnInterval, ...]:
    """What the scripted person draws, marks and turns."""
    regions = (
        DrawnInterval(
            start=start,
            duration=duration,
            region=DrawnRegion(centre=(x, y, z), half_size=(a, b, c)),
        )
        for start, duration, x, y, z, a, b, c in args.draw_region
    )
    targets = (
        DrawnInterval(start=start, duration=duration, target=(x, y, z))
        for start, duration, x, y, z in args.mark_target
    )
    turns = (
        DrawnInterval(
            start=start,
            duration=duration,
            turn=(math.radians(a), math.radians(b), math.radians(c)),
        )
        for start, duration, a, b, c in args.turn_tool
    )
    return (*regions, *targets, *turns)


def _imperfections(args: Imperfect) -> Imperfections:
    if args.imperfections < 0:
        raise ValueError(f"--imperfections must not be negative, but is {args.imperfections}.")
    return Imperfections.nominal().scaled(0.0 if args.ideal else args.imperfections)


def _with_models[Args: RunExperiment](args: Args) -> Args:
    """The arguments complete, with a folder for every model that the experiment needs."""
    refuse_existing(args.out, args.overwrite)
    wanted = [name for name in ("placing", "aiming") if hasattr(args, name)]
    missing = [name for name in wanted if getattr(args, name) is None]
    if any(not (MODELS / name).is_dir() for name in missing):
        console = Console()
        console.print(f"note: no model given and none in {MODELS}, so it is learned first")
        learn(MODELS, console)
    return replace(resolved(args), **{name: MODELS / name for name in missing})


def _conduct(
    experiment: Experiment[Any], args: RunExperiment, counts: Mapping[str, int] | None = None
) -> int:
    return conduct(
        experiment,
        RunOptions.of(args),
        counts=counts,
        configuration=asdict(args),
        command=command_line(),
    )


def demo(args: Demo) -> int:
    """The whole main job, command after command in one process."""
    console = Console()
    learn(args.out, console, steps=5)
    write_text(args.out / "configuration.json", json.dumps(asdict(args), indent=2, default=str))
    _announce(console, 5, 5, "Grasping beside a person, carrying, placing")
    return run_collaboration(
        RunCollaboration(
            placing=args.out / "placing",
            aiming=args.out / "aiming",
            shelf=args.shelf,
            robot=args.robot,
            out=args.out / "run",
            seed=args.seed,
            imperfections=args.imperfections,
            ideal=args.ideal,
            overwrite=True,
            json=args.json,
        )
    )


def learn(out: Path, console: Console, steps: int = 4) -> None:
    """Record demonstrations of placing and servoing, and learn from them.

    Args:
        out: Folder for `placing_demos`, `aiming_demos` and the models `placing`, `aiming`;
            older ones in it are replaced.
        console: Told what is being done.
        steps: How many there are, with those of the caller.

    Raises:
        RuntimeError: If the scripted expert fails.
    """
    from hrc_learn.cli.commands import fit, record

    placing, servoing = out / "placing_demos", out / "aiming_demos"
    _announce(console, 1, steps, "Demonstrations of placing")
    if record.record_placing(RecordPlacing(out=placing, overwrite=True)):
        raise RuntimeError("the scripted expert could not place")
    _announce(console, 2, steps, "Demonstrations of servoing with an uncalibrated camera")
    record.record_servoing(RecordServoing(out=servoing, overwrite=True))
    _announce(console, 3, steps, "Movement primitives from the first")
    fit.fit_primitives(FitPrimitives(dataset=placing, out=out / "placing", overwrite=True))
    _announce(console, 4, steps, "Image Jacobian from the second")
    fit.fit_image_jacobian(
        FitImageJacobian(dataset=servoing, out=out / "aiming", overwrite=True)
    )


def _announce(console: Console, step: int, steps: int, what: str) -> None:
    console.print(f"[bold]\\[{step}/{steps}] {what}[/]", highlight=False)
