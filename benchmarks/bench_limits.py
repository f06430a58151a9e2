"""Search for command sequences that break a limit behind the safety filter.

Batches of arms start anywhere, a quarter of the joints near a limit, and receive bang-bang
commands: first at random, then drawn by the cross-entropy method, which keeps the sequences
that made the tool fastest and draws the next ones from their distribution. Three points are
capped: the tool, the elbow and the end of a load 0.2 m past the tool. An independent monitor
counts the steps beyond any limit; none is wanted.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from limit_monitor import LimitMonitor
from rich.console import Console
from rich.table import Table
from torch import Tensor

from hrc_learn import cli
from hrc_learn.controller import ConstraintConfig, SafetyConfig, SafetyFilter
from hrc_learn.kinematics import Arm, arm

KINDS = ("position", "velocity", "acceleration", "jerk", "speed")
_LOAD = 0.2  # distance of the end of the load from the tool, along its axis [m]
_ELITE = 0.1  # fraction of the sequences that are kept
_LEVELS = 3.0  # commands reach this multiple of the velocity limits


@dataclass(frozen=True, kw_only=True)
class Search:
    """One configuration of a search."""

    arm: str = "panda"
    dt: float = 0.008
    """Step [s]; 0: any from 1 to 20 ms, drawn anew in each step."""
    dtype: torch.dtype = torch.float64
    layer: bool = False
    """True: with the constraint layer."""
    cap: float = 1.0
    """Highest speed of the points [m/s]."""
    batch: int = 256
    steps: int = 120
    """Steps of one sequence."""
    knots: int = 12
    """Changes of the command in a sequence."""
    rounds: int = 10
    """Sequences drawn from the elite of the round before; the first round is random."""
    seed: int = 0

    @property
    def name(self) -> str:
        """Name in tables and files."""
        step = f"{1e3 * self.dt:g} ms" if self.dt else "1-20 ms"
        layer = ", layer" if self.layer else ""
        return f"{self.arm}, {step}, {str(self.dtype)[6:]}{layer}"


@dataclass(frozen=True, kw_only=True)
class Found:
    """Result of a search."""

    steps: int
    beyond: dict[str, int]
    """Steps beyond each kind of limit."""
    fastest: float
    """Largest speed of a point [m/s]."""
    reported: int
    """Steps in which the filter reported a speed above the cap."""


def points_of(robot: Arm, q: Float[Tensor, "batch n"]) -> Float[Tensor, "batch 3 3 n"]:
    """Linear Jacobians of the tool, the end of a load, and the elbow."""
    J, load = robot.jacobian(q), load_of(robot, q)
    end = J[:, :3] + torch.linalg.cross(J[:, 3:], load[..., None], dim=1)
    elbow = robot.joint_jacobian(q, robot.elbow)[:, :3]
    return torch.stack([J[:, :3], end, elbow], dim=1)


def load_of(robot: Arm, q: Float[Tensor, "batch n"]) -> Float[Tensor, "batch 3"]:
    """Vector from the tool to the far end of the load [m]."""
    return _LOAD * robot.forward(q).matrix()[..., :3, 2]


@torch.inference_mode()
def search(config: Search) -> Found:
    """Search with one configuration."""
    robot, rng = arm(config.arm), torch.Generator().manual_seed(config.seed)
    n, B = len(robot.joint_names), config.batch
    settings = SafetyConfig(
        tcp_speed=config.cap, constraints=ConstraintConfig() if config.layer else None
    )
    safety = SafetyFilter(robot, settings).to(config.dtype)
    mean = torch.zeros(config.knots, n, dtype=torch.float64)
    spread, start = torch.ones_like(mean), None
    beyond, fastest, reported = torch.zeros(len(KINDS), dtype=torch.int64), 0.0, 0
    for _ in range(config.rounds):
        noise = torch.randn(B, config.knots, n, generator=rng, dtype=torch.float64)
        knots = mean + spread * noise
        q = _start(robot, B, rng) if start is None else start
        speeds, flags, over = _run(config, robot, safety, q, knots, rng)
        beyond, reported = beyond + flags, reported + over
        fastest = max(fastest, float(speeds.max()))
        best = speeds.topk(max(2, int(_ELITE * B))).indices
        mean, spread = knots[best].mean(0), knots[best].std(0) + 0.1
        # From the starts of the elite, each for several arms of the next round.
        start = q[best].repeat(B // len(best) + 1, 1)[:B]
    return Found(
        steps=config.rounds * B * config.steps,
        beyond=dict(zip(KINDS, beyond.tolist(), strict=True)),
        fastest=fastest,
        reported=reported,
    )


def _start(robot: Arm, count: int, rng: torch.Generator) -> Tensor:
    limits, n = robot.limits, len(robot.joint_names)
    draw = torch.rand(count, n, generator=rng, dtype=torch.float64)
    side, near = torch.rand(2, count, n, generator=rng, dtype=torch.float64)
    draw = torch.where(near < 0.25, torch.where(side < 0.5, 0.02, 0.98), draw)
    return torch.lerp(limits.lower + 0.03, limits.upper - 0.03, draw)


def _run(
    config: Search,
    robot: Arm,
    safety: SafetyFilter,
    q: Tensor,
    knots: Tensor,
    rng: torch.Generator,
) -> tuple[Tensor, Tensor, int]:
    """Largest speed of each arm, steps beyond each limit, and reported steps."""
    limits, dtype = robot.limits, config.dtype
    still = torch.zeros_like(q)
    watch = LimitMonitor(limits, still, config.dt or 0.01, config.cap)
    state, largest = safety.initial_state(q.to(dtype)), torch.zeros_like(q[:, 0])
    beyond, reported = torch.zeros(len(KINDS), dtype=torch.int64), 0
    for k in range(config.steps):
        u = knots[:, k * config.knots // config.steps].clamp(-1, 1) * _LEVELS * limits.velocity
        dt = config.dt or 1e-3 + 0.019 * float(torch.rand((), generator=rng))
        points = points_of(robot, q)
        velocity, state, report = safety.step(
            state,
            q.to(dtype),
            u.to(dtype),
            dt,
            jacobian=robot.jacobian(q).to(dtype),
            load=load_of(robot, q).to(dtype),
        )
        v = velocity.double()
        q = q + dt * v
        after = points_of(robot, q)
        # At the start and at the end of the step.
        beyond += watch.violations(q, v, torch.cat([points, after], dim=1), dt).sum(0)
        speed = torch.einsum("bpin,bn->bpi", after, v).norm(dim=-1).amax(-1)
        largest = torch.maximum(largest, speed)
        reported += int((report.speed_excess > 0).sum())
    return largest, beyond, reported


@dataclass(frozen=True, kw_only=True)
class Args:
    arms: tuple[str, ...] = ("panda", "fr3", "ur5e", "so101", "xarm7")
    """Arms to search with."""
    rounds: int = 10
    """Rounds of each search."""
    batch: int = 256
    """Arms in a batch."""
    single: bool = True
    """Search with single arms as well, a hundred times as short."""
    json: Path | None = None
    """Receives the measured values."""


def searches(args: Args) -> Iterator[Search]:
    """All configurations."""
    for name in args.arms:
        one = Search(arm=name, rounds=args.rounds, batch=args.batch)
        for dt in (0.001, 0.004, 0.008, 0.02, 0.0):
            yield replace(one, dt=dt, steps=300 if dt == 0.001 else 120)
        yield replace(one, dtype=torch.float32, dt=0.001, steps=300)
        yield replace(one, dtype=torch.float32, dt=0.0)
        yield replace(one, cap=0.25)
        yield replace(one, layer=True, batch=args.batch // 4, rounds=max(1, args.rounds // 4))
        if args.single:
            yield replace(one, batch=2, rounds=max(1, args.rounds // 2))


def main(args: Args) -> int | None:
    torch.set_num_threads(1)
    table = Table("search", "steps", *KINDS, "fastest [m/s]", "reported")
    figures: dict[str, float] = {}
    for config in searches(args):
        found = search(config)
        name = f"{config.name}, cap {config.cap:g}, batch {config.batch}"
        counts = [str(n) for n in found.beyond.values()]
        table.add_row(
            name, str(found.steps), *counts, f"{found.fastest:.3f}", str(found.reported)
        )
        key = "_".join(name.replace(",", "").replace(".", "p").split())
        figures[f"{key}_steps"] = found.steps
        figures[f"{key}_beyond"] = sum(found.beyond.values())
        figures[f"{key}_fastest_mps"] = found.fastest
        Console().print(name, found.steps, found.beyond, f"{found.fastest:.3f}")
    Console().print(table)
    if args.json is not None:
        cli.write_json(args.json, figures)
    return 0 if not sum(v for k, v in figures.items() if k.endswith("_beyond")) else 1


if __name__ == "__main__":
    cli.run(main, Args)
