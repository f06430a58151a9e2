"""A chunking policy in closed loop, with different request rates and delays.

`motion_chunk` learns from a dataset of `hrc record expert` and performs its task in MuJoCo, in
simulated time, from starts that were not demonstrated. A chunk is requested every 5, 10, 25 or
50 actions; or the policy is reset once during the task, as in LeRobot's DAgger; or each chunk
takes 300 ms to compute, while the arm continues:

    real-time   LeRobot's queue for real-time chunking, which passes the rest of the last chunk
    unaware     the same delay, but the policy does not know it: each chunk starts at the
                observation, and its execution starts at the action that is due by then

Reported are the success rate, the largest step between actions where chunks meet, and the
largest step anywhere. Steps are relative to the largest step in the demonstrations, for the
component with the largest ratio.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("HF_HUB_OFFLINE", "1")

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from bench_policies import ACTION, STATE, config_of, statistics, train
from rich.console import Console
from rich.table import Table

from hrc_learn import cli

FIRST_SEED = 50_000
"""First seed of starts that were not demonstrated: demonstrations use seeds from 0 on."""


@dataclass(frozen=True, kw_only=True)
class Args:
    data: Path
    """Dataset of `hrc record expert`."""
    scenario: str = "placing"
    """Scenario of the dataset."""
    minutes: float = 1.0
    """CPU time of training."""
    rollouts: int = 10
    """Number of episodes of each kind, from the same starts."""
    periods: tuple[int, ...] = (5, 10, 25, 50)
    """Numbers of actions executed before the next request."""
    delay: float = 0.3
    """Time for which the policy computes [s]."""
    seed: int = 0
    """Seed of weights and batches."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


@dataclass
class Executed:
    """Results of one kind of execution."""

    successes: int = 0
    seam: float = 0.0
    anywhere: float = 0.0


type Stepper = Callable[[dict[str, Any]], tuple[np.ndarray, bool]]
"""Map from an observation to an action, and a flag for the first action of a chunk."""


def main(args: Args) -> None:
    from hrc_learn.lerobot.envs import ArmEnvConfig
    from hrc_learn.lerobot.policy.policy_base import read_episodes

    torch.set_num_threads(1)
    columns = read_episodes(args.data, (STATE, ACTION))
    shown = [{STATE: e[STATE].float(), ACTION: e[ACTION].float()} for e in columns]
    largest = np.max([e[ACTION].diff(dim=0).abs().amax(0).numpy() for e in shown], axis=0)
    config = ArmEnvConfig(task=args.scenario, fps=round(_fps(args.data)))
    policy, steps, seconds = _learn(shown, config.fps, args)
    Console().print(f"motion_chunk: {steps} steps of training, {seconds:.0f} s of CPU")
    env = gym.make(config.gym_id, **config.gym_kwargs)
    late = round(args.delay * config.fps)
    ways: dict[str, Callable[[], Stepper]] = {
        **{f"every {n}": lambda n=n: _selecting(policy, n) for n in args.periods},
        "every 25, reset once": lambda: _selecting(policy, 25, reset_at=150),
        f"real-time, {args.delay:g} s": lambda: _real_time(policy, late, 25, told=True),
        f"unaware, {args.delay:g} s": lambda: _real_time(policy, late, 25, told=False),
    }
    table = Table("asked", "successes", "largest step at a seam", "largest step")
    table.title = f"{args.scenario}, steps over the demonstrators' largest"
    figures: dict[str, float] = {}
    for name, make in ways.items():
        total = Executed()
        for k in range(args.rollouts):
            _roll_out(env, make(), FIRST_SEED + k, largest, total)
        key = name.replace(",", "").replace(" ", "_")
        figures |= {f"{key}_{k}": float(v) for k, v in vars(total).items()}
        table.add_row(
            name,
            f"{total.successes} of {args.rollouts}",
            f"{total.seam:.2f}",
            f"{total.anywhere:.2f}",
        )
        Console().print(name, total)
    Console().print(table)
    if args.json is not None:
        cli.write_json(args.json, figures)


def _fps(root: Path) -> float:
    from hrc_learn.demos.read.dataset_folder import read_info

    return float(read_info(root)["fps"])


def _learn(shown: Any, fps: float, args: Args) -> tuple[Any, int, float]:
    from lerobot.policies import make_pre_post_processors

    import hrc_learn.lerobot  # noqa: F401  registers ours
    from hrc_learn.lerobot.policy.motion_chunk_policy import MotionChunkPolicy

    torch.manual_seed(args.seed)
    stats: Any = statistics(shown)
    begun = time.process_time()
    policy = MotionChunkPolicy(config_of("motion_chunk", shown[0], fps, 50, 25), stats)
    policy.fit(shown)
    before, _ = make_pre_post_processors(policy.config, dataset_stats=stats)
    until = begun + 60 * args.minutes
    steps = train(policy, before, shown, fps, until, 64, args.seed)
    return policy, steps, time.process_time() - begun


def _roll_out(env: Any, step: Stepper, seed: int, largest: np.ndarray, total: Executed) -> None:
    observation, _ = env.reset(seed=seed)
    before, ended = None, False
    while not ended:
        batch = {STATE: torch.from_numpy(observation["agent_pos"])[None]}
        action, begins = step(batch)
        if before is not None:
            share = float((np.abs(action - before) / largest).max())
            total.anywhere = max(total.anywhere, share)
            if begins:
                total.seam = max(total.seam, share)
        observation, _, success, late, _ = env.step(action)
        before, ended = action, success or late
    total.successes += success


def _selecting(policy: Any, period: int, reset_at: int | None = None) -> Stepper:
    """Steps of LeRobot's synchronous execution: a chunk is requested when the last one is used
    up, without delay.
    """
    policy.config.n_action_steps = period
    policy.reset()
    calls = 0

    def step(batch: dict[str, Any]) -> tuple[np.ndarray, bool]:
        nonlocal calls
        if calls == reset_at:
            policy.reset()
        begins = not policy._action_queue
        calls += 1
        return policy.select_action(batch)[0].numpy(), begins

    return step


def _real_time(policy: Any, delay: int, horizon: int, *, told: bool) -> Stepper:
    """Steps of LeRobot's queue for real-time chunking, in simulated time.

    A chunk is requested when a given number of the last chunk's actions have been executed, and
    arrives after `delay` further actions.
    """
    from lerobot.policies.rtc.action_queue import ActionQueue
    from lerobot.policies.rtc.configuration_rtc import RTCConfig

    policy.reset()
    queue = ActionQueue(RTCConfig(enabled=True, execution_horizon=10))
    thinking: tuple[int, torch.Tensor] | None = None
    done = 0

    def think(batch: dict[str, Any]) -> torch.Tensor:
        if told:
            left = queue.get_left_over()
            known = 0 if left is None else delay
            return policy.predict_action_chunk(
                batch, inference_delay=known, prev_chunk_left_over=left
            )[0]
        policy.reset()
        return policy.predict_action_chunk(batch)[0]

    def step(batch: dict[str, Any]) -> tuple[np.ndarray, bool]:
        nonlocal thinking, done
        begins = False
        if queue.empty():  # the arm waits for the first chunk
            chunk = think(batch)
            queue.merge(chunk, chunk, 0)
            done, begins = 0, True
        if thinking is not None and thinking[0] == 0:
            queue.merge(thinking[1], thinking[1], delay)
            thinking, done, begins = None, delay, True
        elif thinking is None and done >= horizon:
            thinking = (delay, think(batch))
        if thinking is not None:
            thinking = (thinking[0] - 1, thinking[1])
        done += 1
        action = queue.get()
        assert action is not None
        return action.numpy(), begins

    return step


if __name__ == "__main__":
    cli.run(main, Args)
