"""`hrc page`: a page in the browser to guide the arm and record demonstrations."""

import os

# More threads would only wait for each other within a control step.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import torch
from rich.console import Console

from hrc_learn.cli._run import configuration, write_values
from hrc_learn.cli._settings import with_settings
from hrc_learn.cli.arm_arguments import ServePage
from hrc_learn.controller import SafetyConfig
from hrc_learn.demos import DatasetWriter
from hrc_learn.deploy import Rate
from hrc_learn.experiments.real_arm import ArmSite, opened_site
from hrc_learn.experiments.simulated_cell import access_by
from hrc_learn.hardware import ending_at_rest
from hrc_learn.kinematics import ArmChoice, SerialChain
from hrc_learn.protocols import Human, OpenedArm
from hrc_learn.sim import MovingBodies, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.teleoperation.demonstration_recorder import DemonstrationRecorder
from hrc_learn.teleoperation.devices import Gamepad, TerminalKeyboard
from hrc_learn.teleoperation.gate import qr_code
from hrc_learn.teleoperation.haptic_device import HapticDevice
from hrc_learn.teleoperation.headset import BUILD
from hrc_learn.teleoperation.page import Page, PageConfig
from hrc_learn.teleoperation.page_session import (
    FEATURES,
    PageSession,
    PageSessionConfig,
    counted,
    place_targets,
)

SWITCH_INTERVAL = 0.0005
"""Longest time for which a thread of the page holds the interpreter [s]."""


@dataclass(frozen=True, kw_only=True)
class _Settings:
    """Settings of the page, the recording session and a real arm."""

    page: PageConfig
    session: PageSessionConfig = field(default_factory=PageSessionConfig)
    site: ArmSite = field(default_factory=ArmSite)


def page(args: ServePage) -> None:
    """Serve the page and run the control loop until the person finishes."""
    settings = _Settings(page=PageConfig(host=args.host, port=args.port))
    settings = with_settings(args.config, settings)
    guiding = settings.session.guiding
    torch.set_num_threads(1)
    sys.setswitchinterval(SWITCH_INTERVAL)
    robot, console = ArmChoice(args.robot, tip=args.tip).work_arm(), Console()
    workplace = Workplace.of(robot)
    writer = DatasetWriter(
        args.out,
        fps=settings.session.fps,
        robot_type=robot.name,
        joint_names=robot.chain.joint_names,
        features=FEATURES,
        frames={"base": f"{robot.name}_link0", "ee": f"{robot.name}_hand_tcp"},
        details={
            "demonstrated by": "a person at the page",
            "recorded with": configuration(args),
        },
    )
    recorder = DemonstrationRecorder(writer, lambda: page.task, chain=robot.chain)
    stands = [*workplace.scene.boxes(), *place_targets(workplace)]
    try:
        # The recorder is closed last, so that an open demonstration is kept in any case.
        with (
            recorder,
            _opened(args, settings.site, guiding.safety, workplace) as (world, opened, safety),
        ):
            bodies = MovingBodies(world)
            drawn = bodies.drawn(*(poses[None] for poses in bodies.poses()))
            config = replace(settings.session, guiding=replace(guiding, safety=safety))
            with (
                _opened_device(args.device, robot.chain) as devices,
                Page(robot.chain, drawn, stands, settings.page, task=args.task) as page,
            ):
                session = PageSession(
                    workplace,
                    page,
                    recorder,
                    world,
                    opened=opened,
                    inputs=devices,
                    config=config,
                )
                _announce(console, page)
                figures = _run_loop(session, page, guiding.dt, args.duration)
    finally:
        if saved := recorder.status.saved:
            console.print(f"{args.out}: {counted(saved)}", soft_wrap=True)
    if not saved:
        console.print("No demonstration was saved, so there is no dataset")
    write_values(args.json, {**figures, "episodes": saved})


@contextmanager
def _opened(
    args: ServePage, site: ArmSite, safety: SafetyConfig, workplace: Workplace
) -> Iterator[tuple[World, OpenedArm | None, SafetyConfig]]:
    """World, arm (None without a driver), and the safety filter's configuration for it."""
    if args.drives_real_arm():
        site = replace(site, driver=args.arm, ip=args.ip)
        with opened_site(site, workplace) as (world, opened):
            yield world, opened, site.cell_config().safety
        return
    world = World(workplace.scene)
    if args.arm == "sim":
        yield world, None, safety
        return
    access = access_by(args.arm, workplace.robot)
    world.hold(workplace.scene.objects[0].name, workplace.home_joints().numpy())
    with access.open(world) as opened:
        delay = safety.delay + access.delay
        yield world, opened, replace(safety, delay=delay, braking=access.dynamics)


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
def _opened_device(device: str, chain: SerialChain) -> Iterator[tuple[Human, ...]]:
    """The additional input device, if any."""
    if device == "haptic":
        with HapticDevice.open(chain) as haptic:
            yield (haptic,)
    elif device == "gamepad":
        yield (Gamepad.open(chain),)
    else:
        yield (TerminalKeyboard.open(chain),) if device == "keyboard" else ()


def _run_loop(
    session: PageSession, page: Page, dt: float, duration: float | None
) -> dict[str, float | int]:
    """Run the loop at the rate of the arm and return its figures."""
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
