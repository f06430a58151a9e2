"""Refresh the pictures and tables of docs/benchmarks/experiments.md from the folders of runs.

The pages of docs/ decide what is shown: each `images/KIND_NAME.png` in them is made from the
picture NAME in the report of that kind of run, and the lines between `<!-- KIND measured -->`
and `<!-- end -->` of the page become the table of what that run measured.

python tools/docs/experiments.py --placing outputs/placing --grasping outputs/grasping

`readme_film.py` makes images/film.webp, which README and site show.
"""

import re
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from PIL import Image

from hrc_learn import cli
from hrc_learn.viz.report import Measurement, Report, read_report

DOCS = Path(__file__).parents[2] / "docs"
PAGE = DOCS / "benchmarks" / "experiments.md"
WIDTH = 1000
"""Of the pictures, at most [px]."""
COLOURS = 256
"""Of a picture: what flat areas and lines need, in a sixth of the bytes."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Which runs to show."""

    placing: Path | None = None
    """Folder of `hrc run placing`; what the page shows of it stays as it is without."""
    grasping: Path | None = None
    """Folder of `hrc run grasping`, likewise."""
    collaboration: Path | None = None
    """Folder of `hrc run collaboration`, likewise."""
    pictures_only: bool = False
    """Leave the tables of the page as they are."""
    page: Path = PAGE
    """The page; pictures are those of all pages of docs/, or of another page alone."""
    images: Path = DOCS / "images"
    """Folder of the pictures."""


def main(args: Args) -> None:
    runs = {
        "placing": args.placing,
        "grasping": args.grasping,
        "collaboration": args.collaboration,
    }
    reports = {kind: read_report(run) for kind, run in runs.items() if run is not None}
    if not reports:
        raise ValueError("no run: give --placing, --grasping or --collaboration")
    text = args.page.read_text()
    pages = sorted(DOCS.rglob("*.md")) if args.page == PAGE else [args.page]
    shown = "\n".join(page.read_text() for page in pages)
    pictures: dict[str, bytes] = {}
    for kind, report in reports.items():
        pictures |= shown_pictures(kind, report, shown)
        text = text if args.pictures_only else with_table(kind, report, text)
    for name, content in pictures.items():
        path = args.images / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
        print(f"{path}: {len(content) / 1e3:.0f} kB")
    cli.write_text(args.page, text)


def shown_pictures(kind: str, report: Report, page: str) -> dict[str, bytes]:
    """The pictures of a report that a page shows, by the names of their files."""
    there = {picture.name: picture for picture in report.pictures}
    wanted = dict.fromkeys(re.findall(rf"images/{kind}_([\w-]+)\.png", page))
    unknown = wanted.keys() - there.keys()
    if unknown:
        raise ValueError(
            f"the page shows a picture {min(unknown)!r} of {kind}, but the report has "
            f"{', '.join(there)}"
        )
    return {f"{kind}_{name}.png": small(there[name].png) for name in wanted}


def small(png: bytes) -> bytes:
    """A picture no wider than the page, with few colours."""
    image = Image.open(BytesIO(png)).convert("RGB")
    if image.width > WIDTH:
        height = round(image.height * WIDTH / image.width)
        image = image.resize((WIDTH, height), Image.Resampling.LANCZOS)
    buffer = BytesIO()
    # By an octree, as the median cut spends its colours on photographs and mixes up lines.
    few = image.quantize(COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    few.save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def with_table(kind: str, report: Report, page: str) -> str:
    """The page with what was measured between the marks of a kind of run, if it has them."""
    begin, end = f"<!-- {kind} measured -->", "<!-- end -->"
    before, found, rest = page.partition(begin)
    if not found:
        return page
    _, closed, after = rest.partition(end)
    if not closed:
        raise ValueError(f"{begin} in the page is not followed by {end}")
    claims = any(m.claim for m in report.table)
    heads = ["measured", "value", "target", *(["the paper says"] if claims else [])]
    rows = [heads, ["---", "---:", "---:", "---"][: len(heads)]]
    rows += [cells(m)[: len(heads)] for m in report.table]
    table = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    return f"{before}{begin}\n\n{table}\n\n{end}{after}"


def cells(m: Measurement) -> list[str]:
    """A row of the table; a value that missed its target is marked."""
    missed = " **(missed)**" if m.ok is False else ""
    return [text.replace("|", "\\|") for text in (m.name, m.shown + missed, m.bound, m.claim)]


if __name__ == "__main__":
    cli.run(main, Args)
