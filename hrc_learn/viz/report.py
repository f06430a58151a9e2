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
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

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

    Quantities that two or more runs measured stand side by side.

    Args:
        title: Title of the page.
        reports: Reports in order. Several are first listed with their verdicts.
        linked: Files in the folder of the page, to which a page of one run links.

    Raises:
        ValueError: If there is no report.
    """
    if not reports:
        raise ValueError("a page needs at least one report.")
    tables = [{m.name: m for m in report.table} for report in reports]
    common = [name for name, n in Counter(n for t in tables for n in t).items() if n > 1]
    compared = [i for i, table in enumerate(tables) if table.keys() & set(common)]
    return (
        page_templates()
        .get_template("report.html")
        .render(
            title=title,
            reports=reports,
            linked=linked if len(reports) == 1 else (),
            common={name: [tables[i].get(name) for i in compared] for name in common},
            compared=[i + 1 for i in compared],
            style=files(__package__).joinpath("report.css").read_text(encoding="utf-8"),
            base64=lambda content: base64.b64encode(content).decode("ascii"),
            leading=leading,
            flatten=flatten,
        )
    )


def page_templates(package: str = "hrc_learn.viz") -> Any:
    """Templates of pages, in the folder of a package."""
    # Used only here; it takes some hundredths of a second to import.
    from jinja2 import Environment, PackageLoader

    return Environment(
        loader=PackageLoader(package, ""),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )


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

    Args:
        folder: Folder of the run. Each file appears only when complete, `report.json` last;
            pictures go to `figures/`.
        report: Content of the report.
    """
    folder = Path(folder)
    drawn = {picture.name: picture.png for picture in report.pictures}
    (folder / FIGURES).mkdir(parents=True, exist_ok=True)
    for name, png in drawn.items():
        with new_file(folder / FIGURES / f"{name}.png") as part:
            part.write_bytes(png)
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


def _as_file(report: Report) -> dict[str, object]:
    """Content of `report.json`, which fits `_ReportFile`; pictures and film are files."""
    sections = [
        {**vars(s), "figures": [{"name": p.name, "caption": p.caption} for p in s.figures]}
        for s in report.sections
    ]
    configuration = flatten(report.configuration)
    return {
        "format": "hrc_learn report",
        "version": 1,
        **vars(report),
        "film": None if report.film is None else report.film.caption,
        "sections": sections,
        "configuration": {key: _plain(value) for key, value in configuration.items()},
    }


def _from_file(content: _ReportFile, folder: Path) -> Report:
    def picture(shown: _PictureFile) -> Picture:
        png = (folder / FIGURES / f"{shown.name}.png").read_bytes()
        return Picture(shown.name, png, shown.caption)

    fields = {k: v for k, v in vars(content).items() if k not in ("format", "version")}
    fields["sections"] = [
        Section(heading=s.heading, text=s.text, figures=[*map(picture, s.figures)])
        for s in content.sections
    ]
    fields["table"] = [
        Measurement(**{**vars(row), "value": math.nan if row.value is None else row.value})
        for row in content.table
    ]
    if content.film is not None:
        fields["film"] = Film((folder / FILM).read_bytes(), content.film)
    return Report(**fields)


def _plain(value: object) -> bool | int | float | str | None:
    """JSON value, with all other types converted to text."""
    if isinstance(value, (bool, int, str, type(None))):
        return value
    return value if isinstance(value, float) and math.isfinite(value) else str(value)
