"""`hrc page`: a page in the browser from which a person leads the arm."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import torch
from rich.console import Console

from hrc_learn.cli._options import resolved
from hrc_learn.cli._run import configuration, leads_real_arm, write_values
from hrc_learn.cli.arguments.run import ServePage
from hrc_learn.controller import SafetyConfig
from hrc_learn.demos import DatasetWriter
from hrc_learn.deploy import Rate
from hrc_learn.experiments.arm_access import access_by
from hrc_learn.experiments.on_arm import ArmSite, opened_site
from hrc_learn.hardware import ending_at_rest
from hrc_learn.kinematics import ArmChoice, SerialChain
from hrc_learn.protocols import Human, OpenedArm
from hrc_learn.sim import MovingBodies, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.teleoperation.demonstration_recorder import DemonstrationRecorder
from hrc_learn.teleoperation.devices import Gamepad, TerminalKeyboard
from hrc_learn.teleoperation.gate import qr_code
from hrc_learn.teleoperation.haptic_device import HapticDevice
from hrc_learn.teleoperation.page import Page
from hrc_learn.teleoperation.page.headset_scene import BUILD
from hrc_learn.teleoperation.page_session import (
    FEATURES,
    PageSession,
    counted,
    place_targets,
)

SWITCH_INTERVAL = 0.0005
"""Longest that the page's threads keep the interpreter from the control loop [s]."""


def page(args: ServePage) -> None:
    args = resolved(args)
    if args.port is not None:
        args = replace(args, page=replace(args.page, port=args.port))
    torch.set_num_threads(1)
    sys.setswitchinterval(SWITCH_INTERVAL)
    robot, console = ArmChoice(args.robot, args.base, args.tip).work_arm(), Console()
    workplace = Workplace.of(robot)
    writer = DatasetWriter(
        args.out,
        fps=args.session.fps,
        robot_type=robot.name,
        joint_names=robot.chain.joint_names,
        features=FEATURES,
        frames={"base": f"{robot.name}_link0", "ee": f"{robot.name}_hand_tcp"},
        details={"taught by": "a person at the page", "recorded with": configuration(args)},
    )
    recorder = DemonstrationRecorder(writer, lambda: page.task, chain=robot.chain)
    stands = [*workplace.scene.boxes(), *place_targets(workplace)]
    try:
        # The recorder ends last: whatever ends the rest, what is open is kept.
        with recorder, _opened(args, workplace) as (world, opened, safety):
            bodies = MovingBodies(world)
            drawn = bodies.drawn(*(poses[None] for poses in bodies.poses()))
            config = replace(args.session, guiding=replace(args.session.guiding, safety=safety))
            with (
                _beside(args.beside, robot.chain) as beside,
                Page(robot.chain, drawn, stands, args.page, task=args.task) as page,
            ):
                session = PageSession(
                    workplace,
                    page,
                    recorder,
                    world,
                    opened=opened,
                    beside=beside,
                    config=config,
                )
                _announce(console, page)
                figures = _serve(session, page, config.guiding.dt, args.duration)
    finally:
        if saved := recorder.status.saved:
            console.print(f"{args.out}: {counted(saved)}", soft_wrap=True)
    if not saved:
        console.print("Nothing saved, so there is no dataset")
    write_values(args.json, {**figures, "episodes": saved})


@contextmanager
def _opened(
    args: ServePage, workplace: Workplace
) -> Iterator[tuple[World, OpenedArm | None, SafetyConfig]]:
    """The world, its arm unless no driver leads it, and what the filter is told of it."""
    safety: SafetyConfig = args.session.guiding.safety
    if leads_real_arm(args):
        site: ArmSite = replace(args.site, driver=args.arm, ip=args.ip)
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
        told = replace(safety, delay=safety.delay + access.delay, braking=access.dynamics)
        yield world, opened, told


def _announce(console: Console, page: Page) -> None:
    """Say where the page is, with the secret that opens it."""
    console.print(f"Page at [bold]{page.url}[/]", soft_wrap=True)
    if page.headset_url:
        console.print(f"For headsets and phones: [bold]{page.headset_url}[/]", soft_wrap=True)
    else:
        console.print(f"No client for headsets: [bold]{BUILD}[/] in a checkout builds it")
    if page.address.scheme == "https":
        console.print("Whoever has this address can move the arm:")
        console.print(qr_code(page.url))


@contextmanager
def _beside(device: str, chain: SerialChain) -> Iterator[tuple[Human, ...]]:
    """The device for the other hand, if any."""
    if device == "haptic":
        with HapticDevice.open(chain) as haptic:
            yield (haptic,)
    elif device == "gamepad":
        yield (Gamepad.open(chain),)
    else:
        yield (TerminalKeyboard.open(chain),) if device == "keyboard" else ()


def _serve(
    session: PageSession, page: Page, dt: float, duration: float | None
) -> dict[str, float | int]:
    """Run the loop in the arm's own time; what was measured of it."""
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
