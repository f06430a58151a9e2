"""Damaged requests and messages: refused in one line or understood, and no client notices."""

import asyncio
import contextlib
import json
import logging
import math
import random

import msgspec
import pytest
from hostile_clients import (
    BEAT,
    DRAG,
    hands,
    http,
    new_client,
    packed,
    socket,
    until_closed,
    viewer,
)
from page_in_browser import Session
from test_mutated_files import mutated
from websockets.exceptions import ConnectionClosed

from hrc_learn.teleoperation.gate.messages import (
    MessageError,
    curation_message,
    session_message,
    view_message,
)

pytest.importorskip("viser", reason="the extra `ui` is not installed")

PATIENCE = 20.0
"""Time after which an answer hangs [s]."""
POSE = {"position": [0.3, 0.1, 0.2], "orientation": [1.0, 0.0, 0.0, 0.0]}
BOX = {"centre": [0.3, 0.4, 0.2], "half_size": [0.1, 0.1, 0.1]}
ANSWERS = b"none 101 200 400 401 403 404 405 426 429 431".split()
"""Statuses of answers; a fault of ours is 500."""
SESSION = (
    BEAT,
    hands(),
    '{"type": "hello", "wants": "scene"}',
    '{"type": "lead", "wish": "hand_over"}',
    '{"type": "ask", "request": "stop"}',
    '{"type": "task", "task": "show it"}',
    '{"type": "gripper", "width": 0.04}',
    '{"type": "target", "point": [0.3, 0.4, 0.2]}',
    json.dumps({"type": "region", **BOX, "active": False}),
    json.dumps({"type": "hands", "grips": [], "tracked": [{"hand": "left", **POSE}]}),
)
CURATION = (
    '{"type": "decide", "episode": 3, "verdict": "cut", "start": 4, "stop": 60}',
    '{"type": "write"}',
)
VIEW = (
    packed("SceneNodeDragMessage", phase="start", **DRAG),
    packed("GuiUpdateMessage", uuid="none", updates={"value": 0.5}),
    packed(
        "TransformControlsUpdateMessage",
        name="/end_effector",
        wxyz=(1.0, 0.0, 0.0, 0.0),
        position=(0.3, 0.0, 0.5),
    ),
    packed("CommandTriggerMessage", uuid="none"),
)


def plain(message):
    """All numbers of a message."""
    if isinstance(message, dict):
        message = list(message.values())
    if isinstance(message, list | tuple):
        return [number for part in message for number in plain(part)]
    return [message] if isinstance(message, int | float) else []


@pytest.mark.parametrize(
    ("decode", "sound"),
    [(session_message, SESSION), (curation_message, CURATION), (view_message, VIEW)],
)
def test_messages_are_refused_or_have_finite_numbers(decode, sound):
    rng, refused = random.Random(len(sound)), 0
    for number in range(600):
        original = sound[number % len(sound)]
        mutant = mutated(original if isinstance(original, bytes) else original.encode(), rng)
        try:
            message, words = decode(mutant), ""
        except MessageError as error:
            message, words = None, str(error)
        assert "\n" not in words, mutant
        assert all(map(math.isfinite, plain(msgspec.to_builtins(message)))), mutant
        refused += bool(words)
    assert refused > 200


def request(path: str, *headers: str) -> str:
    return "\r\n".join([f"GET {path} HTTP/1.1", *headers, "", ""])


def requests(page) -> list[str]:
    """Sound requests of a client with its secret."""
    host, token = f"Host: 127.0.0.1:{page.address.port}", page.address.token
    upgrade = (
        *("Upgrade: websocket", "Connection: Upgrade", f"Origin: {page.address.origin}"),
        *("Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="),
        f"Sec-WebSocket-Protocol: hrc, secret.{token}",
    )
    return [
        request("/", host),
        request("/xr/scene.json", host, f"Authorization: Bearer {token}"),
        request(f"/session/{new_client()}", host, *upgrade),
        request(f"/view/{new_client()}", host, *upgrade),
    ]


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    with Session(
        tmp_path_factory.mktemp("page") / "demos", silence=2.0, timeout=4.0
    ) as session:
        yield session


def test_leaders_watchers_and_headsets_have_a_link_each(session):
    page = session.page
    origin, address = page.address.origin, page.address
    assert page.url == f"{origin}/#token={address.token}"
    assert page.watch_url == f"{origin}/#token={address.watch_token}"
    assert page.headset_url == f"{origin}/xr#token={address.token}"
    assert http(page, "/xr")[0] == 200


async def ask(page, raw: bytes, *, ends: bool = True) -> bytes:
    """Answer to a request that then ends; empty where the server closes without one."""
    reader, writer = await asyncio.open_connection("127.0.0.1", page.address.port)
    try:
        writer.write(raw)
        if ends:
            writer.write_eof()
        return await asyncio.wait_for(reader.read(64), PATIENCE)
    except ConnectionError:
        return b""
    finally:
        writer.transport.abort()


async def tell(page, kind: str, raw: bytes) -> None:
    """Say something that is damaged, as the client that leads."""
    if kind == "session":
        async with socket(page) as one:
            text = raw.decode(errors="surrogateescape")
            await one.send(text if text.isprintable() else raw)
            await one.send(b"\xff")  # the end of any conversation
            await asyncio.wait_for(until_closed(one), PATIENCE)
    else:
        async with viewer(page) as (_, one):
            await one.send(raw)
            await one.send(b"\xc1")
            await asyncio.wait_for(until_closed(one), PATIENCE)


async def onslaught(page, count: int, seed: int) -> None:
    """Send damaged requests and messages one after the other, while somebody watches."""
    rng, sound = random.Random(seed), requests(page)
    async with socket(page, secret=page.address.watch_token) as bystander:
        for number in range(count):
            kind = ("http", "session", "view")[number % 3]
            if kind == "http":
                mutant = mutated(rng.choice(sound).encode(), rng)
                answer = await ask(page, mutant)
                status = answer[9:12] if answer.startswith(b"HTTP/1.1 ") else b"none"
                assert status in ANSWERS, (mutant, answer)
            else:
                mutant = rng.choice(VIEW if kind == "view" else [m.encode() for m in SESSION])
                with contextlib.suppress(ConnectionClosed):
                    await tell(page, kind, mutated(mutant, rng))
            async with asyncio.timeout(PATIENCE):
                await bystander.recv()
    assert http(page, "/")[0] == 200
    assert page.alive


@pytest.fixture
def no_traceback(caplog):
    """No part of the program logs an exception during a test."""
    with caplog.at_level(logging.ERROR):
        yield
    raised = [record for record in caplog.records if record.exc_info]
    assert not raised, [record.getMessage() for record in raised]


@pytest.mark.usefixtures("no_traceback")
@pytest.mark.parametrize("name", ["Host", "Upgrade", "Authorization", "Origin"])
def test_requests_that_repeat_a_header_are_refused(session, name):
    for sound in requests(session.page)[1:3]:
        lines = sound.split("\r\n")
        repeated = [line for line in lines for _ in range(1 + line.startswith(name))]
        if repeated != lines:
            answer = asyncio.run(ask(session.page, "\r\n".join(repeated).encode(), ends=False))
            assert answer[9:12] == b"400"


@pytest.mark.long
@pytest.mark.usefixtures("no_traceback")
def test_a_page_lives_on_after_damaged_messages(session):
    asyncio.run(onslaught(session.page, 42, seed=0))


@pytest.mark.slow
@pytest.mark.usefixtures("no_traceback")
def test_a_page_lives_on_after_many_damaged_messages(session):
    asyncio.run(onslaught(session.page, 402, seed=1))


@pytest.mark.usefixtures("no_traceback")
@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text.replace("GET /", "GET http://[", 1),
        lambda text: text.replace("Host: 127.0.0.1", "Host: evil.example"),
        lambda text: text.replace("Host:", "Host: 127.0.0.1\r\nHost:"),
        lambda text: text.replace("Bearer ", "Bearer \xff"),
        lambda text: text.replace("secret.", "secret.\xff"),
        lambda text: text.replace("Origin: http", "Origin: \xff"),
        lambda text: text.replace("Key: ", "Key: \xff"),
        lambda text: text.replace("GET /", "GET /../", 1),
    ],
)
def test_damage_of_each_kind_is_refused(session, damage):
    sound = requests(session.page)
    for text in sound:
        if (wrong := damage(text)) != text:
            answer = asyncio.run(ask(session.page, wrong.encode("latin-1"), ends=False))
            assert answer == b"" or answer[9:10] == b"4", answer
