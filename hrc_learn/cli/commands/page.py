"""`hrc page`: a page in the browser from which a person leads the arm."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
from dataclasses import replace

import torch
from rich.console import Console

from hrc_learn.cli._options import resolved
from hrc_learn.cli._run import configuration, write_values
from hrc_learn.cli.arguments.run import ServePage
from hrc_learn.demos import DatasetWriter
from hrc_learn.deploy import Rate
from hrc_learn.kinematics import panda
from hrc_learn.protocols import Human
from hrc_learn.sim import MovingBodies, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.teleoperation.demonstration_recorder import DemonstrationRecorder
from hrc_learn.teleoperation.devices import Gamepad, TerminalKeyboard
from hrc_learn.teleoperation.page import Page
from hrc_learn.teleoperation.page_session import (
    FEATURES,
    PageSession,
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
    workplace, console = Workplace(), Console()
    world = World(workplace.scene)
    bodies = MovingBodies(world)
    writer = DatasetWriter(
        args.out,
        fps=args.session.fps,
        robot_type="panda",
        joint_names=panda.joint_names,
        features=FEATURES,
        frames={"base": "panda_link0", "ee": "panda_hand_tcp"},
        details={"taught by": "a person at the page", "recorded with": configuration(args)},
    )
    drawn = bodies.drawn(*(poses[None] for poses in bodies.poses()))
    stands = [*workplace.scene.boxes(), *place_targets(workplace)]
    page = Page(panda, drawn, stands, args.page, task=args.task)
    with DemonstrationRecorder(writer, lambda: page.task) as recorder, page:
        session = PageSession(
            workplace, page, recorder, world, beside=_beside(args.beside), config=args.session
        )
        console.print(f"Page at [bold]{page.url}[/]")
        figures = _serve(session, page, args.session.guiding.dt, args.duration)
    figures["episodes"] = recorder.status.saved
    console.print(
        f"{args.out}: {recorder.status.saved} demonstrations"
        if recorder.status.saved
        else "Nothing saved, so there is no dataset"
    )
    write_values(args.json, figures)


def _beside(device: str) -> tuple[Human, ...]:
    if device == "gamepad":
        return (Gamepad.open(panda),)
    return (TerminalKeyboard.open(panda),) if device == "keyboard" else ()


def _serve(
    session: PageSession, page: Page, dt: float, duration: float | None
) -> dict[str, float | int]:
    """Run the loop in the arm's own time; what was measured of it."""
    rate, steps, latest = Rate(dt), 0, 0.0
    try:
        while page.alive and not session.finished:
            session.step()
            steps += 1
            if duration is not None and steps * dt >= duration:
                break
            latest = max(latest, rate.wait())
    except KeyboardInterrupt:
        print()
    return {"steps": steps, "missed_ticks": rate.missed, "latest_s": latest}
