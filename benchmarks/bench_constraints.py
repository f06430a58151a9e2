"""Cost of keeping limits and distances by a quadratic program, and the benefit of way-making.

First, the exported step with the constraint layer and the exported step without it are called
in turn in the same run: one thread, CPU time. Each is built once, in two to four minutes, and
kept. Then arms move their tool to a pose while a person's fist approaches the elbow and stays
there. The null space is at rest, or it is moved by the person, who has a reaction time, by the
arm itself, or by both.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from bench_controller import settled, usual_step
from rich.console import Console
from rich.table import Table
from timing import time_calls
from torch import Tensor

from hrc_learn import cli
from hrc_learn.controller import (
    AdaptiveController,
    ConstraintConfig,
    ControllerConfig,
    Distances,
    Goals,
    Observation,
    SafetyConfig,
    WayMakingConfig,
)
from hrc_learn.controller.task_pace import way_making_velocity
from hrc_learn.deploy import EagerRunner, open_step
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import panda

_LIMIT = 2.0
"""Largest allowed ratio of the time of the step with the layer to that of the step without."""
_DT = 0.01
# Joints whose origins represent the arm, from shoulder to wrist. The radius is the sum of the
# radii of arm and fist [m].
_JOINTS, _RADIUS = [2, 3, 4, 5, 6], 0.16
# Distances of the fist from the initial position of the elbow at its start and its end [m], and
# its speed [m/s].
_FROM, _UP_TO, _SPEED = 0.6, 0.2, 0.3
_REACTION = 0.4  # reaction time of the person who moves the null space [s]
_NEAR = 0.08  # distance that counts as too near [m]
_ARRIVED = 0.01  # distance of the tool from its goal [m]
_STEP = 1e-6  # step of central differences [rad]


@dataclass(frozen=True, kw_only=True)
class Args:
    repeats: int = 5000
    """Number of calls of each exported step; 0: none is built."""
    pairs: int = 8
    """Number of distances in the step."""
    arms: int = 100
    """Number of arms that a fist approaches; 0: none."""
    seconds: float = 6.0
    """Simulated time [s]."""
    packages: Path | None = None
    """Folder in which compiled steps are kept; default: the user's cache."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


def main(args: Args) -> None:
    """Measure, print tables, and write the measured values."""
    torch.set_num_threads(1)
    console, figures = Console(), {}
    with torch.inference_mode():
        if args.repeats:
            figures |= _exported(args, console)
        if args.arms:
            figures |= _compared(args, console)
    if args.json is not None:
        cli.write_json(args.json, figures)


def _exported(args: Args, console: Console) -> dict[str, float]:
    """CPU time of both steps, called in turn."""
    controller, observation = usual_step(panda.ready)
    rng = torch.Generator().manual_seed(0)
    layered = AdaptiveController(
        panda,
        controller.estimator,
        controller.goals,
        config=ControllerConfig(safety=SafetyConfig(constraints=ConstraintConfig())),
    )
    near = Distances(
        distance=torch.full((args.pairs,), 0.05, dtype=torch.float64),
        gradient=0.3 * torch.randn(args.pairs, 7, generator=rng, dtype=torch.float64),
        approach_speed=torch.zeros(args.pairs, dtype=torch.float64),
    )
    runners = {
        "without": open_step(controller, observation, args.packages),
        "with": open_step(layered, replace(observation, distances=near), args.packages),
    }
    if any(isinstance(runner, EagerRunner) for runner in runners.values()):
        return {}
    calls = {name: settled(runner) for name, runner in runners.items()}
    timings = time_calls(calls, args.repeats)
    table = Table("exported step", "median [us]", "p99 [us]", "least [us]")
    for name, timing in timings.items():
        values = (timing.median, timing.p99, timing.least)
        table.add_row(f"{name} constraints", *(f"{1e6 * value:.1f}" for value in values))
    console.print(table)
    ratio = timings["with"].median / timings["without"].median
    console.print(f"constrained_over_plain {ratio:.2f} (at most {_LIMIT:g})")
    return {
        "constrained_us": 1e6 * timings["with"].median,
        "plain_us": 1e6 * timings["without"].median,
        "constrained_over_plain": ratio,
    }


class _Outcome(NamedTuple):
    """Results of each arm."""

    least: Tensor
    """Smallest distance during the motion [m]."""
    near: Tensor
    """Time for which the distance was below 8 cm [s]."""
    arrival: Tensor
    """Time at which the tool reached its goal [s]; infinite: never."""
    off: Tensor
    """Largest distance of the tool from the straight line to its goal [m]."""
    unsolved: float
    """Fraction of the steps in which the solver did not converge within its own number of
    steps."""


def _compared(args: Args, console: Console) -> dict[str, float]:
    """Results of the four modes, and of a null space at rest without constraints."""
    figures: dict[str, float] = {}
    table = Table(
        "null space", "least mm, p5", "median", "s near", "arrived", "after s",
        "mm off line", "unsolved",
        title=f"{args.arms} arms that a fist comes near",
    )  # fmt: skip
    cases = [("unconstrained", None, "none")]
    cases += [
        (mode, ConstraintConfig(), mode) for mode in ("none", "expert", "automatic", "both")
    ]
    for name, constraints, mode in cases:
        found = _approached(args, constraints, mode)  # pyright: ignore[reportArgumentType]
        p5, median = torch.quantile(found.least, found.least.new_tensor([0.05, 0.5])).tolist()
        values = {
            "least_p5_mm": 1e3 * p5,
            "least_median_mm": 1e3 * median,
            "near_s": float(found.near.mean()),
            "arrived": float(found.arrival.isfinite().double().mean()),
            "arrival_s": float(found.arrival.median()),
            "off_line_mm": 1e3 * float(found.off.median()),
            "unsolved": found.unsolved,
        }
        table.add_row(name, *(f"{value:.3g}" for value in values.values()))
        figures |= {f"{name}_{key}": value for key, value in values.items()}
    console.print(table)
    return figures


def _approached(
    args: Args,
    constraints: ConstraintConfig | None,
    mode: Literal["none", "expert", "automatic", "both"],
) -> _Outcome:
    """Move the tools of the arms while a fist approaches each elbow."""
    rng = torch.Generator().manual_seed(0)
    inside = panda.limits.lower + 0.2, panda.limits.upper - 0.2

    def noise(*shape: int) -> Tensor:
        return torch.randn(args.arms, *shape, generator=rng, dtype=torch.float64)

    q = (panda.ready + 0.3 * noise(7)).clamp(*inside)
    start, goal = panda.forward(q), panda.forward((q + 0.25 * noise(7)).clamp(*inside))
    side = noise(3) * q.new_tensor((1.0, 1.0, 0.3))
    side = side / side.norm(dim=-1, keepdim=True)
    elbow = panda.joint_origins(q)[..., 3, :]
    fist, comes = elbow + _FROM * side, -_SPEED * side
    controller, observation = usual_step(q)
    way = WayMakingConfig(mode=mode)
    controller = AdaptiveController(
        panda,
        controller.estimator,
        Goals.at(goal.position, goal.orientation, half_size=(0.004, 0.004, 0.004)),
        config=ControllerConfig(way_making=way, safety=SafetyConfig(constraints=constraints)),
    )
    state = controller.initial_state(q)
    seen: deque[Tensor] = deque(maxlen=round(_REACTION / _DT))
    least, off = q.new_full((args.arms,), torch.inf), q.new_zeros(args.arms)
    arrival, within, unsolved = torch.full_like(least, torch.inf), torch.zeros_like(off), 0
    for k in range(round(args.seconds / _DT)):
        before = ((fist - elbow) * side).sum(-1, keepdim=True)
        speed = torch.where(before > _UP_TO, comes, 0.0)
        near = _distances(q, fist, speed)
        seen.append(controller.config.null_damping * way_making_velocity(near, way))
        command, state = controller.step(state, _observed(observation, q, near, seen[0]))
        report = command.safety.constraints
        unsolved += 0 if report is None else int((~report.solved).sum())
        q, fist = q + _DT * command.joint_velocity, fist + _DT * speed
        position = panda.forward(q).position
        nearest = near.distance.amin(-1)
        least, within = torch.minimum(least, nearest), within + _DT * (nearest < _NEAR)
        off = torch.maximum(off, _off_line(position, start, goal))
        there = ((position - goal.position).norm(dim=-1) < _ARRIVED) & arrival.isinf()
        arrival = torch.where(there, k * _DT, arrival)
    steps = args.arms * round(args.seconds / _DT)
    return _Outcome(least, within, arrival, off, unsolved / steps)


def _observed(
    observation: Observation, q: Tensor, near: Distances, push: Tensor
) -> Observation:
    """Observation without a visible marker, so that the tool moves to its goal pose."""
    return replace(
        observation,
        joint_position=q,
        image_joint_position=q,
        feature_visible=torch.zeros_like(observation.feature_visible),
        nullspace_input=push,
        distances=near,
        dt=_DT,
    )


def _off_line(position: Tensor, start: Pose, goal: Pose) -> Tensor:
    line, moved = goal.position - start.position, position - start.position
    share = (moved * line).sum(-1) / (line * line).sum(-1)
    return (moved - share.clamp(0, 1).unsqueeze(-1) * line).norm(dim=-1)


def _distances(q: Tensor, fist: Tensor, velocity: Tensor) -> Distances:
    """Distances of joints from a fist; gradients by central differences."""

    def from_fist(q: Tensor, fist: Tensor) -> Tensor:
        return panda.joint_origins(q)[..., _JOINTS, :] - fist.unsqueeze(-2)

    offset = from_fist(q, fist)
    length = offset.norm(dim=-1)
    step = _STEP * torch.eye(7, dtype=q.dtype)
    both = torch.stack([q.unsqueeze(-2) + step, q.unsqueeze(-2) - step])
    above, below = from_fist(both, fist.unsqueeze(-2)).norm(dim=-1)
    nears = torch.linalg.vecdot(offset / length.unsqueeze(-1), velocity.unsqueeze(-2))
    return Distances(
        distance=length - _RADIUS,
        gradient=((above - below) / (2 * _STEP)).mT,
        approach_speed=nears,
    )


if __name__ == "__main__":
    cli.run(main, Args)
