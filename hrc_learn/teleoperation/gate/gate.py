"""Serve all browser traffic through one gate: page, headset, curation and dashboards.

The gate serves files and sockets in a thread of its own. The files of a page are public; data
and sockets need a secret (see `Admission`). A client is a page open in a browser; it draws its
name at random. Every socket belongs to a client, and an error of a client closes only the
sockets of this client.
"""

from __future__ import annotations

import asyncio
import http
import json
import logging
import mimetypes
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from hrc_learn.teleoperation.gate.address import AddressConfig, listening_socket, tls_context
from hrc_learn.teleoperation.gate.admission import (
    HEADERS,
    Admission,
    Bucket,
    RefusedError,
    Right,
)
from hrc_learn.teleoperation.gate.messages import MessageError

# websockets is imported when a page is opened.
if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection as ServerConnection
    from websockets.http11 import Request as Request
    from websockets.http11 import Response as Response
else:
    ServerConnection = Request = Response = Any

_LARGEST = 16_384  # bytes of a message: our longest message has 1.5 kB
_RATE, _BURST = 400.0, 800.0  # messages per second, and at once: a mouse sends 2 x 125 per s
_HANDSHAKE = 30.0
"""Longest time from connecting to the answer [s]; the slowest answer is a block of images."""
_SESSION_WAIT = 3.0
"""Longest time that a socket waits until the session of its client is open [s]."""
_POLL = 0.05  # period of checking for the session [s]
_FAREWELL, _CLOSING = 0.5, 1.0  # longest times to send the last message, and to close [s]
_PING, _PONG = 5.0, 10.0  # time between pings, and longest time until the answer [s]
_TOO_MUCH, _FAILED, _FULL = 1008, 1011, 1013  # codes of the WebSocket protocol (RFC 6455)
_SECRET = "secret."  # begins the subprotocol that carries the secret

_logger = logging.getLogger("hrc_learn.gate")


@dataclass(frozen=True, kw_only=True)
class Content:
    """Content served at a path."""

    body: bytes
    kind: str
    """MIME type of the content."""

    @classmethod
    def of(cls, name: str, body: bytes) -> Content:
        """Content with the MIME type that belongs to a file name."""
        kinds = {".js": "text/javascript", ".glb": "model/gltf-binary"}
        guess = kinds.get(Path(name).suffix) or mimetypes.guess_type(name)[0]
        return cls(body=body, kind=guess or "application/octet-stream")


def folder_contents(folder: Path, prefix: str = "/static/") -> dict[str, Content]:
    """Files of a folder, by path; index.html is also at the path "/"."""
    contents = {
        f"{prefix}{file.name}": Content.of(file.name, file.read_bytes())
        for file in sorted(folder.iterdir())
        if file.is_file()
    }
    index = contents.get(f"{prefix}index.html")
    return contents if index is None else {**contents, "/": index}


@dataclass(frozen=True, kw_only=True)
class Visitor:
    """Client of a page, with its right."""

    client: str
    """Random name of the client, drawn by its page."""
    right: Right


type Route = Callable[[ServerConnection, Visitor], Awaitable[None]]
"""Conversation with a client over one socket; it ends when the socket closes."""


async def incoming[T](
    connection: ServerConnection, decode: Callable[[str | bytes], T]
) -> AsyncIterator[tuple[str | bytes, T]]:
    """Messages of a client, raw and decoded.

    Raises:
        MessageError: A message fits no schema, or there are too many.
    """
    bucket = Bucket(rate=_RATE, burst=_BURST)
    async for raw in connection:
        if not bucket.take():
            raise MessageError("too many messages")
        yield raw, decode(raw)


class Gate:
    """Server of a page, its data and its sockets, in a thread of its own.

    Attributes:
        address: Address of the page, with its secrets.
    """

    def __init__(
        self,
        config: AddressConfig,
        contents: Mapping[str, Content],
        routes: Mapping[str, Route],
        data: Callable[[str], Content | None] = lambda path: None,
    ):
        """Bind the port; no client is accepted before `start`.

        Args:
            config: Host, port and certificate.
            contents: Public content by path.
            routes: Conversation for each kind of socket, by the first part of the socket's
                path. "session" needs the secret; all others need an open session of the client.
            data: Returns the content of a path for clients with a secret, or None; called in
                threads.

        Raises:
            ValueError: The page cannot be served at this address, or not securely.
        """
        self._context = tls_context(config)
        self._socket = listening_socket(config)
        self._contents = {**folder_contents(_STATIC), **contents}
        self._routes, self._data = routes, data
        self._most_clients = config.most_clients
        port = self._socket.getsockname()[1]
        self._admission = Admission(config, port, tls=self._context is not None)
        self.address = self._admission.address
        self._open: dict[str, dict[str, ServerConnection]] = {name: {} for name in routes}
        self._visitors: dict[str, Visitor] = {}
        self._ready, self._farewell = Event(), ""
        self._failure: BaseException | None = None
        self._thread = Thread(target=self._run, name="page gate", daemon=True)

    def start(self) -> None:
        """Accept clients.

        Raises:
            Exception: The gate's thread could not start to serve.
        """
        self._thread.start()
        self._ready.wait()
        if self._failure is not None:
            self._thread.join()
            raise self._failure

    def wait(self) -> None:
        """Wait until the gate is closed by another thread, or for Ctrl-C."""
        self._thread.join()

    def close(self, words: str = "") -> None:
        """Send a farewell to all clients, and stop."""
        self._farewell = words
        if self._thread.is_alive():
            with suppress(RuntimeError):  # it has just ended
                self._loop.call_soon_threadsafe(self._end.set)
            self._thread.join()
        self._socket.close()

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except BaseException as error:
            if self._ready.is_set():
                raise
            self._failure = error
        finally:
            self._ready.set()

    async def _serve(self) -> None:
        from websockets.asyncio.server import serve

        self._loop, self._end = asyncio.get_running_loop(), asyncio.Event()
        async with serve(
            self._handle,
            sock=self._socket,
            ssl=self._context,
            process_request=self._answer,
            select_subprotocol=lambda _, offered: next(
                (name for name in offered if not name.startswith(_SECRET)), None
            ),
            max_size=_LARGEST,
            compression=None,
            open_timeout=_HANDSHAKE,
            close_timeout=_CLOSING,
            ping_interval=_PING,
            ping_timeout=_PONG,
            logger=_quiet_logger(),
        ):
            self._ready.set()
            await self._end.wait()
            words = json.dumps({"type": "end", "words": self._farewell})
            for session in list(self._open["session"].values()):
                with suppress(Exception):  # the client may be gone
                    await asyncio.wait_for(session.send(words), _FAREWELL)

    async def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer a request; None lets a WebSocket through."""
        try:
            # websockets itself would fail on characters that are not ASCII.
            if not all(value.isascii() for _, value in request.headers.raw_items()):
                raise RefusedError(400, "Headers are ASCII text.")
            if not self._admission.is_ours(_header(request, "Host")):
                raise RefusedError(403, "This page is not served under that name.")
            if _header(request, "Upgrade").lower() == "websocket":
                await self._admit(request)
                return None
            content = await self._content(request)
        except RefusedError as error:
            return _response(error.code, Content(body=f"{error}\n".encode(), kind=_PLAIN))
        except Exception as error:  # an error of this program ends this request only
            _logger.exception("%s failed", request.path)
            words = f"{type(error).__name__}: {error}\n"
            return _response(500, Content(body=words.encode(), kind=_PLAIN))
        return _response(200, content)

    async def _content(self, request: Request) -> Content:
        path = _path(request)
        if path in self._contents:
            return self._contents[path]
        kind, _, secret = _header(request, "Authorization").partition(" ")
        self._admission.right(secret if kind == "Bearer" else "")
        if path == "/admitted":
            return Content(body=b"", kind=_PLAIN)
        content = await asyncio.to_thread(self._data, path)
        if content is None:
            raise RefusedError(404, "There is nothing here.")
        return content

    async def _admit(self, request: Request) -> None:
        """Check a request to open a socket.

        Raises:
            RefusedError: The socket may not be opened.
        """
        if not self._admission.from_ours(_header(request, "Origin")):
            raise RefusedError(403, "Another site may not connect.")
        route, client = _place(request)
        if route not in self._routes or not 16 <= len(client) <= 64:
            raise RefusedError(404, "There is nothing here.")
        if route == "session":
            self._admission.right(_secret(request))
            return
        for _ in range(round(_SESSION_WAIT / _POLL)):
            if client in self._visitors:
                return
            await asyncio.sleep(_POLL)
        raise RefusedError(401, "This client has no session.")

    async def _handle(self, connection: ServerConnection) -> None:
        from websockets.exceptions import ConnectionClosed

        request = connection.request
        assert request is not None
        route, client = _place(request)
        table = self._open[route]
        if client in table or len(table) >= self._most_clients:
            await connection.close(_FULL, "too many clients are connected")
            return
        table[client] = connection
        try:
            if route == "session":
                right = self._admission.right(_secret(request))
                self._visitors[client] = Visitor(client=client, right=right)
            await self._routes[route](connection, self._visitors[client])
        except ConnectionClosed:
            pass
        except MessageError as error:
            await connection.close(_TOO_MUCH, str(error)[:120])
        except Exception:  # an error of this program ends this client only
            _logger.exception("a client of %s failed", route)
            await connection.close(_FAILED, "the program failed on a message")
        finally:
            del table[client]
            if route == "session":
                del self._visitors[client]
                for others in self._open.values():
                    if client in others:
                        await others[client].close()


async def first_of(*work: Awaitable[None]) -> None:
    """Wait until one of several tasks ends, and cancel the others."""
    tasks = [asyncio.ensure_future(one) for one in work]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


_STATIC = Path(__file__).parent / "static"
_PLAIN = "text/plain; charset=utf-8"


def _path(request: Request) -> str:
    try:
        return urlsplit(request.path).path
    except ValueError as error:
        raise RefusedError(400, "That is no address.") from error


def _header(request: Request, name: str) -> str:
    """Value of a header that a request may contain at most once; empty if it is absent."""
    values = request.headers.get_all(name)
    if len(values) > 1:
        raise RefusedError(400, f"The request has more than one header {name}.")
    return "".join(values)


def _place(request: Request) -> tuple[str, str]:
    """Route and name of the client, from a socket's path."""
    route, _, client = _path(request).strip("/").partition("/")
    return route, client


def _secret(request: Request) -> str:
    """Secret among the subprotocols that a client offers."""
    offered = ", ".join(request.headers.get_all("Sec-WebSocket-Protocol")).split(",")
    secrets = [name.strip() for name in offered if name.strip().startswith(_SECRET)]
    return secrets[0].removeprefix(_SECRET) if secrets else ""


def _quiet_logger() -> logging.Logger:
    """Drop log lines about refused clients, which could otherwise flood the terminal.

    websockets logs an internal error if a client closes its connection before the answer.
    """
    noise = ("opening handshake", "unexpected internal error")
    logger = logging.getLogger("hrc_learn.gate.sockets")
    if not logger.filters:
        logger.addFilter(lambda record: not record.getMessage().startswith(noise))
    return logger


def _response(code: int, content: Content) -> Response:
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    headers = Headers(
        {
            "Content-Type": content.kind,
            "Content-Length": str(len(content.body)),
            "Connection": "close",
            **HEADERS,
        }
    )
    return Response(code, http.HTTPStatus(code).phrase, headers, content.body)
