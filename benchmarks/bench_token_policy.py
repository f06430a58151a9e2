"""Compare tokens of action chunks by the policies that learn to write them: ours, FAST's, bins.

One small decoder-only transformer reads the observation, without images, and the last two
actions. It writes the tokens of the next chunk, greedily. All codes use the same chunks and the
same CPU time: the numbers of training steps follow from the costs of steps, which are measured
in turn, because other programs change the speed of the machine. Our code has the reconstruction
error of FAST's recipe at its default scale and also 1024 tokens. Bins (RT-2) have 256 levels
for each column of every k-th action, with straight lines between; k is chosen such that a chunk
needs at most 80 tokens.

Tasks are public environments (bench_environments.py). Reported are success and the largest
reward of episodes from unseen starts, which execute half of each chunk and end after twice the
mean duration of the demonstrations. Sets are LeRobot datasets of people. Reported is the error
of the first half second of chunks of held-out episodes, relative to half the range of each
column. Sequences of FAST that do not decode repeat the last action; `relaxed` truncates or pads
their coefficients, as LeRobot does.

    tools/make_environments.sh
    .venv-environments/bin/python benchmarks/bench_token_policy.py --sets unitree/pour

Every finished run is a line of `--runs`; existing runs are not repeated.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MUJOCO_GL", "egl")

import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from bench_tokens import VOCABULARY
from jaxtyping import Float
from rich.console import Console
from rich.table import Table
from scipy.stats import t as student
from token_codes import CODES, MOST_COMPARED, Code, Windows, code_of, equal_length
from token_writer import Policy, Training, relative_costs
from torch import Tensor

from hrc_learn import cli
from hrc_learn.cli._run import write_values

STATE, ENVIRONMENT, ACTION = "observation.state", "observation.environment_state", "action"
MOST_FITTED, MOST_LEARNED = 4000, 12_000
"""Largest number of chunks for fitting codes and for learning."""
SECONDS, JUDGED = 1.0, 0.5
"""Duration of chunks of sets, and of the part that is judged [s]."""
EVERY = 5
"""Every n-th episode of a set is held out."""
FIRST_SEED = 10_000
"""Seed of the first unseen start: demonstrations count from 0."""
LATE = 2.0
"""Time limit of an episode, relative to the mean duration of the demonstrations."""
TOGETHER = 25
"""Number of environments that run in parallel, so that one pass of the network serves all."""
DECIMALS = 5
"""Number of decimals to which actions are rounded, so that columns with few values keep few
values."""
UNIT = 16
"""Number of tokens of a chunk in the unit of CPU time."""
type Episode = dict[str, Tensor]


@dataclass(frozen=True, kw_only=True)
class Args:
    tasks: tuple[str, ...] = ("metaworld-pick-place:150", "so101-pick-place:150", "pusht:50")
    """Tasks of public_tasks/known.py, as NAME:DEMONSTRATIONS."""
    sets: tuple[str, ...] = ()
    """LeRobot datasets, as FOLDER, or as FOLDER:COLUMN if that column's next value is the
    action, as in hand-guided demonstrations."""
    codes: tuple[str, ...] = CODES
    """Codes to compare; ours-free-256 is ours with 256 tokens that also encode the start."""
    units: int = 900
    """CPU time of training, as a number of steps of a code with `UNIT` tokens."""
    seeds: int = 3
    """Number of seeds of weights and batches."""
    rollouts: int = 50
    """Episodes of each task."""
    width: int = 96
    """Width of the network."""
    layers: int = 2
    """Layers of the network."""
    demos: Path = Path("outputs/environments")
    """Folder of the tasks' demonstrations, made if missing."""
    runs: Path = Path("outputs/token_policy.jsonl")
    """File that receives a line for each run."""
    json: Path | None = None
    """File for means and intervals, one flat JSON object of numbers."""


class Job:
    """A task or a set: its data, their code and the evaluation."""

    name: str
    learned: Windows
    fps: float

    def __init__(self, name: str, episodes: Sequence[Episode], fps: float, chunk: int):
        """Scale the episodes to half the range of each moving column."""
        self.name, self.fps, self.chunk = name, fps, chunk
        actions = np.concatenate([e[ACTION].numpy() for e in episodes]).astype(float)
        low, high = np.quantile(actions, (0.01, 0.99), axis=0)
        self.moves = high > low
        self.centre, self.half = (low + high) / 2, np.where(self.moves, (high - low) / 2, 1)
        # The first action of an episode represents the actions before it.
        first = np.stack([_seen(e)[0] for e in episodes])
        begun = np.stack([self.normalised(e[ACTION].numpy()[0]) for e in episodes])
        self._mean, self._spread = first.mean(0), first.std(0) + 1e-3
        features = np.c_[np.ones(len(first)), (first - self._mean) / self._spread]
        ridge = 1e-2 * np.diag([0.0] + [1.0] * first.shape[1])
        self._weights = np.linalg.solve(features.T @ features + ridge, features.T @ begun)
        self.learned = self.windows(episodes).some(MOST_LEARNED)
        self._fitted = self.learned.some(MOST_FITTED).chunks(fps)

    def normalised(self, actions: Float[np.ndarray, "*n A"]) -> Float[np.ndarray, "*n D"]:
        """Moving columns of actions, relative to half their ranges."""
        return ((actions - self.centre) / self.half)[..., self.moves].round(DECIMALS)

    def restored(self, y: Float[np.ndarray, "*n D"]) -> Float[np.ndarray, "*n A"]:
        """Actions from normalised ones."""
        whole = np.broadcast_to(self.centre, (*y.shape[:-1], len(self.centre))).copy()
        whole[..., self.moves] += y * self.half[self.moves]
        return whole

    def begun(self, seen: Float[np.ndarray, "*n F"]) -> Float[np.ndarray, "*n D"]:
        """First action of episodes, normalised, predicted from the first observation."""
        x = (seen - self._mean) / self._spread
        return (self._weights[0] + x @ self._weights[1:]).round(DECIMALS)

    def windows(self, episodes: Sequence[Episode]) -> Windows:
        """Chunks from every frame; the last action is held after the end."""
        parts = []
        for e in episodes:
            seen, a = _seen(e), self.normalised(e[ACTION].numpy().astype(float))
            past = np.concatenate([self.begun(seen[:1]).repeat(2, 0), a])
            t = np.arange(len(a))
            chunk = a[(t[:, None] + np.arange(self.chunk)).clip(max=len(a) - 1)]
            parts.append((seen, past[t + 1], (past[t + 1] - past[t]) * self.fps, chunk))
        return Windows(*map(np.concatenate, zip(*parts, strict=True)))

    @cache  # noqa: B019  jobs last as long as the program
    def encoded(self, code: str) -> tuple[Code, list[list[int]], dict[str, float]]:
        """Code, tokens to learn, and tokens and errors per chunk."""
        begun = time.process_time()
        made = code_of(code, self._fitted)
        ids = made.encode(self.learned.chunks(self.fps))
        few = self.learned.some(MOST_COMPARED)
        rows = equal_length(made.encode(few.chunks(self.fps)), made.end or 0)[0].numpy()
        restored, broken = made.decode(rows, few, True)
        error = restored - few.chunk
        figures = {
            "tokens": float(np.mean([len(row) for row in ids])),
            "code_rmse": float(np.sqrt(np.mean(error**2))),
            "own_undecodable": float(broken.mean()),
            "code_s": time.process_time() - begun,
        }
        return made, ids, figures

    def judged(self, policy: Policy, relaxed: bool) -> dict[str, float]:
        """Measured values of a policy."""
        raise NotImplementedError


class TaskJob(Job):
    """A public environment."""

    def __init__(self, source: str, args: Args):
        """Read demonstrations, or make them."""
        from bench_environments import demonstrations
        from public_tasks.known import TASKS, make_task

        name, _, number = source.partition(":")
        self.executed, self.rollouts = TASKS[name].chunk // 2, args.rollouts
        count = min(TOGETHER, args.rollouts)
        self.tasks = [make_task(name) for _ in range(count)]
        shown = demonstrations(name, int(number), args.demos, Console())
        self.longest = round(LATE * np.mean([len(e[ACTION]) for e in shown]))
        super().__init__(name, shown, self.tasks[0].fps, TASKS[name].chunk)

    def judged(self, policy: Policy, relaxed: bool) -> dict[str, float]:
        """Success and mean largest reward of episodes from unseen starts."""
        best, failures = [], []
        for first in range(0, self.rollouts, len(self.tasks)):
            seeds = range(first, min(first + len(self.tasks), self.rollouts))
            best += self._rolled_out(policy, relaxed, [FIRST_SEED + k for k in seeds], failures)
        return {
            "success": float(np.mean([reward == 1 for reward in best])),
            "reward": float(np.mean(best)),
            "undecodable": float(np.mean(failures)),
        }

    def _rolled_out(
        self, policy: Policy, relaxed: bool, seeds: list[int], failures: list[bool]
    ) -> list[float]:
        """Largest reward of an episode from each seed; 1 for success."""
        seen = [_numbers(t.begin(seed)) for t, seed in zip(self.tasks, seeds, strict=False)]
        past = self.begun(np.stack(seen))[:, None].repeat(2, 1)
        best, running, steps = np.zeros(len(seeds)), list(range(len(seeds))), 0
        while running and steps < self.longest:
            start, before = past[running, 1], past[running, 0]
            now = np.stack([seen[i] for i in running])
            last = Windows(now, start, (start - before) * self.fps, start[:, None])
            chunks, failed = policy.act(last, relaxed)
            failures += failed.tolist()
            for i, chunk in zip(tuple(running), chunks, strict=True):
                for y in chunk[: self.executed].round(DECIMALS):
                    observed, done = self.tasks[i].step(self.restored(y).astype(np.float32))
                    seen[i], past[i] = _numbers(observed), (past[i, 1], y)
                    reward = 1.0 if done else getattr(self.tasks[i], "reward", 0.0)
                    best[i] = max(best[i], min(reward, 1.0 if done else 1 - 1e-6))
                    if done:
                        running.remove(i)
                        break
            steps += self.executed
        return best.tolist()


class SetJob(Job):
    """A dataset of people's demonstrations."""

    def __init__(self, source: str, args: Args):
        """Read the dataset."""
        from hrc_learn.demos.read.dataset_folder import open_folder
        from hrc_learn.lerobot.policy.policy_base import read_episodes

        root, _, column = source.partition(":")
        folder = open_folder(root)
        column = column or ACTION
        columns = read_episodes(root, list(dict.fromkeys((STATE, column))))
        episodes = [
            {STATE: e[STATE].float(), ACTION: e[column].float()}
            if column == ACTION
            else {STATE: e[STATE][:-1].float(), ACTION: e[column][1:].float()}
            for e in columns
        ]
        shown = [e for k, e in enumerate(episodes) if k % EVERY]
        super().__init__(Path(root).name, shown, folder.fps, round(SECONDS * folder.fps))
        self._unseen = self.windows(episodes[::EVERY]).some(MOST_COMPARED)

    def judged(self, policy: Policy, relaxed: bool) -> dict[str, float]:
        """Errors of chunks, of holding the last action and of holding its velocity."""
        made, failed = policy.act(self._unseen, relaxed)
        _, start, velocity, chunk = self._unseen
        ahead = (np.arange(self.chunk) + 1)[:, None] / self.fps
        guesses = {
            "error": made,
            "held_error": start[:, None],
            "drift_error": start[:, None] + ahead * velocity[:, None],
        }
        judged = round(JUDGED * self.fps)
        errors = {
            name: float(np.sqrt(np.mean((guess - chunk)[:, :judged] ** 2)))
            for name, guess in guesses.items()
        }
        return errors | {"undecodable": float(failed.mean())}


def main(args: Args) -> None:
    torch.set_num_threads(1)
    console = Console()
    done = list(_read(args.runs))
    known = {(run["job"], run["code"], run["seed"]) for run in done}
    jobs: dict[str, Callable[[], Job]] = {
        _name(source): partial(kind, source, args)
        for kind, sources in ((TaskJob, args.tasks), (SetJob, args.sets))
        for source in sources
    }
    made: dict[str, Job] = {}
    for seed, name, code in product(range(args.seeds), jobs, args.codes):
        if (name, code, seed) in known:
            continue
        if name not in made:
            made[name] = jobs[name]()
        run = {"job": name, "code": code, "seed": seed} | measured(made[name], code, seed, args)
        args.runs.parent.mkdir(parents=True, exist_ok=True)
        with args.runs.open("a", encoding="utf-8") as file:
            file.write(json.dumps(run) + "\n")
        console.print(json.dumps(run), highlight=False, soft_wrap=True)
        done.append(run)
    show([run for run in done if run["job"] in jobs], args, console)


def measured(job: Job, code: str, seed: int, args: Args) -> dict[str, Any]:
    """Measured values of one run: code, training, evaluation and time of inference."""
    made, ids, figures = job.encoded(code)
    settings = {"seed": seed, "width": args.width, "layers": args.layers}
    unit = np.random.default_rng(seed).integers(VOCABULARY, size=(len(ids), UNIT)).tolist()
    sizes = ((VOCABULARY, unit), (made.size, ids))
    cost = relative_costs([Training(job.learned, *what, **settings) for what in sizes])[1]
    training, steps = (
        Training(job.learned, made.size, ids, **settings),
        round(args.units / cost),
    )
    begun = time.process_time()
    losses = training.run(steps)
    policy = Policy(training.writer, made)
    result: dict[str, Any] = figures | {
        "steps": steps,
        "cost": cost,
        "trained_s": time.process_time() - begun,
        "weights": sum(p.numel() for p in policy.writer.parameters()),
        "losses": [round(loss, 4) for loss in losses],
    }
    times = []
    for k in range(20):
        one = Windows(*(x[k : k + 1] for x in job.learned))
        begun = time.process_time()
        policy.act(one, relaxed=False)
        times.append(time.process_time() - begun)
    result["inference_ms"] = 1e3 * float(np.median(times))
    begun = time.process_time()
    result |= job.judged(policy, relaxed=False)
    result["judged_s"] = time.process_time() - begun
    if result["undecodable"] > 0:
        relaxed = job.judged(policy, relaxed=True)
        result |= {f"relaxed_{name}": value for name, value in relaxed.items()}
    return result


def show(runs: list[dict[str, Any]], args: Args, console: Console) -> None:
    """Table of means over the seeds with 95 % intervals, and of differences to ours."""
    table = Table("job", "code", "tokens", "steps", "ms", "loss", "measure", "value", "ours")
    figures: dict[str, float] = {}
    for job in dict.fromkeys(run["job"] for run in runs):
        of_job = [run for run in runs if run["job"] == job]
        task = "success" in of_job[0]
        for measure in ("success", "reward") if task else ("error",):
            for code, name in product(args.codes, (measure, f"relaxed_{measure}")):
                mine = {r["seed"]: r for r in of_job if r["code"] == code and measure in r}
                if not any(name in run for run in mine.values()):
                    continue
                values = {k: run.get(name, run[measure]) for k, run in mine.items()}
                ours = {r["seed"]: r[measure] for r in of_job if r["code"] == "ours"}
                mean, half = interval(list(values.values()))
                more = [ours[k] - v for k, v in values.items() if k in ours]
                gap, wide = interval(more)
                sign = 1 if task else -1
                better = "better" if sign * gap > 0 else "worse"
                verdict = better if abs(gap) > wide else "draw"
                verdict = "one seed" if math.isnan(wide) else verdict
                figures |= {f"{job}_{code}_{name}": mean, f"{job}_{code}_{name}_half": half}
                average = {
                    key: float(np.mean([run[key] for run in mine.values()]))
                    for key in ("tokens", "steps", "inference_ms", "undecodable")
                }
                figures |= {f"{job}_{code}_{key}": value for key, value in average.items()}
                table.add_row(
                    job,
                    code,
                    *(f"{average[key]:.3g}" for key in ("tokens", "steps", "inference_ms")),
                    f"{np.mean([run['losses'][-1] for run in mine.values()]):.2f}",
                    name,
                    f"{mean:.3f} ± {half:.3f}",
                    f"{verdict} {gap:+.3f} ± {wide:.3f}" if code != "ours" else "",
                )
    console.print(table)
    write_values(args.json, figures)


def interval(values: Sequence[float]) -> tuple[float, float]:
    """Mean and half-width of its 95 % interval, by Student's distribution."""
    n = len(values)
    if n < 2:
        return (values[0] if values else math.nan), math.nan
    half = student.ppf(0.975, n - 1) * np.std(values, ddof=1) / math.sqrt(n)
    return float(np.mean(values)), float(half)


def _seen(episode: Episode) -> Float[np.ndarray, "T F"]:
    parts = [episode[key].numpy() for key in (STATE, ENVIRONMENT) if key in episode]
    return np.concatenate(parts, 1).astype(float)


def _numbers(seen: dict[str, Float[np.ndarray, "_"]]) -> Float[np.ndarray, "F"]:
    keys = ("agent_pos", "environment_state")
    return np.concatenate([seen[key] for key in keys if key in seen]).astype(float)


def _name(source: str) -> str:
    return Path(source.partition(":")[0]).name


def _read(path: Path) -> Iterator[dict[str, Any]]:
    """Finished runs; an incomplete line is left out."""
    for line in path.read_text("utf-8").splitlines() if path.exists() else ():
        try:
            yield json.loads(line)
        except ValueError:
            continue


if __name__ == "__main__":
    cli.run(main, Args)
