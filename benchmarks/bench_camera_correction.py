"""What a policy does after its camera was moved, with and without correcting what it sees.

`motion_chunk` learns from a dataset of

    hrc record expert --scenario grasping --marker --episodes 30 --out DATA

to grasp by the pixel of the object, and does so in MuJoCo from beginnings that were not shown:
with the camera where it was; moved by 10 cm and 10 degrees in random directions in which it
still sees the table; and the same with `add_camera_watch(..., correct=True)`. Each time it was
moved it is watched anew, so that in the first episode after that nothing is known of it before
the arm moves.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("HF_HUB_OFFLINE", "1")

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from bench_policies import ACTION, STATE, config_of, statistics, train
from rich.console import Console
from rich.table import Table

from hrc_learn import cli

FIRST_SEED = 50_000
"""Beginnings that were not shown: demonstrations count from 0."""


@dataclass(frozen=True, kw_only=True)
class Args:
    data: Path
    """Dataset of `hrc record expert --scenario grasping --marker`."""
    minutes: float = 1.0
    """CPU time of training."""
    moves: int = 10
    """Of the camera, in different directions."""
    episodes: int = 5
    """After each of them."""
    distance: float = 0.10
    """By which the camera is moved [m]."""
    angle: float = 10.0
    """By which it is turned [degrees]."""
    executed: int = 10
    """Actions of a chunk that are carried out before the policy looks again."""
    seed: int = 0
    """Of weights and batches."""
    json: Path | None = None
    """Receives all figures as one flat object."""


def main(args: Args) -> None:
    torch.set_num_threads(1)
    table = Table("camera", "grasped", "in the first episode after a move")
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        checkpoint = Path(folder)
        policy, after = _learn(checkpoint, args)
        rows: tuple[tuple[str, float, bool], ...] = (
            ("as it was", 0.0, False),
            ("moved", 1.0, False),
            ("moved, corrected", 1.0, True),
        )
        for name, size, correct in rows:
            grasped = _roll_out(policy, checkpoint, after, size, correct, args)
            first = sum(move[0] for move in grasped)
            every = sum(map(sum, grasped))
            count = args.moves * args.episodes
            table.add_row(name, f"{every} of {count}", f"{first} of {args.moves}")
            figures |= {f"{name}, grasped": every / count, f"{name}, first": first / args.moves}
            Console().print(f"{name}: {grasped}")
    Console().print(table)
    if args.json is not None:
        cli.write_json(args.json, figures)


def _learn(checkpoint: Path, args: Args) -> tuple[Any, Any]:
    """A policy, in a folder with its processors, and its postprocessor."""
    from lerobot.policies import make_pre_post_processors

    import hrc_learn.lerobot  # noqa: F401  registers ours
    from hrc_learn.demos.format.dataset_folder import read_info
    from hrc_learn.lerobot.policy.closed_form import read_episodes
    from hrc_learn.lerobot.policy.modeling_motion_chunk import MotionChunkPolicy

    torch.manual_seed(args.seed)
    columns = read_episodes(args.data, (STATE, ACTION))
    shown = [{STATE: e[STATE].float(), ACTION: e[ACTION].float()} for e in columns]
    stats: Any = statistics(shown)
    info = read_info(args.data)
    config = config_of("motion_chunk", shown[0], float(info["fps"]), 50, args.executed)
    config.set_dataset_feature_metadata(info["features"])
    begun = time.process_time()
    policy = MotionChunkPolicy(config, stats)
    policy.fit(shown)
    before, after = make_pre_post_processors(config, dataset_stats=stats)
    until = begun + 60 * args.minutes
    steps = train(policy, before, shown, config.fps or 0.0, until, 64, args.seed)
    seconds = time.process_time() - begun
    Console().print(f"{len(shown)} demonstrations, {steps} steps, {seconds:.0f} s of CPU")
    before.save_pretrained(checkpoint)
    return policy, after


def _roll_out(
    policy: Any, checkpoint: Path, after: Any, size: float, correct: bool, args: Args
) -> list[list[bool]]:
    """Whether the object was grasped: a row for each move of the camera."""
    from lerobot.processor import PolicyProcessorPipeline

    from hrc_learn.demos.format.dataset_folder import read_info
    from hrc_learn.lerobot.camera_watch import add_camera_watch
    from hrc_learn.lerobot.envs import PandaEnv, PandaEnvConfig
    from hrc_learn.lerobot.robots.mujoco_panda import MovedCameraConfig
    from hrc_learn.lerobot.smoothing import PREPROCESSOR

    if correct:
        add_camera_watch(checkpoint, args.data, correct=True)
    fps, grasped = round(float(read_info(args.data)["fps"])), []
    for move in range(args.moves):
        # Loaded anew, it knows of no move before.
        before: Any = PolicyProcessorPipeline.from_pretrained(checkpoint, PREPROCESSOR)
        camera = MovedCameraConfig(size * args.distance, size * args.angle, move)
        config = PandaEnvConfig(
            task="grasping", fps=fps, pixels=True, marker=True, hand=True, moved_camera=camera
        )
        env, grasped_now = PandaEnv(**config.gym_kwargs), []
        for k in range(args.episodes):
            before.reset()
            policy.reset()
            seed = FIRST_SEED + move * args.episodes + k
            seen, ended, success = env.reset(seed=seed)[0], False, False
            while not ended:
                state = torch.from_numpy(seen["agent_pos"])
                action = after(policy.select_action(before({STATE: state})))[0]
                seen, _, success, late, _ = env.step(action.numpy())
                ended = success or late
            grasped_now.append(success)
        env.close()
        grasped.append(grasped_now)
    return grasped


if __name__ == "__main__":
    cli.run(main, Args)
