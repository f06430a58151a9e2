"""Curves of any log, sent to Rerun as it grows."""

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Shaped

from .logged_steps import LoggedSteps
from .panels import Plot, several
from .rerun_file import StillThings, plot_view, send_values, style


class LogStream:
    """Sends the chosen columns of a log, and a grid of plots that shows them.

    `stream` is any recording stream: `stream.serve_grpc()`, `stream.spawn()` or
    `stream.connect_grpc()` show it in a viewer, `stream.save()` keeps it.
    """

    def __init__(
        self,
        log: LoggedSteps,
        stream: rr.RecordingStream,
        columns: Sequence[str],
        *,
        time: str = "time",
    ):
        """Send the layout.

        Args:
            log: What a loop appends to.
            stream: Where to send.
            columns: Columns of the log to send.
            time: Column that holds the time [s].
        """
        self._log, self._stream, self._still = log, stream, StillThings(stream)
        self._columns, self._time = tuple(columns), time
        self._rows = 0
        views = [plot_view(_plot(name, np.empty((0, 1)))) for name in self._columns]
        stream.send_blueprint(rrb.Blueprint(rrb.Grid(contents=views), collapse_panels=True))

    def send(self) -> None:
        """Send the rows that were not sent before."""
        for rows in self._log.blocks(self._rows):
            if len(rows):
                for name in self._columns:
                    values = rows[name].reshape(len(rows), -1)
                    for curves in _plot(name, values).curves:
                        self._still.send(curves.path, None, lambda c=curves: style(c))
                        send_values(self._stream, rows[self._time], curves)
                self._rows += len(rows)


def _plot(name: str, values: Shaped[np.ndarray, "rows curves"]) -> Plot:
    count = values.shape[1]
    names = [name] if count == 1 else [f"{name} {i + 1}" for i in range(count)]
    curves = several(f"live/{name}", names, values.astype(float))
    return Plot(title=name, curves=(curves,), legend=True)
