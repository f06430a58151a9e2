"""Success of a policy after its camera was moved, with and without corrected pixels.

The policy `dmp` is fitted in closed form to a dataset of

    hrc record expert --scenario grasping --config robot.marker=true --episodes 30 --out DATA

It learns to grasp from the initial pixel of the object. In MuJoCo, it then grasps from starts
that were not demonstrated: with the original camera pose; with the camera moved by 10 cm and 10
degrees in random directions in which it still sees the table; and with the moved camera and
`add_camera_watch(..., correct=True)`. The watch is reset after each move, so the motion of the
camera is unknown at the beginning of the next episode. In that episode this policy cannot
succeed, because it plans from its first observation.
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
"""Number of basis functions of a coordinate, as in `hrc fit --as-lerobot-policy`."""
FIRST_SEED = 50_000
"""First seed of starts that were not demonstrated: demonstrations use seeds from 0 on."""


@dataclass(frozen=True, kw_only=True)
class Args:
    data: Path
    """Dataset of `hrc record expert --scenario grasping --config robot.marker=true`."""
    policy: Path | None = None
    """Checkpoint of a policy that was trained on the dataset. Default: `dmp`, fitted to the
    dataset."""
    moves: int = 10
    """Number of camera motions, in different directions."""
    episodes: int = 5
    """Number of episodes after each camera motion."""
    distance: float = 0.10
    """Distance by which the camera is moved [m]."""
    angle: float = 10.0
    """Angle by which the camera is rotated [degrees]."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


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
            shutil.copytree(args.policy, checkpoint)  # the watch is added to a copy
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
    """Flags of grasped objects: one row for each motion of the camera."""
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
        # Loaded anew for each move, so that the watch knows of no earlier move.
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
