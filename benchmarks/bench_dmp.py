"""Speed of fitting, rolling out and stepping movement primitives, against bare matrix products.

7 joints, 1000 samples, 50 basis functions, one thread, float32 (steps: float64). Each time is
the median CPU time of calls made in turn with the floor: the same matrix product on prepared
matrices. On a busy machine, the minimum approximates the time on a quiet one. Other libraries
are measured if they are installed. Accuracy is measured as well.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from dmp_accuracy import (
    measure_gradient_error,
    measure_noise,
    measure_reproduction,
    measure_turns,
)
from dmp_peers import measure_peers
from operations import count_operations
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_info
from timing import Timing, time_calls

from hrc_learn import cli
from hrc_learn.dmp import JointDMP, OrientationDMP, PoseDMP, Stepper, export_dmp
from hrc_learn.dmp.exported_dmp import resting_inputs, state_tensors
from hrc_learn.geometry import Pose, quaternion

JOINTS, SAMPLES, BASIS = 7, 1000, 50
TARGETS: dict[str, tuple[float, int]] = {
    "rollout_1_of_gemm": (0.6, +1),
    "rollout_256_of_gemm": (0.95, +1),
    "rollout_4096_of_gemm": (0.95, +1),
    "rollout_256_contiguous_of_gemm": (0.7, +1),
    "rollout_4096_contiguous_of_gemm": (0.7, +1),
    "rollout_1_per_s": (50_000, +1),
    "rollout_256_per_s": (50_000, +1),
    "rollout_4096_per_s": (50_000, +1),
    "pose_rollout_256_per_s": (15_000, +1),
    "fit_1_ms": (0.5, -1),
    "fit_256_ms": (30, -1),
    "step_us": (30, -1),
    "step_joint_new_goal_of_without": (1.5, -1),
    "step_orientation_new_goal_of_without": (1.5, -1),
    "step_pose_new_goal_of_without": (1.5, -1),
    "fit_of_1000000_of_samples": (12, -1),
    "stepper_us": (8, -1),
    "backward_over_forward": (3, -1),
    "own_durations_4096_per_s": (20_000, +1),
    "own_durations_4096_of_shared": (0.5, +1),
    "duration_gradient_over_forward": (3, -1),
    "fit_own_stamps_256_ms": (100, -1),
    "joint_gradient_error": (1e-6, -1),
    "orientation_gradient_error": (1e-6, -1),
    "orientation_deg": (1e-3, -1),
    "reproduction_50_nrmse": (8e-5, -1),
    "reproduction_100_nrmse": (3e-5, -1),
    "noisy_peak_acceleration_most": (1.5, -1),
    "noisy_error_of_best_fixed_most": (1.0, -1),
}
"""Targets; +1: at least, -1: at most."""


@dataclass(frozen=True, kw_only=True)
class Args:
    repeats: int = 50
    """Number of repeats of calls that take milliseconds; shorter calls are repeated more often.
    """
    recordings: Path | None = None
    """Folder of recordings to reproduce, without and with added noise; see `recordings.py`."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""
    save: Path | None = None
    """File that keeps the measured values for a later --compare."""
    compare: Path | None = None
    """File of an earlier --save, shown next to the new values."""


def main(args: Args) -> None:
    """Measure, print a table, and write the measured values."""
    torch.set_num_threads(1)
    earlier = read_figures(args.compare) if args.compare else {}
    figures: dict[str, float] = {}
    for batch in (1, 256, 4096):
        figures |= measure_rollouts(batch, args.repeats)
    for batch in (1, 256):
        figures |= measure_fits(batch, args.repeats)
    figures |= measure_poses(args.repeats) | measure_steps(args.repeats)
    figures |= measure_new_goals(args.repeats) | measure_memory()
    figures |= measure_gradients(args.repeats) | measure_own_times(args.repeats)
    figures |= measure_turns() | measure_gradient_error()
    if args.recordings:
        figures |= measure_reproduction(args.recordings) | measure_noise(args.recordings)
    figures |= measure_peers(demonstrations(1), BASIS)
    show(figures, earlier)
    for path in (args.json, args.save):
        if path:
            cli.write_json(path, figures)


def demonstrations(batch: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Time (T,) and smooth joint positions (batch, T, 7), without the batch axis for one."""
    s = torch.linspace(0, 1, SAMPLES)
    rng = torch.Generator().manual_seed(0)
    ends = torch.randn(batch, 2, 1, JOINTS, generator=rng)
    jerk = (s**3 * (10 - 15 * s + 6 * s**2))[:, None]
    position = ends[:, 0] * jerk + 0.2 * ends[:, 1] * torch.sin(9 * s)[:, None]
    return 3 * s, position if batch > 1 else position[0]


@torch.no_grad()
def measure_rollouts(batch: int, repeats: int) -> dict[str, float]:
    """Roll out position alone, and with derivatives, to new goals, against the bare product."""
    dmp = JointDMP.fit(*demonstrations(batch), BASIS)
    goal = dmp.goal + 0.1
    X, H = torch.randn(batch * JOINTS, BASIS + 3), torch.randn(BASIS + 3, SAMPLES)

    def everything() -> tuple[torch.Tensor, ...]:
        motion = dmp.rollout(goal=goal)
        return motion.position, motion.velocity, motion.acceleration

    calls: dict[str, Callable[[], object]] = {
        "gemm": lambda: X @ H,
        "rollout": lambda: dmp.rollout(goal=goal).position,
        "contiguous": lambda: dmp.rollout(goal=goal).position.contiguous(),
        "everything": everything,
    }
    t = time_calls(calls, repeats_for(batch, repeats))
    return {
        f"gemm_{batch}_us": 1e6 * t["gemm"].median,
        f"rollout_{batch}_us": 1e6 * t["rollout"].median,
        f"rollout_{batch}_of_gemm": t["gemm"].median / t["rollout"].median,
        f"rollout_{batch}_contiguous_of_gemm": t["gemm"].median / t["contiguous"].median,
        f"rollout_{batch}_least_us": 1e6 * t["rollout"].least,
        f"rollout_{batch}_of_gemm_least": t["gemm"].least / t["rollout"].least,
        f"rollout_{batch}_operations": count_operations(calls["rollout"]),
        f"rollout_{batch}_per_s": batch / t["rollout"].median,
        f"rollout_with_derivatives_{batch}_per_s": batch / t["everything"].median,
    }


def measure_fits(batch: int, repeats: int) -> dict[str, float]:
    """Fit primitives to demonstrations, including the residuals."""
    time, position = demonstrations(batch)
    calls: dict[str, Callable[[], object]] = {
        name: lambda method=name: JointDMP.fit(time, position, BASIS, method=method)
        for name in ("trajectory", "ridge")
    }
    t = time_calls(calls, repeats_for(batch, repeats))
    return {
        f"fit_{batch}_ms": 1e3 * t["trajectory"].median,
        f"fit_{batch}_least_ms": 1e3 * t["trajectory"].least,
        f"fit_{batch}_operations": count_operations(calls["trajectory"]),
        f"fit_ridge_{batch}_ms": 1e3 * t["ridge"].median,
    }


@torch.no_grad()
def measure_poses(repeats: int) -> dict[str, float]:
    """Position and quaternion of 256 poses."""
    time, columns = demonstrations(256)
    dmp = PoseDMP.fit(time, columns[..., :3], quaternion.exp(columns[..., 3:6]), BASIS)

    def rollout() -> tuple[torch.Tensor, ...]:
        motion = dmp.rollout()
        return motion.position, motion.orientation

    t = time_calls({"pose": rollout}, repeats)
    return {"pose_rollout_256_per_s": 256 / t["pose"].median}


@torch.no_grad()
def measure_steps(repeats: int) -> dict[str, float]:
    """One closed-loop step of 1 ms: eager, in NumPy, and as an exported program.

    Each kind is called alone, as in a loop: in turn with others, its code would leave the
    caches.
    """
    time, position = demonstrations(1)
    dmp = JointDMP.fit(time.double(), position.double(), BASIS)
    stepper = Stepper(dmp)
    state, plain = dmp.step(dmp.initial_state(), 0.5), stepper.initial_state()
    program, tensors = export_dmp(dmp).program.module(), state_tensors(state)
    dt, resting = torch.tensor([1e-3], dtype=torch.float64), resting_inputs(dmp, tensors)
    calls: dict[str, Callable[[], object]] = {
        "step": lambda: dmp.step(state, 1e-3),
        "stepper": lambda: stepper.step(plain, 1e-3),
        "step_program": lambda: program(tensors, dt, resting),
    }
    figures: dict[str, float] = {}
    for name, call in calls.items():
        t: Timing = time_calls({name: call}, 40 * repeats)[name]
        figures |= {
            f"{name}_us": 1e6 * t.median,
            f"{name}_least_us": 1e6 * t.least,
            f"{name}_p99_us": 1e6 * t.p99,
            f"{name}_operations": count_operations(call),
        }
    return figures


@torch.no_grad()
def measure_new_goals(repeats: int) -> dict[str, float]:
    """Steps with and without a new goal, by kind of primitive."""
    time, columns = (x.double() for x in demonstrations(1))
    turned, angle = quaternion.exp(columns[:, 3:6]), torch.tensor([0.1, 0.0, 0.0]).double()
    joint = JointDMP.fit(time, columns, BASIS)
    orientation = OrientationDMP.fit(time, turned, BASIS)
    pose = PoseDMP.fit(time, columns[:, :3], turned, BASIS)
    rotation = quaternion.multiply(quaternion.exp(angle), orientation.goal)
    figures: dict[str, float] = {}
    kinds: dict[str, tuple[Any, Any]] = {
        "joint": (joint, joint.goal + 0.1),
        "orientation": (orientation, rotation),
        "pose": (pose, Pose(pose.goal.position + 0.1, rotation)),
    }
    for name, (dmp, goal) in kinds.items():
        state = dmp.step(dmp.initial_state(), 0.5)
        calls: dict[str, Callable[[], object]] = {
            "without": lambda dmp=dmp, state=state: dmp.step(state, 1e-3),
            "with": lambda dmp=dmp, state=state, goal=goal: dmp.step(state, 1e-3, goal=goal),
        }
        t = time_calls(calls, 10 * repeats)
        figures[f"step_{name}_new_goal_us"] = 1e6 * t["with"].median
        figures[f"step_{name}_new_goal_of_without"] = t["with"].median / t["without"].median
    return figures


LONG_FIT = """
import resource, sys
import torch
from hrc_learn.dmp import JointDMP
time = torch.linspace(0, 60, int(sys.argv[1]), dtype=torch.float64)
position = torch.sin(time[:, None] * torch.arange(1, 8))
JointDMP.fit(time[::50], position[::50])
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
JointDMP.fit(time, position)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


def measure_memory() -> dict[str, float]:
    """Peak memory of a fit of one long recording, in its own process."""
    figures: dict[str, float] = {}
    for samples in (100_000, 1_000_000):
        command = [sys.executable, "-c", LONG_FIT, str(samples)]
        made = subprocess.run(command, check=True, capture_output=True, text=True)
        size = 1024 * float(made.stdout)
        figures[f"fit_of_{samples}_mb"] = size / 1e6
        figures[f"fit_of_{samples}_of_samples"] = size / (samples * JOINTS * 8)
    return figures


def measure_own_times(repeats: int) -> dict[str, float]:
    """Rollouts of a batch with different durations, compared with one common time grid.

    In addition, gradients, and fits of demonstrations with different time stamps.
    """
    figures: dict[str, float] = {}
    for batch in (256, 4096):
        time, position = demonstrations(batch)
        dmp = JointDMP.fit(time, position, BASIS)
        rng = torch.Generator().manual_seed(1)
        duration = 3 * (1 + 0.5 * torch.rand(batch, generator=rng))
        X, H = torch.randn(batch * JOINTS, BASIS + 3), torch.randn(BASIS + 3, SAMPLES)
        calls: dict[str, Callable[[], object]] = {
            "gemm": lambda X=X, H=H: X @ H,
            "shared": lambda dmp=dmp: dmp.rollout().position,
            "own": lambda dmp=dmp, t=time, d=duration: dmp.rollout(t, duration=d).position,
        }
        with torch.no_grad():
            t = time_calls(calls, repeats_for(batch, repeats))
        figures |= {
            f"own_durations_{batch}_per_s": batch / t["own"].median,
            f"own_durations_{batch}_of_shared": t["shared"].median / t["own"].median,
            f"own_durations_{batch}_of_gemm": t["gemm"].median / t["own"].median,
        }
        if batch > 256:
            continue
        learned = duration.clone().requires_grad_()
        seed = torch.randn(batch, SAMPLES, JOINTS, generator=rng)

        def forward(dmp: JointDMP = dmp, d: torch.Tensor = learned) -> torch.Tensor:
            return dmp.rollout(demonstrations(1)[0], duration=d).position

        def both(d: torch.Tensor = learned, seed: torch.Tensor = seed) -> None:
            torch.autograd.grad(forward(), d, seed)

        stamps = time + 1e-4 * torch.rand(batch, SAMPLES, generator=rng)
        t = time_calls({"forward": forward, "both": both}, max(repeats // 5, 3))
        fit = partial(JointDMP.fit, stamps, position, BASIS)
        fits = time_calls({"fit": fit}, max(repeats // 10, 2))
        figures["duration_gradient_over_forward"] = t["both"].median / t["forward"].median - 1
        figures["fit_own_stamps_256_ms"] = 1e3 * fits["fit"].median
        figures["fit_own_stamps_256_least_ms"] = 1e3 * fits["fit"].least
    return figures


def measure_gradients(repeats: int) -> dict[str, float]:
    """Backward pass through a rollout of 256 motions, to weights and goal."""
    dmp = JointDMP.fit(*demonstrations(256), BASIS)
    goal = dmp.goal.clone().requires_grad_()
    seed = torch.randn(256, SAMPLES, JOINTS)

    def forward() -> torch.Tensor:
        return dmp.rollout(goal=goal).position

    def both() -> None:
        torch.autograd.grad(forward(), (dmp.weights, goal), seed)

    t = time_calls({"forward": forward, "both": both}, repeats)
    return {"backward_over_forward": t["both"].median / t["forward"].median - 1}


def repeats_for(batch: int, repeats: int) -> int:
    """Number of repeats: more for calls of microseconds, fewer for calls of a tenth of a
    second.
    """
    return {1: 20 * repeats, 256: repeats}.get(batch, max(repeats // 5, 3))


def read_figures(path: Path) -> dict[str, float]:
    """Figures of an earlier run."""
    try:
        figures = json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} holds no saved figures: {error}") from None
    return figures


def show(figures: dict[str, float], earlier: dict[str, float]) -> None:
    """Print all values with their targets and the earlier values."""
    kernels = [
        library["architecture"]
        for library in threadpool_info()
        if library["internal_api"] == "openblas"
    ]
    title = f"Movement primitives, one thread; OpenBLAS for {', '.join(kernels) or 'none'}"
    table = Table("figure", *(3 * [""]), title=title)
    for column, name in zip(table.columns[1:], ("measured", "reach", "earlier"), strict=True):
        column.header, column.justify = name, "right"
    for name, value in figures.items():
        reach = ""
        if name in TARGETS:
            target, sign = TARGETS[name]
            met = sign * value >= sign * target
            color = "green" if met else "red"
            reach = f"[{color}]{'>=' if sign > 0 else '<='} {target:,g}"
        before = f"{earlier[name]:,.4g}" if name in earlier else ""
        table.add_row(name, f"{value:,.4g}", reach, before)
    Console().print(table)


if __name__ == "__main__":
    cli.run(main, Args)
