"""A session at the page, and a headless Chromium in which a mouse takes part in it."""

import math
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch

from hrc_learn.demos import DatasetWriter
from hrc_learn.deploy import Rate
from hrc_learn.kinematics import panda
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.teleoperation import InteractionForceConfig
from hrc_learn.teleoperation.demonstration_recorder import DemonstrationRecorder
from hrc_learn.teleoperation.page import Page, PageConfig
from hrc_learn.teleoperation.page_session import FEATURES, PageSession, PageSessionConfig

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
OPTIONS = (
    *("--headless=new", "--no-sandbox", "--no-first-run", "--disable-gpu", "--disable-quic"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
PATIENCE = 12.0
"""A browser that draws without a GPU on a busy machine is silent for seconds [s]."""


def wait_until(condition: Callable[[], object], what: str, timeout: float = 90.0) -> None:
    """Wait for something to become true."""
    end = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > end:
            pytest.fail(f"{what}: not within {timeout} s")
        time.sleep(0.02)


class Session:
    """A page session that a thread steps, as the program does."""

    def __init__(self, out: Path, mapping="transpose", **page_options):
        workplace, config = Workplace(), PageSessionConfig()
        world = World(workplace.scene)
        self.writer = DatasetWriter(out, config.fps, "panda", panda.joint_names, FEATURES)
        options = {"silence": PATIENCE, "timeout": PATIENCE, "meshes": False} | page_options
        forces = InteractionForceConfig(mapping=mapping)
        page = PageConfig(forces=forces, **options)
        self.page = Page(world, page, task="show it")
        self.recorder = DemonstrationRecorder(self.writer, lambda: self.page.task)
        self.session = PageSession(workplace, self.page, self.recorder, world)
        self.step = self.session.step()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self):
        metronome = Rate(0.01)
        while not self._closing.is_set():
            self.step = self.session.step()
            metronome.wait()

    def __enter__(self):
        self.recorder.__enter__()
        self.page.__enter__()
        self._thread.start()
        return self

    def __exit__(self, *raised):
        self._closing.set()
        self._thread.join()
        self.page.__exit__(*raised)
        self.recorder.__exit__(*raised)

    @property
    def asked(self):
        return self.step.human_input

    def frame(self, joint: int) -> np.ndarray:
        """Where a joint's frame is now; -1: the tool centre point."""
        q = torch.from_numpy(self.step.state.joint_position)
        return panda.link_poses(q)[joint - 1 if joint > 0 else -1].position.numpy()


class Browser:
    """A page shown in Chromium, and its mouse."""

    def __init__(
        self,
        tab,
        page: Page,
        timeout: float = 180.0,
        *,
        guides: bool = True,
        pixels: float = 1.0,
    ):
        self.tab = tab
        tab.set_default_timeout(1e3 * timeout)
        tab.goto(page.url)
        if pixels != 1.0:  # as the page advises a person with a slow browser
            tab.goto(f"{page.address.origin}/?fixedDpr={pixels:g}")
        # viser warns of drawing without a GPU, right over the arm that the mouse is to meet.
        tab.add_style_tag(content="[class*=Notifications] { display: none !important; }")
        (self.button("Start") if guides else tab.get_by_text("Safety filter")).wait_for()
        wait_until(page._server.get_clients, "a client", timeout)
        clients = page._server.get_clients()
        self._client = clients[max(clients)]
        self._box = tab.query_selector("canvas").bounding_box()
        # The canvas is there before what is drawn in it, which is what a mouse meets.
        self._client.local_storage.get_item("drawn", timeout=timeout)
        time.sleep(2.0)

    def button(self, name: str):
        return self.tab.get_by_role("button", name=name, exact=True)

    def pixel(self, point) -> tuple[float, float]:
        """Where a point of the workplace is on the screen, by the camera the page reports."""
        camera, box = self._client.camera, self._box
        w, *v = camera.wxyz
        offset = np.asarray(point) - camera.position
        turned = np.cross(v, offset)
        x, y, z = offset + 2 * (np.cross(v, turned) - w * turned)  # by the conjugate
        f = box["height"] / 2 / math.tan(camera.fov / 2)
        return box["x"] + box["width"] / 2 + f * x / z, box["y"] + box["height"] / 2 + f * y / z

    @contextmanager
    def dragging(
        self,
        start,
        by: tuple[float, float],
        until: Callable[[], object] = lambda: True,
        limit: float = 240.0,
    ) -> Iterator[None]:
        """Take hold at a point of the workplace, and pull by some pixels; let go at the end.

        A busy machine draws late, and a mouse meets only what is drawn: the drag is repeated
        until it has an effect.
        """
        x, y = self.pixel(start)
        end = time.monotonic() + limit
        try:
            self._drag(x, y, by)
            while not self._soon(until):
                self.tab.mouse.up()
                if time.monotonic() > end:
                    pytest.fail(f"no effect of a drag at {start} within {limit} s")
                self._drag(x, y, by)
            yield
        finally:
            self.tab.mouse.up()

    def _drag(self, x: float, y: float, by: tuple[float, float]) -> None:
        self.tab.mouse.move(x, y)
        time.sleep(0.3)
        self.tab.mouse.down()
        for fraction in np.linspace(0.2, 1.0, 5):
            self.tab.mouse.move(x + fraction * by[0], y + fraction * by[1])
            time.sleep(0.05)

    @staticmethod
    def _soon(condition: Callable[[], object], seconds: float = 15.0) -> bool:
        end = time.monotonic() + seconds
        while not (met := bool(condition())) and time.monotonic() < end:
            time.sleep(0.02)
        return met


@contextmanager
def chromium(
    folder: Path, size: tuple[int, int] = (900, 560), more: tuple[str, ...] = ()
) -> Iterator:
    """A fresh tab of a headless Chromium; skips where there is none."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("no chromium: install it (Debian: apt install chromium)")
    with api.sync_playwright() as playwright:
        context = playwright.chromium.launch_persistent_context(
            folder,
            executable_path=CHROMIUM,
            headless=True,
            viewport={"width": size[0], "height": size[1]},
            args=[*OPTIONS, *more],
        )
        try:
            yield context.pages[0] if context.pages else context.new_page()
        finally:
            context.close()
