"""`hrc play`: the motion of a fitted model to a new goal."""

import sys
from collections.abc import Sequence
from dataclasses import asdict
from io import StringIO
from pathlib import Path

import numpy as np
import torch
from rich.console import Console

from hrc_learn.cli._run import refuse_existing, write_values
from hrc_learn.cli.arguments import Play
from hrc_learn.cli.model_commands import as_fitted, fitted_from
from hrc_learn.demos import DatasetWriter, open_demos
from hrc_learn.experiments.run_recorder import film
from hrc_learn.kinematics import Arm, UnreachableError
from hrc_learn.kinematics.drawing import arm_bodies
from hrc_learn.learning.fitted_model import FittedModel, Target, arm_for
from hrc_learn.learning.motion_playing import (
    DT,
    BeyondLimitsError,
    PlayedMotion,
    play_on_arm,
    play_path,
)
from hrc_learn.log import JointRanges, RunRecording
from hrc_learn.store import new_folder, write_json, write_text
from hrc_learn.viz.report import show_command
from hrc_learn.viz.run_dashboard import record_run

_ERRORS = {
    "goal_position_error_mm": "{:.1f} mm from the goal",
    "goal_turn_error_deg": "{:.1f} deg from the goal's orientation",
    "goal_joint_error": "joints at most {:.2g} from the goal",
}
_POSE = ("x [m]", "y [m]", "z [m]", "qw", "qx", "qy", "qz")


def play(args: Play) -> int:
    """Write the motion of a model to a goal; exit status 1 if the arm cannot follow it.

    Raises:
        FileNotFoundError: There is no model.
        ValueError: The goal or the arm does not fit the model.
    """
    if not args.model.is_dir():
        raise FileNotFoundError(f"there is no model at {args.model}")
    refuse_existing(args.folder, args.overwrite)
    model = FittedModel.load(args.model)
    goal = _target(model, args.goal, "--goal")
    start = _target(model, args.start, "--start") if args.start else None
    robot = arm_for(model, args.robot) if args.robot else None
    try:
        with Console().status("Playing"):
            if robot is None:
                motion = play_path(model, start, goal, args.duration)
            else:
                motion = play_on_arm(model, robot, start, goal, args.duration)
    except (BeyondLimitsError, UnreachableError) as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1
    figures = _figures(motion)
    writing = Console().status(f"Writing {args.folder}")
    with new_folder(args.folder, asdict(args), args.overwrite) as folder, writing:
        write_text(folder / "motion.csv", _table(model, robot, motion))
        write_json(folder / "metrics.json", figures)
        if robot is not None:
            _write_episode(folder / "episode", args, robot, motion)
            run = _recording(args, robot, motion)
            record_run(folder / "run.rrd", run)
            (folder / "film.mp4").write_bytes(film(run).mp4)
    _report(args, robot, motion)
    write_values(args.json, figures)
    return 0


def _target(model: FittedModel, words: Sequence[str], option: str) -> Target:
    """Start or goal, given as numbers or as an episode of the demonstrations."""
    if not words:
        raise ValueError(f"{option} is empty: give numbers, or the word episode and its number")
    if words[0] != "episode":
        return model.target(words, option)
    try:
        (episode,) = map(int, words[1:])
    except ValueError:
        raise ValueError(f"{option} episode needs one number, such as: episode 2") from None
    made_by = fitted_from(model.folder)
    (demo,) = open_demos(made_by["dataset"], episodes=[episode], **as_fitted(made_by))
    row = 0 if option == "--start" else -1
    columns = {
        "joints": demo.joint_position if model.joint is not None else None,
        "position": demo.position,
        "orientation": demo.orientation,
    }
    values = {k: torch.from_numpy(x[row].copy()) for k, x in columns.items() if x is not None}
    if "joints" in values:
        names = [name.removesuffix(".pos") for name in demo.joint_names]
        values = {"joints": values["joints"][[names.index(n) for n in model.joint_names]]}
    if "joints" not in values and "position" not in values:
        raise ValueError(f"{option}: episode {episode} has neither joints nor positions.")
    return Target(**values)


def _figures(motion: PlayedMotion) -> dict[str, float]:
    return {
        "duration_s": float(motion.time[-1]),
        "planned_duration_s": motion.planned_duration,
        "samples": float(len(motion.time)),
        "path_deviation_rad": motion.deviation,
        **motion.goal_errors,
    }


def _table(model: FittedModel, robot: Arm | None, motion: PlayedMotion) -> str:
    """Motion as comma-separated values with a line of names and units."""
    names, columns = ["time [s]"], [motion.time[:, None]]
    if motion.joints is not None:
        joint = model.joint
        unit = "rad" if robot is not None or joint is None else joint.units
        joints = model.joint_names if robot is None else robot.chain.joint_names
        names += [f"{name} [{unit}]" for name in joints]
        columns.append(motion.joints)
    for values, labels in ((motion.position, _POSE[:3]), (motion.orientation, _POSE[3:])):
        if values is not None:
            names += labels
            columns.append(values)
    text = StringIO()
    rows, heads = np.concatenate(columns, axis=1), ",".join(names)
    np.savetxt(text, rows, "%.9g", ",", header=heads, comments="")
    return text.getvalue()


def _write_episode(folder: Path, args: Play, robot: Arm, motion: PlayedMotion) -> None:
    """Write the motion as a LeRobot dataset of one episode; actions are the next positions."""
    assert motion.joints is not None
    assert motion.position is not None
    assert motion.orientation is not None
    following = np.concatenate([motion.joints[1:], motion.joints[-1:]])
    with DatasetWriter.of(robot, folder, round(1 / DT)) as writer:
        writer.start_episode(f"played {args.model.name}")
        columns = motion.joints, motion.position, motion.orientation, following
        for q, p, R, sent in zip(*columns, strict=True):
            writer.add_frame(joint_position=q, position=p, orientation=R, command_position=sent)
        writer.save_episode()


def _recording(args: Play, robot: Arm, motion: PlayedMotion) -> RunRecording:
    assert motion.joints is not None
    assert motion.position is not None
    return RunRecording(
        title=f"{args.model.name} played by {robot.name}",
        time=motion.time,
        joint_names=robot.chain.joint_names,
        joint_position=motion.joints,
        joint_velocity=np.gradient(motion.joints, DT, axis=0),
        joint_limits=JointRanges.of(robot.limits),
        position=motion.position,
        plan_path=motion.position,
        bodies=arm_bodies(robot, motion.joints),
    )


def _report(args: Play, robot: Arm | None, motion: PlayedMotion) -> None:
    lasts = float(motion.time[-1])
    said = [_ERRORS[name].format(error) for name, error in motion.goal_errors.items()]
    print(f"{lasts:.2f} s, {', '.join(said)}")
    if robot is None:
        print("note: without --robot no limits are checked; motion.csv has the model's path")
    elif motion.slowed_by:
        print(
            f"note: {lasts:.2f} s instead of {motion.planned_duration:.2f} s, because the "
            f"{motion.slowed_by} would be beyond its limit"
        )
    print(f"Motion in {args.folder}")
    if robot is not None:
        print(f"Dashboard: {show_command(args.folder)}")
