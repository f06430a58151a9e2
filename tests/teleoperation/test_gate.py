"""Who leads, what may be said, and with which secret."""

import json
import math
import sys
from urllib.error import HTTPError
from urllib.request import ProxyHandler, Request, build_opener

import msgspec
import pytest

from hrc_learn.teleoperation.gate import AddressConfig, Content, Gate
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
    assert "nothing was heard from this browser for 0.40 s" in slow_words(*control.slow, config)
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


def after(time):
    return math.nextafter(time, math.inf)


def test_times_count_up_to_their_very_end(clock):
    control = Control(0.25, 0.5, clock=clock)
    control.join("a")
    for time, present, gone in (
        (0.25, True, False),
        (after(0.25), False, False),
        (0.5, False, False),
        (after(0.5), False, True),
    ):
        clock.time = time
        assert (control.present, control.gone) == (present, gone)
    for lag, present in ((0.5, True), (after(0.5), False)):
        control.hear("a", lag=lag)
        assert (control.present, control.gone) == (present, not present)


@pytest.mark.parametrize(
    ("silence", "lag", "slow"),
    [(0.25, 0.25, False), (after(0.25), 0.0, True), (0.0, after(0.25), True)],
)
def test_slow_is_silence_or_half_of_the_longest_lag_and_is_told_for_three_seconds(
    clock, silence, lag, slow
):
    control = Control(0.25, 0.5, clock=clock)
    assert control.slow == (0, 0)
    control.join("a")
    clock.time = silence
    control.hear("a", lag=lag)
    assert control.slow == ((silence, lag) if slow else (0, 0))
    clock.time = silence + 3.0
    assert control.slow == ((silence, lag) if slow else (0, 0))
    clock.time = after(silence + 3.0)
    assert control.slow == (0, 0)


def test_whoever_asked_first_leads_after_ten_idle_seconds(control, clock):
    for client in "abc":
        control.join(client)
    assert not control.view("b")["asked"]
    for time, client in ((1.0, "b"), (2.0, "c"), (3.0, "b"), (3.0, "a"), (3.0, "nobody")):
        clock.time = time
        control.ask(client)
    clock.time = 10.5
    assert control.act("a", idle=True)
    clock.time = 11.0
    assert control.act("b")
    control.hand_over("b")
    control.hand_over("c")  # nobody has asked
    assert not control.view("a")["taken"]
    control.ask("a")  # it is free
    assert control.view("a") == {
        "role": "leads",
        "taken": True,
        "asked": False,
        "may_lead": True,
    }


def test_clients_that_only_watch_never_lead(control):
    control.join("a", may_lead=False)
    control.hear("nobody")
    nothing = {"role": "watches", "taken": False, "asked": False}
    assert control.view("a") == nothing | {"may_lead": False}
    assert control.view("nobody") == nothing | {"may_lead": False}
    control.join("b")
    control.ask("a")
    assert not control.view("b")["asked"]
    control.leave("b")
    assert not control.view("a")["taken"]
    control.leave("nobody")
    assert control.people == 1


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


def test_a_bucket_fills_at_its_rate_up_to_its_burst(clock):
    bucket = Bucket(rate=0.25, burst=2.0, clock=clock)
    assert [bucket.take() for _ in range(3)] == [True, True, False]
    clock.time += 3.75
    assert not bucket.take()
    clock.time += 0.25  # a whole token, in two parts
    assert [bucket.take(), bucket.take()] == [True, False]
    clock.time += 100.0
    assert [bucket.take() for _ in range(3)] == [True, True, False]


def test_hands_are_understood():
    grip = {"hand": "left", "joint": 4, "start": [0.1, 0, 0.2], "pointer": [0.1, 0.2, 0.3]}
    end = {"hand": "right", "joint": None, "start": [0, 0, 0], "pointer": [0, 0, 1]}
    message = session_message(json.dumps({"type": "hands", "grips": [grip, end], "sent": 3.5}))
    assert isinstance(message, Hands)
    assert message.grips[0].pointer == (0.1, 0.2, 0.3)
    assert message.grips[1].joint is None
    assert message.sent == 3.5
    with pytest.raises(MessageError, match="listed only once"):
        session_message(json.dumps({"type": "hands", "grips": [grip, grip]}))
    turned = {**end, "orientation": [1, 1, 0, 0]}
    with pytest.raises(MessageError, match="unit quaternion"):
        session_message(json.dumps({"type": "hands", "grips": [turned]}))


@pytest.mark.parametrize("length", [0.9989, 0.9991, 1.0009, 1.0011])
def test_orientations_are_unit_quaternions_to_single_precision(length):
    end = {"hand": "right", "joint": None, "start": [0, 0, 0], "pointer": [0, 0, 1]}
    raw = json.dumps({"type": "hands", "grips": [end | {"orientation": [0, length, 0, 0]}]})
    if abs(length - 1) < 1e-3:
        assert session_message(raw).grips[0].orientation[1] == length
    else:
        with pytest.raises(MessageError, match="unit quaternion"):
            session_message(raw)


def test_fields_that_no_schema_names_are_refused():
    assert session_message('{"type": "beat", "lag": 0.5}').lag == 0.5
    with pytest.raises(MessageError, match="unknown field `more`"):
        session_message('{"type": "beat", "lag": 0.5, "more": 1}')


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


def test_names_of_hosts_have_no_case():
    admission = Admission(AddressConfig(host="0.0.0.0", name="Arm.Local"), 8080, tls=True)
    assert admission.address.origin == "https://Arm.Local:8080"
    for name in ("arm.local", "Arm.Local"):
        assert admission.is_ours(f"{name}:8080")
        assert admission.from_ours(f"https://{name}:8080")


def test_each_secret_has_its_right_and_wrong_ones_are_counted():
    admission = Admission(AddressConfig(), 8080, tls=False)
    assert admission.right(admission.address.token) == "act"
    assert admission.right(admission.address.watch_token) == "watch"
    codes = []
    for secret in ["", NO_TEXT, *["wrong"] * 30]:
        with pytest.raises(RefusedError) as refused:
            admission.right(secret)
        codes.append(refused.value.code)
    assert codes == [401] + [403] * 20 + [429] * 11
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
