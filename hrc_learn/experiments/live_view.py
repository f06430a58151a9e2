"""A run's dashboard in the browser while the run goes on."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass

from hrc_learn.experiments.run_recording import record
from hrc_learn.sim import MotionLog, World
from hrc_learn.skills.work_cell import WorkCell

type LiveView = Callable[[WorkCell, World, MotionLog], AbstractContextManager[None]]
"""Entered once a cell is ready to start, and left when the run is over."""


def no_live_view(
    cell: WorkCell, world: World, motion: MotionLog
) -> AbstractContextManager[None]:
    """Nobody watches."""
    return nullcontext()


@dataclass(frozen=True, kw_only=True)
class LiveViewConfig:
    """Where the dashboard of a run is serve_stream while it goes on."""

    port: int = 9090
    """Port of the page."""
    data_port: int = 9876
    """Port from which the page, or `rerun rerun+http://HOST:PORT/proxy`, gets the data."""
    period: float = 0.25
    """How often new data are sent [s]."""


def live_view(title: str, config: LiveViewConfig, on_open: Callable[[str], None]) -> LiveView:
    """Serve the dashboard of a run on a page of its own.

    The loop pays for its log only: another thread makes and sends recordings of the run so
    far. A page that is open when the run ends keeps what it shows.

    Args:
        title: Of the dashboard.
        config: Where.
        on_open: Told the address of the page.
    """

    @contextmanager
    def watch(cell: WorkCell, world: World, motion: MotionLog) -> Iterator[None]:
        # Rerun takes a second.
        from hrc_learn.viz.run_dashboard import live_dashboard, serve_stream

        def snapshot():
            return record(title, cell, world, motion) if len(motion) else None

        with serve_stream(config.port, config.data_port) as server:
            on_open(server.viewer)
            with live_dashboard(server.stream, snapshot, period=config.period):
                yield

    return watch
