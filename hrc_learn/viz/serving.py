"""A recording stream that a browser shows while it is written."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple
from urllib.parse import quote

import rerun as rr


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
