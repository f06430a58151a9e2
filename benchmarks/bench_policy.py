"""Compare the policy `dmp` with a small ACT, trained on the same demonstrations.

A scripted expert demonstrates a task in simulation, such as grasping an object at a random
place that is observed once. Policies learn from one demonstration or more, and then perform the
task from new starts. Reported are the success rate by MuJoCo's contacts, the distance of the
end effector from the expert's path, and the change of commands where chunks meet. For trained
policies, the file of measured values also contains the loss at the beginning, at half time and
at the end of the training.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("HF_HUB_OFFLINE", "1")

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import gymnasium as gym
import numpy as np
import torch
from jaxtyping import Float
from rich.console import Console
from rich.progress import track
from rich.table import Table
from sample_windows import SampleWindows
from torch import Tensor
from torch.optim.lr_scheduler import CosineAnnealingLR

from hrc_learn import cli
from hrc_learn.kinematics import panda

# LeRobot takes ten seconds to import, so it is imported only when needed.
if TYPE_CHECKING:
    from hrc_learn.lerobot.envs import ArmEnvConfig

STATE, ACTION = "observation.state", "action"
ENVIRONMENT = "observation.environment_state"
HELD_OUT = 1000
"""Number of the first start that no policy learns from."""


@dataclass(frozen=True, kw_only=True)
class Args:
    data: Path
    """Folder of the demonstrations, which are recorded if they are missing."""
    task: Literal["grasping", "placing"] = "grasping"
    """Task of the demonstrations and policies."""
    demonstrations: tuple[int, ...] = (1, 10)
    """Numbers of demonstrations to learn from."""
    beginnings: int = 10
    """Number of new starts from which the task is performed."""
    policies: tuple[str, ...] = ("dmp-fit", "dmp", "act")
    """dmp-fit: in closed form; dmp: trained from the closed form; act: a small ACT."""
    steps: int = 1000
    """Number of training steps, over which the learning rate falls to zero along a cosine."""
    batch_size: int = 32
    """Number of samples in each training step."""
    fps: int = 25
    """Commands per second."""
    seed: int = 0
    """Seed of weights and batches."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


@dataclass(frozen=True, kw_only=True)
class Figures:
    """Results of a policy from new starts."""

    success: float
    """Fraction of successes."""
    path_mm: float
    """Distance of the end effector from the expert's path at the same time, root mean square
    [mm]."""
    seam: float
    """Largest change of the joints' commanded velocity where chunks meet, relative to the
    largest change within chunks."""
    jerk: float
    """Root mean square of the third difference of the joints' commands where chunks meet
    [rad/s^3]."""
    train_s: float
    """CPU time of training [s]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Done:
    """Result from one start."""

    success: bool
    joints: Float[Tensor, "T 7"]
    """Joint positions measured before each command [rad]."""
    commands: Float[Tensor, "T 7"]
    """Commanded joint positions [rad]."""


def main(args: Args) -> None:
    from hrc_learn.lerobot.envs import ArmEnvConfig
    from hrc_learn.lerobot.policy.policy_base import read_episodes

    torch.set_num_threads(1)
    env = ArmEnvConfig(task=args.task, fps=args.fps, pixels=args.task == "grasping")
    held_out = _recorded(args, env, HELD_OUT, args.beginnings)
    expert = [episode[STATE][:, :7] for episode in read_episodes(held_out, (STATE,))]
    table = Table("policy", "demonstrations", *Figures.__dataclass_fields__)
    figures: dict[str, float] = {}
    for count in args.demonstrations:
        dataset = _recorded(args, env, 0, count)
        for name in args.policies:
            result, losses = _measure(name, dataset, env, expert, args)
            row = dict(vars(result))
            table.add_row(name, str(count), *(f"{value:.3g}" for value in row.values()))
            row |= {f"loss_{when}": value for when, value in losses.items()}
            figures |= {f"{name}_{count}_{key}": value for key, value in row.items()}
            if args.json is not None:
                cli.write_json(args.json, figures)
    Console().print(table)


def _recorded(args: Args, env: ArmEnvConfig, first: int, count: int) -> Path:
    folder = args.data / f"{args.task}_{args.fps}hz_from_{first}_{count}"
    if not folder.exists():
        from hrc_learn.lerobot.episode_recording import record_expert

        robot = replace(env.robot_config(), seed=first)
        shown = record_expert(folder, robot, count)
        for _, succeeded in track(shown, f"Recording {folder.name}", total=count):
            # A demonstration from another start would not belong to this number.
            if not succeeded:
                raise RuntimeError(f"the expert failed from a beginning after {first}")
    return folder


def _measure(
    name: str, dataset: Path, env: ArmEnvConfig, expert: Sequence[Tensor], args: Args
) -> tuple[Figures, dict[str, float]]:
    torch.manual_seed(args.seed)
    began = time.process_time()
    config, act, losses = _policy(name, dataset, args)
    seconds = time.process_time() - began
    done = _do(act, env, len(expert), f"{name}, {dataset.name}")
    figures = Figures(
        success=float(np.mean([d.success for d in done])),
        path_mm=1e3 * _path_error([d.joints for d in done], expert),
        **_seams([d.commands for d in done], config.n_action_steps, args.fps),
        train_s=seconds,
    )
    return figures, losses


def _policy(
    name: str, dataset: Path, args: Args
) -> tuple[Any, Callable[[Tensor | None], Any], dict[str, float]]:
    """Settings of a trained policy, its map from states to actions, and its training losses.

    None instead of a state resets the policy.
    """
    from lerobot.datasets import LeRobotDatasetMetadata
    from lerobot.policies import make_policy, make_pre_post_processors

    meta = LeRobotDatasetMetadata(f"local/{dataset.name}", root=dataset)
    stats: Any = dict(meta.stats or {})
    stats[STATE] = stats[ENVIRONMENT] = _blind_to_constants(stats[STATE])
    config = _config(name, len(stats[STATE]["mean"]))
    policy = make_policy(config, ds_meta=meta)
    before, after = make_pre_post_processors(config, dataset_stats=stats)
    losses = {}
    if name != "dmp-fit":
        losses = _train(policy, before, dataset, args, f"{name}, {dataset.name}")
    policy.eval()

    @torch.no_grad()
    def act(state: Tensor | None) -> Tensor | None:
        if state is None:
            policy.reset()
            return None
        return after(policy.select_action(before(_observation(state))))[0]

    return config, act, losses


def _blind_to_constants(stats: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Statistics with which a component that never changes is not used as an input.

    In a single demonstration, components may be constant. LeRobot would divide by their spread
    of zero, and the policy's actions would be arbitrary.
    """
    from hrc_learn.lerobot.policy.observation_encoder import SMALLEST_SPREAD

    return stats | {"std": np.where(stats["std"] > SMALLEST_SPREAD, stats["std"], np.inf)}


def _observation(state: Tensor) -> dict[str, Tensor]:
    """Observation with the state also as the environment's state, which ACT requires."""
    return {STATE: state, ENVIRONMENT: state}


def _config(name: str, width: int) -> Any:
    from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
    from lerobot.policies import ACTConfig

    from hrc_learn.lerobot import DMPConfig

    # A chunk lasts one second; half of it is executed.
    common = {"chunk_size": 25, "n_action_steps": 12, "device": "cpu", "push_to_hub": False}
    match name:
        case "dmp" | "dmp-fit":
            return DMPConfig(**common)
        case "act":
            return ACTConfig(
                **common,
                input_features={ENVIRONMENT: PolicyFeature(FeatureType.ENV, (width,))},
                # By default, the environment's state is not normalised; here it has values of
                # hundreds of pixels.
                normalization_mapping=dict.fromkeys(
                    ("STATE", "ENV", "ACTION"), NormalizationMode.MEAN_STD
                ),
                dim_model=64,
                n_heads=4,
                dim_feedforward=256,
                n_encoder_layers=2,
                use_vae=False,
                dropout=0.0,
                optimizer_lr=1e-3,
            )
    raise ValueError(f"--policies takes dmp-fit, dmp and act, not {name!r}")


def _train(policy: Any, before: Any, dataset: Path, args: Args, title: str) -> dict[str, float]:
    """Train as lerobot-train does, with batches from memory; returns mean losses at stages of
    it.
    """
    from hrc_learn.lerobot.policy.policy_base import read_episodes

    config = policy.config
    episodes = [e | _observation(e[STATE]) for e in read_episodes(dataset, (STATE, ACTION))]
    deltas: dict[str, Sequence[int] | None] = {ACTION: config.action_delta_indices}
    deltas |= dict.fromkeys((STATE, ENVIRONMENT), config.observation_delta_indices)
    samples = SampleWindows(episodes, deltas, args.fps)
    optimizer = config.get_optimizer_preset().build(policy.get_optim_params())
    schedule = CosineAnnealingLR(optimizer, args.steps)
    rng, losses = torch.Generator().manual_seed(args.seed), []
    policy.train()
    for _ in track(range(args.steps), title):
        loss, _ = policy.forward(before(samples.draw(args.batch_size, rng)))
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 10.0)
        optimizer.step()
        schedule.step()
        losses.append(loss.item())
    tenths = np.array_split(losses, 10)
    return {"first": tenths[0].mean(), "middle": tenths[4].mean(), "last": tenths[9].mean()}


def _do(
    act: Callable[[Tensor | None], Any], config: ArmEnvConfig, count: int, title: str
) -> list[Done]:
    env, done = gym.make(config.gym_id, **config.gym_kwargs), []
    for seed in track(range(HELD_OUT, HELD_OUT + count), title):
        act(None)
        seen, _ = env.reset(seed=seed)
        states, commands, over, info = [], [], False, {}
        while not over:
            states.append(torch.from_numpy(seen["agent_pos"].copy()))
            commands.append(act(states[-1][None]))
            seen, _, success, late, info = env.step(commands[-1].numpy())
            over = success or late
        done.append(
            Done(
                success=bool(info["is_success"]),
                joints=torch.stack(states)[:, :7],
                commands=torch.stack(commands)[:, :7],
            )
        )
    env.close()
    return done


def _path_error(made: Sequence[Tensor], shown: Sequence[Tensor]) -> float:
    square = []
    for ours, theirs in zip(made, shown, strict=True):
        frames = min(len(ours), len(theirs))
        hands = (panda.forward(q[:frames].double()).position for q in (ours, theirs))
        square.append((next(hands) - next(hands)).square().sum(-1).mean())
    return float(torch.stack(square).mean().sqrt())


def _seams(commands: Sequence[Tensor], chunk: int, fps: int) -> dict[str, float]:
    """`Figures.seam` and `Figures.jerk` of commands that come in chunks of this length."""
    at_seams, within, jerk = [], [], []
    for q in commands:
        change = q.double().diff(n=2, dim=0).abs().amax(-1)
        # Change k is of the commands k, k + 1 and k + 2; a seam is before every `chunk`-th
        # command.
        crosses = (torch.arange(len(change)) + 2) % chunk < 2
        at_seams.append(change[crosses].max())
        within.append(change[~crosses].max())
        third = q.double().diff(n=3, dim=0)
        crosses = (torch.arange(len(third)) + 3) % chunk < 3
        jerk.append(third[crosses].square().mean())
    return {
        "seam": float(torch.stack(at_seams).max() / torch.stack(within).max()),
        "jerk": float(torch.stack(jerk).mean().sqrt()) * fps**3,
    }


if __name__ == "__main__":
    cli.run(main, Args)
