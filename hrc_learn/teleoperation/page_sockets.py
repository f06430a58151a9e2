"""Serve the clients of the page: each has two sockets, and one client has control of the arm.

One socket of a client is its session: requests, signs of life and status. The other is its view
of the scene, which the library viser draws and serves.

viser accepts any client that reaches its port, and trusts all messages. Its port therefore
requires a secret here, and messages reach it only through the gate.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import math
import secrets
import time
from collections.abc import Callable, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import RLock
from typing import Any

import msgspec

from hrc_learn.teleoperation.gate import messages
from hrc_learn.teleoperation.gate.admission import same_secret
from hrc_learn.teleoperation.gate.gate import (
    Content,
    ServerConnection,
    Visitor,
    first_of,
    incoming,
)
from hrc_learn.teleoperation.page_scene import ViserServer

_STATUS_EVERY = 0.1  # period of the status [s]
_SCENE_EVERY = {"leads": 1 / 60, "watches": 1 / 20}
"""Period of scenes for the controlling client, and for each watching client [s]."""
_SECRET_HEADER = "X-Page-Secret"

_MOST_IDLE = 10.0
"""Idle time after which a waiting client gets control [s]."""
_REMEMBERED = 3.0
"""Time for which the page shows why a browser is slow [s], enough to read a sentence."""


@dataclass
class _Client:
    may_lead: bool
    heard: float
    """Time of the client's last sign of life [s]."""
    lag: float = 0.0
    """Time since the client's page last responded [s]."""
    asked: float = math.inf
    """Time at which the client requested control [s]; infinite: no request."""
    slowed: tuple[float, float, float] = (-math.inf, 0.0, 0.0)
    """Time at which the client was last slow, and its silence and lag at that time [s]."""


class Control:
    """Gives control to one of several clients; the others watch and may request control.

    The first client to join has control, and keeps control until it hands over or leaves. If
    the controlling client is idle for 10 s, the client that has waited longest gets control.
    Control is never taken away during a drag. Safe to use from several threads.
    """

    def __init__(
        self,
        silence: float,
        timeout: float,
        changed: Callable[[], object] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Start without clients.

        Args:
            silence: Time without a sign of life after which the controlling client requests no
                motion [s].
            timeout: Time without a sign of life after which the client releases what it holds,
                and an unresponsive page counts as gone [s].
            changed: Called whenever another client gets control.
            clock: Monotonic clock [s].

        Raises:
            ValueError: Times are not positive, or silence is longer than timeout.
        """
        if not 0 < silence <= timeout:
            raise ValueError(
                "silence must be positive and no longer than timeout, but they are "
                f"{silence} and {timeout} s."
            )
        self._silence, self._timeout = silence, timeout
        self._changed, self._clock = changed, clock
        self._clients: dict[str, _Client] = {}
        self._leader: str | None = None
        self._acted = -math.inf
        self._lock = RLock()

    def join(self, client: str, *, may_lead: bool = True) -> None:
        """Add a client. With `may_lead`, it gets control if no other client has control."""
        with self._lock:
            self._clients[client] = _Client(may_lead, self._clock())
            if may_lead and self._leader is None:
                self._give(client)

    def leave(self, client: str) -> None:
        """Remove a client."""
        with self._lock:
            self._clients.pop(client, None)
            if client == self._leader:
                # The only client left gets control, like the first client to join: a reloaded
                # page may join before its old session has left.
                able = [name for name, one in self._clients.items() if one.may_lead]
                self._give(self._waiting() or (able[0] if len(able) == 1 else None))

    def hear(self, client: str, lag: float = 0.0) -> None:
        """Note a sign of life.

        Args:
            client: Client that gave the sign of life.
            lag: Time since the client's page last responded [s]. A web worker sends the signs
                of life, even if the page hangs.
        """
        with self._lock:
            if (one := self._clients.get(client)) is None:
                return
            now = self._clock()
            silence = now - one.heard
            one.heard, one.lag = now, lag
            if silence > self._silence or lag > self._timeout / 2:
                one.slowed = now, silence, lag

    def act(self, client: str, *, idle: bool = False) -> bool:
        """True if a client may act now.

        Args:
            client: Client that wants to act.
            idle: True if the client's message changes nothing, such as a hand that holds
                nothing. Only other messages reset the idle time.
        """
        with self._lock:
            self._pass_on()
            if client != self._leader:
                return False
            if not idle:
                self._acted = self._clock()
            return True

    def keep(self) -> None:
        """Note that the controlling client holds something: a pointer at rest sends nothing."""
        with self._lock:
            self._acted = self._clock()

    def ask(self, client: str) -> None:
        """Request control. If no client has control, this client gets it immediately.
        Otherwise, it waits until the controlling client hands over or is idle.
        """
        with self._lock:
            one = self._clients.get(client)
            if one is None or not one.may_lead or client == self._leader:
                return
            if self._leader is None:
                self._give(client)
            else:
                one.asked = min(one.asked, self._clock())

    def hand_over(self, client: str) -> None:
        """Hand control over to the first client that requested it, or release control."""
        with self._lock:
            if client == self._leader:
                self._give(self._waiting())

    @property
    def present(self) -> bool:
        """True if the controlling client was heard from recently enough to move the arm."""
        return self._within(self._silence)

    @property
    def gone(self) -> bool:
        """True if no client has control, or the controlling client has been silent, or its page
        unresponsive, for longer than `timeout`.
        """
        return not self._within(self._timeout)

    @property
    def slow(self) -> tuple[float, float]:
        """Silence and lag of the controlling client when it was last slow [s]; zeros if this
        was too long ago.
        """
        with self._lock:
            if (leader := self._leading()) is None:
                return 0.0, 0.0
            time, silence, lag = leader.slowed
            return (silence, lag) if self._clock() - time <= _REMEMBERED else (0.0, 0.0)

    @property
    def people(self) -> int:
        """Number of connected clients."""
        return len(self._clients)

    def view(self, client: str) -> dict[str, Any]:
        """Control state as shown to a client.

        Returns:
            `role` ("leads" or "watches"), `taken` (true if any client has control), `asked`
            (for the controlling client: true if another client has requested control; for any
            other client: true if it has requested control itself) and `may_lead` (false: the
            client may only watch).
        """
        with self._lock:
            self._pass_on()
            leads, one = client == self._leader, self._clients.get(client)
            asked = self._waiting() is not None if leads else one and one.asked < math.inf
            return {
                "role": "leads" if leads else "watches",
                "taken": self._leader is not None,
                "asked": bool(asked),
                "may_lead": one is not None and one.may_lead,
            }

    def _leading(self) -> _Client | None:
        return self._clients.get(self._leader or "")

    def _waiting(self) -> str | None:
        """Client that has waited for control for the longest time, if any."""
        asking = [name for name, one in self._clients.items() if one.asked < math.inf]
        return min(asking, key=lambda name: self._clients[name].asked, default=None)

    def _within(self, limit: float) -> bool:
        with self._lock:
            if (leader := self._leading()) is None:
                return False
            return self._clock() - leader.heard <= limit and leader.lag <= self._timeout

    def _give(self, client: str | None) -> None:
        self._leader, self._acted = client, self._clock()
        if (leader := self._leading()) is not None:
            leader.asked = math.inf
        self._changed()

    def _pass_on(self) -> None:
        """Pass control on to a waiting client if the controlling client is idle or
        unresponsive.
        """
        first = self._waiting()
        if self._leader is None or first is None:
            return
        if self._clock() - max(self._acted, self._clients[first].asked) >= _MOST_IDLE:
            self._give(first)


Heard = Callable[[messages.Message], None]
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
        fits: Callable[[messages.GuiUpdate], bool],
        status: Callable[[], Mapping[str, Any]],
        viser_port: int,
        secret: str,
    ):
        """
        Args:
            control: Control of the arm.
            heard: Receives the messages of the controlling client.
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
        """Serve a session: receive signs of life, requests and hands, send status and scene."""
        self._control.join(visitor.client, may_lead=visitor.right == "act")
        wants_scene = False

        async def listen() -> None:
            nonlocal wants_scene
            async for _, message in incoming(connection, messages.session_message):
                if isinstance(message, messages.Hello):
                    wants_scene = message.wants == "scene"
                else:
                    self._hear(visitor.client, message)

        async def speak() -> None:
            due, last, pause = 0.0, None, _STATUS_EVERY
            while True:
                now = time.monotonic()
                content: dict[str, Any] = {}
                if now >= due:
                    due, view = now + _STATUS_EVERY, self._control.view(visitor.client)
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

    def _hear(self, client: str, message: messages.Message) -> None:
        match message:
            case messages.Beat(lag=lag):
                self._control.hear(client, lag)
            case messages.Lead(wish="ask"):
                self._control.ask(client)
            case messages.Lead():
                self._control.hand_over(client)
            case _:
                # Not an error: a watching client may have had control when it sent this.
                idle = isinstance(message, messages.Hands) and not message.grips
                if self._control.act(client, idle=idle):
                    self._heard(message)

    async def view(self, connection: ServerConnection, visitor: Visitor) -> None:
        """Relay messages between viser and its page, and check all messages of the page."""
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
                async for raw, message in incoming(connection, messages.view_message):
                    if isinstance(message, messages.GuiUpdate) and not self._fits(message):
                        raise messages.MessageError("no value of that control")
                    if not messages.acts(message) or self._control.act(visitor.client):
                        await viewer.send(raw)

            async def down() -> None:
                async for raw in viewer:
                    await connection.send(raw)

            await first_of(up(), down())


def page_contents(viser: Path) -> dict[str, Content]:
    """The page of viser, with our scripts.

    Args:
        viser: Folder of the package viser.
    """
    page = (viser / "client" / "build" / "index.html").read_bytes()
    # Our scripts come first: they keep the secret, and determine which socket viser's client
    # opens and how it draws.
    scripts = (b"door.js", b"session.js", b"prompt.js")
    ours = b"".join(b'<script src="/static/%s"></script>' % name for name in scripts)
    page = page.replace(b"<head>", b"<head>" + ours, 1)
    page = page.replace(b"<title>Viser</title>", b"<title>hrc page</title>", 1)
    return {"/": Content.of("index.html", page)}


def guarded_viser() -> tuple[ViserServer, str]:
    """Start a server of viser whose port requires a secret; return server and secret."""
    import viser

    secret = secrets.token_urlsafe(18)
    # viser prints its own address, which is of no use here.
    with _guarded_sockets(secret), contextlib.redirect_stdout(io.StringIO()):
        return viser.ViserServer("127.0.0.1", 0, verbose=False), secret


@contextmanager
def _guarded_sockets(secret: str):
    """Make servers of `websockets` that start within this block require a secret; viser has
    no hook for that.
    """
    import websockets.asyncio.server as server

    plain = server.serve

    def serve(*args: Any, **options: Any) -> Any:
        def check(connection: ServerConnection, request: Any) -> Any:
            if same_secret("".join(request.headers.get_all(_SECRET_HEADER)), secret):
                return None
            return connection.respond(403, "This port is not for browsers.\n")

        return plain(*args, **{**options, "process_request": check})

    server.serve = serve  # type: ignore[assignment]
    try:
        yield
    finally:
        server.serve = plain
