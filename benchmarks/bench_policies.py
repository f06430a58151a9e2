"""Compare policies on held-out demonstrations, at equal CPU time.

Every fifth episode of a LeRobot dataset is held out. Policies observe its states one after
another and predict actions. Reported are the error of these actions and the jerk where chunks
meet, next to the jerk of the demonstrations. No robot moves and actions do not affect later
states, so recovery from errors is not measured.

Peers are the nearest neighbour, which repeats the chunk demonstrated after the most similar
state, and a small ACT of LeRobot, which trains for the same CPU time as ours.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("HF_HUB_OFFLINE", "1")

import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from jaxtyping import Float
from rich.console import Console
from rich.table import Table
from sample_windows import SampleWindows
from torch import Tensor

from hrc_learn import cli

STATE, ACTION = "observation.state", "action"
ENVIRONMENT = "observation.environment_state"
WARM_UP = 50
"""Number of training steps in which the learning rate rises."""
CONSTANT = 1e-6
"""Variation of an action's column below which the column is left out."""
POLICIES = ("act", "diffusion", "dmp", "motion_chunk")
type Episode = dict[str, Tensor]


@dataclass(frozen=True, kw_only=True)
class Args:
    data: tuple[Path, ...]
    """Folders of LeRobot datasets."""
    policies: tuple[str, ...] = ("nearest", "act", "dmp", "motion_chunk")
    """nearest: nearest neighbour; act, diffusion: small networks; dmp, motion_chunk: ours,
    which start from a closed form."""
    minutes: float = 1.0
    """CPU time of building and training each policy."""
    chunk: int = 50
    """Number of actions predicted at once."""
    executed: tuple[int, ...] = (25, 10)
    """Numbers of these actions that are executed before the next prediction."""
    every: int = 5
    """Every n-th episode is held out."""
    batch_size: int = 64
    """Number of samples in each training step."""
    state: str = STATE
    """Column of the states."""
    action: str = ACTION
    """Column of the actions."""
    seed: int = 0
    """Seed of weights and batches."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


def main(args: Args) -> None:
    from hrc_learn.lerobot.policy.policy_base import read_episodes

    torch.set_num_threads(1)
    figures: dict[str, float] = {}
    for root in args.data:
        columns = read_episodes(root, (args.state, args.action))
        episodes = [
            {STATE: e[args.state].float(), ACTION: e[args.action].float()} for e in columns
        ]
        info = json.loads((root / "meta" / "info.json").read_text("utf-8"))
        fps = float(info["fps"])
        shown = [e for k, e in enumerate(episodes) if k % args.every]
        held_out = episodes[:: args.every]
        stats = statistics(shown)
        spread = stats[ACTION]["std"]
        varies = spread > CONSTANT
        wanted = [(e[ACTION] / spread)[:, varies] for e in held_out]
        jerk = _rms([_jerk(x, fps) for x in wanted])
        table = Table("policy", "steps", "CPU s", *_titles(args.executed))
        table.title = f"{root.name}: {len(held_out)} of {len(episodes)} episodes held out"
        for name in args.policies:
            actor, steps, seconds = _actor(name, shown, fps, stats, args)
            row = []
            for executed in args.executed:
                made = [
                    (_play(actor, e[STATE], executed) / spread)[:, varies] for e in held_out
                ]
                error = _rms([x - y for x, y in zip(made, wanted, strict=True)])
                seam = _rms([_at_seams(_jerk(x, fps), executed) for x in made])
                row += [error, seam]
                figures |= {
                    f"{root.name}_{name}_{executed}_rmse": error,
                    f"{root.name}_{name}_{executed}_seam_jerk": seam,
                }
            table.add_row(name, str(steps), f"{seconds:.0f}", *(f"{x:.3g}" for x in row))
        table.add_row("demonstrators", "", "", *(("", f"{jerk:.3g}") * len(args.executed)))
        figures[f"{root.name}_demonstrators_jerk"] = jerk
        Console().print(table)
        if args.json is not None:
            cli.write_json(args.json, figures)


def _actor(
    name: str, shown: list[Episode], fps: float, stats: dict[str, dict[str, Tensor]], args: Args
) -> tuple[Actor, int, float]:
    """Actor, number of training steps, and CPU time of the training [s]."""
    if name == "nearest":
        begun = time.process_time()
        return Nearest(shown, stats, args.chunk), 0, time.process_time() - begun
    learned = learn(
        name,
        shown,
        fps,
        minutes=args.minutes,
        chunk=args.chunk,
        executed=args.executed[0],
        batch_size=args.batch_size,
        seed=args.seed,
    )
    return learned, learned.steps, learned.seconds


def _titles(executed: Sequence[int]) -> list[str]:
    return [t for n in executed for t in (f"RMSE, {n} executed", "jerk at seams [1/s^3]")]


def statistics(episodes: Sequence[Episode]) -> dict[str, dict[str, Tensor]]:
    stats = {}
    for key in episodes[0]:
        x = torch.cat([e[key] for e in episodes])
        low, high = x.aminmax(dim=0)
        stats[key] = {"mean": x.mean(0), "std": x.std(0), "min": low, "max": high}
    return stats


def _rms(parts: list[Tensor]) -> float:
    return float(torch.cat(parts).double().square().mean().sqrt())


def _jerk(x: Float[Tensor, "T A"], fps: float) -> Float[Tensor, "T3 A"]:
    return x.double().diff(n=3, dim=0) * fps**3


def _at_seams(jerk: Float[Tensor, "T3 A"], executed: int) -> Float[Tensor, "n A"]:
    """Third differences at seams. Difference k is of the actions k to k + 3; a seam is before
    every `executed`-th action.
    """
    k = torch.arange(len(jerk))
    return jerk[(k + 3 >= executed) & ((k + 3) % executed < 3)]


class Actor(Protocol):
    """Executes actions for one state after another."""

    def begin(self, executed: int) -> None:
        """Begin an episode; `executed` actions of each chunk are executed."""
        ...

    def act(self, state: Float[Tensor, "F"]) -> Float[Tensor, "A"]:
        """Action in a state, which follows the last action."""
        ...


@torch.no_grad()
def _play(actor: Actor, states: Float[Tensor, "T F"], executed: int) -> Float[Tensor, "T A"]:
    actor.begin(executed)
    return torch.stack([actor.act(state) for state in states])


def learn(
    name: str,
    shown: Sequence[Episode],
    fps: float,
    *,
    minutes: float,
    chunk: int,
    executed: int,
    batch_size: int = 64,
    seed: int = 0,
    state_noise: float = 0.0,
) -> Learned:
    """Train a policy of LeRobot or ours from memory, as lerobot-train does.

    Args:
        name: Name of a policy in `config_of`.
        shown: Demonstrations to learn from, with the environment's state if it is known.
        fps: Frames per second of the demonstrations.
        minutes: CPU time of building and training.
        chunk: Number of actions predicted at once.
        executed: Number of these actions that are executed.
        batch_size: Number of samples in each training step.
        seed: Seed of weights and batches.
        state_noise: Noise on the state in the training of `motion_chunk`.
    """
    torch.manual_seed(seed)
    stats = statistics(shown)
    from lerobot.policies import get_policy_class, make_pre_post_processors

    import hrc_learn.lerobot  # noqa: F401  registers ours

    config = config_of(name, shown[0], fps, chunk, executed, state_noise)
    stands_in = ENVIRONMENT in config.input_features and ENVIRONMENT not in shown[0]
    if stands_in:
        # ACT and Diffusion require images or the environment's state: the state is passed as
        # such.
        stats = stats | {ENVIRONMENT: stats[STATE]}
        shown = [e | {ENVIRONMENT: e[STATE]} for e in shown]
    begun = time.process_time()
    policy: Any = get_policy_class(name)(config, dataset_stats=stats)
    if name in ("dmp", "motion_chunk"):
        policy.fit(shown)
    before, after = make_pre_post_processors(config, dataset_stats=stats)
    until = begun + 60 * minutes
    steps = train(policy, before, shown, fps, until, batch_size, seed)
    seconds = time.process_time() - begun
    return Learned(policy, before, after, stands_in, steps, seconds)


@dataclass(frozen=True, eq=False)
class Learned:
    """A policy of LeRobot, with its processors."""

    policy: Any
    before: Any
    after: Any
    stands_in: bool
    """True if the state is also passed as the environment's state."""
    steps: int = 0
    """Number of training steps."""
    seconds: float = 0.0
    """CPU time of the training [s]."""

    def save(self, folder: Path) -> None:
        """Save the policy as a LeRobot checkpoint."""
        for part in (self.policy, self.before, self.after):
            part.save_pretrained(folder)

    def begin(self, executed: int) -> None:
        self.policy.config.n_action_steps = executed
        self.policy.reset()

    @torch.no_grad()
    def act(self, state: Float[Tensor, "F"]) -> Float[Tensor, "A"]:
        seen = {STATE: state} | ({ENVIRONMENT: state} if self.stands_in else {})
        return self.after(self.policy.select_action(self.before(seen)))[0]


class Nearest:
    """Repeats the chunk that was demonstrated after the most similar state."""

    def __init__(
        self, shown: Sequence[Episode], stats: dict[str, dict[str, Tensor]], chunk: int
    ):
        windows = SampleWindows(shown, {STATE: None, ACTION: range(chunk)}, 1)
        everything = windows.batch(torch.arange(len(windows)))
        spread = stats[STATE]["std"]
        self._scale = torch.where(spread > CONSTANT, spread, torch.inf)
        self._known, self._chunks = everything[STATE] / self._scale, everything[ACTION]
        self.begin(chunk)

    def begin(self, executed: int) -> None:
        self._executed, self._left = executed, self._chunks[0, :0]

    def act(self, state: Float[Tensor, "F"]) -> Float[Tensor, "A"]:
        if not len(self._left):
            k = int((self._known - state / self._scale).square().sum(-1).argmin())
            self._left = self._chunks[k, : self._executed]
        action, self._left = self._left[0], self._left[1:]
        return action


def config_of(
    name: str,
    episode: Episode,
    fps: float,
    chunk: int,
    executed: int,
    state_noise: float = 0.0,
) -> Any:
    """Configuration of a policy with these numbers of predicted and executed actions."""
    from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
    from lerobot.policies import ACTConfig, DiffusionConfig

    from hrc_learn.lerobot import DMPConfig, MotionChunkConfig

    inputs = {STATE: PolicyFeature(FeatureType.STATE, (episode[STATE].shape[1],))}
    if ENVIRONMENT in episode or name not in ("dmp", "motion_chunk"):
        width = episode.get(ENVIRONMENT, episode[STATE]).shape[1]
        inputs[ENVIRONMENT] = PolicyFeature(FeatureType.ENV, (width,))
    width = episode[ACTION].shape[1]
    common: dict[str, Any] = {
        "n_action_steps": executed,
        "device": "cpu",
        "push_to_hub": False,
        "input_features": inputs,
        "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, (width,))},
    }
    act: dict[str, Any] = {
        "chunk_size": chunk,
        "normalization_mapping": dict.fromkeys(
            ("STATE", "ENV", "ACTION"), NormalizationMode.MEAN_STD
        ),
        "dim_model": 64,
        "n_heads": 4,
        "dim_feedforward": 256,
        "n_encoder_layers": 2,
        "use_vae": False,
        "optimizer_lr": 1e-3,
    }
    diffusion: dict[str, Any] = {
        "horizon": chunk,
        "down_dims": (64, 128),
        "noise_scheduler_type": "DDIM",
        "num_inference_steps": 10,
        "diffusion_step_embed_dim": 64,
        "optimizer_lr": 1e-3,
    }
    match name:
        case "dmp":
            return DMPConfig(**common, chunk_size=chunk, fps=fps)
        case "motion_chunk":
            return MotionChunkConfig(
                **common, chunk_size=chunk, fps=fps, state_noise=state_noise
            )
        case "act":
            return ACTConfig(**common, **act)
        case "diffusion":
            return DiffusionConfig(**common, **diffusion)
    raise ValueError(f"--policies takes nearest, {', '.join(POLICIES)}, not {name!r}")


def train(
    policy: Any,
    before: Any,
    shown: Sequence[Episode],
    fps: float,
    until: float,
    batch_size: int,
    seed: int,
) -> int:
    """Train as lerobot-train does, with batches from memory, for a given CPU time.

    The learning rate falls along a cosine over that time.
    """
    config = policy.config
    seen = config.observation_delta_indices
    deltas = {key: seen if key != ACTION else config.action_delta_indices for key in shown[0]}
    windows = SampleWindows(shown, deltas, fps)
    optimizer = config.get_optimizer_preset().build(policy.get_optim_params())
    rates = [group["lr"] for group in optimizer.param_groups]
    rng = torch.Generator().manual_seed(seed)
    begun, steps = time.process_time(), 0
    policy.train()
    while (now := time.process_time()) < until:
        share = (now - begun) / (until - begun)
        factor = min(1, (steps + 1) / WARM_UP) * (1 + math.cos(math.pi * share)) / 2
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * factor
        loss, _ = policy.forward(before(windows.draw(batch_size, rng)))
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 10.0)
        optimizer.step()
        steps += 1
    policy.eval()
    return steps


if __name__ == "__main__":
    cli.run(main, Args)
