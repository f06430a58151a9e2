"""Measure the page with many watching clients while one client drags: delay, memory, survival.

`hrc page` runs in its own process. Each watching client opens the same sockets as a browser: a
session that receives the scene, and a view. The controlling client drags a link 60 times per
second; the delay is the time until the status contains the motion that was sent.

    python benchmarks/bench_watchers.py --minutes 60 --watchers 24 --figures minutes.jsonl
"""

import asyncio
import json
import math
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import parse_qs, urlsplit

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from hostile_clients import (  # pyright: ignore[reportMissingImports]
    BEAT,
    hands,
    until_closed,
    viewer,
)

from hrc_learn import cli
from hrc_learn.teleoperation.gate import Address

_REPORT_EVERY = 60.0  # [s]


@dataclass(frozen=True, kw_only=True)
class Args:
    minutes: float = 1.0
    """Length of the measurement."""
    watchers: int = 24
    """Number of clients that watch."""
    figures: Path | None = None
    """File for the values of every minute, one JSON object per line, written immediately."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


def main(args: Args) -> int:
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        command = [sys.executable, "-m", "hrc_learn.cli", "page", "--out", f"{folder}/demos"]
        with log.open("w", encoding="utf-8") as output:
            program = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
        try:
            while not (found := re.search(r"Page at (\S+)", log.read_text("utf-8"))):
                time.sleep(0.1)
            parts = urlsplit(found[1])
            (token,) = parse_qs(parts.fragment)["token"]
            assert parts.port is not None
            address = Address(scheme="http", host="127.0.0.1", port=parts.port, token=token)
            figures = asyncio.run(_measure(SimpleNamespace(address=address), program.pid, args))
            alive = program.poll() is None
        finally:
            program.terminate()
            program.wait()
        if args.json is not None:
            cli.write_json(args.json, {**figures, "alive": int(alive)})
        print(json.dumps(figures))
        print("alive to the end" if alive else f"the page has ended:\n{log.read_text('utf-8')}")
    return 0 if alive and figures["led"] and figures["watchers"] == args.watchers else 1


async def _measure(page, pid: int, args: Args) -> dict[str, float]:
    stop, delays, everything = asyncio.Event(), [], []
    figures: dict[str, float] = {"watchers": 0}
    leading = asyncio.create_task(_lead(page, stop, delays))
    await asyncio.sleep(1.0)
    watching = [asyncio.create_task(_watch(page, stop)) for _ in range(args.watchers)]
    await asyncio.sleep(1.0)
    began, end = time.monotonic(), time.monotonic() + 60 * args.minutes
    memory = [_memory(pid)]
    while not leading.done() and (left := end - time.monotonic()) > 0:
        delays.clear()
        await asyncio.wait([leading], timeout=min(left, _REPORT_EVERY))
        everything += delays
        memory.append(_memory(pid))
        figures = {
            "seconds": round(time.monotonic() - began, 1),
            **_percentiles(delays),
            "memory_mb": memory[-1],
            "watchers": sum(not one.done() for one in watching),
        }
        print(json.dumps(figures), flush=True)
        if args.figures is not None:
            with args.figures.open("a", encoding="utf-8") as file:
                file.write(json.dumps(figures) + "\n")
    led = not leading.done()
    stop.set()
    await asyncio.gather(leading, *watching, return_exceptions=True)
    return {
        **figures,
        **_percentiles(everything),
        "efforts": len(everything),
        "led": int(led),
        "memory_begin_mb": memory[0],
        "memory_max_mb": max(memory),
    }


def _percentiles(delays: list[float]) -> dict[str, float]:
    median, p95 = 1e3 * np.percentile(delays or [math.inf], [50, 95])
    return {"effort_p50_ms": round(median, 1), "effort_p95_ms": round(p95, 1)}


async def _watch(page, stop: asyncio.Event) -> None:
    async with viewer(page) as (session, view):
        draining = [asyncio.create_task(until_closed(one)) for one in (session, view)]
        await session.send(json.dumps({"type": "hello", "wants": "scene"}))
        while not stop.is_set():
            await session.send(BEAT)
            await asyncio.sleep(0.05)
        for task in draining:
            task.cancel()


async def _lead(page, stop: asyncio.Event, delays: list[float]) -> None:
    async with viewer(page) as (session, view):

        async def listen() -> None:
            async for raw in session:
                sent = json.loads(raw).get("status", {}).get("sent", 0.0)
                if sent:
                    delays.append(time.monotonic() - sent)

        tasks = [asyncio.create_task(listen()), asyncio.create_task(until_closed(view))]
        await session.send('{"type": "hands", "grips": []}')
        while not stop.is_set():
            t = time.monotonic()
            pointer = (0.3 + 0.1 * math.sin(t), 0.15 * math.sin(0.7 * t), 0.6)
            message = {**json.loads(hands(pointer=pointer)), "sent": t}
            await session.send(BEAT)
            await session.send(json.dumps(message))
            await asyncio.sleep(1 / 60)
        for task in tasks:
            task.cancel()


def _memory(pid: int) -> float:
    """Resident memory of a process [MB]."""
    status = Path(f"/proc/{pid}/status").read_text("utf-8")
    found = re.search(r"VmRSS:\s+(\d+)", status)
    return int(found[1]) / 1024 if found else math.nan


if __name__ == "__main__":
    cli.run(main, Args)
