"""Speed of movement primitives and kinematics on a GPU, relative to the limits of the card.

7 joints, 1000 samples, 50 basis functions, float32. The floor of a call is the longer of two
times. One is the time to read and write its data at the bandwidth of a large copy; the other is
the time of its multiplications at the rate of a large float32 product (without TF32). Both
rates are measured in the same run. Times are medians of wall time between events of the device,
for successive calls; small calls are limited by Python. The same calls are measured on all CPU
cores.
"""

import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import torch
from bench_dmp import BASIS, JOINTS, SAMPLES, demonstrations
from rich.console import Console
from rich.table import Table
from torch import Tensor

from hrc_learn import cli
from hrc_learn.dmp import JointDMP, PoseDMP
from hrc_learn.geometry import quaternion
from hrc_learn.kinematics import panda

_FLOAT = 4
"""Bytes of a float32."""
_MOTION = _FLOAT * SAMPLES * JOINTS
"""Bytes of a trajectory."""
_PRODUCT = 2 * (BASIS + 3) * SAMPLES * JOINTS
"""Operations of the matrix product for a trajectory, from weights, start, goal and velocity."""


@dataclass(frozen=True, kw_only=True)
class Args:
    device: str = "cuda"
    """Device of PyTorch; "cpu" tests the program on a machine without a GPU."""
    batches: tuple[int, ...] = (1, 256, 4096, 16384)
    """Numbers of motions in a batch."""
    repeats: int = 50
    """Number of calls of each kind on the device; a fifth of it on the CPU."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """A call, and the least work that any implementation needs for it."""

    name: str
    batch: int
    call: Callable[[], object]
    bytes: float
    operations: float


def main(args: Args) -> None:
    """Measure, print a table, write the figures.

    Raises:
        ValueError: without such a device.
    """
    device = torch.device(args.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(
            "--device cuda: PyTorch finds no GPU here; --device cpu tries the program"
        )
    torch.backends.cuda.matmul.allow_tf32 = False
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    bandwidth, rate = measure_floors(device)
    figures = {"copy_tb_per_s": bandwidth / 1e12, "product_tflop_per_s": rate / 1e12}
    title = (
        f"{name}: copies {bandwidth / 1e12:.2f} TB/s, "
        f"multiplies {rate / 1e12:.1f} TFLOP/s; {torch.get_num_threads()} CPU threads"
    )
    table = Table(
        "call", "motions", "time [µs]", "floor [µs]", "floor/time", "per second", "CPU/GPU",
        title=title,
    )  # fmt: skip
    for on_device, on_cpu in zip(
        tasks(device, args.batches), tasks(torch.device("cpu"), args.batches), strict=True
    ):
        seconds = time_calls(on_device.call, args.repeats, device)
        cpu = time_calls(on_cpu.call, max(args.repeats // 10, 2), torch.device("cpu"))
        floor = max(on_device.bytes / bandwidth, on_device.operations / rate)
        key = f"{on_device.name}_{on_device.batch}"
        figures |= {
            f"{key}_us": 1e6 * seconds,
            f"{key}_of_floor": floor / seconds,
            f"{key}_cpu_over_gpu": cpu / seconds,
        }
        table.add_row(
            on_device.name.replace("_", " "),
            f"{on_device.batch:,}",
            f"{1e6 * seconds:,.0f}",
            f"{1e6 * floor:,.1f}",
            f"{floor / seconds:.2f}",
            f"{on_device.batch / seconds:,.3g}",
            f"{cpu / seconds:.3g}",
        )
    Console(width=110).print(table)
    if args.json is not None:
        cli.write_json(args.json, figures)


def measure_floors(device: torch.device) -> tuple[float, float]:
    """Bytes per second of a copy, read and written, and operations per second of a product."""
    size = 2**28 if device.type == "cuda" else 2**24
    source = torch.ones(size, device=device)
    target = torch.empty_like(source)
    copy = time_calls(lambda: target.copy_(source), 20, device)
    side = 8192 if device.type == "cuda" else 1024
    rng = torch.Generator().manual_seed(0)
    A = torch.randn(side, side, generator=rng).to(device)
    product = time_calls(lambda: A @ A, 10, device)
    return 2 * _FLOAT * size / copy, 2 * side**3 / product


def time_calls(call: Callable[[], object], repeats: int, device: torch.device) -> float:
    """Median time of a call [s], after two calls that are not timed."""
    for _ in range(2):
        call()
    if device.type != "cuda":
        seconds: list[float] = []
        for _ in range(repeats):
            start = time.perf_counter()
            call()
            seconds.append(time.perf_counter() - start)
        return statistics.median(seconds)
    torch.cuda.synchronize(device)
    events = [torch.cuda.Event(enable_timing=True) for _ in range(repeats + 1)]
    events[0].record()
    for event in events[1:]:
        call()
        event.record()
    torch.cuda.synchronize(device)
    # The calls follow each other: the time of one is the time between two ends.
    return statistics.median(a.elapsed_time(b) for a, b in pairwise(events)) / 1e3


def tasks(device: torch.device, batches: tuple[int, ...]) -> Iterator[Task]:
    """Calls to measure, each prepared when it is its turn: the largest need gigabytes."""
    for batch in batches:
        yield from _motions(device, batch)
    for batch in batches[1:]:
        yield from _own_times(device, batch)
    for batch in batches[-2:]:
        yield from _kinematics(device, batch)


def _motions(device: torch.device, batch: int) -> Iterator[Task]:
    stamps, position = (x.to(device) for x in demonstrations(batch))
    dmp = JointDMP.fit(stamps, position, BASIS)
    goal = dmp.goal + 0.1
    work = {"bytes": float(batch * _MOTION), "operations": float(batch * _PRODUCT)}
    yield Task(
        name="fit", batch=batch, call=lambda: JointDMP.fit(stamps, position, BASIS), **work
    )
    no_grad = torch.no_grad()
    X = torch.ones(batch * JOINTS, BASIS + 3, device=device)
    H = torch.ones(BASIS + 3, SAMPLES, device=device)
    yield Task(name="bare_product", batch=batch, call=lambda: X @ H, **work)
    yield Task(
        name="rollout",
        batch=batch,
        call=no_grad(lambda: dmp.rollout(goal=goal).position),
        **work,
    )

    @torch.no_grad()
    def everything() -> tuple[Tensor, ...]:
        motion = dmp.rollout(goal=goal)
        return motion.position, motion.velocity, motion.acceleration

    yield Task(
        name="rollout_with_derivatives",
        batch=batch,
        call=everything,
        bytes=3 * work["bytes"],
        operations=3 * work["operations"],
    )
    learned = dmp.goal.clone().requires_grad_()
    seed = torch.ones_like(position)

    def backward() -> None:
        moved = dmp.rollout(goal=learned).position
        torch.autograd.grad(moved, (dmp.weights, learned), seed)

    # The trajectory is written, its gradient is read.
    yield Task(
        name="forward_and_backward",
        batch=batch,
        call=backward,
        bytes=2 * work["bytes"],
        operations=2 * work["operations"],
    )
    state = dmp.step(dmp.initial_state(), 0.5)
    # Position and rate are read and written; start, goal and weights are read.
    step = {
        "bytes": float(_FLOAT * batch * JOINTS * (BASIS + 8)),
        "operations": float(2 * batch * JOINTS * BASIS),
    }
    yield Task(
        name="closed_loop_step",
        batch=batch,
        call=no_grad(lambda: dmp.step(state, 1e-3)),
        **step,
    )
    if batch <= 4096:
        x = position if batch > 1 else position[None]
        orientation = quaternion.exp(x[..., 3:6])
        pose = PoseDMP.fit(stamps, x[..., :3], orientation, BASIS)

        @torch.no_grad()
        def poses() -> tuple[Tensor, ...]:
            motion = pose.rollout()
            return motion.position, motion.orientation

        yield Task(name="pose_rollout", batch=batch, call=poses, **work)


def _own_times(device: torch.device, batch: int) -> Iterator[Task]:
    """Motions with different durations and time stamps."""
    stamps, position = (x.to(device) for x in demonstrations(batch))
    dmp = JointDMP.fit(stamps, position, BASIS)
    rng = torch.Generator().manual_seed(1)
    duration = 3 * (1 + 0.5 * torch.rand(batch, generator=rng)).to(device)
    work = {"bytes": float(batch * _MOTION), "operations": float(batch * _PRODUCT)}
    yield Task(
        name="rollout_of_own_durations",
        batch=batch,
        call=torch.no_grad()(lambda: dmp.rollout(stamps, duration=duration).position),
        **work,
    )
    compiled = torch.compile(lambda duration: dmp.rollout(stamps, duration=duration).position)
    yield Task(
        name="own_durations_compiled",
        batch=batch,
        call=torch.no_grad()(lambda: compiled(duration)),
        **work,
    )
    if batch > 4096:
        return
    learned = duration.clone().requires_grad_()
    seed = torch.ones_like(position)

    def backward() -> None:
        moved = dmp.rollout(stamps, duration=learned).position
        torch.autograd.grad(moved, learned, seed)

    yield Task(
        name="duration_gradient",
        batch=batch,
        call=backward,
        bytes=2 * work["bytes"],
        operations=2 * work["operations"],
    )
    own = stamps + 1e-4 * torch.rand(batch, SAMPLES, generator=rng).to(device)
    columns = BASIS + 3
    yield Task(
        name="fit_of_own_stamps",
        batch=batch,
        call=partial(JointDMP.fit, own, position, BASIS),
        bytes=work["bytes"] * (1 + 1 / JOINTS),
        # The normal matrix of each demonstration (one half of it) and its right-hand sides.
        operations=float(batch * (columns**2 * SAMPLES + _PRODUCT)),
    )


def _kinematics(device: torch.device, batch: int) -> Iterator[Task]:
    # One row per joint: the batch is last in memory.
    q = panda.ready.float().to(device).expand(batch, 7).mT.contiguous().mT
    yield Task(
        name="kinematics",
        batch=batch,
        call=torch.no_grad()(lambda: panda.transform_and_jacobian(q)),
        bytes=float(_FLOAT * batch * (7 + 12 + 6 * 7)),
        # Seven products with transforms whose last row is known, and as many cross products.
        operations=float(batch * 7 * (2 * 3 * 3 * 4 + 9)),
    )


if __name__ == "__main__":
    cli.run(main, Args)
