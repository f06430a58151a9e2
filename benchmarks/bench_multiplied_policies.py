"""Policies learned from demonstrations that `hrc multiply` made of five, in public tasks.

A policy learns from five demonstrations of the scripted expert (few), from these five
multiplied without physics (multiplied), from these five multiplied and judged by the task
(judged), or from a hundred demonstrations (many), for the same CPU time. It starts where no
demonstration does, and the task decides. The user of `hrc multiply` states where objects and
goals may be: where the task puts them. Every finished run is a line of `--runs`; runs that are
there already are not repeated. Needs tools/make_environments.sh.

    .venv-environments/bin/python benchmarks/bench_multiplied_policies.py
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("HF_HUB_OFFLINE", "1")

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import torch
from bench_environments import environments, successes
from bench_policies import ACTION, ENVIRONMENT, STATE, Episode, learn
from public_tasks.known import TASKS
from public_tasks.multiplied import STAGES, judge_of
from rich.console import Console
from rich.table import Table
from scipy.stats import binomtest

from hrc_learn import cli
from hrc_learn.cli.arguments import Multiply
from hrc_learn.cli.multiply_command import multiply

SETS = ("few", "multiplied", "judged", "many")
SIZES = {"few": "few", "multiplied": "episodes", "judged": "episodes", "many": "many"}
TOGETHER = 10
"""Environments that run side by side."""


@dataclass(frozen=True, kw_only=True)
class Args:
    tasks: tuple[str, ...] = tuple(STAGES)
    """Tasks in public_tasks/multiplied.py."""
    policies: tuple[str, ...] = ("act", "motion_chunk")
    """LeRobot's own and ours."""
    sets: tuple[str, ...] = SETS
    """Sets to learn from; see above."""
    few: int = 5
    """Demonstrations that are multiplied."""
    many: int = 100
    """Demonstrations of the last set; the few are the first of these."""
    episodes: int = 300
    """Multiplied demonstrations."""
    config: tuple[str, ...] = ()
    """Further settings of `hrc multiply`, as for its `--config`."""
    minutes: float = 0.5
    """CPU time of building and training each policy."""
    rollouts: int = 50
    """Rollouts of each policy."""
    seeds: tuple[int, ...] = (0,)
    """Of weights and batches."""
    out: Path = Path("outputs/multiplied_policies")
    """Folder of the datasets, which are made if missing."""
    runs: Path = Path("outputs/multiplied_policies.jsonl")
    """Receives a line for each run."""
    json: Path | None = None
    """Receives all figures as one flat object."""


def main(args: Args) -> None:
    torch.set_num_threads(1)
    console = Console()
    known = {key(run) for run in finished(args.runs)}
    for seed in args.seeds:
        for name in args.tasks:
            for policy in args.policies:
                for chosen in args.sets:
                    run = {
                        "task": name,
                        "policy": policy,
                        "set": chosen,
                        "episodes": getattr(args, SIZES[chosen]),
                        "minutes": args.minutes,
                        "rollouts": args.rollouts,
                        "seed": seed,
                        "config": [*args.config] if SIZES[chosen] == "episodes" else [],
                    }
                    if key(run) in known:
                        continue
                    run |= measured(run, args)
                    args.runs.parent.mkdir(parents=True, exist_ok=True)
                    with args.runs.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(run) + "\n")
                    console.print(run, highlight=False)
    show([*finished(args.runs)], args, console)


def measured(run: dict[str, Any], args: Args) -> dict[str, Any]:
    """Steps and time of the training, and the number of successful rollouts."""
    name = run["task"]
    shown, stage = episodes(name, run["set"], args), STAGES[name]()
    setting = TASKS[name]
    learned = learn(
        run["policy"],
        shown,
        stage.task.fps,
        minutes=args.minutes,
        chunk=setting.chunk,
        executed=setting.executed,
        seed=run["seed"],
    )
    begun = time.process_time()
    with environments(name, TOGETHER, moved=False) as vector:
        vector.set_attr("_max_episode_steps", stage.longest)  # pyright: ignore[reportAttributeAccessIssue]
        done = successes(vector, learned, args.rollouts)
    return {
        "frames": sum(len(e[ACTION]) for e in shown),
        "steps": learned.steps,
        "cpu_s": round(learned.seconds, 1),
        "rollout_cpu_s": round(time.process_time() - begun, 1),
        "successes": done,
    }


def episodes(name: str, chosen: str, args: Args) -> list[Episode]:
    """Episodes of a set, in the columns that the policy sees in the task."""
    folder, stage = args.out / name, STAGES[name]()
    shown = folder / f"demonstrations_{args.many}"
    if not shown.exists():
        stage.record(shown, args.many, name)
    if SIZES[chosen] != "episodes":
        return [*map(stage.seen, read(shown)[: args.few if chosen == "few" else args.many])]
    few = f"multiply.demonstrations={[*range(args.few)]}"
    judge = judge_of(name) if chosen == "judged" else ""
    label = "_".join([chosen, *args.config]).replace("/", "")
    made = folder / f"{label}_{args.few}_{args.episodes}"
    command = Multiply(
        dataset=shown,
        episodes=args.episodes,
        out=made,
        judge=judge,
        config=(few, *stage.ranges(), *args.config),
    )
    if not made.exists() and multiply(command):
        raise SystemExit(1)
    return [*map(stage.seen, read(made))]


def read(folder: Path) -> list[Episode]:
    """Observations and actions of a dataset, by episode."""
    rows = pq.read_table(sorted(folder.glob("data/*/*.parquet")))
    columns = {
        k: torch.tensor(rows.column(k).to_pylist()) for k in (STATE, ENVIRONMENT, ACTION)
    }
    lengths = torch.unique_consecutive(
        torch.tensor(rows.column("episode_index").to_pylist()), return_counts=True
    )[1]
    parts = {k: x.split(lengths.tolist()) for k, x in columns.items()}
    return [{k: x[n] for k, x in parts.items()} for n in range(len(lengths))]


def key(run: dict[str, Any]) -> str:
    """What is asked of a run, as text."""
    asked = ("task", "policy", "set", "episodes", "minutes", "rollouts", "seed", "config")
    return json.dumps([run[name] for name in asked])


def finished(path: Path) -> Iterator[dict[str, Any]]:
    """Finished runs; a line that was cut off is left out."""
    for line in path.read_text("utf-8").splitlines() if path.exists() else ():
        try:
            yield json.loads(line)
        except json.JSONDecodeError:
            continue


def show(runs: list[dict[str, Any]], args: Args, console: Console) -> None:
    """Successes of all seeds with 95 % intervals."""
    table = Table("task", "policy", "set", "steps", "successes", "95 % interval")
    figures: dict[str, float] = {}
    groups: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for run in runs:
        label = "+".join([run["set"], *run["config"]])
        groups.setdefault((run["task"], run["policy"], label), []).append(run)
    for group, each in groups.items():
        done, n = (sum(run[name] for run in each) for name in ("successes", "rollouts"))
        low, high = binomtest(done, n).proportion_ci(method="wilson")
        steps = sum(run["steps"] for run in each) // len(each)
        table.add_row(*group, str(steps), f"{done} of {n}", f"{low:.0%} to {high:.0%}")
        figures["_".join(group)] = done / n
    console.print(table)
    cli.write_values(args.json, figures)


if __name__ == "__main__":
    cli.run(main, Args)
