"""Compare ways to convert the chunks of policies to setpoints at the rate of the motors.

Every fifth episode of each LeRobot dataset is held out. Policies of LeRobot and ours learn from
the others, observe the states of the held-out episodes, and predict chunks of actions. The same
actions are converted to setpoints in several ways:

    hold         each action immediately, as in LeRobot
    line         lines between actions, LeRobot's interpolation_multiplier
    average      exponential moving average of actions, then lines
    ensemble     ACT's temporal ensembling, from LeRobot, then lines
    spline       a B-spline, without a filter
    smooth D, L  `ActionUpsampler` with a curve of degree D, L actions late

Reported at the rate of the motors are the number of setpoints beyond a limit of velocity,
acceleration or jerk, and the largest excess; the delay of the motion, which is the shift with
which it is nearest to the requested actions; its error to them after this shift; and its error
to the demonstration, without a shift. Limits are those of the demonstrators. No robot moves,
and actions do not affect later states.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("HF_HUB_OFFLINE", "1")

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from bench_policies import (
    ACTION,
    CONSTANT,
    ENVIRONMENT,
    STATE,
    Episode,
    config_of,
    statistics,
    train,
)
from rich.console import Console
from rich.table import Table

from hrc_learn import cli
from hrc_learn.lerobot.smoothing import ActionLimits, ActionUpsampler, demonstrated_limits

OURS = ("dmp", "motion_chunk")
AVERAGE = 0.3
"""Weight of the newest action in the moving average."""
ENSEMBLE = 0.01
"""Coefficient of temporal ensembling, ACT's own."""
LATEST = 6
"""Largest delay of a motion that is searched for [actions]."""
ROUNDING = 1 + 1e-6


@dataclass(frozen=True, kw_only=True)
class Args:
    data: tuple[Path, ...]
    """Folders of LeRobot datasets, one per robot."""
    policies: tuple[str, ...] = ("act", "diffusion", "dmp", "motion_chunk")
    """Policies that learn from each dataset; diffusion needs LeRobot's extra of that name."""
    chunks: int = 1000
    """Number of all chunks, the same for each policy and robot."""
    minutes: float = 0.5
    """CPU time of building and training each policy."""
    chunk: int = 32
    """Number of actions predicted at once."""
    executed: int = 16
    """Number of these actions that are executed before the next prediction."""
    rate: float = 250.0
    """Setpoints per second."""
    every: int = 5
    """Every n-th episode is held out."""
    batch_size: int = 64
    """Number of samples in each training step."""
    seed: int = 0
    """Seed of weights and batches."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


@dataclass(frozen=True)
class Played:
    """Requested and demonstrated actions of an episode."""

    asked: np.ndarray
    ensembled: np.ndarray | None
    shown: np.ndarray


@dataclass
class Score:
    """Score of one way over all episodes."""

    setpoints: int = 0
    broken: int = 0
    excess: float = 0.0
    """Largest difference quotient relative to its limit."""
    square_asked: float = 0.0
    square_shown: float = 0.0
    compared: int = 0
    late: float = 0.0


def main(args: Args) -> None:
    torch.set_num_threads(1)
    scores: dict[tuple[str, str], Score] = {}
    figures: dict[str, float] = {}
    count = -(-args.chunks // (len(args.data) * len(args.policies)))
    for done, root in enumerate(args.data, start=1):
        shown, held_out, limits, fps = _read(root, args)
        spread = statistics(shown)[ACTION]["std"].double().numpy()
        for name in args.policies:
            torch.manual_seed(args.seed)
            begun = time.process_time()
            policy = _learn(name, shown, fps, args)
            played, made = [], 0
            for episode in _again(held_out):
                if made >= count:
                    break
                played.append(_play(name, policy, episode, args))
                made += -(-len(played[-1].asked) // args.executed)
            seconds = time.process_time() - begun
            Console().print(f"{root.name}, {name}: {made} chunks, {seconds:.0f} s of CPU")
            for way, path in _ways(played, limits, args):
                score = scores.setdefault((name, way), Score())
                _add(score, path, played, limits, spread, args.rate)
            figures[f"{root.name}_{name}_chunks"] = made
        _report(scores, figures, done, args)


def _report(
    scores: dict[tuple[str, str], Score], figures: dict[str, float], robots: int, args: Args
) -> None:
    """Print and keep the present results."""
    table = Table(
        *("policy", "way", "setpoints", "beyond limits", "largest, over the limit"),
        *("late [actions]", "RMSE to asked", "RMSE to shown"),
    )
    for (name, way), score in scores.items():
        values = {
            "setpoints": score.setpoints,
            "beyond": score.broken,
            "excess": score.excess,
            "late": score.late / robots,
            "rmse_asked": (score.square_asked / score.compared) ** 0.5,
            "rmse_shown": (score.square_shown / score.compared) ** 0.5,
        }
        figures |= {f"{name}_{way.replace(' ', '_')}_{k}": v for k, v in values.items()}
        table.add_row(
            name, way, *(f"{v:.3g}" if k > 1 else str(v) for k, v in enumerate(values.values()))
        )
    Console(width=140).print(table)
    if args.json is not None:
        cli.write_json(args.json, figures)


def _read(root: Path, args: Args) -> tuple[list[Episode], list[Episode], ActionLimits, float]:
    """Episodes to learn from, held-out episodes, limits, frame rate; only columns that move."""
    from hrc_learn.lerobot.policy.policy_base import read_episodes

    columns = read_episodes(root, (STATE, ACTION))
    episodes = [{STATE: e[STATE].float(), ACTION: e[ACTION].float()} for e in columns]
    limits = demonstrated_limits(root)
    moves = torch.cat([e[ACTION] for e in episodes]).std(0) > CONSTANT
    keep = moves.nonzero().flatten().tolist()
    kept = {
        name: [getattr(limits, name)[i] for i in keep]
        for name in vars(limits)
        if name not in ("fps",)
    }
    episodes = [e | {ACTION: e[ACTION][:, moves]} for e in episodes]
    shown = [e for k, e in enumerate(episodes) if k % args.every]
    return shown, episodes[:: args.every], ActionLimits(fps=limits.fps, **kept), limits.fps


def _again(episodes: Sequence[Episode]) -> Iterator[Episode]:
    """Repeat the episodes endlessly: policies that sample differ each time, and seams lie
    elsewhere.
    """
    turn = 0
    while True:
        for episode in episodes:
            yield {key: values[turn:] for key, values in episode.items()}
        turn += 3


def _learn(name: str, shown: Sequence[Episode], fps: float, args: Args) -> Any:
    """Trained policy, its processors, and the spread of actions."""
    from lerobot.policies import get_policy_class, make_pre_post_processors

    import hrc_learn.lerobot  # noqa: F401  registers ours

    stats = statistics(shown)
    # LeRobot's policies require images or the environment's state.
    if name not in OURS:
        stats = stats | {ENVIRONMENT: stats[STATE]}
        shown = [e | {ENVIRONMENT: e[STATE]} for e in shown]
    config = config_of(name, shown[0], fps, args.chunk, args.executed)
    begun = time.process_time()
    policy: Any = get_policy_class(name)(config, dataset_stats=stats)
    if name == "dmp":
        policy.planner.fit(shown, ACTION)
    elif name == "motion_chunk":
        policy.fit(shown)
    before, after = make_pre_post_processors(config, dataset_stats=stats)
    until = begun + 60 * args.minutes
    train(policy, before, shown, fps, until, args.batch_size, args.seed)
    return policy, before, after


@torch.no_grad()
def _play(name: str, learned: Any, episode: Episode, args: Args) -> Played:
    from lerobot.policies.act.modeling_act import ACTTemporalEnsembler

    policy, before, after = learned
    policy.reset()
    asked, ensembled = [], []
    ensembler = ACTTemporalEnsembler(ENSEMBLE, args.chunk)
    ensembler.reset()
    for state in episode[STATE]:
        seen = {STATE: state} | ({ENVIRONMENT: state} if name not in OURS else {})
        batch = before(seen)
        asked.append(after(policy.select_action(dict(batch))))
        if name == "act":
            chunk = policy.predict_action_chunk(dict(batch))
            ensembled.append(after(ensembler.update(chunk)))
    actions = torch.cat(asked).double().numpy()
    return Played(
        asked=actions,
        ensembled=torch.cat(ensembled).double().numpy() if ensembled else None,
        shown=episode[ACTION].double().numpy(),
    )


def _ways(
    played: Sequence[Played], limits: ActionLimits, args: Args
) -> Iterator[tuple[str, list[np.ndarray]]]:
    """Setpoints of each episode, for each way."""
    asked = [p.asked for p in played]
    for way, degree in (("hold", 0), ("line", 1), ("spline", 3)):
        yield way, [_upsampled(a, degree, limits.fps, args.rate) for a in asked]
    yield "average", [_upsampled(_averaged(a), 1, limits.fps, args.rate) for a in asked]
    if all(p.ensembled is not None for p in played):
        yield (
            "ensemble",
            [_upsampled(p.ensembled, 1, limits.fps, args.rate) for p in played],  # pyright: ignore[reportArgumentType]
        )
    for degree, latency in ((3, 2.0), (3, 1.0), (1, 1.0)):
        upsampler = ActionUpsampler(limits, args.rate, degree=degree, latency=latency)
        # All episodes at once; shorter ones are extended by their last action.
        longest = max(len(a) for a in asked)
        padded = np.stack(
            [np.pad(a, ((0, longest - len(a)), (0, 0)), "edge") for a in asked], 1
        )
        upsampler.reset(padded[0])
        made = np.concatenate([upsampler.frame(action) for action in padded])
        per = args.rate / limits.fps
        paths = [made[: int(len(a) * per), k] for k, a in enumerate(asked)]
        yield f"smooth {degree}, {latency:g}", paths


def _upsampled(actions: np.ndarray, degree: int, fps: float, rate: float) -> np.ndarray:
    """Uniform B-spline with the actions as control points, by SciPy."""
    from scipy.interpolate import BSpline

    points = np.concatenate([actions[:1].repeat(degree, 0), actions])
    knots = np.arange(len(points) + degree + 1, dtype=float)
    t = np.arange(int(len(actions) * rate / fps)) * fps / rate
    return BSpline(knots, points, degree)(degree + np.minimum(t, len(actions) - 1e-9))


def _averaged(actions: np.ndarray) -> np.ndarray:
    made = [actions[0]]
    for action in actions[1:]:
        made.append(AVERAGE * action + (1 - AVERAGE) * made[-1])
    return np.stack(made)


def _add(
    score: Score,
    paths: Sequence[np.ndarray],
    played: Sequence[Played],
    limits: ActionLimits,
    spread: np.ndarray,
    rate: float,
) -> None:
    """Add the episodes of a robot to a score; errors are relative to the spread of the
    demonstrated actions.
    """
    bounds = [np.array(x) for x in (limits.velocity, limits.acceleration, limits.jerk)]
    shifts = np.arange(round(LATEST * rate / limits.fps) + 1)
    errors, counts = np.zeros(len(shifts)), np.zeros(len(shifts))
    for path, p in zip(paths, played, strict=True):
        t = np.arange(len(path)) * limits.fps / rate
        k = np.arange(len(p.asked))
        asked, shown = (
            np.stack([np.interp(t, k, column) for column in x.T], axis=-1) / spread
            for x in (p.asked, p.shown)
        )
        values = np.concatenate([path[:1].repeat(3, 0), path])
        broken = np.zeros(len(path), dtype=bool)
        for order, bound in enumerate(bounds):
            values = np.diff(values, axis=0) * rate
            excess = np.abs(values[2 - order :]) / bound
            broken |= (excess > ROUNDING).any(-1)
            score.excess = max(score.excess, float(excess.max()))
        score.setpoints += len(path)
        score.broken += int(broken.sum())
        made = path / spread
        for i, shift in enumerate(shifts):
            off = made[shift:] - asked[: len(asked) - shift]
            errors[i] += np.square(off).sum()
            counts[i] += off.size
        score.square_shown += float(np.square(made - shown).sum())
        score.compared += made.size
    best = int(np.argmin(errors / counts))
    score.late += shifts[best] * limits.fps / rate
    score.square_asked += float(errors[best] / counts[best] * sum(p.size for p in paths))


if __name__ == "__main__":
    cli.run(main, Args)
