"""What a policy does after its camera was moved, with and without correcting what it sees.

The policy `dmp` learns in closed form from a dataset of

    hrc record expert --scenario grasping --config robot.marker=true --episodes 30 --out DATA

to grasp by the pixel of the object, and does so in MuJoCo from beginnings that were not shown:
with the camera where it was; moved by 10 cm and 10 degrees in random directions in which it
still sees the table; and the same with `add_camera_watch(..., correct=True)`. Each time it was
moved it is watched anew, so that in the first episode after that nothing is known of it before
the arm moves: this policy, which plans from the first thing it sees, cannot grasp then.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("HF_HUB_OFFLINE", "1")

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
from lerobot.utils.constants import OBS_STATE
from rich.console import Console
from rich.table import Table

from hrc_learn import cli
from hrc_learn.lerobot.policy.dmp_policy import write_closed_form_policy

N_BASIS = 60
"""Of a coordinate: as of `hrc fit --as-lerobot-policy`."""
FIRST_SEED = 50_000
"""Beginnings that were not shown: demonstrations count from 0."""


@dataclass(frozen=True, kw_only=True)
class Args:
    data: Path
    """Dataset of `hrc record expert --scenario grasping --config robot.marker=true`."""
    policy: Path | None = None
    """Checkpoint of a policy that was trained on it; `dmp` is fitted to it without."""
    moves: int = 10
    """Of the camera, in different directions."""
    episodes: int = 5
    """After each of them."""
    distance: float = 0.10
    """By which the camera is moved [m]."""
    angle: float = 10.0
    """By which it is turned [degrees]."""
    json: Path | None = None
    """Receives all figures as one flat object."""


def main(args: Args) -> None:
    torch.set_num_threads(1)
    table = Table("camera", "grasped", "in the first episode after a move")
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        checkpoint = Path(folder) / "policy"
        if args.policy is None:
            checkpoint.mkdir()
            write_closed_form_policy(args.data, checkpoint, n_basis=N_BASIS)
        else:
            shutil.copytree(args.policy, checkpoint)  # a watch is put into it
        rows: tuple[tuple[str, float, bool], ...] = (
            ("as it was", 0.0, False),
            ("moved", 1.0, False),
            ("moved, corrected", 1.0, True),
        )
        for name, size, correct in rows:
            grasped = _roll_out(checkpoint, size, correct, args)
            first = sum(move[0] for move in grasped)
            every = sum(map(sum, grasped))
            count = args.moves * args.episodes
            table.add_row(name, f"{every} of {count}", f"{first} of {args.moves}")
            figures |= {f"{name}, grasped": every / count, f"{name}, first": first / args.moves}
            Console().print(f"{name}: {grasped}")
    Console().print(table)
    if args.json is not None:
        cli.write_json(args.json, figures)


def _roll_out(checkpoint: Path, size: float, correct: bool, args: Args) -> list[list[bool]]:
    """Whether the object was grasped: a row for each move of the camera."""
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies import get_policy_class, make_pre_post_processors

    from hrc_learn.demos.read.dataset_folder import read_info
    from hrc_learn.lerobot.camera_watch import add_camera_watch
    from hrc_learn.lerobot.envs import ArmEnvConfig
    from hrc_learn.lerobot.mujoco_arm import MovedCameraConfig

    if correct:
        add_camera_watch(checkpoint, args.data, correct=True)
    config = PreTrainedConfig.from_pretrained(checkpoint)
    policy: Any = get_policy_class(config.type).from_pretrained(checkpoint)
    fps, grasped = round(float(read_info(args.data)["fps"])), []
    for move in range(args.moves):
        # Loaded anew, it knows of no move before.
        before, after = make_pre_post_processors(config, pretrained_path=str(checkpoint))
        camera = MovedCameraConfig(size * args.distance, size * args.angle, move)
        scene = ArmEnvConfig(
            task="grasping", fps=fps, pixels=True, marker=True, hand=True, moved_camera=camera
        )
        env, grasped_now = gym.make(scene.gym_id, **scene.gym_kwargs), []
        for k in range(args.episodes):
            for part in (before, policy, after):
                part.reset()
            seed = FIRST_SEED + move * args.episodes + k
            seen, ended, success = env.reset(seed=seed)[0], False, False
            while not ended:
                state = torch.from_numpy(seen["agent_pos"])
                action = after(policy.select_action(before({OBS_STATE: state})))[0]
                seen, _, success, late, _ = env.step(action.numpy())
                ended = success or late
            grasped_now.append(success)
        env.close()
        grasped.append(grasped_now)
    return grasped


if __name__ == "__main__":
    cli.run(main, Args)
