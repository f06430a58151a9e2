"""Demonstrations and policies small enough to be made in every test."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature
from programs_as_modules import load_program
from torch import Tensor

from hrc_learn.demos import DatasetWriter
from hrc_learn.geometry import minimum_jerk
from hrc_learn.lerobot import DMPConfig, MotionChunkConfig
from hrc_learn.lerobot.policy.dmp_policy import DMPPolicy
from hrc_learn.lerobot.policy.motion_chunk_policy import MotionChunkPolicy

SampleWindows = load_program("benchmarks/sample_windows.py").SampleWindows
FPS = 20.0
NAMES = ["a.pos", "b.pos"]
STATE = "observation.state"
GOAL = "observation.environment_state"
IMAGE = "observation.images.front"
UNNAMED = {"state_names": None, "action_feature_names": None}
"""Settings of a policy whose columns have no names."""
type Episode = dict[str, Tensor]


def reaching(count: int, seed: int = 0) -> list[Episode]:
    """From near the origin, in a bow, to goals that the environment's state gives."""
    rng = torch.Generator().manual_seed(seed)
    episodes = []
    for _ in range(count):
        start = 0.1 * torch.randn(2, generator=rng)
        goal = torch.tensor([1.0, -2.0]) + 0.5 * torch.randn(2, generator=rng)
        frames = int(torch.randint(36, 45, (), generator=rng))
        u = torch.linspace(0, 1, frames)[:, None]
        path = start + (goal - start) * minimum_jerk(u)[0]
        path = path + 0.3 * torch.sin(torch.pi * u) ** 2 * torch.tensor([-1.0, 1.0])
        episodes.append(
            {
                # More than the action's components, and in another order.
                STATE: torch.cat([path[:, 1:], torch.zeros(frames, 1), path[:, :1]], dim=-1),
                GOAL: goal.expand(frames, -1),
                "action": path,
            }
        )
    return episodes


def write_dataset(folder: Path, episodes: list[Episode], *, images: bool = False) -> Path:
    """Write them as a LeRobot dataset of an arm that is where it is sent."""
    rng = np.random.default_rng(0)
    with DatasetWriter(
        folder,
        fps=FPS,
        robot_type="point",
        joint_names=("a", "b"),
        features={GOAL: ("goal.a", "goal.b")},
        cameras={"front": (32, 48)} if images else None,
    ) as writer:
        for episode in episodes:
            writer.start_episode("reach")
            for action, goal in zip(episode["action"], episode[GOAL], strict=True):
                seen = {"front": rng.integers(0, 255, (32, 48, 3), np.uint8)}
                writer.add_frame(
                    images=seen if images else None,
                    joint_position=action.numpy(),
                    command_position=action.numpy(),
                    **{GOAL: goal.numpy()},
                )
            writer.save_episode()
    return folder


def stats_of(episodes: list[Episode]) -> dict[str, dict[str, Tensor]]:
    columns = {key: torch.cat([e[key] for e in episodes]) for key in episodes[0]}
    return {
        key: {"mean": x.mean(0), "std": x.std(0), "min": x.amin(0), "max": x.amax(0)}
        for key, x in columns.items()
    }


def features_of(episode: Mapping[str, Tensor]) -> dict[str, dict[str, PolicyFeature]]:
    """What the episode holds; images are (frames, C, H, W)."""
    kinds = {STATE: FeatureType.STATE, GOAL: FeatureType.ENV}
    inputs = {
        key: PolicyFeature(kinds.get(key, FeatureType.VISUAL), tuple(x.shape[1:]))
        for key, x in episode.items()
        if key != "action"
    }
    action = PolicyFeature(FeatureType.ACTION, tuple(episode["action"].shape[1:]))
    return {"input_features": inputs, "output_features": {"action": action}}


def config_for(episode: Mapping[str, Tensor], **changes) -> DMPConfig:
    """Settings for what the episode holds."""
    settings = {
        "chunk_size": 10,
        "n_action_steps": 6,
        "n_basis": 12,
        "hidden_dim": 16,
        "n_keypoints": 4,
        "fps": FPS,
        "state_names": ["b.pos", "gripper.pos", "a.pos"],
        "action_feature_names": NAMES,
        "device": "cpu",
        "push_to_hub": False,
    }
    return DMPConfig(**features_of(episode), **settings | changes)


def chunk_policy(episodes: list[Episode], **changes) -> MotionChunkPolicy:
    """A `motion_chunk` in closed form, small."""
    settings = {
        "chunk_size": 10,
        "n_action_steps": 6,
        "n_basis": 6,
        "hidden_dim": 32,
        "n_keypoints": 4,
        "fps": FPS,
        "state_names": ["b.pos", "gripper.pos", "a.pos"],
        "action_feature_names": NAMES,
        "device": "cpu",
        "push_to_hub": False,
    }
    config = MotionChunkConfig(**features_of(episodes[0]), **settings | changes)
    with torch.random.fork_rng():
        torch.manual_seed(0)  # of the weights, whatever was drawn before
        policy = MotionChunkPolicy(config, dataset_stats=stats_of(episodes))
    policy.fit(episodes)
    return policy


def fitted_policy(episodes: list[Episode], **changes) -> DMPPolicy:
    policy = DMPPolicy(config_for(episodes[0], **changes), dataset_stats=stats_of(episodes))
    policy.fit(episodes)
    return policy


def shaken(policy: DMPPolicy, seed: int = 0) -> DMPPolicy:
    """The same after a training that went astray: what is seen changes the motion wildly."""
    rng = torch.Generator().manual_seed(seed)
    last = policy.motion.network[-1]
    with torch.no_grad():
        last.weight.copy_(0.3 * torch.randn(last.weight.shape, generator=rng))
    return policy


def windows(policy: DMPPolicy | MotionChunkPolicy, episodes: list[Episode]):
    seen = policy.config.observation_delta_indices
    deltas = {key: seen for key in episodes[0] if key != "action"}
    deltas["action"] = policy.config.action_delta_indices
    return SampleWindows(episodes, deltas, FPS)


def played(
    policy: DMPPolicy | MotionChunkPolicy, episode: Episode, frames: int | None = None
) -> Tensor:
    """Actions of a policy that sees an episode go by, (frames, A)."""
    policy.reset()
    frames = len(episode["action"]) if frames is None else frames
    last = len(episode["action"]) - 1
    return torch.cat(
        [
            policy.select_action(
                {key: x[min(k, last)][None] for key, x in episode.items() if key != "action"}
            )
            for k in range(frames)
        ]
    )


DECAY = 1.5
"""Of the decay to the origin in `decaying` [1/s]."""


def decaying(count=12, frames=80):
    """Motions whose future is a linear function of where they are: a' = -DECAY a."""
    rng = torch.Generator().manual_seed(0)
    time = torch.arange(frames)[:, None] / FPS
    paths = [torch.randn(2, generator=rng) * torch.exp(-DECAY * time) for _ in range(count)]
    return [{STATE: path, "action": path} for path in paths]


def wild(policy, seed=0):
    """The same after a training that went astray: what is seen changes the motion wildly."""
    rng = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for layer in (policy.network.plans, policy.network.scores, policy.network.levels):
            layer.weight.copy_(0.3 * torch.randn(layer.weight.shape, generator=rng))
    return policy


def executed(policy, start, steps):
    """Actions by a policy whose arm is where the last action sent it, (steps, A)."""
    policy.reset()
    where, made = start, []
    for _ in range(steps):
        where = policy.select_action({STATE: where[None]})[0]
        made.append(where)
    return torch.stack(made)


def train(policy, episodes, steps, rate=3e-3, size=64):
    """By gradient descent, in a few seconds."""
    samples, rng = windows(policy, episodes), torch.Generator().manual_seed(0)
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    policy.train()
    with torch.random.fork_rng():
        torch.manual_seed(0)
        for _ in range(steps):
            optimizer.zero_grad()
            policy.forward(samples.draw(size, rng))[0].backward()
            optimizer.step()
            schedule.step()
    return policy.eval()
