"""Hand-guide the simulated arm in a browser, and record demonstrations of your own.

Open the address that is printed. Drag a link or a knob of the arm, or of its virtual twin, to
move it in its null space; drag the end effector's gizmo, such as to a green field on a shelf.
Start, stop, save. Ends with "Finish", with Ctrl-C, or after --duration, and leaves a LeRobot
dataset if anything was saved.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from rich.console import Console

from hrc_learn import cli
from hrc_learn.demos import DatasetWriter
from hrc_learn.deploy import Metronome
from hrc_learn.kinematics import panda
from hrc_learn.protocols import Human
from hrc_learn.sim import MovingBodies, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.teleoperation.demonstration_recorder import DemonstrationRecorder
from hrc_learn.teleoperation.devices import Gamepad, TerminalKeyboard
from hrc_learn.teleoperation.page import Page, PageConfig
from hrc_learn.teleoperation.page_session import (
    FEATURES,
    PageSession,
    PageSessionConfig,
    place_targets,
)

SWITCH_INTERVAL = 0.0005
"""Longest that the page's threads keep the interpreter from the control loop [s]."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to record, and where to keep it."""

    out: Path
    """Folder of the dataset to record; must not exist."""
    task: str = "put the object on the middle shelf"
    """What is to be shown, in words; it can be changed on the page."""
    beside: Literal["nothing", "gamepad", "keyboard"] = "nothing"
    """A device for the other hand, which moves the end effector: a gamepad (extra `gamepad`),
    or the keys of the terminal this runs in."""
    duration: float | None = None
    """End after this time [s]; None: when the person finishes."""
    page: PageConfig = field(default_factory=PageConfig)
    """The page."""
    session: PageSessionConfig = field(default_factory=PageSessionConfig)
    """The session."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> None:
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
        details={"taught by": "a person at the page"},
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
    if args.json is not None:
        cli.write_json(args.json, figures)


def _beside(device: str) -> tuple[Human, ...]:
    if device == "gamepad":
        return (Gamepad.open(panda),)
    return (TerminalKeyboard.open(panda),) if device == "keyboard" else ()


def _serve(
    session: PageSession, page: Page, dt: float, duration: float | None
) -> dict[str, float]:
    """Run the loop in the arm's own time; what was measured of it."""
    metronome, steps, latest = Metronome(dt), 0, 0.0
    try:
        while page.alive and not session.finished:
            session.step()
            steps += 1
            if duration is not None and steps * dt >= duration:
                break
            latest = max(latest, metronome.wait())
    except KeyboardInterrupt:
        print()
    return {"steps": steps, "missed_ticks": metronome.missed, "latest_s": latest}


if __name__ == "__main__":
    cli.run(main, Args)
