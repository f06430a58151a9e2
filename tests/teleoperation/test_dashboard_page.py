"""Dashboards through the gate: what arrives, who gets it, and Rerun's viewer itself."""

import asyncio
import json
from urllib.parse import urlsplit

import pytest
import rerun as rr
from hostile_clients import FOREIGN, until_closed
from rrd_reading import Rrd
from sample_runs import sample_run
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from hrc_learn.teleoperation import dashboard_page
from hrc_learn.teleoperation.dashboard_page import serve_recordings, serve_stream
from hrc_learn.viz.panels import run_tabs
from hrc_learn.viz.run_dashboard import live_dashboard, record_run


@pytest.fixture
def without_viewer(monkeypatch):
    monkeypatch.setattr(dashboard_page, "_viewer_contents", dict)


def open_socket(url, *, secret=None, origin=None, host=None):
    address, _, token = url.partition("/#token=")
    there = urlsplit(address)
    where = f"ws://{host or there.netloc}/session/{'d' * 24}"
    offered = ["hrc", f"secret.{secret or token}"]
    options = {"max_size": None, "proxy": None, "host": there.hostname, "port": there.port}
    return connect(where, subprotocols=offered, origin=origin or address, **options)


async def parts(url, count=None):
    """What a page receives until a number of parts is there, or the program ends."""
    got = []
    async with open_socket(url) as one:
        try:
            while count is None or len(got) < count:
                part = await asyncio.wait_for(one.recv(), 30)
                if isinstance(part, str):
                    assert json.loads(part)["type"] == "end"
                    return got
                got.append(part)
        except ConnectionClosed:
            pass
    return got


@pytest.mark.usefixtures("without_viewer")
def test_a_page_that_opens_late_gets_the_whole_run(tmp_path):
    run = sample_run()
    with serve_stream(0) as (stream, address):
        with live_dashboard(stream, lambda: run):
            pass
        got = asyncio.run(parts(address, 1))
    (tmp_path / "got.rrd").write_bytes(got[0])
    (tab,) = (tab for tab in run_tabs(run) if tab.title == "Primitive")
    joint = tab.plots[0].curves[-1]
    assert Rrd(tmp_path / "got.rrd").scalars(joint.path).tolist() == joint.values.tolist()


@pytest.mark.usefixtures("without_viewer")
def test_new_data_arrives_while_a_page_is_open():
    async def go(stream, address):
        watching = asyncio.create_task(parts(address, 2))
        for value in range(2):
            stream.log("value", rr.Scalars(float(value)))
            await asyncio.sleep(0.5)
        return await watching

    with serve_stream(0) as served:
        assert len(asyncio.run(go(*served))) == 2


@pytest.mark.usefixtures("without_viewer")
def test_recordings_are_served_as_they_are_and_to_nobody_without_the_secret(tmp_path):
    record_run(tmp_path / "run.rrd", sample_run())

    async def refused(url, **wrong):
        with pytest.raises(InvalidStatus) as error:
            await open_socket(url, **wrong)
        return error.value.response.status_code

    async def go(url):
        assert await parts(url, 1) == [(tmp_path / "run.rrd").read_bytes()]
        assert await refused(url, secret="wrong") == 403
        assert await refused(url, host="evil.example") == 403
        for origin in FOREIGN:
            assert await refused(url, origin=origin) == 403
        async with open_socket(url) as one:
            await one.send("anything")
            await until_closed(one)
            assert one.close_code == 1008

    with serve_recordings([tmp_path / "run.rrd"], 0) as url:
        asyncio.run(go(url))


def test_the_viewer_is_that_of_the_installed_rerun(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    contents = dashboard_page._viewer_contents()
    assert contents["/viewer/re_viewer_bg.wasm"].body[:4] == b"\0asm"
    # What our page calls.
    for name in (b"open_channel(id, channel_name)", b"send_rrd_to_channel(id, data)"):
        assert name in contents["/viewer/re_viewer.js"].body
    monkeypatch.setattr(dashboard_page, "_fetched_viewer", lambda: 1 / 0)
    assert dashboard_page._viewer_contents() == contents  # is used again
