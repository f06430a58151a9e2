import threading
import time

import numpy as np
import pytest
import rerun as rr
from rrd_reading import Rrd

from hrc_learn.viz import StepLog
from hrc_learn.viz.live import LiveSender


def test_every_step_arrives_once_and_in_order(tmp_path):
    log = StepLog(block=64)
    stream = rr.RecordingStream("test")
    stream.save(tmp_path / "live.rrd")
    with LiveSender(log, stream, ["joint", "error"], period=0.002):
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
    stream = rr.RecordingStream("test")
    with pytest.raises(ValueError, match="speed"), LiveSender(log, stream, ["speed"]):
        pass


def test_an_error_of_the_loop_comes_first():
    stream = rr.RecordingStream("test")
    log = StepLog()
    log.append(time=0.0)
    with pytest.raises(ZeroDivisionError), LiveSender(log, stream, ["speed"]):
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
