"""`hrc serve`: the controller at a fixed rate, and its latency."""

import os

# More threads would only wait for each other within a control step.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import torch
from rich.console import Console

from hrc_learn.cli._run import write_values
from hrc_learn.cli._settings import with_settings
from hrc_learn.cli.arm_arguments import Serve
from hrc_learn.controller import (
    GRIPPER_DOWN,
    INITIAL_IMAGE_JACOBIAN,
    INTERVENTIONS,
    AdaptiveController,
    ControllerConfig,
    Goals,
    Observation,
    SafetyConfig,
)
from hrc_learn.deploy import EagerRunner, Rate, StepRunner, open_step
from hrc_learn.experiments.real_arm import ArmSite, opened_arm
from hrc_learn.experiments.simulated_cell import access_by
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.hardware import ending_at_rest
from hrc_learn.jacobian import KalmanEstimator, RBFImageJacobian, paper_grid
from hrc_learn.kinematics import Arm as ArmModel
from hrc_learn.kinematics import ArmChoice, SerialChain
from hrc_learn.protocols import Arm, OpenedArm
from hrc_learn.sim import SceneConfig, World
from hrc_learn.sim.pinhole_camera import PinholeCamera

FRAME_TIME = 0.032
"""Time between images [s]."""
CENTRE = (0.35, 0.35, 0.35)
"""Centre of the box that the tool moves in [m]."""
PERCENTILES = (50.0, 90.0, 99.0, 99.9, 100.0)


@dataclass(frozen=True, kw_only=True)
class Latencies:
    """Latencies of each control step."""

    step: np.ndarray
    """Time from reading the joints to the command [s]."""
    late: np.ndarray
    """Delay of the tick, or of the first one missed before it [s]."""
    missed: int
    """Number of missed ticks."""


def serve(args: Serve) -> None:
    """Run the loop and print its latencies."""
    if not (args.duration > 0 and args.rate > 0):
        raise ValueError("--duration and --rate must be positive")
    if args.rate < (slowest := SafetyConfig().rate):
        raise ValueError(
            f"--rate must be at least {slowest:g}, the minimum of the safety filter"
        )
    torch.set_num_threads(1)
    dt = 1 / args.rate
    camera, robot = _camera(), ArmChoice(args.robot, tip=args.tip).work_arm()
    access = _access(args, dt, robot)
    controller, observation = _controller(robot.chain, camera, dt, access.safety)
    began = time.perf_counter()
    if args.step == "eager":
        runner = EagerRunner(controller, observation)
    else:
        runner = open_step(controller, observation)
    opened = time.perf_counter() - began
    with access.connect() as arm:
        steps = round(args.duration * args.rate)
        latencies, error = _run_loop(runner, arm, robot.chain, camera, dt, steps)
    figures = {"open_s": opened} | _figures(latencies) | {"pixel_error": error}
    counts = runner.state("safety.counts")
    figures |= {f"safety_{k}": int(n) for k, n in zip(INTERVENTIONS, counts, strict=True)}
    for name, value in figures.items():
        Console().print(f"{name:22} {value:.4g}", highlight=False)
    write_values(args.json, figures)


def _figures(latencies: Latencies) -> dict[str, float | int]:
    figures: dict[str, float | int] = {
        "steps": len(latencies.step),
        "missed_ticks": latencies.missed,
        "missed_percent": 100 * latencies.missed / (len(latencies.step) + latencies.missed),
    }
    for name, seconds in (("step", latencies.step), ("late", latencies.late)):
        values = 1e6 * np.percentile(seconds, PERCENTILES)
        for percentile, value in zip(PERCENTILES, values, strict=True):
            figures[f"{name}_p{percentile:g}_us"] = float(value)
    return figures


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


def _controller(
    chain: SerialChain, camera: PinholeCamera, dt: float, safety: SafetyConfig
) -> tuple[AdaptiveController, Observation]:
    """The controller, and an observation with every field that the loop sets."""
    centre = torch.tensor(CENTRE, dtype=torch.float64)
    down = quaternion.normalize(centre.new_tensor(GRIPPER_DOWN))
    target, _ = camera.project(Pose(centre + centre.new_tensor((0.03, -0.02, 0.0)), down))
    J = torch.tensor(INITIAL_IMAGE_JACOBIAN, dtype=torch.float64)
    network = RBFImageJacobian.from_jacobian(J, paper_grid(), 0.1)
    controller = AdaptiveController(
        chain,
        KalmanEstimator(network),
        Goals.at(centre, down, target),
        config=ControllerConfig(safety=safety),
    )
    q = chain.ready
    observation = Observation(
        joint_position=q,
        feature=target,
        feature_visible=torch.tensor(False),
        feature_new=torch.tensor(False),
        image_joint_position=q,
        nullspace_input=torch.zeros_like(q),
        # A tensor, so that one compiled step serves all rates.
        dt=torch.tensor(dt, dtype=torch.float64),
    )
    return controller, observation


@dataclass(frozen=True, kw_only=True)
class _Access:
    """Access to the arm of the loop."""

    connect: Callable[[], AbstractContextManager[OpenedArm]]
    """Connects to the arm."""
    safety: SafetyConfig
    """Configuration of the safety filter for this arm."""


@dataclass(frozen=True, kw_only=True)
class _Settings:
    """Settings of a real arm."""

    site: ArmSite = field(default_factory=ArmSite)


def _access(args: Serve, dt: float, robot: ArmModel) -> _Access:
    """Access to a real arm, or to a simulated one in its ready posture."""
    settings = with_settings(args.config, _Settings())
    if args.drives_real_arm():
        site = replace(settings.site, driver=args.arm, ip=args.ip)

        @contextmanager
        def open_arm() -> Iterator[OpenedArm]:
            with opened_arm(site) as arm:
                yield OpenedArm(arm=arm, gripper=arm, advance=lambda _time: None)

        return _Access(connect=open_arm, safety=site.cell_config().safety)
    scene = SceneConfig(timestep=dt)
    world = World(replace(scene, arm=replace(scene.arm, robot=robot)))
    world.reset(robot.chain.ready.numpy())
    access = access_by(args.arm, robot)
    safety = SafetyConfig(delay=access.delay, braking=access.dynamics)
    return _Access(connect=partial(access.open, world), safety=safety)


def _run_loop(
    runner: StepRunner,
    opened: OpenedArm,
    chain: SerialChain,
    camera: PinholeCamera,
    dt: float,
    steps: int,
) -> tuple[Latencies, float]:
    """Run the loop and return its latencies and the last image error [px]."""
    arm = opened.arm
    target = runner.observation["feature"].copy()
    frame_steps = max(1, round(FRAME_TIME / dt))
    took, late = np.empty(steps), np.empty(steps)
    runner.observation["joint_position"][:] = arm.read().joint_position
    runner.step()  # the first step is slower than all others
    runner.start(arm.read().joint_position)
    rate = Rate(dt)
    with ending_at_rest(lambda: arm.command(np.zeros(len(chain.joint_names)))):
        for k in range(steps):
            began = time.perf_counter()
            _answer(runner, arm)
            took[k] = time.perf_counter() - began
            opened.advance(dt)
            runner.observation["feature_new"][...] = k % frame_steps == 0
            if k % frame_steps == 0:
                _look(runner.observation, chain, camera, arm)
            late[k] = rate.wait()
    error = float(np.linalg.norm(runner.observation["feature"] - target))
    return Latencies(step=took, late=late, missed=rate.missed), error


def _answer(runner: StepRunner, arm: Arm) -> None:
    """Read the joints, step the controller, send the command."""
    runner.observation["joint_position"][:] = arm.read().joint_position
    arm.command(runner.step())


def _look(
    arrays: dict[str, np.ndarray], chain: SerialChain, camera: PinholeCamera, arm: Arm
) -> None:
    """Take an image of the marker, stamped with the joints."""
    q = arm.read().joint_position
    feature, visible = camera.project(chain.forward(torch.from_numpy(q)))
    arrays["feature"][:] = feature.numpy()
    arrays["feature_visible"][...] = bool(visible)
    arrays["image_joint_position"][:] = q
