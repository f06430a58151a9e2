"""Refresh the pictures of docs/teleoperation.md: the page, as a browser shows it.

A mouse in a headless Chromium leads the simulated arm and is photographed meanwhile.

python docs/teleoperation.py
"""

import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

# The browser is that of the tests.
sys.path.append(str(Path(__file__).parents[1] / "tests"))
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


@dataclass(frozen=True, kw_only=True)
class Args:
    """Where to."""

    out: Path = Path(__file__).parent / "images"
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
    time.sleep(8.0)
    yield "page_region.jpg", browser.tab.screenshot(type="jpeg", quality=85)


if __name__ == "__main__":
    cli.run(main, Args)
