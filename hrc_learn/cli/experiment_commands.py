"""`hrc demo` and `hrc run`: the whole job including the learning, and the experiments.

If no model is given, an experiment uses the model of `hrc demo`, which is learned first if it
is missing.
"""

import hashlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, cast, get_args

from rich.console import Console

from hrc_learn.cli._run import command_line, refuse_existing, with_settings, write_values
from hrc_learn.cli.arguments import (
    Demo,
    FitImageJacobian,
    FitPrimitives,
    Record,
    Run,
    WithImperfections,
    WithRobot,
    refuse_given,
    refuse_of_others,
)
from hrc_learn.experiments.collaboration_experiment import CollaborationExperiment, Pulls
from hrc_learn.experiments.collaboration_trial import Disturbances
from hrc_learn.experiments.experiment import Experiment, RunOptions, run_experiment
from hrc_learn.experiments.grasping_experiment import GraspingExperiment
from hrc_learn.experiments.placing_experiment import PlacingExperiment, dataset_of
from hrc_learn.experiments.real_arm import ArmSite, Task, run_on_arm, task_of
from hrc_learn.hardware import CaptureCamera
from hrc_learn.kinematics import ArmChoice
from hrc_learn.sim import CameraChange, CameraKind, Imperfections
from hrc_learn.sim.scene import UnmarkedLook
from hrc_learn.sim.workplace import Workplace
from hrc_learn.store import read_json, read_toml, write_json
from hrc_learn.teleoperation.page import PageConfig
from hrc_learn.viz.report import show_command, software_versions

MODELS = Path("outputs/demo")
"""Folder of the demo, whose models are used if none are given."""
_APPLIES: dict[str, list[str]] = read_toml(Path(__file__).with_name("option_experiments.toml"))
"""Experiments to which each option applies."""
_SIMULATED = (
    *("robot", "imperfections", "ideal", "seed", "trials", "markerless", "serve", "page"),
    *("pulls", "camera_moved", "worker", "handover"),
)


@dataclass(frozen=True, kw_only=True)
class _Settings:
    """Settings of the experiment and of a real arm."""

    experiment: Experiment[Any]
    site: ArmSite = field(default_factory=ArmSite)
    processes: int = 1
    """Processes that run the trials."""
    film: bool = True
    """True to make a film of the run."""


def run(args: Run) -> int:
    """Run an experiment, in simulation or on a real arm."""
    folder = args.out or Path("outputs") / args.experiment
    args = replace(args, out=folder)
    refuse_of_others(args, _APPLIES, args.experiment, "hrc run")
    refuse_existing(folder, args.overwrite)
    is_real = args.drives_real_arm(_SIMULATED)
    if args.experiment == "placing":
        if not is_real:
            refuse_given(args, ["shelf"], "of placing is for a real arm: all are simulated")
        elif len(args.shelf) != 1:
            raise ValueError("hrc run placing places one object: give one --shelf")
    if args.arm == "lerobot":
        raise ValueError(
            "hrc run does not support --arm lerobot: use hrc page to guide the arm, or hrc "
            "play for the motion of a model."
        )
    options = RunOptions(
        out=folder,
        seed=args.seed,
        trials=args.trials,
        serve=args.serve,
        overwrite=args.overwrite,
        json=args.json,
    )
    experiment = _experiment(args, _models(args))
    settings = with_settings(args.config, _Settings(experiment=experiment))
    if is_real:
        task = task_of(settings.experiment, args.shelf[0])
        return _run_on_arm(args, folder, settings.site, *task)
    options = replace(options, processes=settings.processes, film=settings.film)
    return run_experiment(settings.experiment, options, command=command_line())


def _experiment(args: Run, models: dict[str, Path]) -> Experiment[Any]:
    common: dict[str, Any] = {
        "imperfections": _imperfections(args),
        "arm": args.arm,
        "robot": ArmChoice(args.robot),
    }
    if args.experiment == "placing":
        demonstrations = dataset_of(models["placing"]).resolve()
        return PlacingExperiment(**models, demonstrations=demonstrations, **common)
    common |= {
        "camera": _simulated_camera(args),
        "page": PageConfig() if args.page else None,
        "look": UnmarkedLook() if args.markerless else None,
    }
    if args.experiment == "grasping":
        return GraspingExperiment(**models, **common)
    return CollaborationExperiment(
        shelves=args.shelf,
        pulls=_possible_pulls(args),
        worker=args.worker,
        handover=args.handover,
        disturbances=Disturbances(camera_change=CameraChange() if args.camera_moved else None),
        **models,
        **common,
    )


def _possible_pulls(args: Run) -> Pulls:
    """Pulls at the elbow, or none if the arm has no null space."""
    if args.pulls == "none" or args.drives_real_arm():
        return args.pulls
    robot = ArmChoice(args.robot).work_arm()
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


def _run_on_arm(
    args: Run, folder: Path, site: ArmSite, workplace: Workplace, task: Task
) -> int:
    """Carry out a task on a real arm and store its run; exit status 1 if it failed."""
    console = Console()
    site = replace(site, driver=args.arm, ip=args.ip)
    with ExitStack() as stack:
        camera = None
        if args.experiment != "placing":
            source = "0" if args.camera == "auto" else args.camera
            opened = CaptureCamera(source, delay=site.camera_delay)
            camera = stack.enter_context(closing(opened))
        done = run_on_arm(
            site,
            workplace,
            task,
            camera=camera,
            on_phase=lambda phase, time: console.print(f"  {time:6.2f} s  {phase}"),
        )
    done.save(folder, f"{args.arm} at {args.ip or 'its topics'}", asdict(args))
    console.print(done.failure or "done", style="red" if done.failure else "green")
    print(f"Dashboard: {show_command(folder)}")
    failed = int(bool(done.failure))
    write_values(args.json, {"duration_s": done.duration, "failed": failed})
    return failed


def _models(args: Run) -> dict[str, Path]:
    """Models that the experiment needs; by default those of the demo, learned if missing."""
    defaults = {"placing": MODELS / "placing", "aiming": MODELS / _aiming(args.markerless)}
    needed = {k: v for k, v in defaults.items() if args.experiment in _APPLIES[k]}
    if any(getattr(args, k) is None and not v.is_dir() for k, v in needed.items()):
        if args.robot != "panda":
            raise ValueError(
                f"no model is given, and those in {MODELS} are for the Panda: learn others "
                f"by `hrc demo --robot {args.robot} --out FOLDER`, and name them as options."
            )
        console = Console()
        console.print(f"note: no model is given or found in {MODELS}: models are learned first")
        learn(MODELS, console, markerless=args.markerless)
    return {k: (getattr(args, k) or v).resolve() for k, v in needed.items()}


def _aiming(markerless: bool) -> str:
    """Folder of the demo's visual-servoing skill."""
    return "aiming_markerless" if markerless else "aiming"


def demo(args: Demo) -> int:
    """Carry out the whole job, command after command in one process."""
    console, markerless = Console(), args.markerless
    learn(args.out, console, 5, robot=args, again=args.overwrite, markerless=markerless)
    write_json(args.out / "configuration.json", asdict(args))
    _announce(console, 5, 5, "Grasping near a person, carrying, placing")
    return run(
        Run(
            experiment="collaboration",
            placing=args.out / "placing",
            aiming=args.out / _aiming(markerless),
            markerless=markerless,
            shelf=(args.shelf,),
            robot=args.robot,
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
    markerless: bool = False,
) -> None:
    """Record demonstrations of placing and servoing, and learn from them.

    A step is repeated if its options, the folders that it reads, the code of this package, the
    versions of the libraries or its result have changed.

    Args:
        out: Folder for `placing_demos`, `aiming_demos` and the models `placing`, `aiming`,
            which are replaced; if `markerless`, for `aiming_films` and `aiming_markerless`
            instead of `aiming_demos` and `aiming`.
        console: Console for the progress.
        steps: Number of steps to print, including those of the caller.
        robot: Options that choose the arm. Default: the Panda.
        again: Repeat every step.
        markerless: Film the demonstrations of servoing, and find tool and object in the film.

    Raises:
        RuntimeError: The scripted expert fails.
    """
    robot, done = robot or WithRobot(), {}
    ledger = out / "steps.json"
    with suppress(OSError, ValueError):
        done = read_json(ledger)
    package, file = Path(__file__).parents[1], Path(robot.robot.partition(":")[0])
    code = [_digest(package, kind) for kind in ("*.py", "*.toml")]
    made_of = [software_versions(), *code, robot.robot]
    if file.is_file():
        made_of.append(hashlib.sha256(file.read_bytes()).hexdigest())
    for number, (title, work, folders) in enumerate(_learning_steps(out, robot, markerless), 1):
        name, digest = folders[-1].name, [*made_of, *map(_digest, folders)]
        if not again and done.get(name) == digest:
            _announce(console, number, steps, f"{title}: up to date in {folders[-1]}")
            continue
        _announce(console, number, steps, title)
        work()
        done[name] = [*made_of, *map(_digest, folders)]
        write_json(ledger, done)


def _digest(folder: Path, pattern: str = "*") -> str:
    """Checksum of the names and contents of all files in a folder that match a pattern."""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob(pattern) if path.is_file()):
        name = path.relative_to(folder).as_posix()
        digest.update(f"{name}\0{path.stat().st_size}\0".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _learning_steps(
    out: Path, robot: WithRobot, markerless: bool
) -> Iterator[tuple[str, Callable[[], object], list[Path]]]:
    """Title and work of each step, and its folders: those that it reads, then the one that it
    writes.
    """
    from hrc_learn.cli.fit_command import fit_primitives
    from hrc_learn.cli.image_jacobian_commands import fit_image_jacobian
    from hrc_learn.cli.record_command import record

    def demonstrate(scenario: Any, folder: Path, *config: str) -> None:
        chosen = {"robot": robot.robot, "overwrite": True, "config": config}
        if record(Record(demonstration=scenario, out=folder, **chosen)):
            raise RuntimeError(f"the scripted expert failed to demonstrate {scenario}")

    shown, placing, aiming = out / "placing_demos", out / "placing", out / _aiming(markerless)
    watched = out / ("aiming_films" if markerless else "aiming_demos")
    film = ("demonstration.markerless=true",) if markerless else ()
    primitives = FitPrimitives(dataset=shown, out=placing, overwrite=True)
    jacobian = FitImageJacobian(
        dataset=watched, out=aiming, overwrite=True, markerless=markerless
    )
    title = "Demonstrations of servoing with an uncalibrated camera"
    yield "Demonstrations of placing", lambda: demonstrate("placing", shown), [shown]
    yield title, lambda: demonstrate("servoing", watched, *film), [watched]
    yield "Movement primitives of placing", lambda: fit_primitives(primitives), [shown, placing]
    yield "Image Jacobian of servoing", lambda: fit_image_jacobian(jacobian), [watched, aiming]


def _announce(console: Console, step: int, steps: int, title: str) -> None:
    console.print(f"\\[{step}/{steps}] {title}", style="bold", highlight=False, soft_wrap=True)
