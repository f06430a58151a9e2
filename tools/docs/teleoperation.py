"""Refresh the pictures of docs/howto/teleoperation.md: the page and the view of a headset.

A mouse in a headless Chromium leads the simulated arm and is photographed meanwhile; then two
hands of an emulated headset do, from picture to picture of a film, as drawing without a GPU
takes longer than the film shows.

python tools/docs/teleoperation.py
"""

import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

# The browser is that of the tests.
sys.path.append(str(Path(__file__).parents[2] / "tests"))
from headset_in_browser import (  # pyright: ignore[reportMissingImports]
    Headset,
    headset,
    placed,
)
from page_in_browser import (  # pyright: ignore[reportMissingImports]
    Browser,
    Session,
    chromium,
    wait_until,
)

from hrc_learn import cli

SIZE = (1320, 800)
"""Of the page's pictures [px]."""
ELBOW = 4
"""Link that is pulled."""
VIEW = (720, 450)
"""Of the headset's pictures [px]."""
STANDS, LOOKS_AT = (0.35, 1.55, 0.0), (-0.08, 1.05, -0.95)
"""Where the person stands who wears it, and looks, in the room (y up) [m]."""
MOVED = 0.3
"""Motion of the end effector after which a region is photographed [m]."""
SCENES = 14
"""Pictures of each part of the film."""
FRAME = 150
"""Of the film [ms]."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Where to."""

    out: Path = Path(__file__).parents[2] / "docs" / "images"
    """Folder of the pictures."""


def main(args: Args) -> None:
    for file, content in _pictures():
        (args.out / file).write_bytes(content)
        print(f"{args.out / file}: {len(content) / 1e3:.0f} kB", flush=True)


def _pictures() -> Iterator[tuple[str, bytes]]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with (
            Session(folder / "demos", meshes=True) as session,
            chromium(folder / "browser", SIZE) as tab,
        ):
            yield from _at_the_page(session, Browser(tab, session.page))
        with (
            Session(folder / "more", meshes=True) as session,
            headset(folder / "headset", session.page, VIEW) as person,
        ):
            yield "ar.webp", _film(list(_in_the_room(session, person)))


def _at_the_page(session: Session, browser: Browser) -> Iterator[tuple[str, bytes]]:
    """The elbow is pulled while a demonstration is recorded; then a region leads."""
    browser.button("Start").click()
    wait_until(lambda: session.recorder.status.state == "recording", "it records")
    with browser.dragging(
        session.frame(ELBOW), (90, -30), lambda: session.asked.nullspace_input.any()
    ):
        time.sleep(1.0)
        yield "page_drag.jpg", browser.tab.screenshot(type="jpeg", quality=85)
    browser.button("Stop").click()
    browser.button("discard").click()
    browser.button("Draw on the table").click()
    with browser.dragging([0.25, 0.45, 0.0], (150, 60)):
        pass
    browser.tab.get_by_role("checkbox", name="Active").check()
    wait_until(lambda: session.asked.region is not None, "a region")
    then = session.frame(-1)
    wait_until(lambda: np.linalg.norm(session.frame(-1) - then) > MOVED, "motion to the region")
    time.sleep(5.0)
    yield "page_region.jpg", browser.tab.screenshot(type="jpeg", quality=85)


def _in_the_room(session: Session, person: Headset) -> Iterator[Image.Image]:
    """One hand leads the end effector, then the other pulls the elbow; then a region leads."""
    person.enter()
    # What a headset does not show: the controls of the page beside its view.
    person.tab.add_style_tag(content="#overlay { opacity: 0; }")
    person.look(STANDS, LOOKS_AT)
    right = person.reach("right", np.add(_room(session.frame(-1)), [0.0, 0.02, 0.02]))
    person.pinch("right")
    for k in range(SCENES):
        s = np.sin(np.pi * (k + 1) / SCENES)
        person.reach("right", np.add(right, [0.12 * s, 0.10 * s, 0.0]))
        yield _seen(person)
    left = person.reach("left", _room(session.frame(ELBOW)))
    person.pinch("left")
    for k in range(SCENES):
        s = np.sin(np.pi * (k + 1) / SCENES)
        person.reach("left", np.add(left, [0.25 * s, 0.1 * s, 0.15 * s]))
        yield _seen(person)
    person.pinch("left", closed=False)
    person.pinch("right", closed=False)
    person.press("Draw region")
    corner = person.reach("right", _room([0.42, 0.05, 0.1]))
    person.pinch("right")
    for k in range(SCENES // 2):
        person.reach("right", corner + (k + 1) / (SCENES // 2) * np.array([0.3, 0.2, 0.2]))
        yield _seen(person)
    person.pinch("right", closed=False)
    person.press("Active")
    for _ in range(SCENES):
        time.sleep(FRAME / 1e3)
        yield _seen(person)


def _room(point) -> np.ndarray:
    """A point of the base frame in the room: the arm stands ahead of who enters."""
    return placed(np.array([point]), -np.pi / 2, (0.0, 0.72, -1.1))[0]


def _seen(person: Headset) -> Image.Image:
    person.frames(2)
    return Image.open(BytesIO(person.tab.screenshot(type="png"))).convert("RGB")


def _film(pictures: list[Image.Image]) -> bytes:
    buffer = BytesIO()
    first, *others = pictures
    options = {"save_all": True, "append_images": others, "duration": FRAME, "loop": 0}
    first.save(buffer, "WEBP", quality=60, method=6, **options)
    return buffer.getvalue()


if __name__ == "__main__":
    cli.run(main, Args)
