"""A page beside a task that runs by itself: people watch it, and pull the arm's body."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ..controller.runtime import Metronome
from ..human import BothHands
from ..human.page import Page, PageConfig, PageHuman, PageStatus
from ..kinematics import panda
from ..protocols import Human
from ..sim import MovingBodies, World
from .collaboration import INTERACT
from .station import SAFETY_COLUMNS, Station

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
        self._station: Station | None = None

    def follow(self, station: Station) -> None:
        """Tell from the log of a station what the task is doing."""
        self._station = station

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
        if self._ticks % _SHOW_EVERY == 0 and self._station is not None:
            self._page.show(self.status(self._station))
        self._ticks += 1
        self._metronome.wait()

    def status(self, station: Station) -> PageStatus:
        """What the page says of a task that runs on a station."""
        world, log = self._world, station.log
        phase = log.events[-1].text if log.events else "getting ready"
        acted = log["safety"].sum(axis=0) if len(log) else [0] * len(SAFETY_COLUMNS)
        return PageStatus(
            title="Collaboration",
            doing=phase,
            seconds=station.time,
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
