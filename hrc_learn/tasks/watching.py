"""Watching a run from the side while it goes on."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass

from ..sim import MotionLog, World
from .recording import record
from .station import Station

Watch = Callable[[Station, World, MotionLog], AbstractContextManager[None]]
"""Entered once a station is ready to start, and left when the run is over."""


def unwatched(
    station: Station, world: World, motion: MotionLog
) -> AbstractContextManager[None]:
    """Nobody watches."""
    return nullcontext()


@dataclass(frozen=True, kw_only=True)
class ServeConfig:
    """Where the dashboard of a run can be watched while it goes on."""

    port: int = 9090
    """Port of the page."""
    data_port: int = 9876
    """Port from which the page, or `rerun rerun+http://HOST:PORT/proxy`, gets the data."""
    period: float = 0.25
    """How often what is new is sent [s]."""


def serving(title: str, config: ServeConfig, on_open: Callable[[str], None]) -> Watch:
    """Serve the dashboard of a run on a page of its own.

    The loop pays for its log only: another thread makes and sends recordings of what the run
    is so far. A page that is open when the run ends keeps what it shows.

    Args:
        title: Of the dashboard.
        config: Where.
        on_open: Told the address of the page.
    """

    @contextmanager
    def watch(station: Station, world: World, motion: MotionLog) -> Iterator[None]:
        from ..viz.live import live_dashboard  # rerun takes a second
        from ..viz.serving import served

        def snapshot():
            return record(title, station, world, motion) if len(motion) else None

        with served(config.port, config.data_port) as server:
            on_open(server.viewer)
            with live_dashboard(server.stream, snapshot, period=config.period):
                yield

    return watch
