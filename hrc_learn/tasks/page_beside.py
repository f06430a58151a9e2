"""A page beside a task that runs by itself: people watch it, and pull the arm's body."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ..controller.runtime import Metronome
from ..human.page import Page, PageConfig, PageHuman, PageStatus
from ..kinematics import panda
from ..sim import MovingBodies, World


@contextmanager
def page_beside(
    world: World, dt: float, config: PageConfig, on_open: Callable[[str], None]
) -> Iterator[tuple[PageHuman, Callable[[], None]]]:
    """Serve a page on a world that a task moves.

    Args:
        world: That is shown.
        dt: Control step of the task [s].
        config: Of the page.
        on_open: Told the address of the page.

    Yields:
        The person at the page, and what is called after each control step: it shows where
        everything is, and waits so that the world goes on in real time.
    """
    bodies = MovingBodies(world)
    drawn = bodies.drawn(*(poses[None] for poses in bodies.poses()))
    with Page(panda, drawn, world.config.boxes(), config) as page:
        on_open(page.url)
        metronome = Metronome(dt)

        def tick() -> None:
            page.place(*bodies.poses())
            touches = world.cabinet_contacts.touches + world.table_contacts.touches
            page.show(PageStatus(title="Collaboration", contacts=len(touches)))
            metronome.wait()

        yield page.human, tick
