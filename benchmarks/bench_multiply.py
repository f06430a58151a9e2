"""Compare `hrc multiply` with rigid segments joined by straight lines, and replay its episodes.

Both methods use the same demonstrations, scenes, arm, limits and judge. The baseline is that of
MimicGen (Mandlekar et al. 2023): each segment of one demonstration is moved rigidly with its
object, and a straight line at the demonstrated mean speed joins the tool's position with the
start of the segment. Jerk is that of the planned joint positions. `--replay` executes the
actions of a dataset without code of `hrc multiply`: actions from Parquet files, MuJoCo's
servos, success by the height of the object and the contacts of both fingers.

    bench_multiply.py --dataset five --attempts 50 --json outputs/multiply.json
    bench_multiply.py --dataset five --replay thousand --attempts 200
"""

import json
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
import pyarrow.parquet as pq
import torch

from hrc_learn import cli
from hrc_learn.cli.arguments import Multiply
from hrc_learn.cli.multiply_command import Multiplication, ObjectConfig, Settings
from hrc_learn.experiments.motion_judge import JudgeConfig, Trial, judging
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics.inverse import follow_poses
from hrc_learn.learning.multiply_motions import Draws, frame_of
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.

LIFTED = 0.075
"""Smallest height to which a lifted object rises [m]: half of the demonstrated height."""


@dataclass(frozen=True, kw_only=True)
class Args:
    dataset: Path
    """Demonstrations of `hrc record expert --scenario grasping --config
    robot.object_pose=true`."""
    attempts: int = 50
    """Motions of each method, or episodes to replay."""
    replay: Path | None = None
    """Dataset whose actions are replayed instead."""
    robot: str = ""
    """Arm of the motions. Default: that of the demonstrations."""
    wide: float = 0.0
    """Increase of the ranges of the object's position on each side, as a fraction of the
    ranges."""
    yaw: float = 0.0
    """Largest rotation of the object about the vertical [rad]."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> None:
    job = Multiplication(
        Multiply(
            dataset=args.dataset, episodes=args.attempts, out=Path("unused"), robot=args.robot
        ),
        Settings(judge=JudgeConfig(processes=1)),
    )
    if args.wide or args.yaw:
        objects = {name: harder(pose, args) for name, pose in job.objects.items()}
        job.settings = replace(job.settings, objects=objects)
    if args.replay is not None:
        figures = replayed(job, args.replay, args.attempts)
    else:
        figures = compared(job, args.attempts)
    for name, value in figures.items():
        print(f"{name:32} {value:10.4g}")
    cli.write_values(args.json, figures)


def harder(shown: Pose, args: Args) -> ObjectConfig:
    """Scenes of a wider distribution than that of the demonstrations."""
    low, high = shown.position.amin(0), shown.position.amax(0)
    more = args.wide * (high - low)
    (x, y, _), (X, Y, _) = (low - more).tolist(), (high + more).tolist()
    return ObjectConfig(x=(x, X), y=(y, Y), yaw=(-args.yaw, args.yaw))


def compared(job: Multiplication, attempts: int) -> dict[str, float]:
    """Generation rate and jerk of both methods."""
    draws = job.draw(range(attempts))
    made = job.motions.motions(draws)
    ours = [(job.trial(draws, motion, k), motion.reason) for k, motion in enumerate(made)]
    theirs = [rigid(job, draws, k) for k in range(attempts)]
    figures: dict[str, float] = {}
    fps = job.source.fps
    with judging(job.judge, job.choice, fps, 0.08) as judge:
        for name, trials in (("primitives", ours), ("rigid", theirs)):
            reasons = [reason or next(iter(judge([trial]))).failure for trial, reason in trials]
            jerks = [np.diff(trial.joints, n=3, axis=0) * fps**3 for trial, _ in trials]
            figures[f"{name}_success_rate"] = reasons.count("") / attempts
            figures[f"{name}_jerk_rms"] = float(
                np.median([(j**2).mean() ** 0.5 for j in jerks])
            )
            figures[f"{name}_jerk_peak"] = float(np.median([np.abs(j).max() for j in jerks]))
            print(name, Counter(reasons).most_common(5))
    for kind in ("rms", "peak"):
        ratio = figures[f"primitives_jerk_{kind}"] / figures[f"rigid_jerk_{kind}"]
        figures[f"jerk_{kind}_ratio"] = ratio
    return figures | {"attempts": attempts}


def rigid(job: Multiplication, draws: Draws, k: int) -> tuple[Trial, str]:
    """Motion k by rigid segments and straight lines."""
    main = int(draws.weights[k].argmax())
    demo, cuts = job.demos[main], job.segmentation.cuts[job.demos[main].episode]
    shown = torch.from_numpy(np.asarray(demo.joint_position))
    tool = job.robot.forward(shown)
    scene = {name: pose[k] for name, pose in draws.scene.items()}
    before = {name: pose[main] for name, pose in job.objects.items()}
    places, turns, gripper, wish = (
        [tool.position[0] + draws.start[k]],
        [tool.orientation[0]],
        [],
        [],
    )
    opening = job.columns.gripper(main, np.arange(len(demo), dtype=float))
    gripper.append(opening[0])
    wish.append(shown[0])
    for number, name in enumerate(job.segmentation.frames):
        part = slice(cuts[number], cuts[number + 1] + 1)
        here = tool[part]
        like = here[0]
        moved = frame_of(scene, name, like) @ frame_of(before, name, like).inverse() @ here
        distance = float((moved.position[0] - places[-1]).norm())
        speed = float(here.position.diff(dim=0).norm(dim=-1).mean()) * job.source.fps
        steps = int(np.ceil(distance / max(speed, 0.05) * job.source.fps))
        begin, turn = places[-1], turns[-1]
        for step in range(1, steps):
            places.append(torch.lerp(begin, moved.position[0], step / steps))
            turns.append(quaternion.slerp(turn, moved.orientation[0], step / steps))
            gripper.append(gripper[-1])
            wish.append(shown[part.start])
        places += [*moved.position]
        turns += [*moved.orientation]
        gripper += opening[part].tolist()
        wish += [*shown[part]]
    path = Pose(torch.stack(places), torch.stack(turns))
    q, error = follow_poses(job.robot, path, wish[0], torch.stack(wish))
    objects = {n: torch.cat([p.position, p.orientation]).numpy() for n, p in scene.items()}
    trial = Trial(joints=q.numpy(), gripper=np.array(gripper), objects=objects)
    return trial, "not reached" if float(error[3:].max()) > 1e-3 else ""


def replayed(job: Multiplication, dataset: Path, most: int) -> dict[str, float]:
    """Fraction of a dataset's episodes whose actions succeed when they are replayed."""
    scene = World(Workplace.of(job.robot).scene)
    model, item = scene.model, scene.config.objects[0].name
    data = mujoco.MjData(model)
    info = json.loads((dataset / "meta/info.json").read_text(encoding="utf-8"))
    names, steps = (
        info["features"]["action"]["names"],
        round(1 / info["fps"] / model.opt.timestep),
    )
    listed = pq.read_table(dataset / "meta/episodes/chunk-000/file-000.parquet")
    origins = [json.loads(text) for text in listed.column("provenance").to_pylist()]
    rows = pq.read_table(
        sorted(dataset.glob("data/*/*.parquet")), columns=["episode_index", "action"]
    )
    episode = rows.column("episode_index").to_numpy()
    actions = np.stack(rows.column("action").to_numpy())
    chosen = np.unique(np.linspace(0, len(origins) - 1, most).astype(int))
    size, placing, done = job.robot.hand_size, job.judge.scene == "placing", 0
    for k in chosen.tolist():
        own = actions[episode == k]
        joints = [name.removesuffix(".pos") for name in names[:-1]]
        servo = [model.actuator(f"{name}_position").id for name in joints]
        rate = [model.actuator(f"{name}_velocity").id for name in joints]
        fingers = [model.actuator(f"finger_{side}").id for side in ("left", "right")]
        mujoco.mj_resetData(model, data)
        data.qpos[[model.joint(name).qposadr[0] for name in joints]] = own[0, :-1]
        data.qpos[[model.joint(f"finger_{side}").qposadr[0] for side in ("left", "right")]] = (
            0.04 * size
        )
        pose = np.array([*origins[k]["scene"].values()])[0]
        data.joint(item).qpos[:] = pose
        if placing:
            scene.hold(item, own[0, :-1])
            data.qpos[:] = scene.data.qpos
        before = own[0, :-1]
        for action in own:
            for step in range(steps):
                data.ctrl[servo] = before + (action[:-1] - before) * (step + 1) / steps
                data.ctrl[rate] = (action[:-1] - before) * info["fps"]
                data.ctrl[fingers] = action[-1] / 2
                mujoco.mj_step(model, data)
            before = action[:-1]
        held = {
            model.geom(int(g)).name
            for pair in data.contact.geom
            for g in pair
            if model.geom(item).id in pair
        }
        pads = {"finger_left_pad", "finger_right_pad"} <= held
        lifted = data.body(item).xpos[2] - pose[2] > LIFTED * size
        rests = f"board_{job.judge.shelf}" in held and not pads
        done += bool(rests if placing else pads and lifted)
    return {"replayed": len(chosen), "replay_success_rate": done / len(chosen)}


if __name__ == "__main__":
    cli.run(main, Args)
