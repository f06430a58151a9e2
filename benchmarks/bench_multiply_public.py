"""Test `hrc multiply` on expert demonstrations of public tasks, judged by the task.

Five episodes of a scripted expert become a LeRobot dataset with the arm's joints, its hand, the
object and the goal, written by LeRobot. `hrc multiply` makes episodes for new scenes without
physics. Their actions are executed in the task, which decides on success. The baseline
solves the same scenes by MimicGen's method (Mandlekar et al. 2023): each segment of one
demonstration's commands is moved with its object or the goal, and a straight line leads to its
start; the first segment ends when the object moves. Jerk is that of the commanded positions of
the hand. Needs tools/make_environments.sh.

    .venv-environments/bin/python benchmarks/bench_multiply_public.py --task metaworld-push \
        --out outputs/metaworld --json outputs/metaworld.json
"""

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from public_tasks.multiplied import STAGES, Scene, Stage
from scipy.stats import binomtest

from hrc_learn import cli
from hrc_learn.cli.arguments import Multiply
from hrc_learn.cli.multiply_command import Multiplication, Settings, multiply
from hrc_learn.learning.multiply_motions import POSITION_ONLY

MOVED = 0.01
"""Displacement above which an object counts as grasped [m]."""


@dataclass(frozen=True, kw_only=True)
class Args:
    out: Path
    """Folder for the demonstrations and the new episodes."""
    task: str = "metaworld-pick-place"
    """A task in public_tasks/multiplied.py."""
    demonstrations: int = 5
    """Successful episodes of the expert."""
    attempts: int = 100
    """Number of motions of each method."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> None:
    stage = STAGES[args.task]()
    shown, made = args.out / "demonstrations", args.out / "multiplied"
    if not shown.exists():
        stage.record(shown, args.demonstrations, args.task)
    command = Multiply(dataset=shown, episodes=args.attempts, out=made)
    if not made.exists() and multiply(command):
        raise SystemExit(1)
    job = Multiplication(command, Settings())
    ours, reasons = written(made, args.attempts)
    draws = job.draw(range(args.attempts))
    by_expert = actions_of(shown)
    theirs = {k: rigid(job, draws, k, by_expert) for k in range(args.attempts)}
    scenes = [
        {name: pose.position[k].numpy() for name, pose in draws.scene.items()}
        for k in range(args.attempts)
    ]
    possible = [k for k, scene in enumerate(scenes) if not stage.refusal(scene)]
    figures: dict[str, float] = {"attempts": len(possible)}
    for name, actions in (("primitives", ours), ("rigid", theirs)):
        done = sum(k in actions and succeeds(stage, scenes[k], actions[k]) for k in possible)
        low, high = binomtest(done, len(possible)).proportion_ci(method="wilson")
        paths = [actions[k][:, :3] for k in possible if k in actions]
        jerks = [np.diff(path, n=3, axis=0) * stage.task.fps**3 for path in paths]
        figures |= {
            f"{name}_successes": done,
            f"{name}_success_low": low,
            f"{name}_success_high": high,
            f"{name}_jerk_rms": float(np.median([(j**2).mean() ** 0.5 for j in jerks])),
        }
    print("left out before:", dict(Counter(reasons)))
    for name, value in figures.items():
        print(f"{name:32} {value:10.4g}")
    cli.write_values(args.json, figures)


def actions_of(folder: Path) -> dict[int, np.ndarray]:
    """Actions of a dataset by episode."""
    rows = pq.read_table(sorted(folder.glob("data/*/*.parquet")))
    episode = rows.column("episode_index").to_numpy()
    actions = np.stack(rows.column("action").to_numpy())
    return {int(k): actions[episode == k] for k in np.unique(episode)}


def written(folder: Path, attempts: int) -> tuple[dict[int, np.ndarray], list[str]]:
    """Actions of the written episodes by attempt, and the reasons of the failed attempts."""
    listed = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet")
    origins = [json.loads(text) for text in listed.column("provenance").to_pylist()]
    actions = actions_of(folder)
    made = {origin["attempt"]: actions[k] for k, origin in enumerate(origins)}
    failed = {int(k): reason for o in origins for k, reason in o["failed"].items()}
    return made, [reason for k, reason in failed.items() if k < attempts]


def rigid(
    job: Multiplication, draws: Any, k: int, actions: dict[int, np.ndarray]
) -> np.ndarray:
    """Actions of motion k by rigid segments and straight lines."""
    main = int(draws.weights[k].argmax())
    demo = job.demos[main]
    shown, cuts = actions[demo.episode], job.segmentation.cuts[demo.episode]
    if len(cuts) == 3:  # MimicGen's segment of a grasp ends when the object has been grasped
        at = np.asarray(demo.extra["observation.environment_state"])[:, :3]
        moved = np.linalg.norm(at - at[0], axis=1) > MOVED
        cuts = (cuts[0], int(moved.argmax()), cuts[2])
    assert demo.position is not None
    made = [np.append(demo.position[0] + draws.start[k].numpy(), shown[0, 3])]
    for number, frame in enumerate(job.segmentation.frames):
        part = shown[cuts[number] : cuts[number + 1] + 1].copy()
        if name := frame.removesuffix(POSITION_ONLY) * (frame != "base"):
            part[:, :3] += (
                draws.scene[name].position[k] - job.objects[name].position[main]
            ).numpy()
        speed = np.linalg.norm(np.diff(part[:, :3], axis=0), axis=1).mean()
        steps = int(np.ceil(np.linalg.norm(part[0, :3] - made[-1][:3]) / max(speed, 1e-3)))
        for step in range(1, steps):
            at = made[-step][:3] + (part[0, :3] - made[-step][:3]) * step / steps
            made.append(np.append(at, made[-1][3]))
        made += [*part]
    return np.stack(made)


def succeeds(stage: Stage, scene: Scene, actions: np.ndarray) -> bool:
    """True if the task reports success while the actions are executed."""
    stage.placed(scene)
    return any(stage.task.step(action)[1] for action in actions)


if __name__ == "__main__":
    cli.run(main, Args)
