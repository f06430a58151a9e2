"""Serve dashboards to a browser: Rerun's viewer and recordings, through the gate.

Rerun's own servers require no secret and accept any host name. Therefore they serve no data
here: one of them only provides the files of the viewer, once, and the gate serves these files.
"""

from __future__ import annotations

import asyncio
import socket
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.request import urlopen

from hrc_learn.store import cache_home, new_file
from hrc_learn.teleoperation.gate import AddressConfig, Content, Gate, folder_contents
from hrc_learn.teleoperation.gate.gate import Visitor, first_of
from hrc_learn.teleoperation.gate.messages import MessageError

if TYPE_CHECKING:
    from rerun import RecordingStream as RecordingStream
else:
    RecordingStream = Any

_CLIENT = Path(__file__).parent / "dashboard_client"
_VIEWER_FILES = ("re_viewer.js", "re_viewer_bg.wasm")
_START = 60.0
"""Timeout for starting Rerun's viewer [s]."""
_EVERY = 0.1
"""Period of checking for new data [s]."""


@contextmanager
def serve_stream(port: int | None = 9090) -> Iterator[tuple[RecordingStream, str]]:
    """Serve a recording stream and its viewer until the `with` block ends.

    A page that is opened later shows all earlier data. Yields the stream and the address of
    the page, with its secret.

    Args:
        port: Port of the page; None: the first free port from 8080 on.

    Raises:
        ValueError: The port is in use.
    """
    import rerun

    stream = rerun.RecordingStream("hrc_learn")
    binary, parts = stream.binary_stream(), []

    def data() -> Sequence[bytes]:
        if part := binary.read():
            parts.append(part)
        return parts

    with _served(port, data) as url:
        yield stream, url
        data()
        time.sleep(2 * _EVERY)  # until open pages have received the end


@contextmanager
def serve_recordings(files: Sequence[Path], port: int | None = None) -> Iterator[str]:
    """Serve recordings in Rerun's viewer, and yield the address of the page.

    Args:
        files: Recordings (`.rrd`).
        port: Port of the page; None: the first free port from 8080 on.
    """
    parts = [file.read_bytes() for file in files]
    with _served(port, lambda: parts) as url:
        yield url


@contextmanager
def _served(port: int | None, data: Callable[[], Sequence[bytes]]) -> Iterator[str]:
    """Serve the viewer and the parts of a recording, to which new parts are appended."""
    looking = asyncio.Lock()

    async def session(connection: Any, visitor: Visitor) -> None:
        async def listen() -> None:
            async for _ in connection:
                raise MessageError("a dashboard sends no messages")

        async def speak() -> None:
            sent = 0
            while True:
                async with looking:
                    parts = await asyncio.to_thread(data)
                for part in parts[sent:]:
                    await connection.send(part)
                sent = len(parts)
                await asyncio.sleep(_EVERY)

        await first_of(listen(), speak())

    contents = {**folder_contents(_CLIENT), **_viewer_contents()}
    gate = Gate(AddressConfig(port=port), contents, {"session": session})
    gate.start()
    try:
        yield gate.address.link()
    finally:
        gate.close()


def _viewer_contents() -> dict[str, Content]:
    """Files of Rerun's web viewer by path, from the cache folder."""
    import rerun

    folder = cache_home() / "hrc_learn" / f"rerun_viewer_{rerun.__version__}"
    if not all((folder / name).is_file() for name in _VIEWER_FILES):
        folder.mkdir(parents=True, exist_ok=True)
        for name, body in _fetched_viewer().items():
            with new_file(folder / name) as part:
                part.write_bytes(body)
    return folder_contents(folder, "/viewer/")


def _fetched_viewer() -> dict[str, bytes]:
    """Files of the viewer, which Rerun's program provides by HTTP only."""
    import rerun

    ports = []
    for _ in range(2):
        with socket.create_server(("127.0.0.1", 0)) as free:
            ports.append(free.getsockname()[1])
    command = [
        # Not `python -m rerun`: it starts the program as a child, which would outlive it.
        *(str(Path(rerun.__file__).parents[1] / "rerun_cli/rerun"), "--serve-web"),
        *("--bind", "127.0.0.1"),
        *("--web-viewer-port", str(ports[0]), "--port", str(ports[1])),
    ]
    quiet = subprocess.DEVNULL
    server = subprocess.Popen(command, stdout=quiet, stderr=quiet)
    try:
        end = time.monotonic() + _START
        while True:
            try:
                url = f"http://127.0.0.1:{ports[0]}"
                return {x: urlopen(f"{url}/{x}", timeout=_START).read() for x in _VIEWER_FILES}
            except OSError as error:
                if server.poll() is not None or time.monotonic() > end:
                    raise ValueError(
                        f"Rerun's viewer does not start; try `python -m rerun`. {error}"
                    ) from error
                time.sleep(0.1)
    finally:
        server.kill()
        server.wait()
