"""`hrc page` that is ended in the middle of a recording: what was shown is not lost."""

import asyncio
import json
import re
import signal
import subprocess
import sys
import time
from types import SimpleNamespace
from urllib.parse import parse_qs, urlsplit

import pytest
from hostile_clients import BEAT, hands, socket

from hrc_learn.demos import load_demos, recover_dataset
from hrc_learn.teleoperation.gate import Address

pytest.importorskip("viser", reason="the extra `ui` is not installed")


def served(log, timeout=180.0):
    """The page's address, once the program has printed it."""
    end = time.monotonic() + timeout
    while not (found := re.search(r"Page at (\S+)", log.read_text())):
        assert time.monotonic() < end, log.read_text()
        time.sleep(0.1)
    parts = urlsplit(found[1])
    (token,) = parse_qs(parts.fragment)["token"]
    address = Address(scheme="http", host="127.0.0.1", port=parts.port, token=token)
    return SimpleNamespace(address=address)


async def record(page, until):
    """Lead the end effector to and fro while recording; the last that the page said of it."""
    status, began = {}, None
    async with socket(page) as client:
        await client.send(json.dumps({"type": "ask", "request": "start"}))
        await client.send(json.dumps({"type": "hands", "grips": []}))  # then takes hold
        while not until(status):
            now = time.monotonic()
            began = began or now
            side = 0.15 if int(now - began) % 2 else -0.15
            await client.send(BEAT)
            await client.send(
                hands(joint=None, start=(0.3, 0.0, 0.5), pointer=(0.3, side, 0.5))
            )
            status = json.loads(await client.recv()).get("status", status)
    return status


@pytest.fixture
def hearing_interrupts():
    """As at a terminal: what a shell starts in the background is deaf to them."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.long
@pytest.mark.usefixtures("hearing_interrupts")
@pytest.mark.parametrize(
    "ended_by",
    # A program that is asked to end does so by an exception, which other tests raise.
    [
        signal.SIGKILL,
        pytest.param(signal.SIGINT, marks=pytest.mark.slow),
        pytest.param(signal.SIGTERM, marks=pytest.mark.slow),
    ],
)
def test_what_is_recorded_survives_the_end_of_the_program(tmp_path, ended_by):
    demos, log = tmp_path / "demos", tmp_path / "log"
    command = [sys.executable, "-m", "hrc_learn.cli", "page", "--out", str(demos)]
    command += ["--config", "page.silence=5", "page.timeout=5"]
    draft = tmp_path / "demos.recording" / "episode_000000.parquet"
    with log.open("w") as output:
        program = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
    try:
        page = served(log)

        def shown(status):
            assert program.poll() is None, log.read_text()
            return status.get("seconds", 0.0) > 4.0 and draft.exists()

        told = asyncio.run(asyncio.wait_for(record(page, shown), 120))
        program.send_signal(ended_by)
        program.wait(60)
    finally:
        program.kill()
    if ended_by == signal.SIGKILL:
        assert not demos.exists()
        recover_dataset(demos)
    (demo,) = load_demos(demos)
    assert demo.task == "put the object on the middle shelf"
    assert demo.joint_position.std(0).max() > 0.01
    # A draft is written every two seconds; a busy machine takes its time to write one.
    kept = demo.time[-1] - demo.time[0]
    assert kept > (told["seconds"] - 1.5 if ended_by != signal.SIGKILL else 1.0)
