"""Test `hrc multiply` on expert demonstrations of MetaWorld, judged by MetaWorld.

Five episodes of a scripted expert become a LeRobot dataset with the Sawyer's joints, its hand,
the object and the goal, written by LeRobot. `hrc multiply` makes episodes for new scenes
without physics. Their actions are executed in MetaWorld, which decides on success. The baseline
solves the same scenes by MimicGen's method (Mandlekar et al. 2023): each segment of one
demonstration's commands is moved with its object or the goal, and a straight line leads to its
start; the first segment ends when the object moves. Jerk is that of the commanded positions of
the hand. Needs tools/make_environments.sh.

    .venv-environments/bin/python benchmarks/bench_multiply_public.py --task pick-place-v3 \
        --out outputs/metaworld --json outputs/metaworld.json
"""

import json
from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pyarrow.parquet as pq
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from public_tasks.metaworld import FPS, MetaWorld, _observation
from public_tasks.protocol import AGENT_POS, ENVIRONMENT_STATE, Observation
from scipy.stats import binomtest

from hrc_learn import cli
from hrc_learn.cli.arguments import Multiply
from hrc_learn.cli.multiply_command import Multiplication, Settings, multiply
from hrc_learn.learning.multiply_motions import POSITION_ONLY

JOINTS = tuple(f"right_j{k}" for k in range(7))
HAND = ("ee.x", "ee.y", "ee.z")
STILL = 20
"""Number of frames for which the expert continues after its success."""
MOVED = 0.01
"""Displacement above which an object counts as grasped [m]."""
APART = 0.15
"""Smallest distance between object and goal in MetaWorld's initial scenes [m]."""


@dataclass(frozen=True, kw_only=True)
class Args:
    out: Path
    """Folder for the demonstrations and the new episodes."""
    task: str = "pick-place-v3"
    """A task of MetaWorld with one object and a goal."""
    demonstrations: int = 5
    """Successful episodes of the expert."""
    attempts: int = 100
    """Number of motions of each method."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> None:
    task = MetaWorld(args.task)
    shown, made = args.out / "demonstrations", args.out / "multiplied"
    if not shown.exists():
        record(task, args.task, shown, args.demonstrations)
    command = Multiply(dataset=shown, episodes=args.attempts, out=made)
    if not made.exists() and multiply(command):
        raise SystemExit(1)
    job = Multiplication(command, Settings())
    ours, reasons = written(made, args.attempts)
    draws = job.draw(range(args.attempts))
    by_expert = actions_of(shown)
    theirs = {k: rigid(job, draws, k, by_expert) for k in range(args.attempts)}
    scenes = {
        k: np.concatenate([draws.scene[name].position[k] for name in ("object", "goal")])
        for k in range(args.attempts)
    }
    # MetaWorld has no such scenes.
    possible = [k for k, s in scenes.items() if np.linalg.norm(s[:2] - s[3:5]) >= APART]
    figures: dict[str, float] = {"attempts": len(possible)}
    for name, actions in (("primitives", ours), ("rigid", theirs)):
        done = sum(k in actions and succeeds(task, scenes[k], actions[k]) for k in possible)
        low, high = binomtest(done, len(possible)).proportion_ci(method="wilson")
        jerks = [
            np.diff(actions[k][:, :3], n=3, axis=0) * FPS**3 for k in possible if k in actions
        ]
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


def record(task: MetaWorld, name: str, folder: Path, count: int) -> None:
    """Record episodes of the expert as a dataset, written by LeRobot."""
    things = [f"object.{axis}" for axis in ("x", "y", "z", "qw", "qx", "qy", "qz")]
    names = {
        "observation.state": [*(f"{joint}.pos" for joint in JOINTS), *HAND, "gripper.pos"],
        "observation.environment_state": [*things, "goal.x", "goal.y", "goal.z"],
        "action": [*HAND, "gripper.pos"],
    }
    features = {
        key: {"dtype": "float32", "shape": (len(each),), "names": each}
        for key, each in names.items()
    }
    dataset = LeRobotDataset.create(
        "local/metaworld", int(FPS), features, folder, robot_type="sawyer", use_videos=False
    )
    seed, kept = 0, 0
    while kept < count:
        frames = demonstrated(task, seed)
        seed += 1
        if frames is None:
            continue
        for frame in frames:
            dataset.add_frame({**frame, "task": name})
        dataset.save_episode()
        kept += 1
    dataset.finalize()


def demonstrated(task: MetaWorld, seed: int) -> list[dict[str, Any]] | None:
    """Frames of one episode of the expert; None: it fails."""
    seen, frames, left = task.begin(seed), [], None
    task.expert.begin()
    while left != 0:
        if len(frames) == task.longest:
            return None
        action = task.expert.act(seen)
        frames.append({**shown(task, seen), "action": action.astype(np.float32)})
        seen, done = task.step(action)
        left = STILL if done and left is None else left if left is None else left - 1
    return frames


def shown(task: MetaWorld, seen: Observation) -> Observation:
    """Observations of the dataset: joints, hand and gripper; object (scalar first) and goal."""
    joints = [float(task._env.data.joint(joint).qpos[0]) for joint in JOINTS]
    things = seen[ENVIRONMENT_STATE]
    return {
        "observation.state": np.array([*joints, *seen[AGENT_POS]], np.float32),
        "observation.environment_state": things[[0, 1, 2, 6, 3, 4, 5, -3, -2, -1]],
    }


class Judge:
    """A task of MetaWorld for `hrc multiply --judge`.

    An episode ends some frames after its first success, as the demonstrations do.
    """

    metadata: ClassVar = {"render_fps": FPS}

    def __init__(self, name: str):
        self._task, self._left = MetaWorld(name), STILL

    def reset(self, *, seed: int, options: dict[str, Any]) -> tuple[Observation, dict]:
        """Begin with object and goal in their places; everything else is always the same."""
        self._left = STILL
        scene = np.concatenate([options["objects"][name][:3] for name in ("object", "goal")])
        if np.linalg.norm(scene[:2] - scene[3:5]) < APART:
            return {}, {"failure": "MetaWorld puts no object so near to the goal"}
        return shown(self._task, placed(self._task, scene)), {}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict]:
        """Execute an action."""
        seen, done = self._task.step(action)
        done = done or self._left < STILL
        self._left -= done
        return shown(self._task, seen), float(done), self._left < 0, False, {"success": done}


pick_place = partial(Judge, "pick-place-v3")
push = partial(Judge, "push-v3")
coffee_push = partial(Judge, "coffee-push-v3")
shelf_place = partial(Judge, "shelf-place-v3")


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


def succeeds(task: MetaWorld, scene: np.ndarray, actions: np.ndarray) -> bool:
    """True if MetaWorld reports success while the actions are executed."""
    placed(task, scene)
    return any(task.step(action)[1] for action in actions)


def placed(task: MetaWorld, scene: np.ndarray) -> Observation:
    """First observation of an episode with object and goal at given positions [m]."""
    env = task._env
    # An object that lies on the table has the height that MetaWorld gives it.
    space = env._random_reset_space
    height = (space.low[2] + space.high[2]) / 2
    env._last_rand_vec = np.array([*scene[:2], height, *scene[3:]])
    env._freeze_rand_vec = True
    return _observation(env.reset()[0])


if __name__ == "__main__":
    cli.run(main, Args)
