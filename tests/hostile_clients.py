"""Clients that mean harm, or whose machines have gone mad, against a page that is served."""

import asyncio
import json
import secrets
import time
from contextlib import asynccontextmanager, suppress
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import msgspec
import numpy as np
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from hrc_learn.teleoperation.page import Page

VISER = "viser-v1.1.1"


def http(page: Page, path: str, *, secret: str = "", **headers) -> tuple[int, dict, bytes]:
    """Status, headers and body of a request to the page's server."""
    if secret:
        headers["Authorization"] = f"Bearer {secret}"
    where = f"http://127.0.0.1:{page.address.port}{path}"
    try:
        answer = urlopen(Request(where, headers=headers), timeout=10)
    except HTTPError as error:
        answer = error
    return answer.status, dict(answer.headers), answer.read()


def new_client() -> str:
    return secrets.token_urlsafe(18)


def socket(page: Page, route="session", *, secret=None, origin=None, client="", **options):
    """A socket of the page: a client with all that it takes leaves the defaults."""
    where = f"ws://127.0.0.1:{page.address.port}/{route}/{client or new_client()}"
    secret = page.address.token if secret is None else secret
    offered = ["hrc", f"secret.{secret}"] if route == "session" else [VISER]
    options = {
        "proxy": None,
        "open_timeout": 20,
        "close_timeout": 1,
        "max_size": None,
    } | options
    origin = page.address.origin if origin is None else origin
    return connect(where, subprotocols=offered, origin=origin or None, **options)


@asynccontextmanager
async def viewer(page: Page, client=""):
    """Session and view of one client."""
    client = client or new_client()
    async with socket(page, client=client) as session, socket(page, "view", client=client) as v:
        yield session, v


def hands(pointer=(0.3, 0.0, 0.9), joint=4, start=(0.3, 0.0, 0.5)) -> str:
    grip = {"hand": "left", "joint": joint, "start": start, "pointer": pointer}
    return json.dumps({"type": "hands", "grips": [grip]})


BEAT = json.dumps({"type": "beat", "lag": 0.0})

JUNK = (
    "",
    "{",
    "[]",
    "null",
    '{"type": "none"}',
    '{"type": "beat", "lag": NaN}',
    '{"type": "beat", "lag": 1e999}',
    '{"type": "beat", "lag": "0"}',
    '{"type": "hands", "grips": [{"hand": "left"}]}',
    '{"type": "request", "request": "explode"}',
    '{"type": "gripper", "width": -100}',
    '{"type": "region", "centre": [0, 0, 0], "half_size": [0, 1, 1], "active": true}',
    '{"type": "region", "centre": [0, 0], "half_size": [1, 1, 1], "active": true}',
    hands(pointer=(1e9, 0.0, 0.0)),
    hands(joint=0),
    hands(joint=99),
    "[" * 2000,
    '{"type": "hello", "wants": ' + "[" * 5000,
    '{"type": "beat", "lag": 0, "more": {}}',
    '{"type": "beat", "lag": true}',
    "x" * 100_000,
    b"\x00\xff" * 50,
)
"""What no client of ours says to the session."""


def packed(kind: str, /, **fields) -> bytes:
    return msgspec.msgpack.encode({"type": kind, **fields})


VIEW_JUNK = (
    b"",
    b"\xc1",
    "text",
    packed("ShareUrlRequest"),
    packed("FileTransferStartUpload", source_component_uuid="x", size_bytes=1 << 40),
    packed("SetCameraPositionMessage", position=(0.0, 0.0, 0.0)),
    packed("GuiUpdateMessage", uuid="none", updates={"value": True}),
    packed("GuiUpdateMessage", uuid="none", updates={"visible": False}),
    packed(
        "TransformControlsUpdateMessage", name="/region", wxyz=(0, 0, 0, 0), position=(0, 0, 0)
    ),
    packed(
        "TransformControlsUpdateMessage",
        name="/end_effector",
        wxyz=(1.0, 0.0, 0.0, 0.0),
        position=(float("nan"), 0.0, 0.0),
    ),
    packed("SceneNodeDragMessage", phase="start", name="/arm/link4"),
)
"""What viser's page does not say, or not so."""

DRAG = {
    "name": "/arm/link4",
    "instance_index": None,
    "start_position": (0.3, 0.0, 0.5),
    "start_screen_pos": (0.5, 0.5),
    "end_position": (0.3, 0.5, 0.9),
    "end_screen_pos": (0.6, 0.6),
    "button": "left",
    "modifier": None,
    "owner": "",
}


async def refused(connection, codes=(400, 401, 403, 404, 429, 503)) -> None:
    """A socket that is not to open does not."""
    try:
        async with connection:
            raise AssertionError("somebody was let in")
    except InvalidStatus as error:
        assert error.response.status_code in codes  # noqa: PT017


async def until_closed(connection) -> None:
    try:
        async for _ in connection:
            pass
    except ConnectionClosed:
        pass


async def attack(page: Page, kind: str, rng: np.random.Generator) -> None:
    """One hostile client.

    Args:
        page: Served, and led by somebody else.
        kind: One of `ATTACKS`.
        rng: Varies what is sent.
    """
    route = ("session", "view")[rng.integers(2)]
    match kind:
        case "foreign origin":
            origin = FOREIGN[rng.integers(len(FOREIGN))]
            await refused(socket(page, route, origin=origin))
        case "no origin":
            await refused(socket(page, route, origin=""))
        case "no secret":
            await refused(socket(page, route, secret="x"))
            # As cookies came before, which other ports of this host receive.
            name = f"hrc_page_{page.address.port}={page.address.token}"
            status, *_ = await asyncio.to_thread(http, page, "/xr/scene.json", Cookie=name)
            assert status == 401
        case "wrong secret":
            wrong = secrets.token_urlsafe(18)
            await refused(socket(page, secret=wrong))
            status, *_ = await asyncio.to_thread(http, page, "/xr/scene.json", secret=wrong)
            assert status in (403, 429)
        case "rebound name":
            host = f"evil.example:{page.address.port}"
            secret = page.address.token
            status, *_ = await asyncio.to_thread(http, page, "/", secret=secret, Host=host)
            assert status == 403
        case "past the gate":
            inner = page._server.get_port()
            where = f"ws://127.0.0.1:{inner}"
            await refused(connect(where, subprotocols=[VISER], proxy=None))
        case "raw junk":
            _, writer = await asyncio.open_connection("127.0.0.1", page.address.port)
            writer.write(rng.bytes(int(rng.integers(1, 4000))))
            await writer.drain()
            await asyncio.sleep(0.2)
            writer.close()
        case "slow":
            _, writer = await asyncio.open_connection("127.0.0.1", page.address.port)
            writer.write(b"GET / HTTP/1.1\r\n")
            await asyncio.sleep(1.0)
            writer.transport.abort()
        case "junk":
            async with socket(page) as one:
                await one.send(JUNK[rng.integers(len(JUNK))])
                await until_closed(one)
        case "viewer's junk":
            async with viewer(page) as (_, one):
                await one.send(VIEW_JUNK[rng.integers(len(VIEW_JUNK))])
                await until_closed(one)
        case "flood":
            async with socket(page) as one:
                try:
                    for _ in range(3000):
                        await one.send(BEAT)
                except ConnectionClosed:
                    pass
                await until_closed(one)
        case "stolen control" | "acting watcher":
            watches = kind == "acting watcher"
            secret = page.address.watch_token if watches else page.address.token
            async with socket(page, secret=secret) as one:
                for _ in range(20):
                    if watches:
                        await one.send(json.dumps({"type": "lead", "wish": "ask"}))
                    await one.send(hands())
                    await one.send(json.dumps({"type": "ask", "request": "finish"}))
                    await one.send(json.dumps({"type": "lead", "wish": "hand_over"}))
                    await one.send(json.dumps({"type": "gripper", "width": 0.0}))
                    await asyncio.sleep(0.02)
        case "stolen drag":
            async with viewer(page) as (_, one):
                for phase in ("start", "update", "update"):
                    await one.send(packed("SceneNodeDragMessage", phase=phase, **DRAG))
                    await asyncio.sleep(0.05)
                one.transport.abort()
        case "vanishing":
            async with socket(page) as one:
                await one.send(json.dumps({"type": "lead", "wish": "ask"}))
                await one.send(hands())
                one.transport.abort()


FOREIGN = (
    "http://evil.example",
    "null",
    "http://127.0.0.1",
    "http://localhost",
    "https://localhost",
    "http://127.0.0.1:1",
    "http://127.0.0.1.evil.example",
    "http://user@127.0.0.1",
    "http://[::1]",
    "http://127.0.0.1:",
    "file://",
    "chrome-extension://abcdefghijklmnop",
    "http://localhost:65536",
    "http://127.0.0.1:80@evil.example",
)
"""Origins of other sites, some of them on other ports of this host."""
HOSTS = ("evil.example", "127.0.0.1", "localhost:1", "localhost.evil.example", "", "[abc")
"""Names under which no page of ours is served."""

ATTACKS = (
    "foreign origin",
    "no origin",
    "no secret",
    "wrong secret",
    "rebound name",
    "past the gate",
    "raw junk",
    "slow",
    "junk",
    "viewer's junk",
    "flood",
    "stolen control",
    "acting watcher",
    "stolen drag",
    "vanishing",
)


async def storm(url: str, data: str, count: int, at_once: int = 8) -> None:
    """Clients under wrong origins and names before a door, of which none is let in.

    Args:
        url: Address of the page, with its secret.
        data: Path of something that needs the secret.
        count: Number of clients.
        at_once: Number of clients that come at the same time.
    """
    address, _, token = url.partition("/#token=")
    wrong = [{"origin": one} for one in FOREIGN] + [{"host": one} for one in HOSTS]
    gap = asyncio.Semaphore(at_once)

    def fetch(headers: dict[str, str]) -> int:
        try:
            return urlopen(Request(address + data, headers=headers), timeout=20).status
        except HTTPError as error:
            return error.code

    async def come(k: int) -> None:
        sent = wrong[k % len(wrong)]
        secret = (token, token, "", secrets.token_urlsafe(18))[k // len(wrong) % 4]
        origin, names = sent.get("origin", address), {}
        if "host" in sent:
            names["Host"] = sent["host"]
        async with gap:
            where = f"{address.replace('http', 'ws', 1)}/session/{new_client()}"
            offered = ["hrc", f"secret.{secret}"]
            options = {"proxy": None, "open_timeout": 20, "additional_headers": names}
            await refused(connect(where, subprotocols=offered, origin=origin, **options))
            if secret == token and "host" not in sent:
                secret = "x"  # no other site knows it, and browsers show it to none
            status = await asyncio.to_thread(
                fetch, {"Authorization": f"Bearer {secret}", "Origin": origin, **names}
            )
            assert status in (401, 403, 429), status

    await asyncio.gather(*map(come, range(count)))


class Leader:
    """Somebody who leads well: pulls the elbow up and gives signs of life."""

    def __init__(self, page: Page):
        self._page = page
        self.leads = asyncio.Event()
        self.silent = False

    async def run(self) -> None:
        async with socket(self._page) as one:
            listening = asyncio.create_task(self._listen(one))
            await one.send('{"type": "hands", "grips": []}')
            try:
                while True:
                    if not self.silent:
                        await one.send(BEAT)
                        await one.send(hands())
                    await asyncio.sleep(0.03)
            finally:
                listening.cancel()

    async def _listen(self, one) -> None:
        async for raw in one:
            status = json.loads(raw).get("status", {})
            if status.get("role") == "leads":
                self.leads.set()


async def siege(page: Page, kinds, seed: int, at_once: int = 6) -> None:
    """Clients of these kinds, some at a time, while somebody leads on."""
    leader = Leader(page)
    leading = asyncio.create_task(leader.run())
    await asyncio.wait_for(leader.leads.wait(), 20)
    gap = asyncio.Semaphore(at_once)

    async def one(k: int, kind: str) -> None:
        async with gap:
            rng = np.random.default_rng([seed, k])
            with suppress(ConnectionClosed, ConnectionError):  # thrown out
                await asyncio.wait_for(attack(page, kind, rng), 60)

    await asyncio.gather(*(one(k, kind) for k, kind in enumerate(kinds)))
    assert not leading.done(), leading.exception()
    assert page.control.present
    leading.cancel()


def time_to_rest(page: Page, asked) -> float:
    """How long an effort outlives the client that asks for it and vanishes [s]."""

    async def go() -> float:
        leader = Leader(page)
        leading = asyncio.create_task(leader.run())
        await asyncio.wait_for(leader.leads.wait(), 20)
        while not asked().effort(7).any():
            await asyncio.sleep(0.002)
        # Its network is gone: nothing is closed, nothing comes any more.
        leader.silent, gone = True, time.monotonic()
        try:
            return await asyncio.to_thread(_until_rest, asked, gone)
        finally:
            leading.cancel()

    return asyncio.run(go())


def _until_rest(asked, gone: float) -> float:
    while asked().effort(7).any():
        if time.monotonic() - gone > 10:
            raise AssertionError("the effort stays")
        time.sleep(0.001)
    return time.monotonic() - gone
