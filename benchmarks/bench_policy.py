"""Compare the policy `dmp` with a small ACT, trained on the same demonstrations.

Demonstrations of placing are recorded in simulation, or read from earlier runs; policies learn
from the first one and from more of them. Each then plays demonstrations it has not seen, from
their start and for their goal, on an arm that follows exactly. Reported are the distance of
the hand's path from the one shown, where it ends, and how abruptly actions change where one
chunk follows another.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("HF_HUB_OFFLINE", "1")

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from placing_lessons import GOAL, placing_lessons, write_lessons_of_placing
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor

from hrc_learn import cli
from hrc_learn.kinematics import panda
from hrc_learn.lerobot.policy.episodes import read_episodes
from hrc_learn.lerobot.policy.windows import Windows

STATE, ACTION = "observation.state", "action"
SEEN = (STATE, GOAL)
NEAR = 0.01
"""Distance from the goal [m] at which a thing is in its place."""


@dataclass(frozen=True, kw_only=True)
class Args:
    data: Path
    """Folder of the demonstrations; recorded into it where it does not hold them."""
    demonstrations: tuple[int, ...] = (1, 10)
    """How many to learn from."""
    held_out: int = 10
    """How many to play that were not learned from."""
    steps: int = 2000
    """Of training."""
    batch_size: int = 32
    policies: tuple[str, ...] = ("dmp-fit", "dmp", "act")
    """dmp-fit: in closed form; dmp: trained from there; act: small, state only."""
    seed: int = 0
    """Of weights and batches."""
    json: Path | None = None
    """Receives all figures as one flat object."""


@dataclass(frozen=True, kw_only=True)
class Played:
    """How a policy did on demonstrations it had not seen."""

    path: float
    """Distance from the hand's path at the same time, root mean square [m]."""
    goal: float
    """Distance from where the hand ought to end, mean [m]."""
    placed: float
    """Share that ended within 1 cm."""
    seam: float
    """Largest change of the joints' velocity from one action to the next where chunks meet,
    over the largest within chunks."""
    seconds: float
    """CPU time of training [s]."""

    def row(self) -> list[str]:
        return [
            f"{1e3 * self.path:.1f}",
            f"{1e3 * self.goal:.1f}",
            f"{100 * self.placed:.0f} %",
            f"{self.seam:.2f}",
            f"{self.seconds:.0f}",
        ]


def main(args: Args) -> None:
    torch.set_num_threads(1)
    held_out = _recorded(args.data / f"held_out_{args.held_out}", args.held_out, seed=100)
    table = Table("policy", "demonstrations", "path [mm]", "goal [mm]", "placed", "seam", "s")
    figures: dict[str, float] = {}
    shown = read_episodes(held_out, (*SEEN, ACTION))
    for count in args.demonstrations:
        dataset = _recorded(args.data / f"shown_{count}", count, seed=0)
        for name in args.policies:
            played = _measure(name, dataset, shown, args)
            table.add_row(name, str(count), *played.row())
            figures |= {f"{name}_{count}_{k}": v for k, v in vars(played).items()}
    Console().print(table)
    if args.json is not None:
        cli.write_json(args.json, figures)


def _recorded(folder: Path, count: int, seed: int) -> Path:
    if not folder.exists():
        lessons = track(placing_lessons(count, seed), f"Recording {folder.name}", total=count)
        write_lessons_of_placing(folder, iter(lessons))
    return folder


def _measure(name: str, dataset: Path, shown: Sequence[dict], args: Args) -> Played:
    from lerobot.datasets import LeRobotDatasetMetadata
    from lerobot.policies import make_policy, make_pre_post_processors

    torch.manual_seed(args.seed)
    meta = LeRobotDatasetMetadata(f"local/{dataset.name}", root=dataset)
    config = _config(name)
    began = time.process_time()
    policy = make_policy(config, ds_meta=meta)
    stats: Any = meta.stats
    before, after = make_pre_post_processors(config, dataset_stats=stats)
    if name != "dmp-fit":
        _train(policy, before, _windows(dataset, config), args, f"{name}, {dataset.name}")
    seconds = time.process_time() - began
    return _judge(_play(policy, before, after, shown), shown, config.n_action_steps, seconds)


def _config(name: str) -> Any:
    from lerobot.policies import ACTConfig

    from hrc_learn.lerobot import DMPConfig

    # One second a chunk, of which half is carried out.
    common = {"chunk_size": 25, "n_action_steps": 12, "device": "cpu", "push_to_hub": False}
    match name:
        case "dmp" | "dmp-fit":
            return DMPConfig(**common)
        case "act":
            return ACTConfig(
                **common,
                dim_model=128,
                n_heads=4,
                dim_feedforward=512,
                n_encoder_layers=3,
                use_vae=False,
                dropout=0.0,
                optimizer_lr=3e-4,
            )
    raise ValueError(f"--policies takes dmp-fit, dmp and act, not {name!r}")


def _windows(dataset: Path, config: Any) -> Windows:
    keys = (*SEEN, ACTION)
    deltas: dict[str, Sequence[int] | None] = {ACTION: config.action_delta_indices}
    deltas |= dict.fromkeys(SEEN, config.observation_delta_indices)
    return Windows(read_episodes(dataset, keys), deltas, fps=25)


def _train(policy: Any, before: Any, samples: Windows, args: Args, title: str) -> None:
    """As lerobot-train does it, with batches from memory."""
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    rng = torch.Generator().manual_seed(args.seed)
    policy.train()
    for _ in track(range(args.steps), title):
        loss, _ = policy.forward(before(samples.draw(args.batch_size, rng)))
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 10.0)
        optimizer.step()


@torch.no_grad()
def _play(
    policy: Any, before: Any, after: Any, shown: Sequence[dict]
) -> Float[Tensor, "n T 7"]:
    """Joints of an arm that follows, all demonstrations at once."""
    policy.eval()
    policy.reset()
    q = torch.stack([episode[STATE][0] for episode in shown])
    goal = torch.stack([episode[GOAL][0] for episode in shown])
    path = []
    for _ in range(max(len(episode[ACTION]) for episode in shown)):
        q = after(policy.select_action(before({STATE: q, GOAL: goal})))
        path.append(q)
    return torch.stack(path, dim=1)


def _judge(
    joints: Float[Tensor, "n T 7"], shown: Sequence[dict], chunk: int, seconds: float
) -> Played:
    hand = panda.forward(joints.double()).position
    paths, ends = [], []
    for made, episode in zip(hand, shown, strict=True):
        true = panda.forward(episode[ACTION].double()).position
        distance = (made[: len(true)] - true).norm(dim=-1)
        paths.append(distance.square().mean())
        ends.append(distance[-1])
    change = joints.diff(dim=1).diff(dim=1).abs().amax(dim=(0, 2))
    # Change k is between the actions k, k + 1 and k + 2; a seam is before action m chunk.
    at_seam = torch.tensor([(k + 2) % chunk < 2 for k in range(len(change))])
    return Played(
        path=float(torch.stack(paths).mean().sqrt()),
        goal=float(torch.stack(ends).mean()),
        placed=float((torch.stack(ends) < NEAR).double().mean()),
        seam=float(change[at_seam].max() / change[~at_seam].max()),
        seconds=seconds,
    )


if __name__ == "__main__":
    cli.run(main, Args)
