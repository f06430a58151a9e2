"""Policies in MetaWorld, where the object may be moved while the arm is on its way.

Demonstrations are by the scripted experts of MetaWorld, from beginnings of its own and without
disturbances. Policies see the numbers that MetaWorld shows of the hand, the object and the
goal, learn for the same time by the clock of the CPU, and are rolled out from beginnings that
were not shown: as they are; with the object moved aside once the arm is on its way, to where
another demonstration may have had it; and after three demonstrations only. An episode succeeds
as soon as MetaWorld says so, as in LeRobot.

Actions are where the hand is sent, as on most robots; MetaWorld takes the change to it, up to a
centimetre at a time.

MetaWorld demands a MuJoCo of its own:

    tools/make_metaworld.sh
    .venv-metaworld/bin/python benchmarks/bench_metaworld.py
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("HF_HUB_OFFLINE", "1")

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from bench_policies import ACTION, STATE, Actor, Episode, learn
from jaxtyping import Float
from rich.console import Console
from rich.table import Table
from torch import Tensor

from hrc_learn import cli

FPS = 80.0
"""Of MetaWorld: five steps of simulation of 2.5 ms an action."""
FIRST_SEED = 10_000
"""Of beginnings that were not shown: demonstrations count from 0."""
LONGEST = 200
"""Actions after which an episode has failed: some three times what the experts take."""
PER_METRE = 100.0
"""MetaWorld's own action of a change of position; at most 1."""


@dataclass(frozen=True, kw_only=True)
class Args:
    tasks: tuple[str, ...] = ("pick-place-v3", "push-v3")
    """Of MetaWorld, with one object that can be moved and named as there."""
    policies: tuple[str, ...] = ("nearest", "act", "dmp", "motion_chunk")
    """As of bench_policies.py, and diffusion, which needs LeRobot's extra of that name."""
    demonstrations: int = 50
    """To learn from."""
    few: int = 3
    """To learn from in the last column."""
    minutes: float = 0.3
    """CPU time of building and training each."""
    rollouts: int = 12
    """Of each kind, from the same beginnings."""
    moved: float = 0.07
    """How far the object is moved [m]."""
    moved_at: int = 12
    """Actions after which it is."""
    chunk: int = 24
    """Actions predicted at once."""
    executed: int = 3
    """Of these, how many are carried out before the next prediction."""
    seed: int = 0
    """Of weights and batches."""
    json: Path | None = None
    """Receives all figures as one flat object."""


def main(args: Args) -> None:
    if find_spec("metaworld") is None:
        raise ValueError(
            "no MetaWorld here: tools/make_metaworld.sh, then run this by "
            ".venv-metaworld/bin/python"
        )
    # Its experts ask for more than its arm does, and say so at each action.
    warnings.filterwarnings("ignore", message="Constant.s. may be too high")
    torch.set_num_threads(1)
    figures: dict[str, float] = {}
    for name in args.tasks:
        task = _Task(name)
        shown = [task.demonstration(k) for k in range(args.demonstrations)]
        frames = sum(len(e[ACTION]) for e in shown)
        columns = ("steps", "success", "object moved", f"{args.few} demonstrations")
        table = Table("policy", *columns)
        table.title = (
            f"{name}: {len(shown)} demonstrations, {frames} frames, {args.rollouts} of each"
        )
        counts = [_successes(task, task.expert, args, moved) for moved in (False, True)]
        table.add_row("expert", "", *map(str, counts), "")
        for policy in args.policies:
            actor, steps, seconds = _learn(policy, shown, args)
            counts = [_successes(task, actor, args, moved) for moved in (False, True)]
            actor, _, _ = _learn(policy, shown[: args.few], args)
            counts.append(_successes(task, actor, args, False))
            table.add_row(policy, str(steps), *map(str, counts))
            keys = ("unmoved", "moved", "few")
            figures |= {
                f"{name}_{policy}_{key}": float(n) for key, n in zip(keys, counts, strict=True)
            }
            figures[f"{name}_{policy}_cpu_s"] = seconds
            if args.json is not None:
                cli.write_json(args.json, figures)
        Console().print(table)


def _learn(name: str, shown: Sequence[Episode], args: Args) -> tuple[Actor, int, float]:
    return learn(
        name,
        shown,
        FPS,
        minutes=args.minutes,
        chunk=args.chunk,
        executed=args.executed,
        seed=args.seed,
    )


def _successes(task: _Task, actor: Actor, args: Args, moved: bool) -> int:
    away = args.moved if moved else 0.0
    seeds = range(FIRST_SEED, FIRST_SEED + args.rollouts)
    return sum(task.roll_out(actor, seed, args.executed, away, args.moved_at) for seed in seeds)


class _Task:
    """One of MetaWorld's, begun as LeRobot begins it."""

    def __init__(self, name: str):
        import metaworld  # pyright: ignore[reportMissingImports]
        from metaworld import policies  # pyright: ignore[reportMissingImports]

        suite = metaworld.MT1(name, seed=42)
        self._env: Any = suite.train_classes[name]()
        self._env.set_task(suite.train_tasks[0])
        self._env._freeze_rand_vec, self._env.seeded_rand_vec = False, True
        words = "".join(word.capitalize() for word in name.split("-"))
        self.expert = _Expert(getattr(policies, f"Sawyer{words}Policy")(), self._hand)

    def demonstration(self, seed: int) -> Episode:
        """States and actions of the expert, to the first success."""
        states, actions = [], []
        seen, done = self._begin(seed), False
        while not done:
            states.append(_state(seen))
            actions.append(self.expert.act(states[-1]))
            seen, done = self._step(actions[-1])
            if len(actions) == LONGEST:
                raise RuntimeError(f"the expert fails from the beginning with seed {seed}")
        return {STATE: torch.stack(states), ACTION: torch.stack(actions)}

    def roll_out(
        self, actor: Actor, seed: int, executed: int, away: float, moved_at: int
    ) -> bool:
        """Whether an episode succeeds, with the object moved by `away` [m] under way."""
        actor.begin(executed)
        seen = self._begin(seed)
        for k in range(LONGEST):
            if k == moved_at and away:
                seen = self._move_object(away, np.random.default_rng(seed))
            seen, done = self._step(actor.act(_state(seen)))
            if done:
                return True
        return False

    def _begin(self, seed: int) -> np.ndarray:
        self._env.seed(seed)
        return self._env.reset(seed=seed)[0]

    def _hand(self) -> Float[np.ndarray, "3"]:
        """Where the hand has been sent [m]."""
        return self._env.data.mocap_pos[0].copy()

    def _step(self, action: Float[Tensor, "4"]) -> tuple[np.ndarray, bool]:
        own = action.double().numpy()
        own[:3] = PER_METRE * (own[:3] - self._hand())
        seen, _, _, _, info = self._env.step(own.clip(-1, 1))
        return seen, bool(info["success"])

    def _move_object(self, away: float, rng: np.random.Generator) -> np.ndarray:
        """In a direction that leaves it where it may be at the beginning of an episode."""
        space = self._env._random_reset_space
        low, high = space.low[:2], space.high[:2]
        where = self._env._get_pos_objects()[:3].copy()
        aside = where
        for _ in range(1000):
            angle = rng.uniform(0, 2 * math.pi)
            aside = where + away * np.array([math.cos(angle), math.sin(angle), 0.0])
            if (aside[:2] >= low).all() and (aside[:2] <= high).all():
                break
        else:
            raise RuntimeError(
                f"no place {away} m from {where} is one that MetaWorld begins with"
            )
        self._env._set_obj_xyz(aside)
        return self._env._get_obs()


@dataclass(frozen=True)
class _Expert:
    """What MetaWorld does itself."""

    policy: Any
    hand: Callable[[], np.ndarray]

    def begin(self, executed: int) -> None:
        """It sees anew for every action."""

    def act(self, state: Tensor) -> Tensor:
        seen = np.concatenate([state[:18], np.zeros(18), state[18:]])
        action = self.policy.get_action(seen).astype(float).clip(-1, 1)
        action[:3] = self.hand() + action[:3] / PER_METRE
        return torch.from_numpy(action).float()


def _state(seen: Float[np.ndarray, "39"]) -> Float[Tensor, "21"]:
    """Without the frame before, which MetaWorld repeats in the middle."""
    return torch.from_numpy(np.concatenate([seen[:18], seen[36:]])).float()


if __name__ == "__main__":
    cli.run(main, Args)
