"""Check the pages of the documentation site in a headless Chromium.

Every page has to fit its window without scrolling sideways, and axe, a checker of
accessibility, may find nothing serious or critical: at the width of a phone in dark colours, at
that of a desktop in light ones.

    python tools/build_docs.py
    python tools/check_site.py                  # all pages of outputs/docs
    python tools/check_site.py --pages index howto/index
"""

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.progress import track

# The browser is that of the tests.
sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
from page_in_browser import chromium  # pyright: ignore[reportMissingImports]

from hrc_learn import cli

ROOT = Path(__file__).resolve().parents[1]
AXE = ROOT.joinpath(
    *("hrc_learn", "teleoperation", "xr_client", "node_modules", "axe-core", "axe.min.js")
)
"""Installed with the tools that build the client (`make xr`)."""
VIEWS = ((390, "slate"), (1280, "default"))
"""Widths [px] and colour schemes."""
STILL = "* {transition: none !important}"
"""Style; colours that fade to the other scheme would be measured on their way."""
SERIOUS = """async () => (await axe.run({resultTypes: ["violations"]})).violations
  .filter(v => ["serious", "critical"].includes(v.impact))
  .map(v => `${v.id} (${v.nodes.length}): ${v.nodes[0].html.slice(0, 200)}`)"""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Check the pages of the documentation site."""

    site: Path = ROOT / "outputs" / "docs"
    """Folder of the site."""
    pages: tuple[str, ...] = ()
    """Pages such as howto/index; all of them by default."""
    axe: Path = AXE
    """Script of axe-core."""


def main(args: Args) -> None:
    if not args.axe.is_file():
        raise ValueError(f"no axe-core at {args.axe}: run make xr, or give --axe")
    found = check_pages(args.site, args.pages, args.axe)
    print("\n".join(found) if found else "no fault")
    if found:
        raise SystemExit(1)


def check_pages(site: Path, pages: Sequence[str], axe: Path) -> list[str]:
    """Faults of pages, one a line.

    Args:
        site: Folder of the site.
        pages: Names without .html; all pages of the site if empty.
        axe: Script of axe-core.
    """
    names = pages or sorted(
        file.relative_to(site).with_suffix("").as_posix() for file in site.rglob("*.html")
    )
    missing = [name for name in names if not (site / f"{name}.html").is_file()]
    if missing or not names:
        raise ValueError(f"{site} has no page {', '.join(missing) or 'at all'}: build it first")
    script, found = axe.read_text("utf-8"), []
    with tempfile.TemporaryDirectory() as profile, chromium(Path(profile)) as tab:
        for name in track(names, "Pages", transient=True):
            tab.goto((site / f"{name}.html").as_uri())
            tab.add_style_tag(content=STILL)
            tab.evaluate(script)
            for width, scheme in VIEWS:
                tab.set_viewport_size({"width": width, "height": 844})
                tab.evaluate(f"document.body.dataset.mdColorScheme = '{scheme}'")
                wide = tab.evaluate("document.documentElement.scrollWidth")
                faults = [f"{wide} px wide"] if wide > width else []
                faults += tab.evaluate(SERIOUS)
                found += [f"{name}, {width} px, {scheme}: {fault}" for fault in faults]
    return found


if __name__ == "__main__":
    cli.run(main, Args)
