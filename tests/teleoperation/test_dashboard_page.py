"""Dashboards through the gate: what arrives, who gets it, and Rerun's viewer itself."""

import asyncio
import json
import socket
import subprocess
from io import BytesIO
from types import SimpleNamespace
from typing import Any, cast
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
    started: list[list[str]] = []
    begin, module = cast("Any", subprocess.Popen), cast("Any", dashboard_page)

    def start(command: list[str], **options: Any) -> Any:
        started.append(command)
        return begin(command, **options)

    monkeypatch.setattr(module.subprocess, "Popen", start)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    contents = dashboard_page._viewer_contents()
    port = int(started[0][started[0].index("--web-viewer-port") + 1])
    with pytest.raises(ConnectionRefusedError):  # the server has ended
        socket.create_connection(("127.0.0.1", port), timeout=5)
    assert contents["/viewer/re_viewer_bg.wasm"].body[:4] == b"\0asm"
    # What our page calls.
    for name in (b"open_channel(id, channel_name)", b"send_rrd_to_channel(id, data)"):
        assert name in contents["/viewer/re_viewer.js"].body
    monkeypatch.setattr(dashboard_page, "_fetched_viewer", lambda: 1 / 0)
    assert dashboard_page._viewer_contents() == contents  # is used again


class Viewer:
    """Rerun's program and its clock: answers after a number of attempts, or never."""

    def __init__(self, monkeypatch, answers=3, ends=None):
        self.asked, self.ended, self.now, self.commands = [], [], 100.0, []
        self._answers, self._ends = answers, ends
        module: Any = dashboard_page
        monkeypatch.setattr(module.subprocess, "Popen", self.start)
        monkeypatch.setattr(module, "urlopen", self.open)
        clock = SimpleNamespace(monotonic=lambda: self.now, sleep=self.sleep)
        monkeypatch.setattr(module, "time", clock)

    def start(self, command, **_):
        self.commands.append(command)
        return SimpleNamespace(
            poll=lambda: 1 if self._ends == len(self.asked) else None,
            kill=lambda: self.ended.append("killed"),
            wait=lambda: self.ended.append("waited"),
        )

    def open(self, url, timeout):
        self.asked.append(url)
        if len(self.asked) < self._answers:
            raise ConnectionRefusedError("refused")
        return BytesIO(url.rsplit("/", 1)[-1].encode())

    def sleep(self, seconds):
        self.now += seconds


def test_the_viewer_is_asked_until_it_answers_on_a_port_of_its_own(monkeypatch):
    viewer = Viewer(monkeypatch)
    files = dashboard_page._fetched_viewer()
    assert files == {name: name.encode() for name in dashboard_page._VIEWER_FILES}
    assert viewer.ended == ["killed", "waited"]
    assert viewer.now == pytest.approx(100.2)
    (command,) = viewer.commands
    web, other = (command[command.index(o) + 1] for o in ("--web-viewer-port", "--port"))
    assert web != other
    assert {url.rsplit("/", 1)[0] for url in viewer.asked} == {f"http://127.0.0.1:{web}"}


def test_a_viewer_that_ends_is_not_waited_for(monkeypatch):
    viewer = Viewer(monkeypatch, answers=99, ends=2)
    with pytest.raises(ValueError, match=r"does not start; try `python -m rerun`. refused"):
        dashboard_page._fetched_viewer()
    assert len(viewer.asked) == 2
    assert viewer.ended == ["killed", "waited"]


def test_a_viewer_that_does_not_answer_is_given_up_after_its_time(monkeypatch):
    viewer = Viewer(monkeypatch, answers=10**9)
    with pytest.raises(ValueError, match="viewer does not start"):
        dashboard_page._fetched_viewer()
    assert viewer.now - 100 == pytest.approx(dashboard_page._START, abs=0.15)
    assert viewer.now - 100 > dashboard_page._START - 1e-6
    assert viewer.ended == ["killed", "waited"]


def test_a_viewer_of_which_a_file_is_missing_is_fetched_again(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    fetched = []
    files = {name: name.encode() for name in dashboard_page._VIEWER_FILES}
    monkeypatch.setattr(dashboard_page, "_fetched_viewer", lambda: fetched.append(1) or files)
    contents = dashboard_page._viewer_contents()
    assert {path: content.body for path, content in contents.items()} == {
        f"/viewer/{name}": body for name, body in files.items()
    }
    (folder,) = (tmp_path / "hrc_learn").iterdir()
    for name in files:
        (folder / name).unlink()
        assert dashboard_page._viewer_contents() == contents
    assert len(fetched) == 1 + len(files)
