"""Sockets of the page: the session of each client, and its view, which viser serves.

viser accepts any client that reaches its port and trusts what it receives. Its port therefore
asks for a secret, and messages reach it through the gate alone.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import secrets
import time
from collections.abc import Callable, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from hrc_learn.teleoperation.gate.admission import same_secret
from hrc_learn.teleoperation.gate.control import Control
from hrc_learn.teleoperation.gate.gate import Content, Visitor, first_of, incoming
from hrc_learn.teleoperation.gate.messages import (
    Beat,
    GuiUpdate,
    Hands,
    Hello,
    Lead,
    Message,
    MessageError,
    acts,
    session_message,
    view_message,
)

if TYPE_CHECKING:
    from viser import ViserServer as ViserServer
    from websockets.asyncio.server import ServerConnection as ServerConnection
else:
    ServerConnection = ViserServer = Any

_STATUS_EVERY = 0.1  # [s]
_SCENE_EVERY = {"leads": 1 / 60, "watches": 1 / 20}
"""Time between two scenes for the leader, and for each of many who watch [s]."""
_SECRET_HEADER = "X-Page-Secret"

Heard = Callable[[Message], None]
"""Receiver of a message of the controlling client; called in the gate's thread."""


class PageSockets:
    """Conversations with the clients of the page; all run in the gate's thread.

    Attributes:
        scene: Scene in JSON, replaced as a whole when it changes.
    """

    def __init__(
        self,
        control: Control,
        heard: Heard,
        fits: Callable[[GuiUpdate], bool],
        status: Callable[[], Mapping[str, Any]],
        viser_port: int,
        secret: str,
    ):
        """
        Args:
            control: Control of the arm.
            heard: Receives what the controlling client asks for.
            fits: True if a control of viser's panel accepts a value.
            status: Status sent to all clients ten times a second.
            viser_port: Port of viser's socket on this machine.
            secret: Secret that viser's socket requires.
        """
        self._control, self._heard, self._fits = control, heard, fits
        self._status = status
        self._viser, self._secret = f"ws://127.0.0.1:{viser_port}", secret
        self.scene: msgspec.Raw | None = None

    async def session(self, connection: ServerConnection, visitor: Visitor) -> None:
        """Serve our own clients: signs of life, control requests and hands in, status out."""
        self._control.join(visitor.client, may_lead=visitor.right == "act")
        wants_scene = False

        async def listen() -> None:
            nonlocal wants_scene
            async for _, message in incoming(connection, session_message):
                if isinstance(message, Hello):
                    wants_scene = message.wants == "scene"
                else:
                    self._hear(visitor.client, message)

        async def speak() -> None:
            due, last, pause = 0.0, None, _STATUS_EVERY
            while True:
                now = time.monotonic()
                content: dict[str, Any] = {}
                if now >= due:
                    due, view = now + _STATUS_EVERY, vars(self._control.view(visitor.client))
                    content = {"status": {**self._status(), **view}}
                    pause = _SCENE_EVERY[view["role"]] if wants_scene else _STATUS_EVERY
                if wants_scene and (scene := self.scene) is not last:
                    last, content["scene"] = scene, scene
                if content:
                    text = msgspec.json.encode({"type": "state", **content}).decode()
                    await connection.send(text)
                await asyncio.sleep(pause)

        try:
            await first_of(listen(), speak())
        finally:
            self._control.leave(visitor.client)

    def _hear(self, client: str, message: Message) -> None:
        match message:
            case Beat(lag=lag):
                self._control.hear(client, lag)
            case Lead(wish="ask"):
                self._control.ask(client)
            case Lead():
                self._control.hand_over(client)
            case _:
                # A watching client may have had control when it sent this: no error.
                idle = isinstance(message, Hands) and not message.grips
                if self._control.act(client, idle=idle):
                    self._heard(message)

    async def view(self, connection: ServerConnection, visitor: Visitor) -> None:
        """Pass on the messages between viser and its page that fit."""
        from websockets.asyncio.client import connect
        from websockets.typing import Subprotocol

        protocols = [Subprotocol(connection.subprotocol)] if connection.subprotocol else None
        async with connect(
            self._viser,
            subprotocols=protocols,
            additional_headers={_SECRET_HEADER: self._secret},
            max_size=None,
            compression=None,
            ping_interval=None,
            proxy=None,
        ) as viewer:

            async def up() -> None:
                async for raw, message in incoming(connection, view_message):
                    if isinstance(message, GuiUpdate) and not self._fits(message):
                        raise MessageError("no value of that control")
                    if not acts(message) or self._control.act(visitor.client):
                        await viewer.send(raw)

            async def down() -> None:
                async for raw in viewer:
                    await connection.send(raw)

            await first_of(up(), down())


def page_contents(viser: Path) -> dict[str, Content]:
    """The page of viser with our part of it.

    Args:
        viser: Folder of the package.
    """
    page = (viser / "client" / "build" / "index.html").read_bytes()
    # Our scripts come first: they keep the secret, say which socket viser's client opens, and
    # how it draws.
    scripts = (b"door.js", b"session.js", b"prompt.js")
    ours = b"".join(b'<script src="/static/%s"></script>' % name for name in scripts)
    page = page.replace(b"<head>", b"<head>" + ours, 1)
    page = page.replace(b"<title>Viser</title>", b"<title>hrc page</title>", 1)
    return {"/": Content.of("index.html", page)}


def guarded_viser() -> tuple[ViserServer, str]:
    """Start a server of viser whose port asks for a secret, and return both."""
    import viser

    secret = secrets.token_urlsafe(18)
    # viser prints its own address, which is of no use to people.
    with _guarded_sockets(secret), contextlib.redirect_stdout(io.StringIO()):
        return viser.ViserServer("127.0.0.1", 0, verbose=False), secret


@contextmanager
def _guarded_sockets(secret: str):
    """Make servers of `websockets` created within this block ask for a secret; viser has no
    hook for that.
    """
    import websockets.asyncio.server as server

    plain = server.serve

    def serve(*args: Any, **options: Any) -> Any:
        def check(connection: ServerConnection, request: Any) -> Any:
            if same_secret(request.headers.get(_SECRET_HEADER, ""), secret):
                return None
            return connection.respond(403, "This port is not for browsers.\n")

        return plain(*args, **{**options, "process_request": check})

    server.serve = serve  # type: ignore[assignment]
    try:
        yield
    finally:
        server.serve = plain
