"""`hrc record`: demonstrations by a scripted expert, in simulation."""

import sys
from collections.abc import Iterator

import numpy as np
from rich.progress import Progress, track

from hrc_learn.cli._options import resolved
from hrc_learn.cli._run import configuration, leads_real_arm, write_values
from hrc_learn.cli.arguments.record import RecordExpert, RecordPlacing, RecordServoing
from hrc_learn.experiments.arm_access import access_by
from hrc_learn.kinematics import Arm, ArmChoice
from hrc_learn.sim import PhysicsError, World, open_camera
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.failures import TaskFailedError
from hrc_learn.skills.marker_sensor import MarkerSensor
from hrc_learn.skills.visual_skill import (
    ANGLE_FEATURE,
    ANGLE_FEATURE_NAMES,
    OBJECT_FEATURE,
    OBJECT_FEATURE_NAMES,
)
from hrc_learn.teleoperation.hand_guiding import Frame
from hrc_learn.teleoperation.scripted_demonstrations import (
    OpenArm,
    demonstrate_placing_without_contact,
    demonstrate_servoing,
    write_demonstrations,
)


def record_placing(args: RecordPlacing) -> int:
    """Paired demonstrations of placing."""
    args = resolved(args)
    if args.episodes < 1:
        raise ValueError(f"--episodes must be at least 1, but is {args.episodes}.")
    robot = ArmChoice(args.robot, args.base, args.tip).work_arm()
    open_arm = _opening(args, robot)
    workplace = Workplace.of(robot)
    goal = workplace.shelf(args.shelf).position.numpy()
    world = World(workplace.scene)
    rng = np.random.default_rng(args.seed)
    thrown_away, errors = [], []

    def demonstrations() -> Iterator[list[Frame]]:
        for _ in track(range(args.episodes), description="Placing demonstrations"):
            frames, thrown = demonstrate_placing_without_contact(
                world, workplace, args.shelf, args.demonstration, rng, open_arm
            )
            thrown_away.append(thrown)
            errors.append(float(np.linalg.norm(frames[-1]["position"] - goal)))
            yield frames

    try:
        write_demonstrations(
            args.out,
            demonstrations(),
            f"place the box on the {args.shelf} shelf",
            args.demonstration.fps,
            details={
                "shelf": args.shelf,
                "scene": "hrc_learn workplace",
                "recorded with": configuration(args),
            },
            overwrite=args.overwrite,
            robot=robot,
        )
    except (TaskFailedError, PhysicsError) as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1
    print(f"{args.episodes} demonstrations in {args.out} ({sum(thrown_away)} discarded)")
    values = {
        "episodes": args.episodes,
        "thrown_away": sum(thrown_away),
        "final_error_mm_max": 1e3 * max(errors),
    }
    write_values(args.json, values)
    return 0


def record_servoing(args: RecordServoing) -> None:
    """Demonstrations of visual servoing with an uncalibrated camera."""
    args = resolved(args)
    if args.episodes < 1:
        raise ValueError(f"--episodes must be at least 1, but is {args.episodes}.")
    robot = ArmChoice(args.robot, args.base, args.tip).work_arm()
    open_arm = _opening(args, robot)
    workplace = Workplace.of(robot)
    world = World(workplace.scene)
    rng = np.random.default_rng(args.seed)
    sensor = MarkerSensor(open_camera(world, args.camera, rng=rng), workplace.scene.marker_ids)
    seen = []

    def demonstrations() -> Iterator[list[Frame]]:
        for _ in track(range(args.episodes), description="Servoing demonstrations"):
            frames = demonstrate_servoing(
                world, workplace, sensor, args.demonstration, rng, open_arm
            )
            seen.append(float(np.mean([bool(frame["feature_visible"]) for frame in frames])))
            yield frames

    write_demonstrations(
        args.out,
        demonstrations(),
        "servo to the box",
        args.demonstration.fps,
        features={OBJECT_FEATURE: OBJECT_FEATURE_NAMES, ANGLE_FEATURE: ANGLE_FEATURE_NAMES},
        details={"scene": "hrc_learn workplace", "recorded with": configuration(args)},
        overwrite=args.overwrite,
        robot=robot,
    )
    print(f"{args.episodes} demonstrations in {args.out}, marker seen {100 * min(seen):.0f} %")
    write_values(args.json, {"episodes": args.episodes, "marker_seen_min": min(seen)})


def _opening(args: RecordPlacing | RecordServoing, robot: Arm) -> OpenArm:
    """How the scripted expert's arm is led.

    Raises:
        ValueError: It is a real one, or not the driver's.
    """
    if leads_real_arm(args):
        raise ValueError(
            f"--ip {args.ip}: a scripted expert demonstrates in simulation only. Lead the real "
            f"arm yourself: hrc page --arm {args.arm} --ip {args.ip}."
        )
    return access_by(args.arm, robot).open


def record_expert(args: RecordExpert) -> int:
    """The same expert on LeRobot's simulated arm."""
    from hrc_learn.lerobot.expert_recording import record_expert as recorded
    from hrc_learn.lerobot.robots import MujocoArmRobotConfig

    if args.episodes < 1:
        raise ValueError(f"--episodes must be at least 1, but is {args.episodes}.")
    if args.out.exists():
        raise FileExistsError(f"there is something at {args.out}: give another folder.")
    config = MujocoArmRobotConfig(
        arm=args.robot,
        base=args.base,
        tip=args.tip,
        scenario=args.scenario,
        shelf=args.shelf,
        fps=float(args.fps),
        action_space=args.action_space,
        pixels=args.pixels and args.scenario == "grasping",
        marker=args.marker,
        hand=args.marker,
        seed=args.seed,
    )
    failed = 0
    try:
        with Progress(transient=True) as progress:
            shown = progress.add_task(f"Demonstrations of {args.scenario}", total=args.episodes)
            for written, succeeded in recorded(args.out, config, args.episodes):
                failed += not succeeded
                progress.update(shown, completed=written)
    except RuntimeError as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1
    print(f"{args.episodes} demonstrations in {args.out} ({failed} discarded)")
    write_values(args.json, {"episodes": args.episodes, "thrown_away": failed})
    return 0
