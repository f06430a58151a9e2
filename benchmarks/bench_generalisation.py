"""Accuracy of primitives on demonstrations that they were not fitted to.

Each demonstration of a task is predicted from all others, given its start and goal, and then
also given its pose at half time. Each recording is a file TASK.npy of shape (demonstrations,
samples, 7): position and unit quaternion (w, x, y, z), evenly sampled.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import track
from rich.table import Table

from hrc_learn import cli
from hrc_learn.dmp import (
    PoseDMP,
    PoseTrajectory,
    ProbabilisticDMP,
    mean_primitive,
)
from hrc_learn.geometry import Pose, quaternion

DURATION = 5.0
"""Duration [s]; no result depends on it."""
HALF = DURATION / 2
NOISE = 1e-4
"""Standard deviation of the given values, in the units of the recording and in rad."""


@dataclass(frozen=True, kw_only=True)
class Args:
    recordings: Path
    """Folder of TASK.npy files."""
    n_basis: int = 50
    """Number of basis functions of each primitive."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """Demonstrations of one task: primitives of all but one, and the remaining one."""

    others: PoseDMP
    """Primitives of the other demonstrations, in the paper's form."""
    gentle: PoseDMP
    """The same with `approach=1`: a minimum-jerk approach to new starts and goals."""
    shown: Pose
    """Demonstration to predict, (T,)."""

    @property
    def ends(self) -> tuple[Pose, Pose]:
        return self.shown[0], self.shown[-1]

    @property
    def via(self) -> Pose:
        """Pose at half time, (1,): between two samples if their number is even."""
        T = len(self.shown.position)
        before, after = self.shown[(T - 1) // 2], self.shown[T // 2]
        middle = quaternion.slerp(before.orientation, after.orientation, 0.5)
        return Pose(((before.position + after.position) / 2)[None], middle[None])


def main(args: Args) -> None:
    """Predict, print a table, and write the measured values."""
    torch.set_num_threads(1)
    files = sorted(args.recordings.glob("*.npy"))
    if not files:
        raise ValueError(f"no .npy files in {args.recordings}")
    errors = {
        file.stem: predict_each(read_poses(file), args.n_basis)
        for file in track(files, description="tasks", transient=True)
    }
    show(errors)
    if args.json:
        cli.write_json(args.json, figures(errors))


def read_poses(file: Path) -> Pose:
    """Recorded poses of one task, (demonstrations, T)."""
    recorded = np.load(file)
    if recorded.ndim != 3 or recorded.shape[-1] != 7 or len(recorded) < 3:
        raise ValueError(
            f"{file}: expected (3 or more demonstrations, samples, 7), got {recorded.shape}"
        )
    values = torch.from_numpy(recorded).double()
    return Pose(values[..., :3], values[..., 3:])


def predict_each(poses: Pose, n_basis: int) -> dict[str, tuple[float, float]]:
    """By method: median position error [% of the range] and orientation error [deg]."""
    n, T = poses.position.shape[:2]
    time = torch.linspace(0, DURATION, T, dtype=torch.float64)
    columns = poses.position, poses.orientation
    plain = PoseDMP.fit(time, *columns, n_basis)
    gentle = PoseDMP.fit(time, *columns, n_basis, approach=1.0)
    errors: dict[str, list[tuple[float, float]]] = {name: [] for name in METHODS}
    for i in range(n):
        rest = torch.arange(n) != i
        task = Task(others=select(plain, rest), gentle=select(gentle, rest), shown=poses[i])
        for name, predict in METHODS.items():
            with torch.no_grad():
                errors[name].append(error(predict(task).rollout(time), task.shown))
    return {name: tuple(np.median(rows, axis=0)) for name, rows in errors.items()}


def select(dmps: PoseDMP, rows: torch.Tensor) -> PoseDMP:
    """Selected primitives of a batch."""
    motion = dmps.motion
    chosen = motion.with_coordinates(
        motion.coordinates().detach()[rows],
        motion.duration[rows],
        amplitude=motion.amplitude[rows],
    )
    return PoseDMP(chosen, dmps.goal_orientation[rows])


def error(motion: PoseTrajectory, shown: Pose) -> tuple[float, float]:
    """RMSE of the position [% of the largest range] and of the orientation [deg]."""
    off = (motion.position - shown.position).square().mean().sqrt()
    low, high = shown.position.aminmax(dim=0)
    turned = quaternion.angle(motion.orientation, shown.orientation).square().mean().sqrt()
    return 100 * (off / (high - low).max()).item(), np.rad2deg(turned.item())


def another(task: Task) -> PoseDMP:
    """The demonstration with the closest start and goal, adapted."""
    start, goal = (
        (own.position - new.position).norm(dim=-1)
        for own, new in (
            (task.others.start, task.shown[0]),
            (task.others.goal, task.shown[-1]),
        )
    )
    away = start + goal
    nearest = torch.zeros(len(away), dtype=torch.bool)
    nearest[away.argmin()] = True
    return mean_primitive(select(task.others, nearest)).with_boundary(*task.ends)


def mean(task: Task) -> PoseDMP:
    """The mean of all other demonstrations, adapted."""
    return mean_primitive(task.others).with_boundary(*task.ends)


def gentle_mean(task: Task) -> PoseDMP:
    """The same mean with a minimum-jerk approach."""
    return mean_primitive(task.gentle).with_boundary(*task.ends)


def conditioned(task: Task, slack: float, times: list[float]) -> PoseDMP:
    """The distribution of the others, conditioned on the poses at these times."""
    given = {0.0: task.shown[:1], HALF: task.via, DURATION: task.shown[-1:]}
    where = [given[time] for time in times]
    via = Pose(
        torch.cat([pose.position for pose in where]),
        torch.cat([pose.orientation for pose in where]),
    )
    distribution = ProbabilisticDMP.fit(task.others, slack=slack)
    return distribution.condition(times, via, noise=NOISE).mean_primitive()


METHODS: dict[str, Callable[[Task], Any]] = {
    "nearest": another,
    "mean": mean,
    "mean, approach": gentle_mean,
    "distribution 0.3": lambda task: conditioned(task, 0.3, [0.0, DURATION]),
    "via: mean, through": lambda task: mean(task).condition([HALF], task.via),
    "via: mean, approach, through": lambda task: gentle_mean(task).condition([HALF], task.via),
    "via: mean, around": lambda task: (
        ProbabilisticDMP.around(mean(task)).condition([HALF], task.via).mean_primitive()
    ),
    "via: distribution 0": lambda task: conditioned(task, 0.0, [0.0, HALF, DURATION]),
    "via: distribution 0.1": lambda task: conditioned(task, 0.1, [0.0, HALF, DURATION]),
    "via: distribution 0.3": lambda task: conditioned(task, 0.3, [0.0, HALF, DURATION]),
}
"""Methods that begin with "via" use the pose at half time; numbers are the slack."""


def show(errors: dict[str, dict[str, tuple[float, float]]]) -> None:
    """Print a row for each method, with the median over all tasks last."""
    table = Table("% of range / deg", *errors, "median")
    for name in METHODS:
        row = np.array([errors[task][name] for task in errors])
        cells = [f"{position:.1f} / {angle:.1f}" for position, angle in row]
        position, angle = np.median(row, axis=0)
        table.add_row(name, *cells, f"{position:.2f} / {angle:.2f}")
    Console(width=max(Console().width, 200)).print(table)


def figures(errors: dict[str, dict[str, tuple[float, float]]]) -> dict[str, float]:
    """Measured values as a flat dictionary, by method, task and quantity."""
    flat = {}
    for name in METHODS:
        key = name.replace(":", "").replace(",", "").replace(" ", "_")
        rows = {task: errors[task][name] for task in errors}
        rows["median"] = tuple(np.median(list(rows.values()), axis=0))
        for task, (position, angle) in rows.items():
            flat[f"{key}.{task}.position_percent"] = float(position)
            flat[f"{key}.{task}.orientation_deg"] = float(angle)
    return flat


if __name__ == "__main__":
    cli.run(main, Args)
