"""Compare policies in public and our environments, by LeRobot's evaluation, at equal CPU time.

Scripted experts give the demonstrations, from their own starts and without disturbances.
Policies observe numbers, not images: positions of the agent and of objects. All policies learn
for the same CPU time and are evaluated by the code of `lerobot-eval`, from starts that were not
demonstrated, in three ways: unchanged; with the object moved while the agent approaches it; and
after three demonstrations only.

Public environments need older packages than ours:

    tools/make_environments.sh
    .venv-environments/bin/python benchmarks/bench_environments.py

Our environment (--tasks grasping) needs the MuJoCo of .venv, and so the Python of .venv. The
command evaluates a policy that was kept (--keep):

    PYTHONPATH=benchmarks lerobot-eval --env.discover_packages_path=public_tasks
        --env.type=public_task --env.task=pusht --policy.path=FOLDER ...
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("MUJOCO_GL", "egl")

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
from bench_policies import Learned, learn
from public_tasks.known import TASKS, make_task
from public_tasks.protocol import Episode, demonstrate, succeeds
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from safetensors.torch import load_file, save_file

from hrc_learn import cli

FIRST_SEED = 10_000
"""First seed of starts that were not demonstrated: demonstrations use seeds from 0 on."""
PUBLIC = (
    "pusht",
    "aloha-transfer",
    "metaworld-pick-place",
    "metaworld-push",
    "so101-pick-place",
)
COLUMNS = ("unmoved", "moved", "few")
SEPARATOR = "/"
"""Separator between the number of an episode and the key of its column, in a file."""


@dataclass(frozen=True, kw_only=True)
class Args:
    tasks: tuple[str, ...] = PUBLIC
    """Names of tasks of public_tasks/known.py."""
    policies: tuple[str, ...] = (
        "act",
        "diffusion",
        "dmp",
        "motion_chunk",
    )
    """Policies of LeRobot and ours."""
    demonstrations: int = 50
    """Number of demonstrations to learn from."""
    few: int = 3
    """Number of demonstrations for the last column."""
    minutes: float = 1.0
    """CPU time of building and training each policy."""
    executed: int | None = None
    """Number of executed actions of each chunk; None: the task's number in known.py."""
    rollouts: int = 12
    """Number of episodes of each kind, from the same starts."""
    seed: int = 0
    """Seed of weights and batches."""
    state_noise: float = 0.0
    """Noise on the state in the training of `motion_chunk`."""
    out: Path = Path("outputs/environments")
    """Folder in which demonstrations are kept for later runs."""
    keep: bool = False
    """Keep the policies too, as LeRobot checkpoints."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


def main(args: Args) -> None:
    torch.set_num_threads(1)
    console = Console()
    figures: dict[str, float] = {}
    for name in args.tasks:
        task = make_task(name)
        shown = demonstrations(name, args.demonstrations, args.out, console)
        frames = sum(len(e["action"]) for e in shown)
        table = Table(
            "policy", "steps", "CPU s", "success", "object moved", f"{args.few} shown"
        )
        table.title = (
            f"{name}: {len(shown)} demonstrations, {frames} frames; {args.rollouts} of each"
        )
        with environments(name, args.rollouts, moved=False) as still:
            moves = task.moved_at is not None
            counts = [_by_expert(task, args, moved) for moved in (False, True)[: 1 + moves]]
            table.add_row("expert", "", "", *map(str, counts))
            for policy in args.policies:
                learned = _learn(name, policy, shown, args)
                row = {"unmoved": successes(still, learned)}
                if moves:
                    with environments(name, args.rollouts, moved=True) as moving:
                        row["moved"] = successes(moving, learned)
                few = _learn(name, policy, shown[: args.few], args)
                row["few"] = successes(still, few)
                cells = [str(row.get(key, "-")) for key in COLUMNS]
                table.add_row(policy, str(learned.steps), f"{learned.seconds:.0f}", *cells)
                console.print(f"[dim]{name} {policy}: {' '.join(cells)}[/]", highlight=False)
                figures |= {f"{name}_{policy}_{key}": float(n) for key, n in row.items()}
                figures[f"{name}_{policy}_cpu_s"] = learned.seconds
                if args.json is not None:
                    cli.write_json(args.json, figures)
                if args.keep:
                    learned.save(args.out / name / policy)
        console.print(table)


def demonstrations(name: str, count: int, folder: Path, console: Console) -> list[Episode]:
    """Demonstrations of a task: read from a folder, or made and kept there if it has fewer."""
    path = folder / f"{name}.safetensors"
    columns = load_file(path) if path.exists() else {}
    shown: list[Episode] = []
    for key in sorted(columns, key=lambda key: int(key.split(SEPARATOR)[0])):
        k, column = key.split(SEPARATOR, 1)
        if int(k) == len(shown):
            shown.append({})
        shown[int(k)][column] = columns[key]
    if len(shown) >= count:
        return shown[:count]
    task, seed, failed = make_task(name), 0, 0
    shown = []
    with Progress(console=console, transient=True) as progress:
        bar = progress.add_task(f"{name}: demonstrations", total=count)
        while len(shown) < count:
            episode = demonstrate(task, seed)
            seed += 1
            if episode is None:
                failed += 1
                if failed > max(3, len(shown)):
                    raise RuntimeError(f"{name}: {failed} of {seed} demonstrations failed")
                continue
            shown.append(episode)
            progress.advance(bar)
    if failed:
        console.print(f"{name}: the expert failed in {failed} of {seed}, which were left out")
    path.parent.mkdir(parents=True, exist_ok=True)
    columns = {
        f"{k}{SEPARATOR}{key}": x.contiguous()
        for k, e in enumerate(shown)
        for key, x in e.items()
    }
    unfinished = path.with_suffix(".unfinished")
    save_file(columns, unfinished)
    unfinished.rename(path)
    return shown


@contextmanager
def environments(name: str, count: int, *, moved: bool) -> Iterator[gym.vector.VectorEnv]:
    """Vector of environments of a task, as LeRobot makes them."""
    from public_tasks.lerobot_env import PublicTaskConfig

    config = PublicTaskConfig(task=name, move_object=moved)
    vector = config.create_envs(count)[config.type][0]
    try:
        yield vector
    finally:
        vector.close()


def _learn(name: str, policy: str, shown: Sequence[Episode], args: Args) -> Learned:
    setting = TASKS[name]
    return learn(
        policy,
        shown,
        make_task(name).fps,
        minutes=args.minutes,
        chunk=setting.chunk,
        executed=args.executed or setting.executed,
        seed=args.seed,
        state_noise=args.state_noise,
    )


def _by_expert(task: Any, args: Args, moved: bool) -> int:
    seeds = range(FIRST_SEED, FIRST_SEED + args.rollouts)
    return sum(succeeds(task, seed, moved=moved) for seed in seeds)


def successes(
    vector: gym.vector.VectorEnv, learned: Learned, episodes: int | None = None
) -> int:
    """Number of successes, by the code of `lerobot-eval`.

    Args:
        vector: Environments that run side by side.
        learned: Policy.
        episodes: Number of episodes; None: one in each environment.
    """
    from lerobot.processor import PolicyProcessorPipeline
    from lerobot.scripts.lerobot_eval import eval_policy

    torch.manual_seed(0)  # for policies that sample their actions
    nothing: Any = PolicyProcessorPipeline(steps=[])
    with redirect_stderr(StringIO()):  # a progress bar for every episode
        result = eval_policy(
            vector,
            learned.policy,
            nothing,
            nothing,
            learned.before,
            learned.after,
            n_episodes=episodes or vector.num_envs,
            start_seed=FIRST_SEED,
        )
    return sum(episode["success"] for episode in result["per_episode"])


if __name__ == "__main__":
    cli.run(main, Args)
