"""Delay from a motion of a hand to the controller's input, through the page and the headset.

A headset emulated in Chromium pinches link 4, and its hand jumps back and forth; a mouse drags
the same link on viser's page. The delay is measured from the time at which the hand is set or
the mouse is moved, by the clock of this machine, to the first reading of `Human.read` that
differs. It is wall time, with drawing without a graphics processor, so it depends on the load
of the machine as much as on the page. The frame rate of the client is reported, too, and all
values are measured again with other clients watching. With `--soak`, the hand continues for
some minutes, and the memory of both sides is measured.

    python benchmarks/bench_page.py --watchers 4 --soak 10
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import subprocess
import sys
import tempfile
import threading
import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console
from rich.table import Table

# The browser and the emulated headset are those of the tests.
sys.path.append(str(Path(__file__).parents[1] / "tests"))
from headset_in_browser import Headset, headset  # pyright: ignore[reportMissingImports]
from page_in_browser import Browser, chromium  # pyright: ignore[reportMissingImports]

from hrc_learn import cli
from hrc_learn.cli._run import write_values
from hrc_learn.kinematics import panda
from hrc_learn.protocols import ArmState
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.teleoperation.page import Page, PageConfig

_POLL = 0.001  # period of reading the person [s]
_LOST = 2.0  # time after which a motion without an effect counts as lost [s]
_JUMPS = """
window.jumped = [];
window.jumping = setInterval(() => {
  const p = headset.hands.left.position;
  const by = 0.03 * (window.jumped.length % 2 ? -1 : 1);
  p.set(p.x + by, p.y + by, p.z);
  window.jumped.push(performance.timeOrigin + performance.now());
}, 250);
"""
_STOP_JUMPING = """
clearInterval(window.jumping);
if (window.jumped.length % 2) {
  const p = headset.hands.left.position;
  p.set(p.x - 0.03, p.y - 0.03, p.z);
}
"""
_WATCH = """
import asyncio, sys
from websockets.asyncio.client import connect
url, secret, origin = sys.argv[1:]
async def main():
    offered = ["hrc", f"secret.{secret}"]
    async with connect(url, subprotocols=offered, origin=origin, proxy=None) as socket:
        await socket.send('{"type": "hello", "wants": "scene"}')
        async for _ in socket:
            await socket.send('{"type": "beat", "lag": 0}')
asyncio.run(main())
"""


@dataclass(frozen=True, kw_only=True)
class Args:
    seconds: float = 20.0
    """Duration of each measurement [s]."""
    watchers: int = 4
    """Number of watching clients in the second measurement."""
    soak: float = 0.0
    """Duration of the final measurement [min]."""
    pixels: float = 1.0
    """Fraction of the screen's horizontal resolution that viser's page draws (its `fixedDpr`).
    """
    meshes: bool = True
    """True if the clients draw the arm's meshes, False for capsules."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


class Reader:
    """Reads the person's input as a control loop does, and records the times of its changes."""

    def __init__(self, page: Page, state: ArmState):
        self.changes: list[float] = []
        self._page, self._state, self._closing = page, state, threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        last = np.zeros(7)
        while not self._closing.wait(_POLL):
            d = self._page.human.read(self._state).effort(7)
            if np.abs(d - last).max() > 1e-9:
                self.changes.append(time.time())
                last = d

    def __enter__(self) -> "Reader":
        self._thread.start()
        return self

    def __exit__(self, *raised: object) -> None:
        self._closing.set()
        self._thread.join()

    def delays(self, moved: list[float]) -> np.ndarray:
        """Delay from each motion to its effect [s]; infinite for lost motions."""
        changes = np.array([*self.changes, np.inf])
        first = changes[np.searchsorted(changes, moved)]
        delays = first - np.array(moved)
        return np.where(delays > _LOST, np.inf, delays)


@contextmanager
def still_page(meshes: bool):
    """Page of an arm at rest: only hands change the input."""
    workplace = Workplace()
    world, q = World(workplace.scene), workplace.home_joints().numpy()
    world.hold(workplace.scene.objects[0].name, q)
    config = PageConfig(meshes=meshes, silence=5.0, timeout=5.0)
    state = ArmState(time=0.0, joint_position=q, joint_velocity=np.zeros(7), gripper_width=0.05)
    with Page(world, config, task="measure") as page:
        page.human.read(state)
        yield page, state


def by_hand(page: Page, state: ArmState, person: Headset, seconds: float) -> dict[str, float]:
    """Delays of a hand that jumps back and forth."""
    frames, began = person.tab.evaluate("window.seen.frames"), time.time()
    with Reader(page, state) as reader:
        person.tab.evaluate(_JUMPS)
        time.sleep(seconds)
        person.tab.evaluate(_STOP_JUMPING)
        time.sleep(_LOST)
    moved = [t / 1e3 for t in person.tab.evaluate("window.jumped")]
    drawn = person.tab.evaluate("window.seen.frames") - frames
    return {**figures(reader.delays(moved)), "frames_per_s": drawn / (time.time() - began)}


def by_mouse(
    page: Page, state: ArmState, folder: Path, seconds: float, pixels: float
) -> dict[str, float]:
    """Delays of a mouse that drags link 4 on viser's page."""
    q = torch.from_numpy(state.joint_position)
    elbow = panda.link_poses(q)[3].position.numpy()
    moved = []
    with chromium(folder) as tab, Reader(page, state) as reader:
        browser = Browser(tab, page, pixels=pixels)
        x, y = browser.pixel(elbow)
        held = lambda: page.human.read(state).effort(7).any()  # noqa: E731
        with browser.dragging(elbow, by=(40, -10), until=held):
            for k in range(int(seconds / 0.25)):
                moved.append(time.time())
                tab.mouse.move(x + 40 + 15 * (k % 2), y - 10)
                time.sleep(0.25)
    return figures(reader.delays(moved))


def figures(delays: np.ndarray) -> dict[str, float]:
    """Median and 95th percentile of delays [ms], numbers of all and of lost motions."""
    median, p95 = np.percentile(delays, [50, 95], method="higher")
    lost = int(np.isinf(delays).sum())
    return {"p50_ms": 1e3 * median, "p95_ms": 1e3 * p95, "motions": len(delays), "lost": lost}


@contextmanager
def watched(page: Page, count: int):
    """Watching clients, which receive the scene, each in its own process."""
    urls = [
        f"ws://127.0.0.1:{page.address.port}/session/somebody-who-watches-{k}"
        for k in range(count)
    ]
    command = [sys.executable, "-c", _WATCH]
    address = page.address
    watchers = [
        subprocess.Popen([*command, url, address.token, address.origin]) for url in urls
    ]
    try:
        while page.control.people < count + 1:
            time.sleep(0.1)
        yield
    finally:
        for watcher in watchers:
            watcher.terminate()
            watcher.wait()


def memory(person: Headset) -> tuple[float, float]:
    """Memory of this process and heap of the client [MB]."""
    pages = int(Path("/proc/self/statm").read_text("ascii").split()[1])
    browser = person.tab.context.new_cdp_session(person.tab)
    browser.send("HeapProfiler.collectGarbage")  # otherwise, garbage would count
    browser.detach()
    heap = person.tab.evaluate("performance.memory.usedJSHeapSize")
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6, heap / 1e6


def soaked(page: Page, state: ArmState, person: Headset, minutes: float) -> dict[str, float]:
    """Memory before and after, and the motions lost in between.

    A hand that was released, as after a silence of the client, grips again at the start of the
    next minute: `let_go` counts such releases, and `lost` the motions without effect until
    then.
    """
    by_hand(page, state, person, 20)  # caches that are filled once are full now
    server, client = memory(person)
    motions = lost = let_go = 0.0
    for minute in range(max(round(minutes), 1)):
        if not page.human.read(state).effort(7).any():
            let_go += 1
            person.pinch("left", closed=False)
            person.pinch("left")
        seen = by_hand(page, state, person, 58)
        motions, lost = motions + seen["motions"], lost + seen["lost"]
        print(
            f"minute {minute + 1}: {seen['lost']:.0f} of {seen['motions']:.0f} lost", flush=True
        )
    after = memory(person)
    grown = {"server_grown_mb": after[0] - server, "client_grown_mb": after[1] - client}
    counts = {"motions": motions, "lost": lost, "let_go": let_go}
    return {"minutes": minutes, **counts, **grown, "server_mb": after[0]}


def main(args: Args) -> None:
    """Measure, print a table, and write the measured values."""
    torch.set_num_threads(1)
    rows: dict[str, dict[str, float]] = {}
    with (
        tempfile.TemporaryDirectory() as name,
        still_page(args.meshes) as (page, state),
    ):
        folder = Path(name)
        rows["mouse"] = by_mouse(page, state, folder / "mouse", args.seconds, args.pixels)
        with headset(folder / "headset", page, (320, 200)) as person:
            person.enter()
            arm = person.tab.evaluate("JSON.parse(localStorage['hrc-placing'] ?? '{}').arm")
            # the placement lies in front of the point where the person entered
            assert arm is None
            q = torch.from_numpy(state.joint_position)
            x, y, z = panda.link_poses(q)[3].position.tolist()
            # 1.1 m ahead, on a table of 0.72 m, with x towards the person
            person.reach("left", [y, 0.72 + z, -1.1 + x])
            person.pinch("left")
            if not page.human.read(state).effort(7).any():
                person.reach("left", [y + 0.05, 0.72 + z, -1.1 + x])
            rows["hand"] = by_hand(page, state, person, args.seconds)
            with watched(page, args.watchers):
                rows["hand_watched"] = by_hand(page, state, person, args.seconds)
            if args.soak:
                rows["soak"] = soaked(page, state, person, args.soak)
    table = Table("", *dict.fromkeys(name for row in rows.values() for name in row))
    columns = [str(column.header) for column in table.columns[1:]]
    for name, row in rows.items():
        table.add_row(name, *(f"{row[c]:.3g}" if c in row else "" for c in columns))
    Console(width=120).print(table)  # no column is cut in a log file
    flat = {f"{name}_{key}": value for name, row in rows.items() for key, value in row.items()}
    write_values(args.json, flat)


def measure(args: Args) -> None:
    """The work of `main`; without a browser or the built client, prints this and measures
    nothing.
    """
    try:
        main(args)
    except pytest.skip.Exception as missing:
        print(f"not measured: {missing}")


if __name__ == "__main__":
    cli.run(measure, Args)
