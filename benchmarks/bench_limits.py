"""Search for command sequences that break a limit behind the safety filter.

Arms start anywhere, a quarter of their joints near a limit, and receive bang-bang commands:
first at random, then drawn by the cross-entropy method, which keeps the sequences that made a
point fastest and draws the next ones from their distribution. With `--cma`, CMA-ES (`pip
install cma`) searches with the batch as well, for commands and starts together. Tool, elbow
and the end of a load 0.2 m past the tool are capped. An independent monitor counts the steps
beyond any limit.

The filter runs as a batch, arm by arm, with the constraint layer, and exported, arm by arm
and as one loop over a batch; with float32
and float64; with readings that are late or wrong, and with a wrong model of the arm, for which
the filter is given a delay and a lower cap.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from limit_monitor import LimitMonitor
from rich.console import Console
from rich.table import Table
from torch import Tensor
from torch.utils import _pytree

from hrc_learn import cli
from hrc_learn.controller import ConstraintConfig, SafetyConfig, VelocityStep, WantedVelocity
from hrc_learn.deploy import PackageRunner, export_step
from hrc_learn.kinematics import SerialChain, arm

KINDS = ("position", "velocity", "acceleration", "jerk", "speed")
_LOAD = (0.0, 0.0, 0.2)  # far end of the load in the frame of the tool [m]
_ELITE = 0.1  # fraction of the sequences that are kept
_LEVELS = 3.0  # commands reach this multiple of the velocity limits
_POPULATION = 128  # of each search by CMA-ES
_DT = (0.001, 0.02)  # shortest and longest step [s]

type _Filter = Callable[[Tensor, Tensor, float], tuple[Tensor, int]]
"""Function of joint positions, wanted velocities and the step that returns the velocities sent
and the number of arms whose speed was reported to exceed the cap."""


@dataclass(frozen=True, kw_only=True)
class Search:
    """One configuration of a search."""

    arm: str = "panda"
    path: Literal["batch", "layer", "single", "exported", "exported batch"] = "batch"
    """The filter for all arms at once, with the constraint layer, arm by arm, or exported, arm
    by arm or for all at once."""
    dt: float = 0.0
    """Step [s]; 0: any from 1 to 20 ms, drawn anew in each step."""
    dtype: torch.dtype = torch.float64
    cap: float = 1.0
    """Highest speed of the points [m/s]."""
    reserve: float = 0.0
    """Fraction by which the filter's cap is lower."""
    late: int = 0
    """Steps by which readings are late; the filter knows their longest duration."""
    encoder_error: float = 0.0
    """Largest error of a reading, drawn anew in each step [rad]."""
    model_error: float = 0.0
    """Fraction by which the links are longer than the filter knows."""
    batch: int = 1024
    steps: int = 120
    """Steps of one sequence."""
    knots: int = 12
    """Changes of the command in a sequence."""
    rounds: int = 9
    """Sequences drawn from the elite of the round before; the first round is random."""
    method: Literal["cross-entropy", "CMA-ES"] = "cross-entropy"
    seed: int = 0

    @property
    def name(self) -> str:
        """Name in tables and files."""
        step = f"{1e3 * self.dt:g} ms" if self.dt else "1-20 ms"
        parts = [self.arm, self.path, step, str(self.dtype)[6:]]
        if self.method != "cross-entropy":
            parts.append(self.method)
        if self.cap != 1.0:
            parts.append(f"cap {self.cap:g}")
        if self.late:
            parts.append(f"{self.late} late")
        if self.encoder_error:
            parts.append(f"encoders {1e3 * self.encoder_error:g} mrad")
        if self.model_error:
            parts.append(f"links {100 * self.model_error:g} % longer")
        return ", ".join(parts)


@dataclass(frozen=True, kw_only=True)
class Found:
    """Result of a search."""

    steps: int
    beyond: dict[str, int]
    """Steps beyond each kind of limit."""
    fastest: float
    """Largest speed of a point, of the cap."""
    reported: int
    """Steps in which the filter reported a speed above its cap."""


def points_of(robot: SerialChain, q: Float[Tensor, "batch n"]) -> Float[Tensor, "batch 3 3 n"]:
    """Linear Jacobians of the tool, the end of a load, and the elbow."""
    pose, J = robot.forward_and_jacobian(q)
    end = pose.apply(torch.tensor(_LOAD).to(q)) - pose.position
    load = J[:, :3] + torch.linalg.cross(J[:, 3:], end[..., None], dim=1)
    elbow = robot.joint_jacobian(q, robot.elbow)[:, :3]
    return torch.stack([J[:, :3], load, elbow], dim=1)


@torch.inference_mode()
def search(config: Search) -> Found:
    """Search with one configuration."""
    robot, rng = arm(config.arm), torch.Generator().manual_seed(config.seed)
    drawn = (_CMA if config.method == "CMA-ES" else _CrossEntropy)(config, robot, rng)
    beyond, fastest, reported = torch.zeros(len(KINDS), dtype=torch.int64), 0.0, 0
    for _ in range(config.rounds):
        q, knots = drawn.ask()
        speeds, flags, over = _run(config, robot, q, knots, rng)
        beyond, reported = beyond + flags, reported + over
        fastest = max(fastest, float(speeds.max()))
        drawn.tell(speeds)
    return Found(
        steps=config.rounds * config.batch * config.steps,
        beyond=dict(zip(KINDS, beyond.tolist(), strict=True)),
        fastest=fastest / config.cap,
        reported=reported,
    )


class _CrossEntropy:
    """Commands from the normal distribution of the elite, starts from the elite's starts."""

    def __init__(self, config: Search, robot: SerialChain, rng: torch.Generator):
        self._rng, self._count = rng, config.batch
        self._mean = torch.zeros(config.knots, len(robot.joint_names), dtype=torch.float64)
        self._spread = torch.ones_like(self._mean)
        self._start = _start(robot, config.batch, rng)

    def ask(self) -> tuple[Tensor, Tensor]:
        """Joint positions at the start (batch, n) and commands (batch, knots, n)."""
        shape = self._count, *self._mean.shape
        noise = torch.randn(shape, generator=self._rng, dtype=torch.float64)
        self._knots = self._mean + self._spread * noise
        return self._start, self._knots

    def tell(self, speeds: Tensor) -> None:
        """Largest speeds (batch) that the sequences reached."""
        best = speeds.topk(max(2, int(_ELITE * self._count))).indices
        elite = self._knots[best]
        self._mean, self._spread = elite.mean(0), elite.std(0) + 0.1
        # From the starts of the elite, each for several arms of the next round.
        starts = self._start[best]
        self._start = starts.repeat(self._count // len(best) + 1, 1)[: self._count]


class _CMA:
    """Commands and starts by CMA-ES; those that converged begin again elsewhere."""

    def __init__(self, config: Search, robot: SerialChain, rng: torch.Generator):
        self._shape = config.knots + 1, len(robot.joint_names)
        self._lower, self._upper = robot.limits.lower + 0.03, robot.limits.upper - 0.03
        self._seeds = itertools.count(1 + config.seed)
        self._searches = [self._begun() for _ in range(config.batch // _POPULATION)]

    def _begun(self) -> Any:
        import cma  # pyright: ignore[reportMissingImports]

        size, seed = math.prod(self._shape), next(self._seeds)
        first = torch.randn(size, generator=torch.Generator().manual_seed(seed)).tolist()
        options = {"popsize": _POPULATION, "seed": seed, "verbose": -9}
        return cma.CMAEvolutionStrategy(first, 0.5, options)

    def ask(self) -> tuple[Tensor, Tensor]:
        """Joint positions at the start (batch, n) and commands (batch, knots, n)."""
        self._asked = [search.ask() for search in self._searches]
        drawn = torch.tensor(np.array(self._asked)).reshape(-1, *self._shape)
        place = (0.5 + 0.5 * drawn[:, 0]).clamp(0, 1)
        return torch.lerp(self._lower, self._upper, place), drawn[:, 1:]

    def tell(self, speeds: Tensor) -> None:
        """Largest speeds (batch) that the sequences reached."""
        reached = speeds.reshape(len(self._searches), -1).tolist()
        for k, search in enumerate(self._searches):
            search.tell(self._asked[k], [-speed for speed in reached[k]])
            if search.stop():
                self._searches[k] = self._begun()


def _start(robot: SerialChain, count: int, rng: torch.Generator) -> Tensor:
    limits, n = robot.limits, len(robot.joint_names)
    draw = torch.rand(count, n, generator=rng, dtype=torch.float64)
    side, near = torch.rand(2, count, n, generator=rng, dtype=torch.float64)
    draw = torch.where(near < 0.25, torch.where(side < 0.5, 0.02, 0.98), draw)
    return torch.lerp(limits.lower + 0.03, limits.upper - 0.03, draw)


def _run(
    config: Search, robot: SerialChain, q: Tensor, knots: Tensor, rng: torch.Generator
) -> tuple[Tensor, Tensor, int]:
    """Largest speed of each arm, steps beyond each limit, and reported steps."""
    limits, real = robot.limits, _longer(robot, config.model_error)
    watch = LimitMonitor(limits, torch.zeros_like(q), config.dt or 0.01, config.cap)
    send, largest = _opened(config, robot, q), torch.zeros_like(q[:, 0])
    beyond, reported = torch.zeros(len(KINDS), dtype=torch.int64), 0
    readings, points = deque([q], config.late + 1), points_of(real, q)
    for k in range(config.steps):
        u = knots[:, k * config.knots // config.steps].clamp(-1, 1) * _LEVELS * limits.velocity
        shortest, longest = _DT
        drawn = shortest + (longest - shortest) * float(torch.rand((), generator=rng))
        dt = config.dt or drawn
        error = 2 * torch.rand(q.shape, generator=rng, dtype=q.dtype) - 1
        v, over = send(readings[0] + config.encoder_error * error, u, dt)
        q = q + dt * v
        readings.append(q)
        before, points = points, points_of(real, q)
        # At the start and at the end of the step.
        both = torch.cat([before, points], dim=1)
        beyond += watch.violations(q, v, both, dt).sum(0)
        speed = torch.einsum("bpin,bn->bpi", both, v).norm(dim=-1).amax(-1)
        largest, reported = torch.maximum(largest, speed), reported + over
    return largest, beyond, reported


def _longer(robot: SerialChain, fraction: float) -> SerialChain:
    """An arm with longer links."""

    def longer(frames: Tensor) -> Tensor:
        frames = frames.clone()
        frames[..., :3, 3] *= 1 + fraction
        return frames

    return SerialChain(
        joint_names=robot.joint_names,
        mounts=longer(robot.mounts),
        flange=longer(robot.flange),
        tcp=longer(robot.tcp),
        limits=robot.limits,
        ready=robot.ready,
        kinds=robot.kinds,
    )


def _opened(config: Search, robot: SerialChain, q: Tensor) -> _Filter:
    """The filter of a configuration, for arms at rest."""
    longest = config.dt or _DT[1]
    settings = SafetyConfig(
        tcp_speed=(1 - config.reserve) * config.cap,
        delay=config.late * longest,
        constraints=ConstraintConfig() if config.path == "layer" else None,
    )
    step = VelocityStep(robot, settings).to(config.dtype)
    observation = WantedVelocity(
        joint_position=q.to(config.dtype),
        joint_velocity=torch.zeros_like(q, dtype=config.dtype),
        stop=torch.zeros_like(q[:, 0], dtype=torch.bool),
        dt=torch.tensor(longest, dtype=config.dtype),
        load=torch.tensor(_LOAD, dtype=config.dtype).expand(len(q), 3).contiguous(),
    )
    if config.path in ("batch", "layer"):
        return _Eager(step, observation)
    if config.path == "exported batch":
        return _exported(export_step(step, observation), observation)
    alone = [
        _pytree.tree_map(lambda x, k=k: x[k] if x.ndim else x, observation)
        for k in range(len(q))
    ]
    if config.path == "single":
        return partial(_one_by_one, [_Eager(step, one) for one in alone])
    package = export_step(step, alone[0])
    return partial(_one_by_one, [_exported(package, one) for one in alone])


class _Eager:
    """The filter run as it is written."""

    def __init__(self, step: VelocityStep, observation: WantedVelocity):
        self._step, self._given = step, observation
        self._state = step.initial_state(observation.joint_position)

    def __call__(self, q: Tensor, u: Tensor, dt: float) -> tuple[Tensor, int]:
        like = self._given.joint_position
        given = replace(
            self._given,
            joint_position=q.to(like),
            joint_velocity=u.to(like),
            dt=torch.full((), dt, dtype=like.dtype),
        )
        command, self._state = self._step.step(self._state, given)
        over = int((command.safety.speed_excess > 0).sum())
        return command.joint_velocity.double(), over


def _exported(package: Path, observation: WantedVelocity) -> _Filter:
    """The compiled filter of one arm, or of a batch."""
    runner = PackageRunner(package)
    runner.observe(observation)
    runner.start(runner.observation["joint_position"])
    excess = runner.command["safety.speed_excess"]

    def send(q: Tensor, u: Tensor, dt: float) -> tuple[Tensor, int]:
        runner.observation["joint_position"][:] = q.numpy()
        runner.observation["joint_velocity"][:] = u.numpy()
        runner.observation["dt"][...] = dt
        # A copy: the next step writes to the same memory.
        return torch.from_numpy(runner.step().copy()).double(), int((excess > 0).sum())

    return send


def _one_by_one(filters: list[_Filter], q: Tensor, u: Tensor, dt: float) -> tuple[Tensor, int]:
    """Step of several arms, each with its own filter."""
    sent, over = zip(*(f(q[k], u[k], dt) for k, f in enumerate(filters)), strict=True)
    return torch.stack(sent), sum(over)


@dataclass(frozen=True, kw_only=True)
class Args:
    arms: tuple[str, ...] = ("panda", "fr3", "ur5e", "so101", "xarm7")
    """Arms to search with."""
    steps: int = 1_000_000
    """Steps of each large search. Those with the uncompiled filter arm by arm take a fiftieth,
    those with errors a quarter."""
    cma: bool = False
    """Search by CMA-ES, too; needs `pip install cma`."""
    only: str = ""
    """Search only with configurations whose name holds this text."""
    processes: int = 2
    """Searches that run at the same time."""
    json: Path | None = None
    """File for the measured values."""


def searches(args: Args) -> Iterator[Search]:
    """All configurations; those that compile come first."""

    def sized(one: Search, steps: int) -> Search:
        return replace(one, rounds=max(2, -(-steps // (one.batch * one.steps))))

    single = torch.float32
    for name in args.arms:
        exported = Search(arm=name, path="exported", batch=128)
        yield sized(exported, args.steps)
        yield sized(replace(exported, dtype=single), args.steps)
        yield sized(replace(exported, path="exported batch"), args.steps)
    for name in args.arms:
        one = Search(arm=name)
        yield sized(replace(one, path="layer"), args.steps)
        yield sized(one, args.steps // 2)
        yield sized(replace(one, cap=0.25), args.steps // 4)
        yield sized(replace(one, dt=0.001, steps=300), args.steps // 4)
        yield sized(replace(one, dtype=single), args.steps // 2)
        yield sized(replace(one, dtype=single, dt=0.001, steps=300), args.steps // 2)
        yield sized(replace(one, path="single", batch=8), args.steps // 50)
        for late in (1, 3):
            yield sized(replace(one, dt=0.008, late=late), args.steps // 4)
        wrong = replace(one, dt=0.008, late=1, reserve=0.01, encoder_error=0.002)
        yield sized(wrong, args.steps // 4)
        yield sized(replace(one, reserve=0.025, model_error=0.02), args.steps // 4)
        if args.cma:
            yield sized(replace(one, method="CMA-ES"), args.steps)
            yield sized(replace(one, method="CMA-ES", dtype=single), args.steps)


def main(args: Args) -> int | None:
    table = Table("search", "steps", *KINDS, "fastest, of its cap", "reported")
    figures: dict[str, float] = {}
    configs = [config for config in searches(args) if args.only in config.name]
    console = Console()
    pool = ProcessPoolExecutor(
        args.processes, get_context("spawn"), torch.set_num_threads, (1,)
    )
    with pool:
        for config, found in zip(configs, pool.map(search, configs), strict=True):
            counts = [str(n) for n in found.beyond.values()]
            row = (config.name, str(found.steps), *counts, f"{found.fastest:.4f}")
            table.add_row(*row, str(found.reported))
            console.print(*row, found.reported)
            key = "_".join(config.name.replace(",", "").replace(".", "p").split())
            figures[f"{key}_steps"] = found.steps
            figures[f"{key}_beyond"] = sum(found.beyond.values())
            figures[f"{key}_fastest_ratio"] = found.fastest
    console.print(table)
    if args.json is not None:
        cli.write_json(args.json, figures)
    return 0 if not sum(v for k, v in figures.items() if k.endswith("_beyond")) else 1


if __name__ == "__main__":
    cli.run(main, Args)
