"""Reports of runs: the folder of a run, and one self-contained HTML page about one or several.

A program fills a `Report`; `write_report` writes `report.json`, pictures, `film.mp4` and
`report.html` to the folder of the run. `read_report` reads them again, and `reports_page` shows
several on one page. The page has no external script, font or picture: it can be mailed,
printed, and read offline.
"""

import base64
import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Literal
from urllib.parse import quote

from hrc_learn.store import new_file, read_json, write_json
from hrc_learn.viz.report_content import Film as Film
from hrc_learn.viz.report_content import Measurement as Measurement
from hrc_learn.viz.report_content import Picture as Picture
from hrc_learn.viz.report_content import Report as Report
from hrc_learn.viz.report_content import Section as Section
from hrc_learn.viz.report_content import flatten as flatten
from hrc_learn.viz.report_content import leading as leading
from hrc_learn.viz.report_content import show_command as show_command
from hrc_learn.viz.report_content import show_measurements as show_measurements
from hrc_learn.viz.report_content import software_versions as software_versions


def reports_page(title: str, reports: Sequence[Report], linked: Sequence[str] = ()) -> str:
    """One page about one or several runs, as HTML.

    Args:
        title: Title of the page.
        reports: Reports in order. Several are first listed with their verdicts.
        linked: Files in the folder of the page, to which a page of one run links.

    Raises:
        ValueError: If there is no report.
    """
    if not reports:
        raise ValueError("a page needs at least one report.")
    if len(reports) == 1:
        body = _report(reports[0], "run1", linked)
    else:
        articles = [
            f"<article>{_report(report, f'run{i}')}</article>"
            for i, report in enumerate(reports, 1)
        ]
        heading = f"<h1>{escape(title)}</h1>"
        overview = "\n".join(
            f'<tr><td class="n">{i}</td><td><a href="#run{i}">{escape(report.title)}</a></td>'
            f"<td>{_verdict(report)}</td></tr>"
            for i, report in enumerate(reports, 1)
        )
        overview = f'<table class="overview"><tbody>{overview}</tbody></table>'
        body = "\n".join([heading, overview, _side_by_side(reports), *articles])
    style = files(__package__).joinpath("report.css").read_text(encoding="utf-8")
    return _PAGE.format(title=escape(title), style=style, body=body)


def _side_by_side(reports: Sequence[Report]) -> str:
    """HTML table of all quantities that two or more runs measured; empty without any.

    Each column is a run, numbered as in the overview. Missed targets are marked.
    """
    tables = [{m.name: m for m in report.table} for report in reports]
    common = [name for name, n in Counter(n for t in tables for n in t).items() if n > 1]
    if not common:
        return ""
    compared = [i for i, table in enumerate(tables) if table.keys() & set(common)]
    heads = "".join(f'<th class="n"><a href="#run{i + 1}">{i + 1}</a></th>' for i in compared)
    rows = []
    for name in common:
        cells = "".join(_cell(tables[i].get(name)) for i in compared)
        rows.append(f"<tr><td>{escape(name)}</td>{cells}</tr>")
    return f"<h2>Side by side</h2>{_table(f'<th>Measured</th>{heads}', rows)}"


def _table(heads: str, rows: Sequence[str]) -> str:
    """HTML table that scrolls on a narrow page."""
    return (
        f'<div class="scroll"><table><thead><tr>{heads}</tr></thead>'
        f"<tbody>{'\n'.join(rows)}</tbody></table></div>"
    )


def _cell(m: Measurement | None) -> str:
    if m is None:
        return "<td></td>"
    missed = ' class="n miss"' if m.ok is False else ' class="n"'
    return f"<td{missed}>{escape(m.shown)}</td>"


def _report(report: Report, anchor: str, linked: Sequence[str] = ()) -> str:
    return "\n".join(
        [
            f'<h1 id="{anchor}">{escape(report.title)}</h1>',
            _verdict(report),
            _paragraphs(report.summary),
            "" if report.film is None else _film(report.film),
            _measurements(report.table),
            _links(linked),
            *(_section(section) for section in report.sections),
            *(
                [f"<h2>Reproduce</h2>\n<pre>{escape(report.command)}</pre>"]
                * bool(report.command)
            ),
            _details("Configuration", flatten(report.configuration)),
            _details("Versions", report.versions),
        ]
    )


def _verdict(report: Report) -> str:
    if not report.targets:
        return ""
    if not report.missed:
        reached = "The target" if report.targets == 1 else f"All {report.targets} targets"
        return f'<span class="verdict ok">{reached} reached.</span>'
    missed = f"{len(report.missed)} of {report.targets} targets missed."
    return f'<span class="verdict miss">{missed}</span>'


_FIRST = 6
"""Number of values shown unfolded."""


def _measurements(table: Sequence[Measurement]) -> str:
    """First values as a table, the others folded."""
    if not table:
        return ""
    first, others = leading(table, _FIRST)
    page = _values(first)
    if others:
        summary = f"{len(others)} more value" + "s" * (len(others) > 1)
        page += f"<details><summary>{summary}</summary>{_values(others)}</details>"
    return page


def _values(table: Sequence[Measurement]) -> str:
    """Values with their targets, and the claims of the paper if there are any."""
    claims = any(m.claim for m in table)
    heads = '<th>Measured</th><th class="n">Value</th><th class="n">Target</th><th></th>'
    if claims:
        heads += "<th>The paper says</th>"
    return _table(heads, [_row(m, claims) for m in table])


def _links(linked: Sequence[str]) -> str:
    """Links to the other files in the folder of the page."""
    if not linked:
        return ""
    links = ", ".join(f'<a href="{quote(name)}">{escape(name)}</a>' for name in linked)
    opens = " <code>hrc show</code> with this folder opens the recording."
    shown = opens if any(name.endswith(".rrd") for name in linked) else ""
    return f"<p>In this folder: {links}.{shown}</p>"


def _row(m: Measurement, claims: bool) -> str:
    marks = {
        True: '<td class="ok">✓ ok</td>',
        False: '<td class="miss">✗ missed</td>',
        None: "<td></td>",
    }
    claim = f"<td>{escape(m.claim)}</td>" if claims else ""
    return (
        f'<tr><td>{escape(m.name)}</td><td class="n">{escape(m.shown)}</td>'
        f'<td class="n">{escape(m.bound)}</td>{marks[m.ok]}{claim}</tr>'
    )


def _section(section: Section) -> str:
    figures = "\n".join(_figure(picture) for picture in section.figures)
    heading = f"<h2>{escape(section.heading)}</h2>"
    return f"<section>{heading}{_paragraphs(section.text)}{figures}</section>"


def _figure(picture: Picture) -> str:
    kind, content = ("svg+xml", picture.svg) if picture.svg else ("png", picture.png())
    data = base64.b64encode(content).decode("ascii")
    caption = escape(picture.caption)
    return (
        f'<figure><img alt="{caption}" src="data:image/{kind};base64,{data}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _film(film: Film) -> str:
    data = base64.b64encode(film.mp4).decode("ascii")
    caption = escape(film.caption)
    return (
        f'<figure><video controls autoplay muted loop playsinline aria-label="{caption}" '
        f'src="data:video/mp4;base64,{data}"></video>'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _paragraphs(text: str) -> str:
    parts = [part.strip() for part in text.split("\n\n")]
    return "\n".join(f"<p>{escape(part)}</p>" for part in parts if part)


def _details(summary: str, values: Mapping[str, object]) -> str:
    if not values:
        return ""
    rows = "\n".join(
        f"<tr><td>{escape(str(key))}</td><td>{escape(str(value))}</td></tr>"
        for key, value in values.items()
    )
    return (
        f"<details><summary>{escape(summary)}</summary>"
        '<div class="scroll"><table class="plain"><tbody>'
        f"{rows}</tbody></table></div></details>"
    )


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
{style}</style>
</head>
<body><main>
{body}
</main></body>
</html>
"""


REPORT = "report.json"
"""File that marks the folder of a run with a report."""
PAGE = "report.html"
FIGURES = "figures"
FILM = "film.mp4"
LINKED = (".rrd", ".mp4", ".npz")
"""Suffixes of recordings, films and logs in the folder, to which the page links."""


@dataclass(frozen=True, kw_only=True)
class _PictureFile:
    name: str
    caption: str


@dataclass(frozen=True, kw_only=True)
class _SectionFile:
    heading: str
    text: str
    figures: list[_PictureFile]


@dataclass(frozen=True, kw_only=True)
class _Row(Measurement):
    value: float | int | None  # pyright: ignore[reportIncompatibleVariableOverride]
    """Value; None if it is not finite, which JSON cannot represent."""


@dataclass(frozen=True, kw_only=True)
class _ReportFile:
    format: Literal["hrc_learn report"] = "hrc_learn report"
    version: Literal[1] = 1
    title: str
    summary: str
    command: str
    film: str | None = None
    """Caption of the film; None without one."""
    table: list[_Row]
    sections: list[_SectionFile]
    configuration: dict[str, bool | int | float | str | None]
    versions: dict[str, str]


def write_report(folder: str | os.PathLike[str], report: Report) -> None:
    """Write `report.json`, pictures, `film.mp4` and the self-contained `report.html`.

    Pictures are `figures/*.png`, and `*.svg` beside figures of few lines.

    Args:
        folder: Folder of the run. Each file appears only when complete, `report.json` last.
        report: Content of the report.
    """
    folder = Path(folder)
    report = _drawn(report)
    (folder / FIGURES).mkdir(parents=True, exist_ok=True)
    for picture in report.pictures:
        with new_file(folder / FIGURES / f"{picture.name}.png") as part:
            part.write_bytes(picture.png())
        vector = folder / FIGURES / f"{picture.name}.svg"
        if picture.svg is not None:
            with new_file(vector) as part:
                part.write_bytes(picture.svg)
        else:
            vector.unlink(missing_ok=True)  # of an older report
    if report.film is not None:
        with new_file(folder / FILM) as part:
            part.write_bytes(report.film.mp4)
    with new_file(folder / PAGE) as part:
        linked = sorted(file.name for file in folder.iterdir() if file.suffix in LINKED)
        part.write_text(reports_page(report.title, [report], linked), encoding="utf-8")
    write_json(folder / REPORT, _as_file(report))


def read_report(folder: str | os.PathLike[str]) -> Report:
    """Read the report in a folder.

    Raises:
        FileNotFoundError: If there is no such folder, or a picture or the film is missing.
        ValueError: If the folder holds no report, or one that this version cannot read.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is not a folder.")
    path = folder / REPORT
    if not path.is_file():
        raise ValueError(
            f"{folder} has no {REPORT}: it is not the folder of a run, or the run failed "
            "before its report."
        )
    advice = "read it with the package that wrote it, or repeat the run"
    content = read_json(path, _ReportFile, advice)
    return _from_file(content, folder)


def _drawn(report: Report) -> Report:
    """Report with every figure drawn, so that none is drawn twice."""
    sections = [
        replace(section, figures=[p.drawn() for p in section.figures])
        for section in report.sections
    ]
    return replace(report, sections=sections)


def _as_file(report: Report) -> _ReportFile:
    configuration = flatten(report.configuration)
    return _ReportFile(
        title=report.title,
        summary=report.summary,
        command=report.command,
        film=None if report.film is None else report.film.caption,
        table=[_Row(**vars(row)) for row in report.table],
        sections=[
            _SectionFile(
                heading=section.heading,
                text=section.text,
                figures=[_PictureFile(name=p.name, caption=p.caption) for p in section.figures],
            )
            for section in report.sections
        ],
        configuration={key: _plain(value) for key, value in configuration.items()},
        versions=dict(report.versions),
    )


def _from_file(content: _ReportFile, folder: Path) -> Report:
    sections = [
        Section(
            heading=section.heading,
            text=section.text,
            figures=[
                Picture(
                    figure.name,
                    (folder / FIGURES / f"{figure.name}.png").read_bytes(),
                    figure.caption,
                    _bytes_if_there(folder / FIGURES / f"{figure.name}.svg"),
                )
                for figure in section.figures
            ],
        )
        for section in content.sections
    ]
    table = [
        Measurement(**{**vars(row), "value": math.nan if row.value is None else row.value})
        for row in content.table
    ]
    film = None
    if content.film is not None:
        film = Film((folder / FILM).read_bytes(), content.film)
    return Report(
        title=content.title,
        summary=content.summary,
        command=content.command,
        table=table,
        sections=sections,
        film=film,
        configuration=content.configuration,
        versions=content.versions,
    )


def _bytes_if_there(path: Path) -> bytes | None:
    return path.read_bytes() if path.is_file() else None


def _plain(value: object) -> bool | int | float | str | None:
    """JSON value, with all other types converted to text."""
    if isinstance(value, (bool, int, str, type(None))):
        return value
    return value if isinstance(value, float) and math.isfinite(value) else str(value)
