"""Curves of a running loop in a Rerun viewer, sent by a thread of its own."""

import threading
from collections.abc import Sequence
from types import TracebackType

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Shaped

from .panels import Plot, several
from .rerun_file import plot_view, send_style, send_values
from .step_log import StepLog


class LiveSender:
    """Sends what a loop adds to a `StepLog`, a few times a second, until it is closed.

    The loop pays for its log only. What it has logged when the `with` block ends is sent
    before the block is left; an error of the thread is raised there.

        with LiveSender(log, stream, ["joint_position", "feature"]):
            ...  # the loop, which appends to `log`

    `stream` is any recording stream: `stream.serve_grpc()`, `stream.spawn()` or
    `stream.connect_grpc()` show it in a viewer, `stream.save()` keeps it.
    """

    def __init__(
        self,
        log: StepLog,
        stream: rr.RecordingStream,
        columns: Sequence[str],
        *,
        time: str = "time",
        period: float = 0.1,
    ):
        """Prepare the thread; it starts with the `with` block.

        Args:
            log: What the loop appends to.
            stream: Where to send.
            columns: Columns of the log to send.
            time: Column that holds the time [s].
            period: How often to send [s].
        """
        self._log, self._stream = log, stream
        self._columns, self._time, self._period = tuple(columns), time, period
        self._sent = 0
        self._closing = threading.Event()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="LiveSender", daemon=True)

    def __enter__(self) -> "LiveSender":
        views = [plot_view(_plot(name, np.empty((0, 1)))) for name in self._columns]
        layout = rrb.Blueprint(rrb.Grid(contents=views), collapse_panels=True)
        self._stream.send_blueprint(layout)
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._closing.set()
        self._thread.join()
        if self._error is not None and error is None:
            raise self._error

    def _run(self) -> None:
        try:
            while not self._closing.wait(self._period):
                self._send()
            self._send()
            self._stream.flush()
        except Exception as error:  # handed over to the thread that closes
            self._error = error

    def _send(self) -> None:
        for rows in self._log.blocks(self._sent):
            if len(rows):
                for name in self._columns:
                    values = rows[name].reshape(len(rows), -1)
                    for curves in _plot(name, values).curves:
                        if not self._sent:
                            send_style(self._stream, curves)
                        send_values(self._stream, rows[self._time], curves)
                self._sent += len(rows)


def _plot(name: str, values: Shaped[np.ndarray, "rows curves"]) -> Plot:
    count = values.shape[1]
    names = [name] if count == 1 else [f"{name} {i + 1}" for i in range(count)]
    curves = several(f"live/{name}", names, values.astype(float))
    return Plot(title=name, curves=(curves,), legend=True)
