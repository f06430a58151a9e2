"""Entrance for all browser traffic, which is validated before it reaches anything else.

The gate stands in front of viser, which accepts any client that reaches its port, and of the XR
client's socket.
"""

from __future__ import annotations

import asyncio
import http
import json
import logging
import mimetypes
import time
from collections.abc import Awaitable, Callable, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from hrc_learn.teleoperation.gate.address import (
    AddressConfig,
    listening_socket,
    tls_context,
)
from hrc_learn.teleoperation.gate.admission import HEADERS, Admission, Bucket, same_secret
from hrc_learn.teleoperation.gate.control import Control
from hrc_learn.teleoperation.gate.messages import (
    Beat,
    GuiUpdate,
    Hands,
    Hello,
    Lead,
    Message,
    MessageError,
    session_message,
    view_message,
)

# websockets comes with viser, and is imported when a page is opened.
if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection as ServerConnection
    from websockets.http11 import Request as Request
    from websockets.http11 import Response as Response
else:
    ServerConnection = Request = Response = Any

_LARGEST = 16_384  # bytes of a message: the longest of ours has 1.5 kB
_RATE, _BURST = 400.0, 800.0  # messages a second and at once: a mouse makes 2 x 125
_CONNECTIONS = 64  # open at once, whatever they are: a browser needs 8
_PER_PERSON = 2  # a page and its socket
_STATUS_EVERY, _SCENE_EVERY = 0.1, 1 / 60
_GONE, _TOO_MUCH, _FULL = 1001, 1008, 1013  # codes of the WebSocket protocol (RFC 6455)


@dataclass(frozen=True, kw_only=True)
class Content:
    """Content served at a path."""

    body: bytes
    kind: str
    """Its MIME type."""

    @classmethod
    def of(cls, name: str, body: bytes) -> Content:
        """Content with the MIME type that belongs to a file name."""
        kinds = {".js": "text/javascript", ".glb": "model/gltf-binary"}
        suffix = name[name.rfind(".") :]
        guess = kinds.get(suffix) or mimetypes.guess_type(name)[0]
        return cls(body=body, kind=guess or "application/octet-stream")


_STATIC = Path(__file__).parent / "static"


def page_contents(viser: Path) -> dict[str, Content]:
    """The page of viser with our part of it, by path.

    Args:
        viser: Folder of the package.
    """
    page = (viser / "client" / "build" / "index.html").read_bytes()
    # Ours come first: one says which socket viser's client opens, one how it draws.
    ours = b"".join(
        b'<script src="/static/%s"></script>' % name for name in (b"session.js", b"prompt.js")
    )
    page = page.replace(b"<head>", b"<head>" + ours, 1)
    page = page.replace(b"<title>Viser</title>", b"<title>hrc page</title>", 1)
    return {"/": Content.of("index.html", page), **static_contents(_STATIC)}


def static_contents(folder: Path) -> dict[str, Content]:
    """Files of a folder, by path."""
    return {
        f"/static/{file.name}": Content.of(file.name, file.read_bytes())
        for file in sorted(folder.iterdir())
        if file.is_file()
    }


@dataclass(frozen=True, kw_only=True)
class GateCallbacks:
    """Callbacks of the page for validated messages; the gate's thread calls them."""

    heard: Callable[[Message], None]
    """A message of the controlling client."""
    fits: Callable[[GuiUpdate], bool]
    """True if a control of viser's panel accepts a value."""
    status: Callable[[], Mapping[str, Any]]
    """Status sent to all clients ten times a second."""
    scene: Callable[[], Mapping[str, Any]]
    """Scene sent on each change to clients that render it themselves."""


class Gate:
    """Serves pages and sockets to clients with the token, in a thread of its own.

    Attributes:
        address: Address, with the secret.
        control: Control of the arm.
    """

    def __init__(
        self,
        config: AddressConfig,
        control: Control,
        contents: Mapping[str, Content],
        callbacks: GateCallbacks,
        viewer: str,
        secret: str,
    ):
        """Bind the port; no client is accepted before `start`.

        Args:
            config: Host, port and certificate.
            control: Control of the arm.
            contents: Content by path.
            callbacks: Callbacks of the page.
            viewer: Address of viser's socket.
            secret: Secret that viser's socket requires.

        Raises:
            ValueError: The page cannot be served at this address, or not securely.
        """
        self._context = tls_context(config)
        self._socket = listening_socket(config)
        self._config, self.control, self._contents = config, control, contents
        self._callbacks, self._viewer, self._secret = callbacks, viewer, secret
        port = self._socket.getsockname()[1]
        self._admission = Admission(config, port, tls=self._context is not None)
        self.address = self._admission.address
        self._sessions: dict[str, ServerConnection] = {}
        self._views: dict[str, ServerConnection] = {}
        self._open = 0
        self._ready, self._farewell = Event(), ""
        self._failure: BaseException | None = None
        self._thread = Thread(target=self._run, name="page gate", daemon=True)

    def start(self) -> None:
        """Let people in.

        Raises:
            Exception: Whatever kept the gate's thread from serving.
        """
        self._thread.start()
        self._ready.wait()
        if self._failure is not None:
            self._thread.join()
            raise self._failure

    def close(self, words: str) -> None:
        """Tell everybody that it is over, and why, and stop."""
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
            process_request=self._admit,
            select_subprotocol=lambda _, offered: next(
                (name for name in offered if name.startswith("viser-v")), None
            ),
            max_size=_LARGEST,
            compression=None,
            open_timeout=5,
            close_timeout=1,
            ping_interval=5,
            ping_timeout=10,
            logger=_quiet_logger(),
        ):
            self._ready.set()
            await self._end.wait()
            words = json.dumps({"type": "end", "words": self._farewell})
            for session in list(self._sessions.values()):
                with suppress(Exception):  # the client may be gone
                    await asyncio.wait_for(session.send(words), 0.5)

    # Admission.

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer a request; None lets a WebSocket through."""
        verdict = self._admission.refuse(
            request.path,
            request.headers.get("Host", ""),
            request.headers.get_all("Cookie"),
            self._contents.__contains__,
        )
        if verdict is not None:
            words = f"{verdict.words}\n".encode() if verdict.words else b""
            return _response(verdict.code, words, _PLAIN, **verdict.headers)
        parts = urlsplit(request.path)
        if request.headers.get("Upgrade", "").lower() != "websocket":
            content = self._contents.get(parts.path)
            if content is None:
                return _refused(404, "There is nothing here.")
            return _response(200, content.body, content.kind)
        if not self._admission.from_ours(request.headers.get("Origin", "")):
            return _refused(403, "Another site may not connect.")
        route, _, client = parts.path.strip("/").partition("/")
        if route not in ("session", "view") or not 16 <= len(client) <= 64:
            return _refused(404, "There is nothing here.")
        if self._open >= _CONNECTIONS:
            return _refused(503, "Too many connections.")
        return None

    # What they may say.

    async def _handle(self, connection: ServerConnection) -> None:
        assert connection.request is not None
        route, _, client = urlsplit(connection.request.path).path.strip("/").partition("/")
        table = self._sessions if route == "session" else self._views
        if client in table or len(table) >= self._config.most_clients:
            await connection.close(_FULL, "as many people are here as may be")
            return
        table[client] = connection
        self._open += 1
        try:
            await (self._session if route == "session" else self._view)(connection, client)
        except MessageError as error:
            await connection.close(_TOO_MUCH, str(error)[:120])
        finally:
            self._open -= 1
            del table[client]

    async def _session(self, connection: ServerConnection, client: str) -> None:
        """Serve our own clients: signs of life, control requests and hands in, status out."""
        self.control.join(client)
        wants = {"scene": False}

        async def listen() -> None:
            bucket = Bucket(rate=_RATE, burst=_BURST)
            async for raw in connection:
                if not bucket.take():
                    raise MessageError("too many messages")
                self._hear(client, session_message(raw), wants)

        async def tell() -> None:
            status, last = 0.0, None
            while True:
                now = time.monotonic()
                content: dict[str, Any] = {}
                if now - status >= _STATUS_EVERY:
                    status, view = now, vars(self.control.view(client))
                    content = {"status": {**self._callbacks.status(), **view}, "clock": now}
                if wants["scene"] and (scene := self._callbacks.scene()) is not last:
                    last, content["scene"] = scene, scene
                if content:
                    await connection.send(json.dumps({"type": "state", **content}))
                await asyncio.sleep(_SCENE_EVERY if wants["scene"] else _STATUS_EVERY)

        try:
            await _first(listen(), tell())
        finally:
            self.control.leave(client)

    def _hear(self, client: str, message: Message, wants: dict[str, bool]) -> None:
        match message:
            case Beat(lag=lag, echo=echo):
                delay = 0.0 if echo is None else max(time.monotonic() - echo, 0.0)
                self.control.hear(client, lag, delay)
            case Hello():
                wants["scene"] = message.wants == "scene"
            case Lead(wish="ask"):
                self.control.ask(client)
            case Lead():
                self.control.hand_over(client)
            case _:
                # A watching client may have had control when it sent this: no error.
                idle = isinstance(message, Hands) and not message.grips
                if self.control.act(client, idle=idle):
                    self._callbacks.heard(message)

    async def _view(self, connection: ServerConnection, client: str) -> None:
        """The page of viser: what fits goes on to it, and all that it says comes back."""
        from websockets.asyncio.client import connect
        from websockets.typing import Subprotocol

        protocols = [Subprotocol(connection.subprotocol)] if connection.subprotocol else None
        async with connect(
            self._viewer,
            subprotocols=protocols,
            additional_headers={SECRET_HEADER: self._secret},
            max_size=None,
            compression=None,
            ping_interval=None,
            proxy=None,
        ) as viewer:

            async def up() -> None:
                bucket = Bucket(rate=_RATE, burst=_BURST)
                async for raw in connection:
                    if not bucket.take():
                        raise MessageError("too many messages")
                    message = view_message(raw)
                    if isinstance(message.content, GuiUpdate) and not self._callbacks.fits(
                        message.content
                    ):
                        raise MessageError("no value of that control")
                    if not message.acts or self.control.act(client):
                        await viewer.send(raw)

            async def down() -> None:
                async for raw in viewer:
                    await connection.send(raw)

            await _first(up(), down())


async def _first(*work: Awaitable[None]) -> None:
    """Wait until one ends, and end the others; a connection that closes is no error."""
    from websockets.exceptions import ConnectionClosed

    tasks = [asyncio.ensure_future(one) for one in work]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            error = task.exception()
            if error is not None and not isinstance(error, ConnectionClosed):
                raise error
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _quiet_logger() -> logging.Logger:
    """Drop log lines about refused clients, which could otherwise flood the terminal."""
    logger = logging.getLogger("hrc_learn.gate")
    if not logger.filters:
        logger.addFilter(lambda record: not record.getMessage().startswith("opening handshake"))
    return logger


_PLAIN = "text/plain; charset=utf-8"


def _refused(code: int, words: str) -> Response:
    return _response(code, f"{words}\n".encode(), _PLAIN)


def _response(code: int, body: bytes, kind: str, **more: str) -> Response:
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    headers = Headers(
        {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            **HEADERS,
            "Permissions-Policy": "xr-spatial-tracking=(self)",
            "Connection": "close",
            **more,
        }
    )
    return Response(code, http.HTTPStatus(code).phrase, headers, body)


SECRET_HEADER = "X-Page-Secret"


@contextmanager
def guarded_servers(secret: str):
    """Make servers of `websockets` created within this block require a secret.

    viser has no hook to check its clients, and serves any that reach its port, including any
    site open in a browser of this machine.

    Args:
        secret: Required value of the header `SECRET_HEADER`.
    """
    import websockets.asyncio.server as server

    plain = server.serve

    def serve(*args: Any, **options: Any) -> Any:
        def check(connection: ServerConnection, request: Request) -> Response | None:
            given = request.headers.get(SECRET_HEADER, "")
            if same_secret(given, secret):
                return None
            return _refused(403, "This port is not for browsers.")

        return plain(*args, **{**options, "process_request": check})

    server.serve = serve  # type: ignore[assignment]
    try:
        yield
    finally:
        server.serve = plain
