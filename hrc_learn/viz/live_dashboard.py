"""A dashboard that follows a running loop: a thread sends what was logged, a browser
shows it.
"""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import NamedTuple
from urllib.parse import quote

import rerun as rr

from hrc_learn.viz.recordings import RunRecording
from hrc_learn.viz.rerun_stream import begin
from hrc_learn.viz.run_dashboard import RunStream

# A thread that shows a running loop, so that the loop pays for its log only.

_SHARE = 0.2


class LiveSender:
    """Calls a function a few times a second, and once more when it is closed.

    An error of the function ends the thread and is raised where the `with` block is left.

        log = StepLog()
        with LiveSender(LogStream(log, stream, ["joint_position", "feature"]).send):
            ...  # the loop, which appends to `log`
    """

    def __init__(self, send: Callable[[], object], *, period: float = 0.25):
        """Prepare the thread; it starts with the `with` block.

        Args:
            send: Sends what is new.
            period: How often [s]; less often where sending would take more than a fifth of
                the time.
        """
        self._send, self._period = send, period
        self._closing = threading.Event()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="LiveSender", daemon=True)

    def __enter__(self) -> "LiveSender":
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
        pause = self._period
        try:
            while not self._closing.wait(pause):
                began = time.monotonic()
                self._send()
                pause = max(self._period, (time.monotonic() - began) * (1 / _SHARE - 1))
            self._send()
        except Exception as error:  # handed over to the thread that closes
            self._error = error


@contextmanager
def live_dashboard(
    stream: rr.RecordingStream,
    snapshot: Callable[[], RunRecording | None],
    *,
    period: float = 0.25,
) -> Iterator[None]:
    """Show a run while it goes on, as `record_run` keeps it afterwards.

    Args:
        stream: Where to send; `hrc_learn.viz.live_dashboard` gives one that a browser shows.
        snapshot: The run so far, None before there is anything; called by another thread.
        period: How often to send [s].
    """
    sender = RunStream(stream)
    begun = False

    def send() -> None:
        nonlocal begun
        run = snapshot()
        if run is not None:
            if not begun:
                begin(stream, run.title)
                begun = True
            sender.send(run)

    with LiveSender(send, period=period):
        yield
    stream.flush()


# A recording stream that a browser shows while it is written.


class Served(NamedTuple):
    """A stream that is served on this machine."""

    stream: rr.RecordingStream
    viewer: str
    """Address of the viewer, for a browser."""
    data: str
    """Address of the data, for `rerun ADDRESS`."""


@contextmanager
def served(port: int = 9090, data_port: int = 9876) -> Iterator[Served]:
    """Serve a stream and a viewer for it, for as long as the `with` block lasts.

    Who opens the page later sees all that was sent before, as far as a gigabyte goes.

    Args:
        port: Of the viewer's page.
        data_port: Of the data that the page fetches.

    Raises:
        ValueError: If a port is taken.
    """
    for number in (port, data_port):
        _check_free(number)
    stream = rr.RecordingStream("hrc_learn")
    data = stream.serve_grpc(grpc_port=data_port)
    rr.serve_web_viewer(web_port=port, open_browser=False, connect_to=data)
    try:
        yield Served(stream, f"http://127.0.0.1:{port}?url={quote(data, safe='')}", data)
    finally:
        stream.disconnect()


def _check_free(port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("", port))
        except OSError as error:
            raise ValueError(
                f"port {port} is taken: end what uses it, or choose another."
            ) from error
