"""Compare policies on demonstrations that they did not learn from, at equal CPU time.

Of a LeRobot dataset every fifth episode is held out. Policies see its states go by and say
what to do; reported is how far that is from what was shown, and how abruptly commands change
where one chunk follows another, beside how abruptly the demonstrators moved. No robot moves:
what a policy does is not seen by it, so this says nothing of how it recovers.

Peers are the nearest neighbour, the chunk shown after the state most like the one seen, and a
small ACT of LeRobot, which trains as long as ours by the clock of the CPU.
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
"""Steps of training in which the learning rate rises."""
CONSTANT = 1e-6
"""Columns of the action that vary by less play no part."""
POLICIES = ("act", "diffusion", "dmp", "motion_chunk")
type Episode = dict[str, Tensor]


@dataclass(frozen=True, kw_only=True)
class Args:
    data: tuple[Path, ...]
    """Folders of LeRobot datasets."""
    policies: tuple[str, ...] = ("nearest", "act", "dmp", "motion_chunk")
    """nearest: neighbour; act, diffusion: small ones; dmp, motion_chunk: from a closed form."""
    minutes: float = 1.0
    """CPU time of building and training each."""
    chunk: int = 50
    """Actions predicted at once."""
    executed: tuple[int, ...] = (25, 10)
    """Of these, how many are carried out before the next prediction."""
    every: int = 5
    """Of the episodes every so many is held out."""
    batch_size: int = 64
    """Samples in each step of training."""
    state: str = STATE
    """Column of the states."""
    action: str = ACTION
    """Column of the actions."""
    seed: int = 0
    """Of weights and batches."""
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
    """Who acts, the steps it was trained for, and the CPU time that took [s]."""
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
    """Third difference k is of the actions k to k + 3; a seam is before action m executed."""
    k = torch.arange(len(jerk))
    return jerk[(k + 3 >= executed) & ((k + 3) % executed < 3)]


class Actor(Protocol):
    """Acts on one state after the other."""

    def begin(self, executed: int) -> None:
        """Begin an episode, with so many actions carried out of each chunk."""
        ...

    def act(self, state: Float[Tensor, "F"]) -> Float[Tensor, "A"]:
        """What to do in a state, which is that after the last action."""
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
    """A policy of LeRobot or ours, trained from memory as lerobot-train does it.

    Args:
        name: Of a policy that `config_of` knows.
        shown: Demonstrations to learn from, with the environment's state where it is known.
        fps: Their frames a second.
        minutes: CPU time of building and training.
        chunk: Actions predicted at once.
        executed: Of these, how many are to be carried out.
        batch_size: Samples in each step of training.
        seed: Of weights and batches.
        state_noise: Of `motion_chunk`.
    """
    torch.manual_seed(seed)
    stats = statistics(shown)
    from lerobot.policies import get_policy_class, make_pre_post_processors

    import hrc_learn.lerobot  # noqa: F401  registers ours

    config = config_of(name, shown[0], fps, chunk, executed, state_noise)
    stands_in = ENVIRONMENT in config.input_features and ENVIRONMENT not in shown[0]
    if stands_in:
        # ACT and Diffusion demand images or the environment's state: they get the state there.
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
    """Whether the state stands in for that of the environment."""
    steps: int = 0
    """It was trained for."""
    seconds: float = 0.0
    """CPU time that took."""

    def save(self, folder: Path) -> None:
        """As a checkpoint of LeRobot."""
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
    """The chunk that was shown after the state most like the one seen."""

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
    """Settings of a policy that predicts so many actions and carries out so many of them."""
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
    """As lerobot-train does it, with batches from memory, until so much CPU time has passed.

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
