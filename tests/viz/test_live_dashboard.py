import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from rrd_reading import Rrd
from sample_runs import sample_run, until

from hrc_learn.viz import StepLog
from hrc_learn.viz.live_dashboard import LiveSender, live_dashboard, served
from hrc_learn.viz.panels import run_tabs
from hrc_learn.viz.run_dashboard import LogStream, record_run


def test_every_step_arrives_once_and_in_order(tmp_path):
    log = StepLog(block=64)
    stream = rr.RecordingStream("test")
    stream.save(tmp_path / "live.rrd")
    with LiveSender(LogStream(log, stream, ["joint", "error"]).send, period=0.002):
        for k in range(1000):
            log.append(time=k / 1000, joint=np.full(7, k), error=-k, unsent=0.0)
            if k % 50 == 0:
                time.sleep(0.002)
    stream.disconnect()
    rrd = Rrd(tmp_path / "live.rrd")
    order = np.argsort(rrd.time("live/joint"), kind="stable")
    k = np.arange(1000)
    np.testing.assert_allclose(rrd.time("live/joint")[order], k / 1000, atol=1e-9)
    np.testing.assert_array_equal(rrd.scalars("live/joint")[order], k[:, None] + np.zeros(7))
    assert sorted(rrd.scalars("live/error")[:, 0]) == (-k[::-1]).tolist()
    assert "live/unsent" not in rrd.entities


def test_an_error_of_the_thread_is_raised_where_it_is_closed():
    log = StepLog()
    log.append(time=0.0)
    sender = LiveSender(LogStream(log, rr.RecordingStream("test"), ["speed"]).send)
    with pytest.raises(ValueError, match="speed"), sender:
        pass


def test_an_error_of_the_loop_comes_first():
    def fail() -> None:
        raise ValueError

    with pytest.raises(ZeroDivisionError), LiveSender(fail):
        raise ZeroDivisionError
    assert "LiveSender" not in {thread.name for thread in threading.enumerate()}


def test_rows_are_read_whole_while_another_thread_appends():
    log, done, torn = StepLog(block=16), threading.Event(), []

    def read() -> None:
        seen = 0
        while not done.is_set() or seen < len(log):
            for rows in log.blocks(seen):
                expected = np.arange(seen, seen + len(rows))
                if (rows["a"] != expected).any() or (rows["b"] != expected[:, None]).any():
                    torn.append(seen)
                seen += len(rows)

    reader = threading.Thread(target=read)
    reader.start()
    for k in range(20_000):
        log.append(a=k, b=np.full(30, k))
    done.set()
    reader.join()
    assert torn == []


def test_a_run_sent_as_it_grows_arrives_like_a_finished_one(tmp_path):
    run = sample_run()
    # No step, a few, as many as before, and so on: as a thread happens to come.
    lengths = iter([None, 1, 1, 37, 90, 150])
    drawn = threading.Event()

    def snapshot():
        steps = next(lengths, len(run.time))
        if steps == len(run.time):
            drawn.set()
        return None if steps is None else until(run, steps)

    stream = rr.RecordingStream("test")
    stream.save(tmp_path / "live.rrd")
    with live_dashboard(stream, snapshot, period=0.001):
        assert drawn.wait(timeout=60)
    stream.disconnect()
    record_run(tmp_path / "saved.rrd", run)
    live, saved = Rrd(tmp_path / "live.rrd"), Rrd(tmp_path / "saved.rrd")
    assert live.entities == saved.entities
    for curves in (c for tab in run_tabs(run) for plot in tab.plots for c in plot.curves):
        order = np.argsort(live.time(curves.path), kind="stable")
        np.testing.assert_array_equal(live.scalars(curves.path)[order], curves.values)
    assert sorted(live.column("phases", "TextLog:text")) == saved.column(
        "phases", "TextLog:text"
    )
    assert len(live.column("world/camera/image", "EncodedImage:blob")) == 3
    for entity in ("world/scene", "world/camera", "world/bodies/hand/capsules"):
        assert live.rows(entity, static=True) == saved.rows(entity, static=True) == 1, entity
    # The last samples are the same; in between a growing run is sampled a little more often.
    for entity, component in (
        ("world/bodies/hand", "Transform3D:translation"),
        ("world/paths/run", "LineStrips3D:strips"),
        ("world/camera/image/target", "LineStrips2D:strips"),
    ):
        last = [
            rrd.column(entity, component)[rrd.time(entity).argmax()] for rrd in (live, saved)
        ]
        assert last[0] == last[1], entity
        assert set(saved.time(entity)[[0, -1]]) <= set(live.time(entity))


def free_ports() -> tuple[int, int]:
    with socket.socket() as one, socket.socket() as two:
        one.bind(("", 0))
        two.bind(("", 0))
        return one.getsockname()[1], two.getsockname()[1]


def test_a_viewer_that_connects_gets_the_run(tmp_path):
    """The viewer is rerun's own, told to write down what it receives."""
    rerun = shutil.which("rerun", path=str(Path(sys.executable).parent))
    if rerun is None:
        pytest.skip("no rerun command beside python")
    run, got = sample_run(), tmp_path / "got.rrd"
    page, data = free_ports()
    with served(page, data) as server:
        assert server.viewer.startswith(f"http://127.0.0.1:{page}?url=")
        with live_dashboard(server.stream, lambda: run):
            pass
        # Late: what was sent before is kept for it.
        viewer = subprocess.Popen(
            [rerun, server.data, "--save", got, "--port", str(free_ports()[0])],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            assert arrives(got, size=200_000)
        finally:
            os.killpg(viewer.pid, signal.SIGTERM)
            viewer.wait(timeout=120)
    rrd = Rrd(got)
    joint = run_tabs(run)[-2].plots[0].curves[-1]
    np.testing.assert_array_equal(rrd.scalars(joint.path), joint.values)


def arrives(path: Path, size: int, timeout: float = 60.0) -> bool:
    """Whether a file grows to a size, and then no more."""
    end, before = time.monotonic() + timeout, -1
    while time.monotonic() < end:
        now = path.stat().st_size if path.exists() else 0
        if now >= size and now == before:
            return True
        before = now
        time.sleep(0.2)
    return False


def test_a_port_that_is_taken_is_said():
    with socket.socket() as taken:
        taken.bind(("", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ValueError, match=f"port {port} is taken"), served(port):
            pass
