"""A thread that shows a running loop, so that the loop pays for its log only."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType

import rerun as rr

from .recording import RunRecording
from .rerun_file import begin
from .run_stream import RunStream

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
        stream: Where to send; `hrc_learn.viz.serving` gives one that a browser shows.
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
