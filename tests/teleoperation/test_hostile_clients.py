"""Whoever comes to the page without being wanted: nothing moves, and the page lives."""

import asyncio
import json
import math
import threading
import time
from contextlib import contextmanager, nullcontext

import numpy as np
import pytest
from clean_sets import write_set
from hostile_clients import (
    ATTACKS,
    BEAT,
    FOREIGN,
    HOSTS,
    VISER,
    hands,
    http,
    new_client,
    packed,
    refused,
    siege,
    socket,
    storm,
    until_closed,
    viewer,
)
from page_in_browser import Session, wait_until
from websockets.asyncio.client import connect

from hrc_learn.demos.quality.ranking import rank_episodes
from hrc_learn.teleoperation import dashboard_page
from hrc_learn.teleoperation.curation_page import CurationPage
from hrc_learn.teleoperation.dashboard_page import serve_recordings
from hrc_learn.teleoperation.gate import AddressConfig

pytest.importorskip("viser", reason="the extra `ui` is not installed")


REGION = {"centre": [0.35, 0.45, 0.22], "half_size": [0.1, 0.1, 0.1], "active": False}


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    # Generous times, for a machine that is busy with other tests.
    with Session(
        tmp_path_factory.mktemp("page") / "demos", silence=2.0, timeout=4.0
    ) as session:
        yield session


def besieged(session, kinds, seed=0):
    """Besiege the page, and see that only its leader's efforts arrived."""
    seen = []
    read = session.page.human.read

    def noted(state):
        seen.append(read(state))
        return seen[-1]

    session.page.human.read = noted
    try:
        asyncio.run(siege(session.page, kinds, seed))
    finally:
        session.page.human.read = read
    assert session.page.alive
    assert not any(asked.requests for asked in seen)
    assert all(asked.gripper is None and asked.region is None for asked in seen)
    assert not any(asked.twist.any() for asked in seen)
    pulled = [asked for asked in seen if asked.effort(7).any()]
    # The leader pulls the elbow up: joint 5 and later are not concerned.
    assert len(pulled) > len(seen) // 2
    assert all(not asked.effort(7)[4:].any() for asked in pulled)
    wait_until(lambda: session.page.control.people == 0, "everybody gone")
    wait_until(lambda: not session.asked.effort(7).any(), "rest")


@pytest.mark.long
def test_one_of_each_kind_changes_nothing(session):
    besieged(session, ATTACKS)
    assert http(session.page, "/")[0] == 200


@pytest.mark.slow
def test_two_hundred_change_nothing(session):
    rng = np.random.default_rng(7)
    kinds = [ATTACKS[k % len(ATTACKS)] for k in range(200)]
    besieged(session, [kinds[k] for k in rng.permutation(200)], seed=1)
    assert http(session.page, "/")[0] == 200


def besiege_door(url, data, count):
    """Two hundred come from elsewhere while somebody watches who may."""

    async def go():
        address, _, token = url.partition("/#token=")
        where = f"{address.replace('http', 'ws')}/session/{new_client()}"
        options = {"subprotocols": ["hrc", f"secret.{token}"], "origin": address, "proxy": None}
        async with connect(where, **options) as bystander:
            watching = asyncio.create_task(until_closed(bystander))
            await storm(url, data, count)
            await asyncio.wait_for(await bystander.ping(), 20)
            watching.cancel()

    asyncio.run(go())


def doors(name, session, tmp_path):
    """Address of a page and a path of its data, and what must not change."""
    if name == "page":
        return nullcontext((session.page.url, "/xr/scene.json", lambda: session.asked.gripper))
    if name == "dashboard":
        (tmp_path / "run.rrd").write_bytes(b"a recording")
        served = serve_recordings([tmp_path / "run.rrd"], 0)
        return _with(served, lambda url: (url, "/admitted", lambda: None))
    root = write_set(tmp_path / "set", "v3.0")
    page = CurationPage(rank_episodes(root), tmp_path / "out", AddressConfig(port=0))
    return _with(page, lambda page: (page.url, "/data/state", lambda: dict(page.decisions)))


@contextmanager
def _with(opened, describe):
    with opened as one:
        yield describe(one)


@pytest.mark.parametrize("name", ["page", "dashboard", "curation"])
@pytest.mark.parametrize("count", [20, pytest.param(200, marks=pytest.mark.slow)])
def test_clients_from_elsewhere_reach_no_door(name, count, session, tmp_path, monkeypatch):
    monkeypatch.setattr(dashboard_page, "_viewer_contents", dict)
    with doors(name, session, tmp_path) as (url, data, state):
        before = state()
        besiege_door(url, data, count)
        assert state() == before
    wait_until(lambda: session.page.control.people == 0, "everybody gone")


def test_data_opens_to_those_who_have_a_secret(session):
    page = session.page
    for secret in (page.address.token, page.address.watch_token):
        assert http(page, "/admitted", secret=secret)[0] == 200
    assert http(page, "/admitted")[0] == 401
    assert http(page, "/admitted", secret="wrong")[0] == 403
    assert http(page, "/static/../gate.py", secret=page.address.token)[0] == 404
    # The page itself is public: it is what keeps the secret that comes in the fragment.
    status, headers, body = http(page, "/")
    assert status == 200
    assert body.index(b"/static/door.js") < body.index(b"/static/session.js")
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    assert "Set-Cookie" not in headers


@pytest.mark.parametrize("host", HOSTS)
def test_a_foreign_name_opens_nothing(session, host):
    assert http(session.page, "/", secret=session.page.address.token, Host=host)[0] == 403


@pytest.mark.parametrize("origin", FOREIGN)
def test_a_foreign_site_opens_no_socket(session, origin):
    for route in ("session", "view"):
        asyncio.run(refused(socket(session.page, route, origin=origin), codes=(403,)))


def test_a_view_needs_the_session_of_its_client(session):
    asyncio.run(refused(socket(session.page, "view"), codes=(401,)))


def test_a_watcher_leads_at_no_time(session, monkeypatch):
    page, openings = session.page, []
    monkeypatch.setattr(page.human, "grip", openings.append)

    async def watch(secret):
        async with socket(page, secret=secret) as one:
            await one.send(json.dumps({"type": "lead", "wish": "ask"}))
            await one.send(json.dumps({"type": "gripper", "width": 0.0}))
            await one.send(hands())
            states = [json.loads(await one.recv())["status"] for _ in range(3)]
        return states[-1]

    told = asyncio.run(watch(page.address.watch_token))
    assert (told["role"], told["taken"], told["may_lead"]) == ("watches", False, False)
    assert openings == []
    assert asyncio.run(watch(page.address.token))["role"] == "leads"
    assert openings == [0.0]


def test_an_error_of_ours_closes_that_client_only(session, monkeypatch):
    page = session.page

    async def go():
        async with socket(page) as leader, socket(page) as other:
            await leader.recv(), await other.recv()
            monkeypatch.setattr(page._sockets, "_heard", lambda message: 1 / 0)
            await leader.send(json.dumps({"type": "gripper", "width": 0.0}))
            await until_closed(leader)
            await other.recv()
            return leader.close_code

    assert asyncio.run(go()) == 1011
    assert page.alive


def test_a_picture_that_fails_does_not_end_the_page(session, monkeypatch):
    page, failures = session.page, []

    def fail(*_):
        failures.append(1)
        raise RuntimeError("deque mutated during iteration")

    monkeypatch.setattr(page._scene, "move", fail)
    wait_until(lambda: len(failures) >= 3, "failing pictures")
    monkeypatch.undo()
    assert page.alive


def test_viser_is_touched_in_its_own_loop_while_many_watch(session, monkeypatch):
    """24 watchers and a leader: viser's queues break if another thread pushes into them."""
    from viser.infra._async_message_buffer import AsyncMessageBuffer

    page, threads, delays = session.page, set(), []
    push = AsyncMessageBuffer.push

    def noted(buffer, message):
        threads.add(threading.current_thread())
        push(buffer, message)

    monkeypatch.setattr(AsyncMessageBuffer, "push", noted)

    async def watch():
        async with viewer(page) as (one, view):
            drain = asyncio.create_task(until_closed(view))
            await one.send(json.dumps({"type": "hello", "wants": "scene"}))
            states = 0
            while states < 6:
                states += bool(json.loads(await one.recv()).get("scene"))
            drain.cancel()

    async def lead(stop):
        async with viewer(page) as (one, view):
            drain = asyncio.create_task(until_closed(view))
            await one.send(json.dumps({"type": "region", **REGION}))
            while not stop.is_set() or len(delays) < 6:
                sent = time.monotonic()
                side = 0.1 * math.sin(5 * sent)
                grips = json.loads(hands(pointer=(0.3, side, 0.9)))["grips"]
                await one.send(BEAT)
                await one.send(json.dumps({"type": "hands", "grips": grips, "sent": sent}))
                while (told := json.loads(await one.recv())).get("status") is None:
                    pass
                if told["status"]["sent"]:
                    delays.append(time.monotonic() - told["status"]["sent"])
            drain.cancel()

    async def go():
        stop = asyncio.Event()
        leading = asyncio.create_task(lead(stop))
        await asyncio.sleep(0.3)
        # As long as it takes: a busy machine shows fewer states a second.
        async with asyncio.timeout(30):
            await asyncio.gather(*(watch() for _ in range(24)))
        stop.set()
        await leading

    asyncio.run(go())
    assert page.alive
    assert len(threads) == 1, threads
    wait_until(lambda: page.control.people == 0, "everybody gone")


@pytest.mark.parametrize("value", [-100.0, 1e9, True, "strong"])
def test_a_control_takes_only_what_it_offers(session, value):
    page, before = session.page, session.page._panel.forces
    uuid = page._panel._strength._impl.uuid

    async def set_strength():
        async with viewer(page) as (_, view):
            await view.send(packed("GuiUpdateMessage", uuid=uuid, updates={"value": value}))
            await until_closed(view)
            assert view.close_code == 1008

    asyncio.run(set_strength())
    assert page._panel.forces == before
    assert page.alive


def test_what_the_leader_sets_arrives(session):
    page = session.page
    uuid, initial = page._panel._strength._impl.uuid, page._panel.forces

    async def set_strength():
        async with viewer(page) as (_, view):
            for value in (50, 100):
                await view.send(packed("GuiUpdateMessage", uuid=uuid, updates={"value": value}))
                wanted = initial.stiffness * value / 100
                await asyncio.to_thread(
                    wait_until,
                    lambda wanted=wanted: page._panel.forces.stiffness == wanted,
                    "the strength",
                )

    asyncio.run(set_strength())


def test_viser_itself_lets_nobody_in(session):
    where = f"ws://127.0.0.1:{session.page._server.get_port()}"
    asyncio.run(refused(connect(where, subprotocols=[VISER], proxy=None), codes=(403,)))


def test_as_many_come_in_as_may(session):
    page = session.page

    async def crowd():
        most = page._config.most_clients
        people = [await socket(page, "session") for _ in range(most + 3)]
        for late in people[most:]:
            await asyncio.wait_for(until_closed(late), 20)
            assert late.close_code == 1013
        assert page.control.people == most
        for one in people:
            await one.close()

    asyncio.run(crowd())
    wait_until(lambda: page.control.people == 0, "everybody gone")


def test_a_grip_that_was_held_before_the_hand_over_moves_nothing(session):
    page = session.page

    async def go():
        first = await socket(page, "session")
        second = await socket(page, "session")
        await second.send(hands())  # watches, and pinches already
        await second.send(json.dumps({"type": "lead", "wish": "ask"}))
        await first.send(json.dumps({"type": "lead", "wish": "hand_over"}))
        await asyncio.sleep(0.3)
        for _ in range(10):
            await second.send(hands(pointer=(0.3, 0.4, 0.5)))
            await asyncio.sleep(0.03)
        assert not session.asked.effort(7).any()
        await second.send(json.dumps({"type": "hands", "grips": []}))
        await second.send(hands(pointer=(0.3, 0.4, 0.5)))
        await asyncio.to_thread(wait_until, lambda: session.asked.effort(7).any(), "an effort")
        await first.close()
        await second.close()

    asyncio.run(go())
    wait_until(lambda: not session.asked.effort(7).any(), "rest")


def test_a_client_that_draws_the_scene_itself_is_told_where_everything_is(session):
    page = session.page

    async def go():
        async with socket(page, "session") as one:
            await one.send(json.dumps({"type": "hello", "wants": "scene"}))
            async for raw in one:
                if "scene" in (told := json.loads(raw)):
                    return told["scene"]
        raise AssertionError("the page has closed the connection")

    scene = asyncio.run(go())
    np.testing.assert_allclose(scene["links"][3], session.frame(4), atol=1e-3)
    assert len(scene["bodies"]) == len(page._poses[0])
    wait_until(lambda: page.control.people == 0, "everybody gone")
