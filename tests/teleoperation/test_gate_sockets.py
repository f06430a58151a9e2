"""Requests that the gate answers and sockets that it opens, one condition at a time."""

import asyncio
import base64
import json
import logging
import socket
import threading
from contextlib import contextmanager

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from hrc_learn.teleoperation.gate import AddressConfig, Content, Gate, folder_contents
from hrc_learn.teleoperation.gate import gate as gate_module
from hrc_learn.teleoperation.gate.gate import first_of, incoming
from hrc_learn.teleoperation.gate.messages import MessageError

CLIENT = "c" * 18
LONG = "This is no message: " + "x" * 200


def decoded(raw):
    if raw == "wrong":
        raise MessageError(LONG)
    return raw


async def echo(connection, visitor):
    """Answer each message with the name and the right of its client."""
    async for _, message in incoming(connection, decoded):
        await connection.send(f"{visitor.client} {visitor.right} {message}")


@contextmanager
def served(data=lambda path: None, most_clients=2):
    routes = {"session": echo, "view": echo}
    content = {"/page": Content.of("page.html", b"a page")}
    config = AddressConfig(port=0, most_clients=most_clients)
    gate = Gate(config, content, routes, data)
    gate.start()
    try:
        yield gate
    finally:
        gate.close("goodbye")


@pytest.fixture(scope="module")
def gate():
    with served() as gate:
        yield gate


def status(gate, path, headers):
    """Status of the answer to a request with exactly these headers."""
    head = "".join(f"{name}: {value}\r\n" for name, value in headers)
    with socket.create_connection(("127.0.0.1", gate.address.port), timeout=20) as connection:
        connection.sendall(f"GET {path} HTTP/1.1\r\n{head}\r\n".encode())
        return int(connection.recv(64).split()[1])


def handshake(gate, path=f"/session/{CLIENT}", **changed):
    """Status of the answer to a socket that asks for all that it needs, but for changes."""
    headers = {
        "Host": f"127.0.0.1:{gate.address.port}",
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Origin": gate.address.origin,
        "Key": base64.b64encode(bytes(16)).decode(),
        "Version": "13",
        "Protocol": f"hrc, secret.{gate.address.token}",
    } | changed
    names = {name: f"Sec-WebSocket-{name}" for name in ("Key", "Version", "Protocol")}
    rows = [(names.get(name, name), value) for name, value in headers.items() if value]
    return status(gate, path, rows)


@pytest.mark.parametrize(("length", "code"), [(15, 404), (16, 101), (64, 101), (65, 404)])
def test_clients_draw_names_of_sixteen_to_sixty_four_characters(gate, length, code):
    assert handshake(gate, f"/session/{'c' * length}") == code


def test_a_socket_opens_for_the_right_host_origin_route_and_secret_only(gate):
    token = gate.address.token
    assert handshake(gate, Upgrade="WebSocket") == 101  # in any case (RFC 6455, 4.2.1)
    for offered in (f"secret.{token}", f"hrc,secret.{token}", f"a,  secret.{token} , b"):
        assert handshake(gate, Protocol=offered) == 101
    for offered in ("hrc", "", "secret.", token):
        assert handshake(gate, Protocol=offered) == 401
    assert handshake(gate, Protocol="secret.wrong") == 403
    assert handshake(gate, Origin="") == 403
    assert handshake(gate, Origin="http://example.org") == 403
    assert handshake(gate, Host="") == 403
    assert handshake(gate, f"/none/{CLIENT}") == 404


def test_an_address_with_two_hosts_is_none(gate):
    ours = ("Host", f"127.0.0.1:{gate.address.port}")
    assert status(gate, "/page", [ours]) == 200
    assert status(gate, "/page", []) == 403
    for hosts in ([ours, ours], [ours, ("Host", "example.org")]):
        assert status(gate, "/page", hosts) == 400


def test_data_needs_the_secret_as_a_bearer_and_a_source():
    def data(path):
        return Content.of(path, path.encode())

    with served(data) as full, served() as bare:
        for gate, code in ((full, 200), (bare, 404)):
            host = ("Host", f"127.0.0.1:{gate.address.port}")
            bearer = ("Authorization", f"Bearer {gate.address.token}")
            assert status(gate, "/data", [host, bearer]) == code
            assert status(gate, "/admitted", [host, bearer]) == 200
            for other in ("Basic", "", "bearer"):
                words = ("Authorization", f"{other} {gate.address.token}")
                assert status(gate, "/data", [host, words]) == 401
            assert status(gate, "/data", [host]) == 401


def open_socket(gate, route="session", client=CLIENT, secret=None):
    secret = gate.address.token if secret is None else secret
    return connect(
        f"ws://127.0.0.1:{gate.address.port}/{route}/{client}",
        subprotocols=[f"secret.{secret}", "hrc"],
        origin=gate.address.origin,
        proxy=None,
        open_timeout=20,
    )


def closed(connection):
    """Code and reason with which the gate closes a socket."""
    with pytest.raises(ConnectionClosed) as ended:
        connection.recv(timeout=20)
    assert ended.value.rcvd is not None
    return ended.value.rcvd.code, ended.value.rcvd.reason


def answer(connection, words="hello"):
    connection.send(words)
    return connection.recv(timeout=20)


@pytest.mark.parametrize("right", ["act", "watch"])
def test_a_client_has_the_right_of_its_secret_in_all_its_sockets(gate, right):
    secret = gate.address.token if right == "act" else gate.address.watch_token
    with (
        open_socket(gate, secret=secret) as session,
        open_socket(gate, "view") as view,
    ):
        assert session.subprotocol == "hrc"  # and never the secret, which would be echoed
        assert answer(session) == answer(view) == f"{CLIENT} {right} hello"


def test_a_view_waits_for_the_session_of_its_client(gate):
    answers = []

    def look():
        with open_socket(gate, "view") as view:
            answers.append(answer(view))

    thread = threading.Thread(target=look)
    thread.start()
    threading.Event().wait(0.1)  # the view asks first
    with open_socket(gate):
        thread.join(20)
    assert answers == [f"{CLIENT} act hello"]


def test_a_view_ends_with_the_session_of_its_client_and_with_no_other(gate):
    with (
        open_socket(gate, client="a" * 16) as one,
        open_socket(gate, "view", client="a" * 16) as view,
        open_socket(gate, client="b" * 16) as other,
    ):
        one.close()
        assert closed(view)[0] == 1000
        assert answer(other) == f"{'b' * 16} act hello"


def test_the_last_place_is_given_away_and_no_client_comes_twice():
    with served(most_clients=2) as gate, open_socket(gate, client="a" * 16) as first:
        with open_socket(gate, client="a" * 16) as again:
            assert closed(again)[0] == 1013
        with (
            open_socket(gate, client="b" * 16) as second,
            open_socket(gate, client="d" * 16) as third,
        ):
            assert closed(third)[0] == 1013
            assert answer(first) == f"{'a' * 16} act hello"
            assert answer(second) == f"{'b' * 16} act hello"
        gate.close("goodbye")
        assert json.loads(first.recv(timeout=20)) == {"type": "end", "words": "goodbye"}


def test_a_wrong_message_and_too_many_close_a_socket_with_the_reason(gate, monkeypatch):
    with open_socket(gate) as one:
        one.send("wrong")
        # A reason has at most 123 bytes (RFC 6455, 5.5).
        assert closed(one) == (1008, LONG[:120])
    monkeypatch.setattr(gate_module, "_BURST", 3.0)
    monkeypatch.setattr(gate_module, "_RATE", 1e-3)
    with open_socket(gate) as one:
        for _ in range(3):
            assert answer(one) == f"{CLIENT} act hello"
        one.send("hello")
        assert closed(one) == (1008, "too many messages")


def test_work_ends_with_the_first_that_ends_and_with_its_error():
    ended = []

    async def rest(name):
        try:
            await asyncio.sleep(60)
        finally:
            ended.append(name)

    async def fail():
        raise KeyError("lost")

    async def cleanly():
        await first_of(rest("a"), asyncio.sleep(0), rest("b"))
        return "goes on"

    assert asyncio.run(cleanly()) == "goes on"
    assert sorted(ended) == ["a", "b"]
    with pytest.raises(KeyError, match="lost"):
        asyncio.run(first_of(rest("c"), fail()))
    assert ended[2:] == ["c"]


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("a.js", "text/javascript"),
        ("b.glb", "model/gltf-binary"),
        ("c.png", "image/png"),
        ("d.html", "text/html"),
        ("e.unknown", "application/octet-stream"),
        ("f", "application/octet-stream"),
    ],
)
def test_content_has_the_type_of_its_name(name, kind):
    assert Content.of(name, b"").kind == kind


def test_a_folder_is_served_by_name_and_its_index_as_the_page(tmp_path):
    (tmp_path / "a.js").write_bytes(b"code")
    (tmp_path / "folder").mkdir()
    code = {"/a/a.js": Content(body=b"code", kind="text/javascript")}
    assert folder_contents(tmp_path, "/a/") == code
    (tmp_path / "index.html").write_bytes(b"page")
    page = Content(body=b"page", kind="text/html")
    assert folder_contents(tmp_path, "/a/") == code | {"/a/index.html": page, "/": page}
    assert set(folder_contents(tmp_path)) == {"/static/a.js", "/static/index.html", "/"}


def test_refused_clients_do_not_fill_the_log(gate, caplog):
    logger = logging.getLogger("hrc_learn.gate.sockets")
    with caplog.at_level(logging.DEBUG):
        logger.error("opening handshake failed")
        logger.error("something else")
    assert caplog.messages == ["something else"]
