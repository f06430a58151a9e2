"""Measure fits of demonstrations larger than memory: time, memory and accuracy.

Writes a synthetic dataset with this package's writer, reads it once from disk, episode by
episode, and fits a movement primitive and an image Jacobian to it.
"""

import math
import resource
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from hrc_learn import cli
from hrc_learn.demos import DatasetWriter, Demonstration, open_demos
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import ImageJacobianFitConfig, RBFCenters, RBFImageJacobian
from hrc_learn.learning.primitive_fitting import fit_streamed
from hrc_learn.learning.visual_servo_fitting import feature_trajectories

JOINTS = tuple(f"joint{i + 1}" for i in range(7))


@dataclass(frozen=True, kw_only=True)
class Args:
    """Size of the dataset and settings of the fit."""

    episodes: int = 1000
    """Number of demonstrations."""
    frames: int = 1000
    """Number of frames in each demonstration."""
    n_basis: int = 50
    """Number of basis functions."""
    dataset: Path | None = None
    """Folder of the dataset, which is kept, or read if it exists. None: a temporary folder."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


def main(args: Args) -> None:
    torch.set_num_threads(1)
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.dataset or Path(temporary) / "synthetic"
        if not folder.exists():
            figures["write_s"] = _timed(lambda: _write(folder, args))[0]
        demos = open_demos(folder)
        figures["frames"] = float(demos.frames)
        before = _peak_memory()
        took, (_, values) = _timed(lambda: fit_streamed(demos, args.n_basis))
        figures["dmp_fit_s"] = took
        figures["dmp_fit_peak_growth_mb"] = _peak_memory() - before
        figures["dmp_rmse_rad"] = values["mean_joint_rmse"]
        camera = feature_trajectories(demos)
        config = ImageJacobianFitConfig(pixel_noise=0.1)
        took, network = _timed(
            lambda: RBFImageJacobian.fit(camera, RBFCenters.around(camera), config)
        )
        figures["jacobian_fit_s"] = took
        figures["peak_growth_mb"] = _peak_memory() - before
        figures["peak_mb"] = _peak_memory()
        if network.report is not None:
            figures["jacobian_held_out_relative"] = (
                network.report.held_out_error / network.report.motion
            )
    for name, value in figures.items():
        print(f"{name:<32} {value:.3g}")
    if args.json is not None:
        cli.write_json(args.json, figures)


def _timed[T](work: Callable[[], T]) -> tuple[float, T]:
    """CPU time [s], on which other programs have little effect, and the result."""
    began = time.process_time()
    result = work()
    return time.process_time() - began, result


def _peak_memory() -> float:
    """Peak memory of this process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _write(folder: Path, args: Args) -> None:
    rng = np.random.default_rng(0)
    with DatasetWriter(folder, fps=100, robot_type="synthetic", joint_names=JOINTS) as writer:
        for episode in range(args.episodes):
            writer.add_episode(_demonstration(episode, args.frames, rng))


def _demonstration(episode: int, frames: int, rng: np.random.Generator) -> Demonstration:
    """A motion with its own ends, duration, stamps and noise, seen by a camera."""
    duration = rng.uniform(0.8, 1.2) * frames / 100
    steps = 1 + 0.2 * rng.uniform(-1, 1, frames)
    stamps = np.concatenate([[0.0], np.cumsum(steps[1:])])
    s = stamps / stamps[-1]
    way = 10 * s**3 - 15 * s**4 + 6 * s**5
    ends = np.array([[-0.5], [0.5]]) + 0.02 * rng.uniform(-1, 1, (2, 7))
    shape = 0.3 * np.sin(np.outer(s, 1 + np.arange(7)) * math.pi) * np.sin(math.pi * s)[:, None]
    joints = ends[0] + np.outer(way, ends[1] - ends[0]) + shape
    phase = 2 * math.pi * (s[:, None] * (1 + np.arange(3)) + rng.uniform(0, 1, 3))
    place = np.array([0.2, 0.5, 0.2]) + 0.08 * np.sin(phase)
    turn = quaternion.exp(torch.from_numpy(0.1 * np.cos(2 * phase)))
    marker = Pose(torch.from_numpy(place), turn).apply(torch.tensor([0.1, 0.0, 0.0]).double())
    pixel = 1500 * (marker[:, :2] / (1.5 - marker[:, 2:])).numpy()
    return Demonstration(
        episode=episode,
        task="synthetic",
        fps=100,
        time=s * duration,
        joint_names=JOINTS,
        joint_position=joints + 1e-3 * rng.standard_normal((frames, 7)),
        position=place,
        orientation=turn.numpy(),
        feature=pixel + 0.1 * rng.standard_normal((frames, 2)),
        feature_visible=np.ones(frames, dtype=bool),
    )


if __name__ == "__main__":
    cli.run(main, Args)
