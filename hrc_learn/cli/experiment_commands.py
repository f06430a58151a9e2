"""`hrc demo` and `hrc run`: the whole job from the demonstrations on, and the experiments.

An experiment that is given no model uses the demo's, which is learned first if it is missing.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, cast, get_args

from rich.console import Console

from hrc_learn.cli._ledger import Ledger
from hrc_learn.cli._run import command_line, refuse_existing
from hrc_learn.cli._settings import with_settings
from hrc_learn.cli.arguments import (
    Demo,
    FitImageJacobian,
    FitPrimitives,
    Record,
    Run,
    WithImperfections,
    WithRobot,
)
from hrc_learn.experiments.collaboration_experiment import CollaborationExperiment, Pulls
from hrc_learn.experiments.collaboration_trial import Disturbances
from hrc_learn.experiments.experiment import (
    Experiment,
    LiveViewConfig,
    RunOptions,
    run_experiment,
)
from hrc_learn.experiments.grasping_experiment import GraspingExperiment
from hrc_learn.experiments.placing_experiment import PlacingExperiment, dataset_of
from hrc_learn.experiments.real_arm import (
    ArmSite,
    Task,
    collaboration_task,
    grasping_task,
    placing_task,
    run_on_arm,
)
from hrc_learn.experiments.table_objects import workplace_for
from hrc_learn.hardware import open_camera
from hrc_learn.kinematics import ArmChoice, panda
from hrc_learn.sim import CameraChange, CameraKind, Imperfections
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.placing import PlacingSkill
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.store import write_json
from hrc_learn.teleoperation.page import PageConfig
from hrc_learn.viz.report import show_command

MODELS = Path("outputs/demo")
"""Folder of the demo, whose models are used if none are given."""
_APPLIES = {
    "placing": ("placing", "collaboration"),
    "aiming": ("grasping", "collaboration"),
    "camera": ("grasping", "collaboration"),
    "page": ("grasping", "collaboration"),
    "pulls": ("collaboration",),
    "camera_moved": ("collaboration",),
    "worker": ("collaboration",),
    "handover": ("collaboration",),
}
"""Experiments that an option belongs to."""
_SIMULATED_ONLY = ("trials", "serve", "page", "camera_moved", "worker", "handover")


@dataclass(frozen=True, kw_only=True)
class _Settings:
    """Settings of the experiment, a real arm and the live view."""

    experiment: Experiment[Any]
    site: ArmSite = field(default_factory=ArmSite)
    serving: LiveViewConfig = field(default_factory=LiveViewConfig)


def run(args: Run) -> int:
    """Run an experiment, in simulation or on a real arm."""
    args = replace(args, out=args.out or Path("outputs") / args.experiment)
    _refuse_inapplicable(args)
    refuse_existing(_folder(args), args.overwrite)
    is_real = args.drives_real_arm(_SIMULATED_ONLY)
    experiment, make_task = {
        "placing": _placing,
        "grasping": _grasping,
        "collaboration": _collaboration,
    }[args.experiment](_with_models(args))
    settings = with_settings(args.config, _Settings(experiment=experiment))
    if is_real:
        return _run_on_arm(args, settings.site, *make_task(settings.experiment))
    options = RunOptions(
        out=_folder(args),
        seed=args.seed,
        trials=args.trials,
        processes=args.processes,
        serve=args.serve,
        serving=settings.serving,
        film=args.film,
        overwrite=args.overwrite,
        json=args.json,
    )
    return run_experiment(settings.experiment, options, command=command_line())


def _folder(args: Run) -> Path:
    assert args.out is not None
    return args.out


def _refuse_inapplicable(args: Run) -> None:
    defaults = {field.name: field.default for field in fields(args)}
    for name, experiments in _APPLIES.items():
        if args.experiment not in experiments and getattr(args, name) != defaults[name]:
            raise ValueError(
                f"--{name.replace('_', '-')} is an option of hrc run "
                f"{' and '.join(experiments)}, not of {args.experiment}"
            )


def _placing(args: Run) -> tuple[PlacingExperiment, Callable[..., tuple[Workplace, Task]]]:
    """Experiment 1, and its task on a real arm."""
    folder = _model(args.placing)
    experiment = PlacingExperiment(
        placing=folder,
        demonstrations=dataset_of(folder).resolve(),
        imperfections=_imperfections(args),
        arm=args.arm,
        robot=_choice(args),
    )

    def task(experiment: PlacingExperiment) -> tuple[Workplace, Task]:
        workplace = Workplace()
        skill = PlacingSkill.load(folder, workplace.robot)
        return workplace, placing_task(skill, workplace, args.shelf[0], experiment.speed)

    return experiment, task


def _grasping(args: Run) -> tuple[GraspingExperiment, Callable[..., tuple[Workplace, Task]]]:
    """Experiment 2, and its task on a real arm."""
    folder = _model(args.aiming)
    experiment = GraspingExperiment(
        aiming=folder,
        imperfections=_imperfections(args),
        camera=_simulated_camera(args),
        page=PageConfig() if args.page else None,
        arm=args.arm,
        robot=_choice(args),
    )

    def task(experiment: GraspingExperiment) -> tuple[Workplace, Task]:
        servoing = VisualServoSkill.load(folder)
        workplace = Workplace().approached(servoing.approach)
        return workplace, grasping_task(servoing, workplace, experiment.config)

    return experiment, task


def _collaboration(
    args: Run,
) -> tuple[CollaborationExperiment, Callable[..., tuple[Workplace, Task]]]:
    """Experiment 3, the whole job, and its task on a real arm."""
    aiming, placing = _model(args.aiming), _model(args.placing)
    experiment = CollaborationExperiment(
        aiming=aiming,
        placing=placing,
        shelves=args.shelf,
        pulls=_possible_pulls(args),
        worker=args.worker,
        handover=args.handover,
        imperfections=_imperfections(args),
        disturbances=Disturbances(camera_change=CameraChange() if args.camera_moved else None),
        camera=_simulated_camera(args),
        page=PageConfig() if args.page else None,
        arm=args.arm,
        robot=_choice(args),
    )

    def task(experiment: CollaborationExperiment) -> tuple[Workplace, Task]:
        servoing, skill = VisualServoSkill.load(aiming), PlacingSkill.load(placing, panda)
        shelves = experiment.shelves
        workplace = workplace_for(shelves, panda)
        workplace = workplace.approached(servoing.approach)
        return workplace, collaboration_task(
            servoing, skill, workplace, shelves, experiment.config
        )

    return experiment, task


def _model(folder: Path | None) -> Path:
    assert folder is not None
    return folder.resolve()


def _choice(args: WithRobot) -> ArmChoice:
    return ArmChoice(args.robot, tip=args.tip)


def _possible_pulls(args: Run) -> Pulls:
    """Pulls at the elbow, or none if the arm has no null space."""
    if args.pulls == "none" or args.drives_real_arm():
        return args.pulls
    robot = _choice(args).work_arm()
    if robot.null_space == "none":
        print(
            f"note: the {robot.name} needs all its {robot.joints} joints for the tool's pose: "
            "no pulls at the elbow"
        )
        return "none"
    return args.pulls


def _simulated_camera(args: Run) -> CameraKind:
    if args.drives_real_arm():
        return "synthetic"
    if args.camera not in get_args(CameraKind):
        kinds = ", ".join(get_args(CameraKind))
        raise ValueError(
            f"--camera {args.camera}: the simulated work cell has the cameras {kinds}. Other "
            "cameras are for a real arm (--arm, --ip)."
        )
    return cast("CameraKind", args.camera)


def _imperfections(args: WithImperfections) -> Imperfections:
    if args.imperfections < 0:
        raise ValueError(f"--imperfections must not be negative, but is {args.imperfections}.")
    return Imperfections.nominal().scaled(0.0 if args.ideal else args.imperfections)


def _run_on_arm(args: Run, site: ArmSite, workplace: Workplace, task: Task) -> int:
    """Carry out a task on a real arm and store its run; exit status 1 if it failed."""
    console = Console()
    site = replace(site, driver=args.arm, ip=args.ip)
    with ExitStack() as stack:
        camera = None
        if args.experiment != "placing":
            source = "0" if args.camera == "auto" else args.camera
            opened = open_camera(source, delay=site.camera_delay)
            camera = stack.enter_context(closing(opened))
        done = run_on_arm(
            site,
            workplace,
            task,
            camera=camera,
            on_phase=lambda phase, time: console.print(f"  {time:6.2f} s  {phase}"),
        )
    folder = _folder(args)
    done.save(folder, f"{args.arm} at {args.ip}", asdict(args))
    console.print(done.failure or "done", style="red" if done.failure else "green")
    print(f"Dashboard: {show_command(folder)}")
    return int(bool(done.failure))


def _with_models(args: Run) -> Run:
    """Fill in the demo's models where none are given; make them if they are missing."""
    needed = [name for name in ("placing", "aiming") if args.experiment in _APPLIES[name]]
    missing = [name for name in needed if getattr(args, name) is None]
    if any(not (MODELS / name).is_dir() for name in missing):
        console = Console()
        console.print(f"note: no model given and none in {MODELS}: it is learned first")
        if args.robot != "panda":
            raise ValueError(
                f"the models in {MODELS} are a Panda's: make those of the {args.robot} by "
                f"`hrc demo --robot {args.robot} --out FOLDER`, and name them."
            )
        learn(MODELS, console)
    return replace(args, **{name: MODELS / name for name in missing})


def demo(args: Demo) -> int:
    """Carry out the whole job, command after command in one process."""
    console = Console()
    learn(args.out, console, steps=5, robot=args, again=args.overwrite)
    write_json(args.out / "configuration.json", asdict(args))
    _announce(console, 5, 5, "Grasping near a person, carrying, placing")
    return run(
        Run(
            experiment="collaboration",
            placing=args.out / "placing",
            aiming=args.out / "aiming",
            shelf=(args.shelf,),
            robot=args.robot,
            tip=args.tip,
            out=args.out / "run",
            seed=args.seed,
            imperfections=args.imperfections,
            ideal=args.ideal,
            overwrite=True,
            json=args.json,
        )
    )


def learn(
    out: Path,
    console: Console,
    steps: int = 4,
    robot: WithRobot | None = None,
    again: bool = False,
) -> None:
    """Record demonstrations of placing and servoing, and learn from them.

    Results of the same options and code are kept.

    Args:
        out: Folder for `placing_demos`, `aiming_demos` and the models `placing`, `aiming`,
            which are replaced.
        console: Console for the progress.
        steps: Number of steps, including those of the caller.
        robot: Options that choose the arm. Default: the Panda.
        again: Repeat every step.

    Raises:
        RuntimeError: The scripted expert fails.
    """
    robot = robot or WithRobot()
    ledger, options = Ledger(out / "steps.json"), {"robot": robot.robot, "tip": robot.tip}
    for number, step in enumerate(_learning_steps(out, robot), start=1):
        if not again and ledger.holds(step.result, options, *step.reads):
            _announce(console, number, steps, f"{step.title}: up to date in {step.result}")
            continue
        _announce(console, number, steps, step.title)
        step.work()
        ledger.enter(step.result, options, *step.reads)


@dataclass(frozen=True, kw_only=True)
class _Step:
    """One step of `learn`."""

    title: str
    work: Callable[[], None]
    result: Path
    reads: tuple[Path, ...] = ()


def _learning_steps(out: Path, robot: WithRobot) -> Iterator[_Step]:
    """Demonstrations of placing and servoing, and the models of both."""
    from hrc_learn.cli import fit_commands, record_command

    def record(scenario: Any, folder: Path) -> None:
        arguments = Record(
            scenario=scenario, out=folder, robot=robot.robot, tip=robot.tip, overwrite=True
        )
        if record_command.record(arguments):
            raise RuntimeError(f"the scripted expert failed to demonstrate {scenario}")

    placing, servoing = out / "placing_demos", out / "aiming_demos"
    yield _Step(
        title="Demonstrations of placing",
        work=lambda: record("placing", placing),
        result=placing,
    )
    yield _Step(
        title="Demonstrations of servoing with an uncalibrated camera",
        work=lambda: record("servoing", servoing),
        result=servoing,
    )
    primitives = FitPrimitives(dataset=placing, out=out / "placing", overwrite=True)
    yield _Step(
        title="Movement primitives of placing",
        work=lambda: fit_commands.fit_primitives(primitives),
        result=primitives.folder,
        reads=(placing,),
    )
    jacobian = FitImageJacobian(dataset=servoing, out=out / "aiming", overwrite=True)
    yield _Step(
        title="Image Jacobian of servoing",
        work=lambda: fit_commands.fit_image_jacobian(jacobian),
        result=jacobian.folder,
        reads=(servoing,),
    )


def _announce(console: Console, step: int, steps: int, title: str) -> None:
    console.print(f"\\[{step}/{steps}] {title}", style="bold", highlight=False, soft_wrap=True)
