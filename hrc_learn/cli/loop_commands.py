"""`hrc page` and `hrc serve`: loops at a fixed rate on a simulated or a real arm."""

import os

# More threads would only wait for each other within a control step.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from rich.console import Console

from hrc_learn.cli._run import with_settings, write_values
from hrc_learn.cli.arguments import Serve, ServePage, WithDriver, refuse_given
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
from hrc_learn.demos import DatasetWriter
from hrc_learn.demos.issues import counted
from hrc_learn.deploy import EagerRunner, Rate, StepRunner, open_step
from hrc_learn.experiments.real_arm import ArmSite, opened_arm
from hrc_learn.experiments.simulated_cell import access_by
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.hardware import DriverError, ending_at_rest
from hrc_learn.hardware.ros2_topics import found_description, ros2_origin
from hrc_learn.jacobian import KalmanEstimator, RBFImageJacobian, paper_grid
from hrc_learn.kinematics import Arm, ArmChoice, SerialChain
from hrc_learn.protocols import OpenedArm
from hrc_learn.sim import SceneConfig, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.teleoperation.demonstration_recorder import DemonstrationRecorder
from hrc_learn.teleoperation.devices import Gamepad, HapticDevice, TerminalKeyboard
from hrc_learn.teleoperation.gate import qr_code
from hrc_learn.teleoperation.headset import BUILD
from hrc_learn.teleoperation.page import Page, PageConfig
from hrc_learn.teleoperation.page_session import (
    FEATURES,
    PageSession,
    PageSessionConfig,
    place_targets,
)
from hrc_learn.vision import CameraModel

SWITCH_INTERVAL = 0.0005
"""Longest time for which a thread of the page holds the interpreter [s]."""
MARKER = (0.05, 0.0, -0.08)
"""Position of the gripper's marker in the tool's frame, as `hrc serve` simulates it [m]."""
FRAME_TIME = 0.032
"""Time between images of `hrc serve` [s]."""
CENTRE = (0.35, 0.35, 0.35)
"""Centre of the tool's motion in `hrc serve`, for an arm with the Franka hand [m]."""
PERCENTILES = (50.0, 90.0, 99.0, 99.9, 100.0)


def _arm_of(args: WithDriver, site: ArmSite) -> Arm:
    """The arm that `--robot` names, or `site.robot` if `--robot` is the default (Panda)."""
    named = site.robot if args.robot == "panda" else found_description(args.robot)
    return ArmChoice(named).work_arm()


def _access(
    args: WithDriver, site: ArmSite, world: World, safety: SafetyConfig
) -> tuple[Callable[[], AbstractContextManager[OpenedArm]], SafetyConfig]:
    """Connection to a real arm, which the simulated world mirrors, or to the simulated arm.

    Returns:
        Function that connects, and the configuration of the safety filter for this arm.
    """
    robot = world.arm.robot
    if args.drives_real_arm():
        if args.arm in ("franky", "franka"):
            access_by(args.arm, robot)  # refuses other arms
        site = replace(site, driver=args.arm, ip=args.ip)
        return partial(_real_arm, site, world, robot), site.cell_config().safety
    assert args.arm not in ("lerobot", "ros2")  # both drive real arms
    access = access_by(args.arm, robot)
    delay = safety.delay + access.delay
    braking = min(safety.braking, access.dynamics)
    return partial(access.open, world), replace(safety, delay=delay, braking=braking)


@contextmanager
def _real_arm(site: ArmSite, world: World, chain: SerialChain) -> Iterator[OpenedArm]:
    with ExitStack() as stack:
        try:
            arm = stack.enter_context(opened_arm(site, chain))
        except DriverError as error:
            raise ConnectionError(str(error)) from error
        world.follow(arm.read())
        yield OpenedArm(arm=arm, gripper=arm, advance=lambda _time: world.follow(arm.read()))


@dataclass(frozen=True, kw_only=True)
class _PageSettings:
    """Settings of the page, the recording session and a real arm."""

    page: PageConfig
    task: str = "put the object on the middle shelf"
    """Task in words, which can be changed on the page."""
    session: PageSessionConfig = field(default_factory=PageSessionConfig)
    site: ArmSite = field(default_factory=ArmSite)


def page(args: ServePage) -> None:
    """Serve the page and run the control loop until the person finishes."""
    settings = _PageSettings(page=PageConfig(host=args.host, port=args.port))
    settings = with_settings(args.config, settings)
    guiding = settings.session.guiding
    torch.set_num_threads(1)
    sys.setswitchinterval(SWITCH_INTERVAL)
    print("Preparing arm and work cell; the first start takes longer", flush=True)
    robot, console = _arm_of(args, settings.site), Console()
    workplace = Workplace.of(robot)
    world = World(workplace.scene)
    connect, safety = _access(args, settings.site, world, guiding.safety)
    if not args.drives_real_arm():
        world.hold(workplace.scene.objects[0].name, workplace.home_joints().numpy())
    writer = DatasetWriter.of(robot, args.out, settings.session.fps, features=FEATURES)
    recorder = DemonstrationRecorder(writer, lambda: page.task, chain=robot.chain)
    forces = replace(settings.page.forces, level_at=workplace.level_at)
    shown = replace(settings.page, forces=forces)
    try:
        # The recorder is closed last, so that an open demonstration is kept in any case.
        with recorder, connect() as opened:
            config = replace(settings.session, guiding=replace(guiding, safety=safety))
            with (
                _opened_device(args.device, robot.chain) as devices,
                Page(world, shown, boxes=place_targets(workplace), task=settings.task) as page,
            ):
                for device in devices:
                    device.forces = forces
                session = PageSession(
                    workplace,
                    page,
                    recorder,
                    world,
                    opened=None if args.arm == "sim" else opened,
                    inputs=devices,
                    config=config,
                )
                _announce(console, page)
                figures = _run_page(session, page, guiding.dt, args.duration)
    finally:
        if saved := recorder.status.saved:
            console.print(f"{args.out}: {counted(saved, 'demonstration')}", soft_wrap=True)
    if not saved:
        console.print("No demonstration was saved, so there is no dataset")
    write_values(args.json, {**figures, "episodes": saved})


def _announce(console: Console, page: Page) -> None:
    """Print the addresses of the page, with the secret that opens it."""
    console.print(f"Page at [bold]{page.url}[/]", soft_wrap=True)
    console.print(f"To watch only: [bold]{page.watch_url}[/]", soft_wrap=True)
    if page.headset_url:
        console.print(f"For headsets and phones: [bold]{page.headset_url}[/]", soft_wrap=True)
    else:
        console.print(f"No client for headsets: build it with [bold]{BUILD}[/] in a checkout")
    if page.address.scheme == "https":
        console.print("Anyone with this address can move the arm:")
        console.print(qr_code(page.url))


@contextmanager
def _opened_device(
    device: str, chain: SerialChain
) -> Iterator[tuple[Gamepad | HapticDevice | TerminalKeyboard, ...]]:
    """The additional input device, if any."""
    if device == "haptic":
        with HapticDevice.open(chain) as haptic:
            yield (haptic,)
    elif device == "gamepad":
        yield (Gamepad.open(chain),)
    else:
        yield (TerminalKeyboard.open(chain),) if device == "keyboard" else ()


def _run_page(
    session: PageSession, page: Page, dt: float, duration: float | None
) -> dict[str, float | int]:
    """Run the loop at the rate of the arm and return its measured values."""
    rate, steps = Rate(dt), 0
    try:
        with ending_at_rest(session.arm.stop):
            while page.alive and not session.finished:
                session.step()
                steps += 1
                if duration is not None and steps * dt >= duration:
                    break
                rate.wait()
    except KeyboardInterrupt:
        print()
    return {"steps": steps, "missed_ticks": rate.missed, "latest_s": rate.latest}


@dataclass(frozen=True, kw_only=True)
class _ServeSettings:
    """Settings of a real arm, of the step and of a node of ROS 2."""

    site: ArmSite = field(default_factory=ArmSite)
    step: Literal["fastest", "eager"] = "fastest"
    """fastest: compile the step to machine code; eager: do not compile it."""
    autostart: bool = True
    """Configure and activate the node at once; False: a launch file does this."""


def serve(args: Serve) -> None:
    """Run the loop, or a node of ROS 2, and print the latencies."""
    duration = 8.0 if args.duration is None else args.duration
    if not (0 < duration < np.inf and 0 < args.rate < np.inf):
        raise ValueError("--duration and --rate must be positive and finite")
    if args.rate < (slowest := SafetyConfig().rate):
        raise ValueError(
            f"--rate must be at least {slowest:g}, the minimum of the safety filter"
        )
    torch.set_num_threads(1)
    dt = 1 / args.rate
    settings = with_settings(args.config, _ServeSettings())
    if args.ros2:
        refuse_given(args, ["rate", "arm"], "is not used by --ros2: leave it out")
        _serve_node(args, settings)
        return
    robot = _arm_of(args, settings.site)
    # `hand_size` also scales the workspace: smaller arms have smaller hands.
    centre = robot.hand_size * np.array(CENTRE)
    camera = _camera(centre)
    scene = SceneConfig(timestep=dt)
    world = World(replace(scene, arm=replace(scene.arm, robot=robot)))
    world.reset(robot.chain.ready.numpy())
    connect, safety = _access(args, settings.site, world, SafetyConfig())
    controller, observation = _controller(robot.chain, camera, centre, dt, safety)
    began = time.perf_counter()
    step = EagerRunner if settings.step == "eager" else open_step
    runner = step(controller, observation)
    opened = time.perf_counter() - began
    with connect() as arm:
        steps = max(1, round(duration * args.rate))
        measured = _run_serve(runner, arm, robot.chain, camera, dt, steps)
    figures = {"open_s": opened} | measured
    counts = runner.state["safety.counts"]
    figures |= {f"safety_{k}": int(n) for k, n in zip(INTERVENTIONS, counts, strict=True)}
    _report(args, figures)


def _serve_node(args: Serve, settings: _ServeSettings) -> None:
    """Run the controller as a node until Ctrl-C, or for the given duration."""
    from hrc_learn.hardware.ros2_node import ControllerNode

    print(ros2_origin(), flush=True)
    robot = ArmChoice(found_description(args.robot)).arm()
    safety = replace(settings.site, driver="ros2").cell_config().safety
    step = EagerRunner if settings.step == "eager" else open_step
    made = ControllerNode(robot.chain, settings.site.ros2, safety, step)
    with closing(made) as node:
        if settings.autostart and not node.start():
            raise ConnectionError("the node could not be started: its log says why")
        end = time.monotonic() + (np.inf if args.duration is None else args.duration)
        with suppress(KeyboardInterrupt), ending_at_rest(node.deactivate):
            while time.monotonic() < end:
                time.sleep(0.1)
        figures = node.figures()
    _report(args, figures)


def _report(args: Serve, figures: Mapping[str, float | int]) -> None:
    for name, value in figures.items():
        Console().print(f"{name:22} {value:.4g}", highlight=False)
    write_values(args.json, figures)


def _camera(centre: Float[np.ndarray, "3"]) -> CameraModel:
    """Camera 1.1 m from the centre of the motion, looking down at 0.2 rad from the vertical.

    The controller starts with the image Jacobian of the paper's camera, whose image is turned
    by half a radian from the image of this camera.
    """
    lean, turn = 0.2, 1.0
    towards = np.sin(lean) * np.cos(turn), np.sin(lean) * np.sin(turn), np.cos(lean)
    return CameraModel(focal=(1600.0, 1600.0)).look_at(centre + 1.1 * np.array(towards), centre)


def _controller(
    chain: SerialChain,
    camera: CameraModel,
    middle: Float[np.ndarray, "3"],
    dt: float,
    safety: SafetyConfig,
) -> tuple[AdaptiveController, Observation]:
    """The controller, and an observation with every field that the loop sets."""
    centre = torch.from_numpy(middle)
    down = quaternion.normalize(centre.new_tensor(GRIPPER_DOWN))
    tool = Pose(centre + centre.new_tensor((0.03, -0.02, 0.0)), down)
    target = torch.from_numpy(camera.project(tool.apply(MARKER).numpy()))
    J = torch.tensor(INITIAL_IMAGE_JACOBIAN, dtype=torch.float64)
    network = RBFImageJacobian.from_jacobian(J, paper_grid(), 0.1)
    controller = AdaptiveController(
        chain,
        KalmanEstimator(network),
        Goals.at(centre, down, target),
        config=ControllerConfig(safety=safety),
    )
    return controller, Observation.unseen(chain.ready, target, dt)


def _run_serve(
    runner: StepRunner,
    opened: OpenedArm,
    chain: SerialChain,
    camera: CameraModel,
    dt: float,
    steps: int,
) -> dict[str, float | int]:
    """Run the loop; returns its latencies and the last image error."""
    arm, observation = opened.arm, runner.observation
    target = observation["feature"].copy()
    frame_steps = max(1, round(FRAME_TIME / dt))
    took, late = np.empty(steps), np.empty(steps)
    observation["joint_position"][:] = arm.read().joint_position
    runner.step()  # the first step is slow and not measured
    reading = arm.read()
    runner.start(reading.joint_position, reading.joint_velocity)
    rate = Rate(dt)
    with ending_at_rest(lambda: arm.command(np.zeros(len(chain.joint_names)))):
        for k in range(steps):
            began = time.perf_counter()
            observation["joint_position"][:] = arm.read().joint_position
            arm.command(runner.step())
            took[k] = time.perf_counter() - began
            opened.advance(dt)
            observation["feature_new"][...] = k % frame_steps == 0
            if k % frame_steps == 0:
                q = arm.read().joint_position
                marker = chain.forward(q).apply(MARKER).numpy()
                observation["feature"][:] = camera.project(marker)
                observation["feature_visible"][...] = bool(camera.in_view(marker))
                observation["image_joint_position"][:] = q
            late[k] = rate.wait()
    figures: dict[str, float | int] = {
        "steps": steps,
        "missed_ticks": rate.missed,
        "missed_percent": 100 * rate.missed / (steps + rate.missed),
    }
    for name, seconds in (("step", took), ("late", late)):
        values = 1e6 * np.percentile(seconds, PERCENTILES)
        for percentile, value in zip(PERCENTILES, values, strict=True):
            figures[f"{name}_p{percentile:g}_us"] = float(value)
    figures["pixel_error"] = float(np.linalg.norm(observation["feature"] - target))
    return figures
