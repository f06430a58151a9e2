"""`hrc run`, `hrc demo`: the paper's experiments, and the whole job from the demonstrations on.

An experiment that is given no model takes the demo's, learned first where they are missing.
"""

import json
import math
from collections.abc import Mapping
from contextlib import ExitStack, closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast, get_args

from rich.console import Console

from hrc_learn.cli._ledger import Ledger
from hrc_learn.cli._options import resolved
from hrc_learn.cli._run import command_line, leads_real_arm, refuse_existing
from hrc_learn.cli.arguments import OfRobot
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
from hrc_learn.experiments.collaboration.trial import Disturbances, Pulls, workplace_for
from hrc_learn.experiments.frame import Experiment, RunOptions, conduct
from hrc_learn.experiments.grasping.experiment import GraspingExperiment
from hrc_learn.experiments.grasping.trial import GraspingSceneConfig
from hrc_learn.experiments.on_arm import (
    ArmSite,
    Task,
    collaboration_task,
    grasping_task,
    placing_task,
    run_on_arm,
)
from hrc_learn.experiments.placing.experiment import ABLATION, PlacingExperiment, dataset_of
from hrc_learn.hardware import open_camera
from hrc_learn.kinematics import ArmChoice
from hrc_learn.learning.tuning import with_gains
from hrc_learn.protocols import DrawnRegion
from hrc_learn.sim import CameraKind, Imperfections, OcclusionInterval
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.marker_sensor import LatencyConfig
from hrc_learn.skills.placing import PlacingSkill
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.skills.work_cell import WorkCellConfig
from hrc_learn.store import write_text
from hrc_learn.teleoperation import DrawnInterval
from hrc_learn.teleoperation.page import PageConfig
from hrc_learn.viz.report import show_command

_PANDA = ArmChoice()

MODELS = Path("outputs/demo")
"""Where commands that are given no model look for those of the demo."""


_SIMULATED_ONLY = (
    "trials",
    "curve",
    "serve",
    "page",
    "draw_region",
    "mark_target",
    "turn_tool",
    "random_camera",
    "ablation",
    "occlusion",
    "camera_moved",
    "worker",
    "handover",
)
"""Options that only the simulated work cell has."""


def run_placing(args: RunPlacing) -> int:
    """The paper's first experiment."""
    args = _with_models(args)
    assert args.placing is not None
    if leads_real_arm(args, _SIMULATED_ONLY):
        workplace = Workplace()
        skill = PlacingSkill.load(args.placing)
        task = placing_task(skill, workplace, args.shelf, args.speed)
        return _on_arm(args, workplace, task)
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
        arm=args.arm,
        robot=_choice(args),
    )
    return _conduct(experiment, args, counts={ABLATION: args.ablation})


def run_grasping(args: RunGrasping) -> int:
    """The paper's second experiment."""
    args = _with_models(args)
    assert args.aiming is not None
    controller = with_gains(args.config.controller, args.gains)
    config = replace(args.config, controller=controller)
    if leads_real_arm(args, _SIMULATED_ONLY):
        servoing = VisualServoSkill.load(args.aiming)
        workplace = Workplace().approached(servoing.approach)
        return _on_arm(args, workplace, grasping_task(servoing, workplace, config))
    experiment = GraspingExperiment(
        aiming=args.aiming.resolve(),
        variants=() if args.variants == ("none",) else args.variants,
        scene=GraspingSceneConfig(
            camera_roll=math.radians(args.camera_roll), random_camera=args.random_camera
        ),
        imperfections=_imperfections(args),
        curve=args.curve,
        camera=_simulated_camera(args),
        config=config,
        drawings=_drawings(args),
        page=PageConfig(port=args.port) if args.page else None,
        arm=args.arm,
        robot=_choice(args),
    )
    return _conduct(experiment, args)


def run_collaboration(args: RunCollaboration) -> int:
    """The paper's third experiment, the whole job."""
    args = _with_models(args)
    assert args.aiming is not None
    assert args.placing is not None
    controller = with_gains(args.config.grasping.controller, args.gains)
    config = replace(args.config, grasping=replace(args.config.grasping, controller=controller))
    shelves = args.shelves or (args.shelf,)
    if leads_real_arm(args, _SIMULATED_ONLY):
        servoing, placing = VisualServoSkill.load(args.aiming), PlacingSkill.load(args.placing)
        workplace = workplace_for(shelves, args.shelf_x, args.shelf_depth)
        workplace = workplace.approached(servoing.approach)
        task = collaboration_task(servoing, placing, workplace, shelves, config)
        return _on_arm(args, workplace, task)
    experiment = CollaborationExperiment(
        aiming=args.aiming.resolve(),
        placing=args.placing.resolve(),
        shelves=shelves,
        shelf_x=args.shelf_x,
        shelf_depth=args.shelf_depth,
        pulls=_possible_pulls(args),
        mapping=args.mapping,
        worker=args.worker,
        handover=args.handover,
        imperfections=_imperfections(args),
        curve=args.curve,
        disturbances=Disturbances(
            occlusions=tuple(OcclusionInterval(start=s, duration=d) for s, d in args.occlusion),
            camera_change=args.camera_change if args.camera_moved else None,
        ),
        cell=WorkCellConfig(
            latency=LatencyConfig(delay=args.latency, frame_loss=args.frame_loss)
        ),
        config=config,
        camera=_simulated_camera(args),
        drawings=_drawings(args),
        page=PageConfig(port=args.port) if args.page else None,
        arm=args.arm,
        robot=_choice(args),
    )
    return _conduct(experiment, args)


def _choice(args: OfRobot) -> ArmChoice:
    return ArmChoice(args.robot, args.base, args.tip)


def _possible_pulls(args: RunCollaboration) -> Pulls:
    """When a scripted person pulls the elbow of an arm that leaves it free to be pulled."""
    robot = _choice(args).work_arm()
    if robot.null_space == "none" and args.pulls != "none":
        print(
            f"note: the {robot.name} needs all its {robot.joints} joints for the pose of its "
            "tool: nobody can pull its elbow aside, so nobody does."
        )
        return "none"
    return args.pulls


def _simulated_camera(args: RunServoing) -> CameraKind:
    if args.camera not in get_args(CameraKind):
        kinds = ", ".join(get_args(CameraKind))
        raise ValueError(
            f"--camera {args.camera}: the simulated work cell has the cameras {kinds}. Others "
            "watch a real arm (--arm, --ip)."
        )
    return cast("CameraKind", args.camera)


def _on_arm(args: RunExperiment, workplace: Workplace, task: Task) -> int:
    """Let a real arm do a task, and write what it left; exit status 1 if it failed."""
    console = Console()
    site: ArmSite = replace(args.site, driver=args.arm, ip=args.ip)
    with ExitStack() as stack:
        camera = None
        if isinstance(args, RunServoing):
            source = "0" if args.camera == "auto" else args.camera
            opened = open_camera(source, delay=site.camera_delay)
            camera = stack.enter_context(closing(opened))
        run = run_on_arm(
            site,
            workplace,
            task,
            camera=camera,
            on_phase=lambda phase, time: console.print(f"  {time:6.2f} s  {phase}"),
        )
    run.save(args.out, f"{args.arm} at {args.ip}", asdict(args))
    console.print(run.failure or "done", style="red" if run.failure else "green")
    print(f"Dashboard: {show_command(args.out)}")
    return int(bool(run.failure))


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
        if args.robot != "panda":
            raise ValueError(
                f"the models in {MODELS} are a Panda's: make those of the {args.robot} by "
                f"`hrc demo --robot {args.robot} --out FOLDER`, and name them."
            )
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
    learn(args.out, console, steps=5, robot=_choice(args), again=args.again)
    write_text(args.out / "configuration.json", json.dumps(asdict(args), indent=2, default=str))
    _announce(console, 5, 5, "Grasping beside a person, carrying, placing")
    return run_collaboration(
        RunCollaboration(
            placing=args.out / "placing",
            aiming=args.out / "aiming",
            shelf=args.shelf,
            robot=args.robot,
            base=args.base,
            tip=args.tip,
            out=args.out / "run",
            seed=args.seed,
            imperfections=args.imperfections,
            ideal=args.ideal,
            film=args.film,
            verbose=args.verbose,
            overwrite=True,
            json=args.json,
        )
    )


def learn(
    out: Path,
    console: Console,
    steps: int = 4,
    robot: ArmChoice = _PANDA,
    again: bool = False,
) -> None:
    """Record demonstrations of placing and servoing, and learn from them.

    What is there already from the same options and code is kept.

    Args:
        out: Folder for `placing_demos`, `aiming_demos` and the models `placing`, `aiming`;
            older ones in it are replaced.
        console: Told what is being done.
        steps: How many there are, with those of the caller.
        robot: The arm.
        again: Whether all is done anew.

    Raises:
        RuntimeError: If the scripted expert fails.
    """
    from hrc_learn.cli.commands import fit, record

    placing, servoing = out / "placing_demos", out / "aiming_demos"
    of_robot: dict[str, Any] = {
        "robot": robot.name,
        "base": robot.base,
        "tip": robot.tip,
        "overwrite": True,
    }

    def record_placing() -> None:
        if record.record_placing(RecordPlacing(out=placing, **of_robot)):
            raise RuntimeError("the scripted expert could not place")

    def record_servoing() -> None:
        record.record_servoing(RecordServoing(out=servoing, **of_robot))

    def fit_primitives() -> None:
        fit.fit_primitives(FitPrimitives(dataset=placing, out=out / "placing", overwrite=True))

    def fit_image_jacobian() -> None:
        arguments = FitImageJacobian(dataset=servoing, out=out / "aiming", overwrite=True)
        fit.fit_image_jacobian(arguments)

    ledger, options = Ledger(out / "steps.json"), {"robot": asdict(robot)}
    for number, (what, work, made, reads) in enumerate(
        (
            ("Demonstrations of placing", record_placing, placing, ()),
            (
                "Demonstrations of servoing with an uncalibrated camera",
                record_servoing,
                servoing,
                (),
            ),
            ("Movement primitives from the first", fit_primitives, out / "placing", (placing,)),
            (
                "Image Jacobian from the second",
                fit_image_jacobian,
                out / "aiming",
                (servoing,),
            ),
        ),
        start=1,
    ):
        if not again and ledger.holds(made, options, *reads):
            _announce(console, number, steps, f"{what}: there and unchanged in {made}")
            continue
        _announce(console, number, steps, what)
        work()
        ledger.enter(made, options, *reads)


def _announce(console: Console, step: int, steps: int, what: str) -> None:
    console.print(f"\\[{step}/{steps}] {what}", style="bold", highlight=False, soft_wrap=True)
