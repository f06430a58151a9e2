"""Time of a thousand closed loops with compiled control steps.

Each loop has its own unknown camera and start, as in `controller_sweep.py` (`near`): any roll,
images late by a frame, noise of 0.5 px, the Kalman estimator and the safety filter. Some loops
also run uncompiled, to compare time and results.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from closed_loop import VirtualCamera, simulate_closed_loop
from grasp_trials import TrialConfig, TrialScene, draw_scene, grasp_controller
from jaxtyping import Float
from rich.console import Console
from torch import Tensor

from hrc_learn import cli
from hrc_learn.controller import AdaptiveController, Observation
from hrc_learn.deploy import EagerRunner, open_step
from hrc_learn.jacobian import KalmanEstimator


@dataclass(frozen=True, kw_only=True)
class Args:
    loops: int = 1000
    """Number of closed loops."""
    seconds: float = 10.0
    """Simulated duration of each loop [s]."""
    threads: int = 2
    """Number of threads; each runs an equal part of the loops."""
    eager: int = 100
    """Number of loops that also run uncompiled."""
    packages: Path | None = None
    """Folder in which compiled steps are kept; default: the user's cache."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


class Trials:
    """Trials that a compiled step runs as one batch."""

    def __init__(self, config: TrialConfig, packages: Path | None):
        """Draw the trials and compile their step.

        Args:
            config: Distribution, number and duration of the trials.
            packages: Folder in which compiled steps are kept; None: the user's cache.
        """
        self.config, self.rng = config, torch.Generator().manual_seed(config.seed)
        self.scene = draw_scene(config, self.rng)
        self.controller = grasp_controller(KalmanEstimator, config, self.scene)
        self.camera = VirtualCamera(
            camera=self.scene.camera, imperfections=config.imperfections, generator=self.rng
        )
        self.runner = open_step(*batched(self.controller, self.scene, config.dt), packages)
        if isinstance(self.runner, EagerRunner):
            raise SystemExit("the step of these trials is not compiled: install a C compiler")

    def run(self) -> Float[Tensor, "trials n"]:
        """Joint positions at the end [rad]."""
        config, q, dt = self.config, self.scene.start.clone(), self.config.dt
        values, between = self.runner.observation, config.imperfections.frame_steps
        with torch.inference_mode():
            for k in range(round(config.duration / dt)):
                if k % between == 0:  # an image is taken
                    tool = self.controller.chain.forward(q)
                for name, value in self.camera.observe(tool, q.clone(), dt).items():
                    values[name][...] = value.numpy()
                values["joint_position"][...] = q.numpy()
                q += dt * torch.from_numpy(self.runner.step())
        return q


def batched(
    controller: AdaptiveController, scene: TrialScene, dt: float
) -> tuple[AdaptiveController, Observation]:
    """A controller, and an observation that has all fields of its loops."""
    seen = torch.ones(len(scene.start), dtype=torch.bool)
    observation = Observation(
        joint_position=scene.start,
        feature=scene.target,
        feature_visible=seen,
        feature_new=seen,
        image_joint_position=scene.start,
        dt=dt,
        goals=controller.goals,
    )
    return controller, observation


def pixel_errors(trials: Trials, q: Float[Tensor, "trials n"]) -> Float[Tensor, " trials"]:
    """Distance of each marker from its target [px]."""
    feature, _ = trials.scene.camera.project(trials.controller.chain.forward(q))
    return (feature - trials.scene.target).norm(dim=-1)


def main(args: Args) -> None:
    """Measure, print, and write the measured values."""
    torch.set_num_threads(1)
    console = Console()
    config = TrialConfig(duration=args.seconds, count=args.loops // args.threads)
    parts = [replace(config, seed=k) for k in range(args.threads)]
    trials = [Trials(part, args.packages) for part in parts]
    began, used = time.perf_counter(), time.process_time()
    with ThreadPoolExecutor(args.threads) as pool:
        ends = list(pool.map(Trials.run, trials))
    wall, cpu = time.perf_counter() - began, time.process_time() - used
    errors = torch.cat([pixel_errors(*pair) for pair in zip(trials, ends, strict=True)])
    values = {
        "loops": float(len(errors)),
        "simulated_s": args.seconds,
        "wall_s": wall,
        "cpu_s": cpu,
        "on_target": float((errors < 5).double().mean()),
    }
    if args.eager:
        values |= compared(replace(config, count=args.eager), args.packages)
    for name, value in values.items():
        console.print(f"{name:30} {value:.4g}")
    if args.json is not None:
        cli.write_json(args.json, values)


def compared(config: TrialConfig, packages: Path | None) -> dict[str, float]:
    """Compiled and uncompiled loops of the same trials: time, and difference at the end."""
    compiled, eager = Trials(config, packages), Trials(config, packages)
    began = time.process_time()
    q = compiled.run()
    middle = time.process_time()
    with torch.inference_mode():
        reference = simulate_closed_loop(
            eager.controller,
            eager.camera,
            eager.scene.start,
            steps=round(config.duration / config.dt),
            dt=config.dt,
        )
    took = time.process_time() - middle
    return {
        "eager_over_compiled": took / (middle - began),
        "largest_difference_rad": float((q - reference).abs().max()),
    }


if __name__ == "__main__":
    cli.run(main, Args)
