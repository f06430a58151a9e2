"""Refresh the pictures of docs/concepts/dashboards.md: what a browser shows of each recording.

Every recording is served as `hrc show --web` does, opened in a headless Chromium and
photographed; of a run, each of its tabs.

hrc run collaboration --pulls random --worker --out outputs/near_worker
python tools/docs/dashboards.py --run outputs/near_worker/run.rrd --tabs story person

`tools/build_gallery.py` lists the commands of all pictures.
"""

import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Literal

from PIL import Image

# The browser is that of the tests.
sys.path.append(str(Path(__file__).parents[2] / "tests"))
from page_in_browser import chromium  # pyright: ignore[reportMissingImports]

from hrc_learn import cli
from hrc_learn.teleoperation.dashboard_page import serve_recordings

SIZE = (1600, 1000)
"""Of the window [px]."""
WIDTH = 1200
"""Of the pictures, at which the viewer's text can still be read [px]."""
TABS = ("Story", "Servoing", "Person", "Worker", "Primitive", "Safety", "Lyapunov")
"""Of a run, as `run_tabs` names them."""
LEFT, DOWN, LETTER, MARGIN = 800, 40, 6.5, 33
"""Where the viewer draws the row of a run's tabs, and how wide they are: a letter, and what is
around a title [px]. Read off its picture: the viewer draws them itself, without elements."""
PAUSES = 20
"""Most pauses of a viewer that still draws."""


type Tab = Literal["story", "servoing", "person", "worker", "primitive", "safety", "lyapunov"]


@dataclass(frozen=True, kw_only=True)
class Args:
    """Which recordings to show; the pictures of others stay as they are."""

    run: Path | None = None
    """Of `hrc run collaboration`."""
    tabs: tuple[Tab, ...] = ("story", "person", "servoing", "safety")
    """Tabs of the run to photograph."""
    demonstrations: Path | None = None
    """Of `hrc show DATASET --out FILE`."""
    fit: Path | None = None
    """Of `hrc fit`."""
    pause: float = 30.0
    """A picture that stays the same for so long is complete [s]."""
    out: Path = Path(__file__).parents[2] / "docs" / "images"
    """Folder of the pictures."""


def main(args: Args) -> None:
    recordings = {
        "dashboard": args.run,
        "demonstrations": args.demonstrations,
        "fit_dashboard": args.fit,
    }
    for name, recording in recordings.items():
        if recording is None:
            continue
        for suffix, content in _pictures(
            recording, args.pause, args.tabs if name == "dashboard" else ()
        ):
            file = args.out / f"{name}{suffix}.jpg"
            file.write_bytes(content)
            print(f"{file}: {len(content) / 1e3:.0f} kB", flush=True)


def _pictures(
    recording: Path, pause: float, tabs: tuple[Tab, ...]
) -> Iterator[tuple[str, bytes]]:
    with (
        tempfile.TemporaryDirectory() as profile,
        serve_recordings([recording], 0) as address,
        chromium(Path(profile), SIZE) as tab,
    ):
        tab.goto(address, timeout=120e3)
        shown = _settled(tab, pause)
        if not tabs:
            yield "", _picture(shown)
        left = float(LEFT)
        for title in TABS if tabs else ():
            width, name = MARGIN + LETTER * len(title), title.split()[0].lower()
            if name not in tabs:
                left += width
                continue
            tab.mouse.click(left + width / 2, DOWN)
            if title != TABS[0]:  # the first one is open
                shown = _settled(tab, pause, before=shown)
            yield f"_{name}", _picture(shown)
            left += width


def _settled(tab, pause: float, before: bytes = b"") -> bytes:
    """Picture of the viewer as soon as it is the same after a pause [s].

    A busy machine may still show the tab of `before`, which is not taken.
    """
    last = b""
    for _ in range(PAUSES):
        # The viewer draws while something moves over it; else a scale stays half drawn.
        for place in ((LEFT + 200, 300), (LEFT + 400, 500), (LEFT / 2, SIZE[1] - 5)):
            tab.wait_for_timeout(1e3 * pause / 3)
            tab.mouse.move(*place)
        shown = tab.screenshot(type="png", timeout=300e3)
        if shown == last and shown != before:
            return shown
        last = shown
    raise ValueError(f"the viewer draws for longer than {PAUSES * pause:.0f} s: raise --pause")


def _picture(shown: bytes) -> bytes:
    image = Image.open(BytesIO(shown)).convert("RGB")
    buffer = BytesIO()
    smaller = image.resize((WIDTH, WIDTH * SIZE[1] // SIZE[0]), Image.Resampling.LANCZOS)
    smaller.save(buffer, "JPEG", quality=80)
    return buffer.getvalue()


if __name__ == "__main__":
    cli.run(main, Args)
