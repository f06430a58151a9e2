"""Run the controller at a fixed rate on the simulated arm, and report how fast it answers.

The arm servoes on a marker that an uncalibrated camera sees at 31 Hz. Latency is the time from
reading the joints to the command, in wall-clock time; a tick is missed when the loop, physics
included, was still busy a whole period after it. Exit status 1 if the marker did not arrive.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from rich.console import Console

from hrc_learn import cli
from hrc_learn.controller import (
    GRIPPER_DOWN,
    INITIAL_IMAGE_JACOBIAN,
    AdaptiveController,
    Goals,
    Observation,
)
from hrc_learn.controller.rehearsal import PinholeCamera
from hrc_learn.controller.runtime import Metronome, StepRunner, open_step
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import KalmanEstimator, RBFImageJacobian, paper_grid
from hrc_learn.kinematics import panda
from hrc_learn.sim import SceneConfig, World

FRAME_TIME = 0.032
"""From one image to the next [s]."""
CLOSE = 5.0
"""Pixel error at which the marker has arrived [px]."""
CENTRE = (0.35, 0.35, 0.35)
"""Of the box [m]."""


@dataclass(frozen=True, kw_only=True)
class Args:
    duration: float = 8.0
    """How long to run [s]."""
    rate: float = 500.0
    """Control steps a second; the physics takes steps of the same length."""
    step: Literal["fastest", "eager"] = "fastest"
    """Whether to compile the step ahead of time, where there is a C++ compiler."""
    packages: Path | None = None
    """Folder in which compiled steps are kept; default: the user's cache."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> int:
    if not (args.duration > 0 and args.rate > 0):
        raise ValueError("duration and rate must be positive")
    torch.set_num_threads(1)
    dt = 1 / args.rate
    camera = _camera()
    controller, observation = _controller(camera, dt)
    if args.step == "eager":
        runner = StepRunner.eager(controller, observation)
    else:
        runner = open_step(controller, observation, args.packages)
    latencies, missed, error = _serve(runner, camera, dt, round(args.duration * args.rate))
    p50, p99, p999 = 1e6 * np.quantile(latencies, [0.5, 0.99, 0.999])
    figures = {
        "steps": len(latencies),
        "missed_ticks": missed,
        "latency_p50_us": p50,
        "latency_p99_us": p99,
        "latency_p999_us": p999,
        "latency_max_us": 1e6 * latencies.max(),
        "pixel_error": error,
    }
    for name, value in figures.items():
        Console().print(f"{name:16} {value:.4g}", highlight=False)
    if args.json is not None:
        cli.write_json(args.json, figures)
    return 0 if error < CLOSE else 1


def _camera() -> PinholeCamera:
    centre = torch.tensor(CENTRE, dtype=torch.float64)
    return PinholeCamera.above(
        centre,
        height=centre.new_tensor(1.1),
        roll=centre.new_tensor(0.5),
        tilt=centre.new_tensor(0.2),
        bearing=centre.new_tensor(1.0),
        marker=centre.new_tensor((0.05, 0.0, -0.08)),
    )


def _controller(camera: PinholeCamera, dt: float) -> tuple[AdaptiveController, Observation]:
    """The controller, and an observation with all that the loop will tell it."""
    centre = torch.tensor(CENTRE, dtype=torch.float64)
    down = quaternion.normalize(centre.new_tensor(GRIPPER_DOWN))
    target, _ = camera.project(Pose(centre + centre.new_tensor((0.03, -0.02, 0.0)), down))
    J = torch.tensor(INITIAL_IMAGE_JACOBIAN, dtype=torch.float64)
    network = RBFImageJacobian.from_jacobian(J, paper_grid(), 0.1)
    controller = AdaptiveController(
        panda, KalmanEstimator(network), Goals.at(centre, down, target)
    )
    q = panda.ready
    observation = Observation(
        joint_position=q,
        feature=target,
        feature_visible=torch.tensor(False),
        feature_new=torch.tensor(False),
        image_joint_position=q,
        human_effort=torch.zeros_like(q),
        dt=dt,
    )
    return controller, observation


def _serve(
    runner: StepRunner, camera: PinholeCamera, dt: float, steps: int
) -> tuple[np.ndarray, int, float]:
    """Run the loop; returns latencies [s], missed ticks, and the last pixel error [px]."""
    world = World(SceneConfig(timestep=dt))
    world.reset(panda.ready.numpy())
    arrays, latencies = runner.observation, np.empty(steps)
    target = arrays["feature"].copy()
    frame_steps = max(1, round(FRAME_TIME / dt))
    runner.step()  # the first call is slower than any other
    runner.start(panda.ready.numpy())
    metronome = Metronome(dt)
    for k in range(steps):
        began = time.perf_counter()
        q = world.arm.read().joint_position
        arrays["joint_position"][:] = q
        world.arm.command(runner.step())
        latencies[k] = time.perf_counter() - began
        world.advance(dt)
        arrays["feature_new"][...] = k % frame_steps == 0
        if k % frame_steps == 0:
            _look(arrays, camera, world)
        metronome.wait()
    return latencies, metronome.missed, float(np.linalg.norm(arrays["feature"] - target))


def _look(arrays: dict[str, np.ndarray], camera: PinholeCamera, world: World) -> None:
    q = world.arm.read().joint_position
    feature, visible = camera.project(panda.forward(torch.from_numpy(q)))
    arrays["feature"][:] = feature.numpy()
    arrays["feature_visible"][...] = bool(visible)
    arrays["image_joint_position"][:] = q


if __name__ == "__main__":
    cli.run(main, Args)
