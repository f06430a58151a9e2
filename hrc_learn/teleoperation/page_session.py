"""A page beside the simulated arm: a person records demonstrations from it, or watches a
job and pulls the arm's body.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.controller import INTERVENTIONS
from hrc_learn.deploy import Metronome
from hrc_learn.geometry import Box
from hrc_learn.kinematics import panda
from hrc_learn.protocols import Human, HumanInput, Request
from hrc_learn.sim import MovingBodies, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.pick_and_place import INTERACT
from hrc_learn.skills.work_cell import SAFETY_COLUMNS, WorkCell
from hrc_learn.teleoperation.combined_input import BothHands, Eased, EasingConfig
from hrc_learn.teleoperation.demonstration_recorder import DemonstrationRecorder
from hrc_learn.teleoperation.hand_guiding import Frame, Instant, LedArm, LedArmConfig
from hrc_learn.teleoperation.page import Page, PageConfig, PageHuman, PageStatus
from hrc_learn.viz.palette import GREEN, rgba

# Where on the shelves things go: drawn, and said in words, for a person who shows the way.

_THICKNESS = 0.002  # of what is drawn on a board [m]


def landing_places(workplace: Workplace) -> list[Box]:
    """A green field on each board, where the thing stands once the hand has let go of it."""
    item, (red, green, blue, _) = workplace.scene.objects[0], rgba(GREEN)
    # Held from above, a thing lies on its side once the hand points level.
    x, y = item.half_size[0], item.half_size[2]
    fields = []
    for name in workplace.shelf_names():
        place = workplace.shelf(name).position.tolist()
        height = workplace.scene.cabinet.shelves[name] + _THICKNESS
        fields.append(
            Box(
                name=f"place_{name}",
                centre=(place[0], place[1], height),
                half_size=(x, y, _THICKNESS),
                colour=(red / 255, green / 255, blue / 255, 1.0),
            )
        )
    return fields


def way_left(workplace: Workplace, hand: Float[np.ndarray, "3"]) -> str:
    """How far the hand is from where it would let go on the nearest shelf, in words.

    Args:
        workplace: With the shelves.
        hand: Tool centre point [m].
    """
    names = workplace.shelf_names()
    offsets = {name: workplace.shelf(name).position.numpy() - hand for name in names}
    nearest = min(names, key=lambda name: float(np.linalg.norm(offsets[name])))
    away, left, up = 100 * offsets[nearest]
    steps = (
        _step(away, "away", "back"),
        _step(left, "left", "right"),
        _step(up, "up", "down"),
    )
    return f"{nearest} shelf: {', '.join(step for step in steps if step) or 'there'}"


def _step(way: float, forward: str, backward: str) -> str:
    """A way [cm] in a direction or the other; nothing below one."""
    return "" if abs(way) < 1 else f"{abs(way):.0f} cm {forward if way > 0 else backward}"


# A person at the page leads the simulated arm and records demonstrations.

FEATURES = {
    "observation.human_twist": ("vx", "vy", "vz", "wx", "wy", "wz"),
    "observation.region": ("x", "y", "z", "half_x", "half_y", "half_z"),
}
"""Recorded beside the usual columns: motion of the hand that the person asked for, and the
region in force (zeros where there is none)."""


@dataclass(frozen=True, kw_only=True)
class PageSessionConfig:
    """How a session runs."""

    led: LedArmConfig = field(default_factory=LedArmConfig)
    """How the arm follows."""
    easing: EasingConfig = field(default_factory=EasingConfig)
    """How fast the motion of a hand that is led may change."""
    record_every: int = 2
    """Control steps from one recorded frame to the next."""
    show_every: int = 10
    """Control steps from one status shown on the page to the next."""

    def __post_init__(self) -> None:
        if self.record_every < 1 or self.show_every < 1:
            raise ValueError("record_every and show_every must be at least 1.")

    @property
    def fps(self) -> float:
        """Recorded frames a second."""
        return 1.0 / (self.led.dt * self.record_every)


class PageSession:
    """Steps the simulated arm as the person at the page asks.

    Attributes:
        world: That the arm is in.
        finished: Whether the person is done.
        led: The arm as it is led.
    """

    def __init__(
        self,
        workplace: Workplace,
        page: Page,
        recorder: DemonstrationRecorder,
        world: World,
        *,
        beside: tuple[Human, ...] = (),
        config: PageSessionConfig | None = None,
    ):
        """Put a thing into the hand, at home.

        Args:
            workplace: Where.
            page: Shows what happens, and hands on what the person asks for.
            recorder: Of demonstrations.
            world: Of the workplace.
            beside: Other sources of the person's input, such as a gamepad.
            config: How the session runs.
        """
        self.world, self.finished = world, False
        self._workplace, self._page, self._recorder = workplace, page, recorder
        self._config = config or PageSessionConfig()
        self._bodies = MovingBodies(world)
        self._home = workplace.home_joints().numpy()
        self._go_home()
        human = Eased(BothHands(page.human, *beside), self._config.easing)
        self.led = LedArm(panda, world.arm, human, self._config.led)
        self._ticks, self._width = 0, None

    def step(self) -> Instant:
        """One control step of the arm, and of the world."""
        with torch.inference_mode():
            instant = self.led.step()
        if self._ticks % self._config.record_every == 0:
            self._recorder.add(recorded(instant))
        self._grip(instant.asked)
        self.world.advance(self._config.led.dt)
        self._page.place(*self._bodies.poses())
        for request in instant.asked.requests:
            self._handle(request)
        if self._ticks % self._config.show_every == 0:
            self._page.show(self._status(instant))
        self._ticks += 1
        return instant

    def _handle(self, request: Request) -> None:
        if request == "finish":
            self.finished = True
        elif request == "home":
            # A jump of the arm has no place in a demonstration.
            if self._recorder.status.state == "recording":
                self._recorder.handle("stop")
            self._go_home()
            self.led.restart()
        else:
            self._recorder.handle(request)

    def _go_home(self) -> None:
        self.world.hold(self._workplace.scene.objects[0].name, self._home)

    def _grip(self, asked: HumanInput) -> None:
        if asked.gripper is not None and asked.gripper != self._width:
            self._width = asked.gripper
            self.world.arm.move(asked.gripper)

    def _status(self, instant: Instant) -> PageStatus:
        status, world = self._recorder.status, self.world
        notes = [status.note]
        if status.state != "ready":
            notes.insert(0, way_left(self._workplace, instant.pose.position.numpy()))
        monitors = (world.cabinet_contacts, world.table_contacts, world.self_contacts)
        counts = self.led.safety.counts.tolist()
        return PageStatus(
            title="Simulated Panda",
            recording=status.state,
            seconds=status.seconds,
            saved=status.saved,
            note="; ".join(filter(None, notes)),
            interventions=dict(zip(INTERVENTIONS, counts, strict=True)),
            contacts=sum(len(monitor.touches) for monitor in monitors),
        )


def recorded(instant: Instant) -> Frame:
    """Columns of an instant, with all that the person asked for."""
    asked, box = instant.asked, np.zeros(6)
    if asked.region is not None:
        box = np.array([*asked.region.centre, *asked.region.half_size])
    return {
        **instant.frame(),
        "observation.human_twist": asked.twist,
        "observation.region": box,
    }


# A page beside a task that runs by itself: people watch it, and pull the arm's body.

_SHOW_EVERY = 10  # control steps from one status to the next
_INVITED = "Pull at a link or a knob: the hand goes on aiming."


class PageBeside:
    """A page on a world that a task moves.

    Attributes:
        human: The person at the page.
    """

    human: PageHuman

    def __init__(self, world: World, page: Page, dt: float):
        """Take the page along.

        Args:
            world: That is shown.
            page: Open.
            dt: Control step of the task [s].
        """
        self.human = page.human
        self._world, self._page, self._bodies = world, page, MovingBodies(world)
        self._metronome, self._ticks = Metronome(dt), 0
        self._cell: WorkCell | None = None

    def follow(self, cell: WorkCell) -> None:
        """Tell from the log of a work cell what the task is doing."""
        self._cell = cell

    def joined(
        self, person: Human, advance: Callable[[float], None]
    ) -> tuple[Human, Callable[[float], None]]:
        """A person with those at the page, and time that passes for both.

        Args:
            person: Beside the arm.
            advance: Lets a given time pass in the world [s].
        """

        def advance_and_show(duration: float) -> None:
            advance(duration)
            self.tick()

        return BothHands(person, self.human), advance_and_show

    def tick(self) -> None:
        """After each control step: show where everything is, and let real time pass."""
        self._page.place(*self._bodies.poses())
        if self._ticks % _SHOW_EVERY == 0 and self._cell is not None:
            self._page.show(self.status(self._cell))
        self._ticks += 1
        self._metronome.wait()

    def status(self, cell: WorkCell) -> PageStatus:
        """What the page says of a task that runs on a work cell."""
        world, log = self._world, cell.log
        phase = log.events[-1].text if log.events else "getting ready"
        acted = log["safety"].sum(axis=0) if len(log) else [0] * len(SAFETY_COLUMNS)
        return PageStatus(
            title="Collaboration",
            doing=phase,
            seconds=cell.time,
            note=_INVITED if phase == INTERACT else "",
            interventions=dict(zip(SAFETY_COLUMNS, map(int, acted), strict=True)),
            contacts=len(world.cabinet_contacts.touches) + len(world.table_contacts.touches),
        )


@contextmanager
def page_beside(
    world: World, dt: float, config: PageConfig, on_open: Callable[[str], None]
) -> Iterator[PageBeside]:
    """Serve a page on a world that a task moves.

    Args:
        world: That is shown.
        dt: Control step of the task [s].
        config: Of the page.
        on_open: Told the address of the page.
    """
    bodies = MovingBodies(world)
    drawn = bodies.drawn(*(poses[None] for poses in bodies.poses()))
    with Page(panda, drawn, world.config.boxes(), config, leads=False) as page:
        on_open(page.url)
        yield PageBeside(world, page, dt)
