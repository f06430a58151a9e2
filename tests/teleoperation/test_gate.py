"""Who leads, what may be said, and at which address."""

import json
import math
import ssl
import subprocess
import sys
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import ProxyHandler, Request, build_opener

import cv2
import msgspec
import numpy as np
import pytest

from hrc_learn.teleoperation.gate import Content, Gate, address, qr_code
from hrc_learn.teleoperation.gate.address import (
    Address,
    AddressConfig,
    listening_socket,
    network_name,
    tls_context,
)
from hrc_learn.teleoperation.gate.admission import Admission, Bucket, RefusedError
from hrc_learn.teleoperation.gate.messages import (
    Hands,
    MessageError,
    acts,
    session_message,
    view_message,
)
from hrc_learn.teleoperation.page import PageConfig, slow_words
from hrc_learn.teleoperation.page_sockets import Control


class Clock:
    time = 0.0

    def __call__(self):
        return self.time


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def control(clock):
    return Control(silence=0.15, timeout=0.6, clock=clock)


def test_the_first_to_come_leads_and_the_others_watch(control):
    control.join("a")
    control.join("b")
    assert control.view("a")["role"] == "leads"
    assert control.view("b")["role"] == "watches"
    assert control.act("a")
    assert not control.act("b")


def test_signs_of_life_carry_motion_and_silence_ends_it(control, clock):
    assert not control.present
    control.join("a")
    for _ in range(20):
        clock.time += 0.14
        assert control.present
        control.hear("a")
    clock.time += 0.16
    assert not control.present
    assert not control.gone
    control.hear("a")
    assert control.present
    clock.time += 0.61
    assert control.gone


def test_what_slowed_the_leader_down_is_told_for_a_while(control, clock):
    config = PageConfig(silence=0.15, timeout=0.6)
    control.join("a")
    for _ in range(20):
        clock.time += 0.04
        control.hear("a")
    assert slow_words(*control.slow, config) == ""
    clock.time += 0.4
    control.hear("a")
    assert "nothing was heard of this browser for 0.40 s" in slow_words(*control.slow, config)
    control.hear("a", lag=0.35)
    assert "busy for 0.3" in slow_words(*control.slow, config)
    for _ in range(31):
        clock.time += 0.1
        control.hear("a")
    assert slow_words(*control.slow, config) == ""
    control.leave("a")
    assert control.slow == (0.0, 0.0)


def test_a_page_that_hangs_behind_a_worker_that_beats_is_gone(control):
    control.join("a")
    control.hear("a", lag=0.59)
    assert control.present
    control.hear("a", lag=0.61)
    assert not control.present
    assert control.gone


def test_another_persons_signs_of_life_do_not_count(control, clock):
    control.join("a")
    control.join("b")
    clock.time += 0.2
    control.hear("b")
    assert not control.present


def test_control_is_handed_over_to_who_asked_first(clock):
    changes = []
    control = Control(0.15, 0.6, lambda: changes.append(1), clock)
    for client in "abc":
        control.join(client)
    assert len(changes) == 1
    control.ask("c")
    clock.time += 1.0
    control.ask("b")
    assert control.view("a")["asked"]
    assert control.view("c")["asked"]
    control.hand_over("b")  # does not lead
    assert len(changes) == 1
    control.hand_over("a")
    assert control.act("c")
    assert len(changes) == 2
    assert not control.act("a")
    assert control.view("c")["asked"]  # b still waits


def test_who_does_nothing_keeps_others_waiting_for_so_long(control, clock):
    control.join("a")
    control.join("b")
    clock.time = 20.0  # being idle before anybody asked does not count
    control.ask("b")
    clock.time += 9.9
    control.act("a", idle=True)
    assert control.view("b")["role"] == "watches"
    clock.time += 0.2
    assert control.view("b")["role"] == "leads"


@pytest.mark.parametrize("deed", ["act", "keep"])
def test_nobody_takes_control_in_the_middle_of_a_drag(control, clock, deed):
    control.join("a")
    control.join("b")
    control.ask("b")
    for _ in range(20):
        clock.time += 9.0
        control.act("a") if deed == "act" else control.keep()
        assert not control.act("b")


def test_who_leaves_leads_no_more(control):
    for client in "abd":
        control.join(client)
    control.leave("a")
    assert control.gone
    assert not control.view("b")["taken"]  # nobody of several leads unasked
    control.ask("b")
    assert control.view("b")["role"] == "leads"
    control.join("c")
    control.ask("c")
    control.leave("b")
    assert control.view("c")["role"] == "leads"
    control.leave("c")
    assert control.view("d")["role"] == "leads"  # alone


def test_times_make_sense():
    with pytest.raises(ValueError, match="silence must be positive"):
        Control(silence=1.0, timeout=0.5)


def test_a_bucket_lets_bursts_through_and_no_more_than_its_rate(clock):
    bucket = Bucket(rate=10.0, burst=5.0, clock=clock)
    assert [bucket.take() for _ in range(6)] == [True] * 5 + [False]
    passed = 0
    for _ in range(1000):
        clock.time += 0.01
        passed += bucket.take()
    assert passed == pytest.approx(100, abs=1)


def test_hands_are_understood():
    grip = {"hand": "left", "joint": 4, "start": [0.1, 0, 0.2], "pointer": [0.1, 0.2, 0.3]}
    end = {"hand": "right", "joint": None, "start": [0, 0, 0], "pointer": [0, 0, 1]}
    message = session_message(json.dumps({"type": "hands", "grips": [grip, end], "sent": 3.5}))
    assert isinstance(message, Hands)
    assert message.grips[0].pointer == (0.1, 0.2, 0.3)
    assert message.grips[1].joint is None
    assert message.sent == 3.5
    with pytest.raises(MessageError, match="one thing"):
        session_message(json.dumps({"type": "hands", "grips": [grip, grip]}))
    turned = {**end, "orientation": [1, 1, 0, 0]}
    with pytest.raises(MessageError, match="unit quaternion"):
        session_message(json.dumps({"type": "hands", "grips": [turned]}))


@pytest.mark.parametrize("length", [0.998, 0.9995, 1.0005, 1.002])
def test_orientations_are_unit_quaternions_to_single_precision(length):
    end = {"hand": "right", "joint": None, "start": [0, 0, 0], "pointer": [0, 0, 1]}
    raw = json.dumps({"type": "hands", "grips": [end | {"orientation": [0, length, 0, 0]}]})
    if abs(length - 1) < 1e-3:
        assert session_message(raw).grips[0].orientation[1] == length
    else:
        with pytest.raises(MessageError, match="unit quaternion"):
            session_message(raw)


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_no_number_is_let_through_that_is_none(number):
    fields = {"name": "/region", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, number, 0.0)}
    raw = msgspec.msgpack.encode({"type": "TransformControlsUpdateMessage", **fields})
    with pytest.raises(MessageError, match="position"):
        view_message(raw)


def test_looking_around_acts_on_nothing():
    stored = {"request_uuid": "7", "value": None, "error": None}
    used = {"uuid": "7"}
    for tag, content, acting in (
        ("LocalStorageGetItemResponseMessage", stored, False),
        ("CommandTriggerMessage", used, True),
    ):
        raw = msgspec.msgpack.encode({"type": tag} | content)
        assert acts(view_message(raw)) == acting


def test_an_address_is_ours_alone_unless_asked_for():
    assert AddressConfig().local
    assert AddressConfig(host="localhost").local
    assert not AddressConfig(host="0.0.0.0").local
    assert tls_context(AddressConfig()) is None
    assert network_name(AddressConfig(host="192.0.2.7")) == "192.0.2.7"
    assert network_name(AddressConfig(host="0.0.0.0", name="arm.local")) == "arm.local"
    one, other = (Address(scheme="http", host="::1", port=8080) for _ in range(2))
    assert one.origin == "http://[::1]:8080"
    assert one.token != other.token
    assert one.token not in repr(one)
    assert one.link("/xr") == f"http://[::1]:8080/xr#token={one.token}"
    assert one.watch_token in one.link(watch=True)
    assert one.token not in one.link(watch=True)


def test_what_cannot_be_served_is_refused():
    assert AddressConfig(port=65535, most_clients=1).port == 65535
    with pytest.raises(ValueError, match="most_clients must be at least 1"):
        AddressConfig(most_clients=0)
    for port in (65536, -1):
        with pytest.raises(ValueError, match="port must be 0 to 65535"):
            AddressConfig(port=port)
    with pytest.raises(ValueError, match="given together"):
        AddressConfig(certificate=Path(__file__))
    with pytest.raises(ValueError, match=r"192\.0\.2\.1 is no address of this"):
        listening_socket(AddressConfig(host="192.0.2.1"))


def test_a_port_in_use_is_refused_and_without_one_the_next_free_is_taken():
    with listening_socket(AddressConfig()) as one:
        port = one.getsockname()[1]
        with pytest.raises(
            ValueError, match=f"port {port} of 127.0.0.1 is in use; give another"
        ):
            listening_socket(AddressConfig(port=port))
        with listening_socket(AddressConfig()) as other:
            assert other.getsockname()[1] > port
    with listening_socket(AddressConfig(port=0)) as any_free:
        assert any_free.getsockname()[1] > 1023


def test_a_page_on_the_network_has_a_certificate_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    config = AddressConfig(host="0.0.0.0", name="arm.local")
    assert isinstance(tls_context(config), ssl.SSLContext)
    folder = tmp_path / "hrc_learn" / "tls"
    made = {file.name: file.read_bytes() for file in folder.iterdir()}
    assert set(made) == {"arm.local.pem", "arm.local.key"}
    assert folder.stat().st_mode & 0o077 == 0
    tls_context(config)  # is used again
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == made
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ValueError, match="install openssl"):
        tls_context(AddressConfig(host="0.0.0.0", name="other.local"))
    (folder / "arm.local.pem").write_text("no certificate")
    with pytest.raises(ValueError, match=r"arm\.local\.pem"):
        tls_context(config)


def test_a_certificate_that_ends_is_made_anew(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(address, "_VALID_DAYS", 2)
    config = AddressConfig(host="0.0.0.0", name="arm.local")
    tls_context(config)
    certificate = tmp_path / "hrc_learn" / "tls" / "arm.local.pem"
    before = certificate.read_bytes()
    tls_context(config)
    assert certificate.read_bytes() != before


@pytest.mark.parametrize(("name", "kind"), [("192.0.2.7", "IP Address"), ("arm.local", "DNS")])
def test_a_certificate_names_its_page_and_is_served_where_it_is_given(
    tmp_path, monkeypatch, name, kind
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    tls_context(AddressConfig(host="0.0.0.0", name=name))
    folder = tmp_path / "hrc_learn" / "tls"
    pem, key = folder / f"{name}.pem", folder / f"{name}.key"
    shown = subprocess.run(
        ["openssl", "x509", "-noout", "-dates", "-ext", "subjectAltName", "-in", str(pem)],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert f"{kind}:{name}" in shown
    begins, ends = (
        ssl.cert_time_to_seconds(line.split("=")[1]) for line in shown.splitlines()[:2]
    )
    assert 790 <= (ends - begins) / 86400 <= 825
    # Given by name, it is served even to this machine alone, and nothing is made.
    own = {file: file.rename(tmp_path / file.name) for file in (pem, key)}
    context = tls_context(AddressConfig(certificate=own[pem], key=own[key]))
    assert isinstance(context, ssl.SSLContext)
    assert not list(folder.iterdir())
    with pytest.raises(ValueError, match=r"certificate .* with key"):
        tls_context(AddressConfig(certificate=own[key], key=own[pem]))


def test_every_address_is_reached_by_the_one_that_goes_out():
    name = network_name(AddressConfig(host="0.0.0.0"))
    assert name == network_name(AddressConfig(host="::"))
    assert name not in ("0.0.0.0", "::", "")


NO_TEXT = b"\xff".decode("ascii", "surrogateescape")
"""As headers come that hold other bytes."""


def test_hosts_and_origins_are_exact():
    admission = Admission(AddressConfig(), 8080, tls=False)
    for host in ("127.0.0.1:8080", "LOCALHOST:8080", "[::1]:8080"):
        assert admission.is_ours(host)
        assert admission.from_ours(f"http://{host.lower()}")
        assert not admission.from_ours(f"https://{host.lower()}")
    for host in ("127.0.0.1", "localhost", "localhost:80", "[abc", "", "x@localhost:8080"):
        assert not admission.is_ours(host)
        assert not admission.from_ours(f"http://{host}")
    # Browsers leave the default port out.
    default = Admission(AddressConfig(), 443, tls=True)
    assert default.from_ours("https://localhost")
    assert default.is_ours("localhost:443")
    assert not default.from_ours("http://localhost")


def test_each_secret_has_its_right_and_wrong_ones_are_counted():
    admission = Admission(AddressConfig(), 8080, tls=False)
    assert admission.right(admission.address.token) == "act"
    assert admission.right(admission.address.watch_token) == "watch"
    codes = []
    for secret in ["", NO_TEXT, *["wrong"] * 30]:
        with pytest.raises(RefusedError) as refused:
            admission.right(secret)
        codes.append(refused.value.code)
    assert codes[:3] == [401, 403, 403]
    assert codes[-1] == 429
    assert admission.right(admission.address.token) == "act"


def test_a_gate_whose_thread_fails_says_so_instead_of_waiting(monkeypatch):
    gate = Gate(AddressConfig(port=0), {}, {"session": lambda *_: None})
    monkeypatch.setitem(sys.modules, "websockets.asyncio.server", None)
    with pytest.raises(ImportError, match="websockets"):
        gate.start()
    gate.close()


def test_a_fault_of_a_source_ends_one_request_alone(caplog):
    def data(path: str) -> Content:
        if path == "/broken":
            raise OSError("no such disk")
        return Content(body=path.encode(), kind="text/plain")

    gate = Gate(AddressConfig(port=0), {}, {"session": lambda *_: None}, data)
    gate.start()
    try:
        secret = {"Authorization": f"Bearer {gate.address.token}"}

        def answer(path: str) -> tuple[int, bytes]:
            request = Request(gate.address.origin + path, headers=secret)
            try:
                with build_opener(ProxyHandler({})).open(request, timeout=30) as got:
                    return got.status, got.read()
            except HTTPError as refused:
                return refused.code, refused.read()

        assert answer("/broken") == (500, b"OSError: no such disk\n")
        assert "/broken failed" in caplog.text
        assert answer("/sound") == (200, b"/sound")
    finally:
        gate.close()


def test_a_phone_reads_the_code():
    text = "https://192.0.2.7:8080/xr#token=" + "aB3_-x" * 4
    lines = qr_code(text).splitlines()
    cells = {"█": (1, 1), "▀": (1, 0), "▄": (0, 1), " ": (0, 0)}
    rows = [[cells[cell][half] for cell in line] for line in lines for half in (0, 1)]
    rows_of_code = len(rows[0]) - 2  # the code is square, with a light column to either side
    assert rows_of_code < len(rows) <= rows_of_code + 2
    assert all(row[0] and row[-1] for row in rows)
    assert all(all(row) for row in rows[rows_of_code:])
    image = np.kron(np.array(rows, np.uint8) * 255, np.ones((6, 6), np.uint8))
    assert cv2.QRCodeDetector().detectAndDecode(image)[0] == text
