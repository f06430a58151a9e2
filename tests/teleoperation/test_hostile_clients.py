"""Whoever comes to the page without being wanted: nothing moves, and the page lives."""

import asyncio
import json

import numpy as np
import pytest
from hostile_clients import (
    ATTACKS,
    VISER,
    cookie,
    hands,
    http,
    packed,
    refused,
    siege,
    socket,
    until_closed,
)
from page_in_browser import Session, wait_until
from websockets.asyncio.client import connect

pytest.importorskip("viser", reason="the extra `ui` is not installed")


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
    pulled = [asked for asked in seen if asked.nullspace_input.any()]
    # The leader pulls the elbow up: joint 5 and later are not concerned.
    assert len(pulled) > len(seen) // 2
    assert all(not asked.nullspace_input[4:].any() for asked in pulled)
    wait_until(lambda: session.page.control.people == 0, "everybody gone")
    wait_until(lambda: not session.asked.nullspace_input.any(), "rest")


def test_one_of_each_kind_changes_nothing(session):
    besieged(session, ATTACKS)
    assert http(session.page, "/", Cookie=cookie(session.page))[0] == 200


@pytest.mark.slow
def test_two_hundred_change_nothing(session):
    rng = np.random.default_rng(7)
    kinds = [ATTACKS[k % len(ATTACKS)] for k in range(200)]
    besieged(session, [kinds[k] for k in rng.permutation(200)], seed=1)
    assert http(session.page, "/", Cookie=cookie(session.page))[0] == 200


def test_the_page_opens_to_those_who_have_its_secret(session):
    page = session.page
    assert http(page, "/")[0] == 401
    status, headers, _ = http(page, f"/?token={page.address.token}")
    assert (status, headers["Location"]) == (303, "/")
    assert "HttpOnly" in headers["Set-Cookie"]
    assert "SameSite=Strict" in headers["Set-Cookie"]
    status, headers, body = http(page, "/", Cookie=cookie(page))
    assert status == 200
    assert b"/static/session.js" in body
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    assert http(page, "/static/../gate.py", Cookie=cookie(page))[0] == 404
    # Only what is served is a place to go to.
    assert http(page, f"//evil.example?token={page.address.token}")[1]["Location"] == "/"


@pytest.mark.parametrize("value", [-100.0, 1e9, True, "strong"])
def test_a_control_takes_only_what_it_offers(session, value):
    page, before = session.page, session.page._panel.forces
    uuid = page._panel._strength._impl.uuid

    async def set_strength():
        known = await asyncio.to_thread(cookie, page)
        async with socket(page, "session", cookie=known, client="a" * 24):
            options = {"subprotocols": [VISER], "client": "a" * 24, "max_size": None}
            async with socket(page, "view", cookie=known, **options) as view:
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
        known = await asyncio.to_thread(cookie, page)
        async with socket(page, "session", cookie=known, client="b" * 24):
            options = {"subprotocols": [VISER], "client": "b" * 24, "max_size": None}
            async with socket(page, "view", cookie=known, **options) as view:
                for value in (50, 100):
                    update = {"uuid": uuid, "updates": {"value": value}}
                    await view.send(packed("GuiUpdateMessage", **update))
                    await asyncio.to_thread(
                        wait_until,
                        lambda v=value: (
                            page._panel.forces.stiffness == initial.stiffness * v / 100
                        ),
                        "the strength",
                    )

    asyncio.run(set_strength())


def test_viser_itself_lets_nobody_in(session):
    where = f"ws://127.0.0.1:{session.page._server.get_port()}"
    asyncio.run(refused(connect(where, subprotocols=[VISER], proxy=None), codes=(403,)))


def test_as_many_come_in_as_may(session):
    page = session.page

    async def crowd():
        known = await asyncio.to_thread(cookie, page)
        most = page._config.most_clients
        people = [await socket(page, "session", cookie=known) for _ in range(most + 3)]
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
        known = await asyncio.to_thread(cookie, page)
        first = await socket(page, "session", cookie=known)
        second = await socket(page, "session", cookie=known)
        await second.send(hands())  # watches, and pinches already
        await second.send(json.dumps({"type": "lead", "wish": "ask"}))
        await first.send(json.dumps({"type": "lead", "wish": "hand_over"}))
        await asyncio.sleep(0.3)
        for _ in range(10):
            await second.send(hands(pointer=(0.3, 0.4, 0.5)))
            await asyncio.sleep(0.03)
        assert not session.asked.nullspace_input.any()
        await second.send(json.dumps({"type": "hands", "grips": []}))
        await second.send(hands(pointer=(0.3, 0.4, 0.5)))
        await asyncio.to_thread(
            wait_until, lambda: session.asked.nullspace_input.any(), "an effort"
        )
        await first.close()
        await second.close()

    asyncio.run(go())
    wait_until(lambda: not session.asked.nullspace_input.any(), "rest")


def test_a_client_that_draws_the_scene_itself_is_told_where_everything_is(session):
    page = session.page

    async def go():
        known = await asyncio.to_thread(cookie, page)
        async with socket(page, "session", cookie=known) as one:
            await one.send(json.dumps({"type": "hello", "wants": "scene"}))
            async for raw in one:
                if "scene" in (told := json.loads(raw)):
                    return told["scene"]
        raise AssertionError("the page has closed the connection")

    scene = asyncio.run(go())
    np.testing.assert_allclose(scene["links"][3], session.frame(4), atol=1e-3)
    assert len(scene["bodies"]) == len(page._poses[0])
    wait_until(lambda: page.control.people == 0, "everybody gone")
