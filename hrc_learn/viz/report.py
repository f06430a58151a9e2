"""Reports of runs: measured values, pictures and text in a folder, and one page about them.

A program fills a `Report`; `write_report` writes `report.json`, pictures, `film.mp4` and
`report.html` to the folder of the run. `read_report` reads them again, and `reports_page` shows
several on one page. The page has no external script, font or picture: it can be mailed,
printed, and read offline.
"""

import base64
import math
import os
import platform
import re
import shlex
import shutil
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hrc_learn.store import new_file, read_json, write_json

_DPI = 150  # sharp in print, at the width of a page


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """One measured value with its target."""

    name: str
    """Name of the quantity, in words."""
    value: float | int
    unit: str = ""
    target: float | int | None = None
    """Bound of the value; None: it is only reported."""
    at_least: bool = False
    """True if the target is a lower bound; it is an upper one otherwise."""
    claim: str = ""
    """Claim of the paper, in words; empty without one."""
    resolution: float = 0.0
    """Resolution of the measurement; no finer digits are shown."""

    @property
    def ok(self) -> bool | None:
        """True if the target is met, None without a target. NaN does not meet any target."""
        if self.target is None:
            return None
        # Python's bool, because callers test `ok is False`, which never holds for numpy's.
        return bool(self.value >= self.target if self.at_least else self.value <= self.target)

    @property
    def shown(self) -> str:
        """Value and unit for a reader, without digits below the resolution."""
        if abs(self.value) < self.resolution:
            return f"< {short(self.resolution)} {self.unit}".rstrip()
        rounded = replace(self, value=_rounded(self.value, self.resolution))
        # A bound missed by less than the resolution must not look as if it was met.
        value = rounded.value if rounded.ok is self.ok else self.value
        return f"{short(value)} {self.unit}".rstrip()

    @property
    def bound(self) -> str:
        """Target and unit for a reader, empty without a target."""
        if self.target is None:
            return ""
        return f"{'≥' if self.at_least else '≤'} {short(self.target)} {self.unit}".rstrip()

    @property
    def key(self) -> str:
        """Name and unit as one word: the key of the value in JSON files."""
        words = re.findall(r"\w+", self.name.lower())
        return "_".join([*words, *([self.unit] if self.unit else [])])


type Row = tuple[str, str, float, str, float | None, float]
"""Key, name, factor to the unit, unit, largest value that passes, resolution."""


def measured(rows: Iterable[Row], values: Mapping[str, float | int]) -> list[Measurement]:
    """Measurements of the rows whose values are given; values without a unit are counts."""
    return [
        Measurement(
            name=name,
            value=factor * values[key] if unit else round(values[key]),
            unit=unit,
            target=target,
            resolution=resolution,
        )
        for key, name, factor, unit, target, resolution in rows
        if key in values
    ]


@dataclass(frozen=True)
class Picture:
    """A picture with its caption."""

    name: str
    """Name of its file without suffix: letters, digits, hyphens and underscores."""
    drawing: Any = b""
    """A matplotlib figure, an RGB image (height, width, 3), or a finished PNG file."""
    caption: str = ""
    narrow: bytes = b""
    """PNG file of a figure for phones, with its panels above one another; drawn together with
    `png`. Empty for photographs."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[\w-]+", self.name):
            raise ValueError(
                f"picture name {self.name!r} is not a portable file name: "
                "use letters, digits, hyphens and underscores."
            )

    @cached_property
    def png(self) -> bytes:
        """The picture as a PNG file, drawn once."""
        if isinstance(self.drawing, bytes):
            return self.drawing
        buffer = BytesIO()
        if isinstance(self.drawing, np.ndarray):
            from PIL import Image

            Image.fromarray(self.drawing).save(buffer, "PNG", optimize=True)
        else:
            from hrc_learn.viz.figures import stack_panels

            self.drawing.savefig(buffer, format="png", dpi=_DPI)
            phone = BytesIO()
            stack_panels(self.drawing)
            self.drawing.savefig(phone, format="png", dpi=_DPI)
            object.__setattr__(self, "narrow", phone.getvalue())
        return buffer.getvalue()


@dataclass(frozen=True)
class Film:
    """A film with its caption."""

    mp4: bytes
    """The file."""
    caption: str


@dataclass(frozen=True, kw_only=True)
class Section:
    """A heading, paragraphs and pictures."""

    heading: str
    text: str = ""
    """Plain text; blank lines separate paragraphs."""
    figures: Sequence[Picture] = ()


@dataclass(frozen=True, kw_only=True)
class Report:
    """Results of a run.

    Raises:
        ValueError: If two pictures have the same name.
    """

    title: str
    summary: str
    """Description of the run, in plain text; blank lines separate paragraphs."""
    table: Sequence[Measurement] = ()
    """All measured values."""
    sections: Sequence[Section] = ()
    film: Film | None = None
    """Film of the run."""
    configuration: Mapping[str, Any] = field(default_factory=dict)
    """Configuration of the run; nested mappings are flattened."""
    versions: Mapping[str, str] = field(default_factory=dict)
    """Versions of the software, by name."""
    command: str = ""
    """Command line that repeats the run."""

    def __post_init__(self) -> None:
        names = Counter(picture.name for picture in self.pictures)
        if twice := [name for name, count in names.items() if count > 1]:
            raise ValueError(f"report {self.title!r} has two pictures named {twice[0]!r}.")

    @property
    def targets(self) -> int:
        """Number of values with a target."""
        return sum(m.ok is not None for m in self.table)

    @property
    def missed(self) -> tuple[Measurement, ...]:
        """Values that missed their target."""
        return tuple(m for m in self.table if m.ok is False)

    @property
    def pictures(self) -> tuple[Picture, ...]:
        """Pictures of all sections, in order."""
        return tuple(picture for section in self.sections for picture in section.figures)


def leading(
    table: Sequence[Measurement], count: int
) -> tuple[tuple[Measurement, ...], tuple[Measurement, ...]]:
    """Measurements to show first, and the others, both in the order of the table.

    All missed targets are shown first. Met targets, then values without a target, are added up
    to `count` measurements.

    Args:
        table: All measurements.
        count: Number of measurements shown first, unless more have missed their targets.
    """
    ranks = {False: 0, True: 1, None: 2}
    order = sorted(range(len(table)), key=lambda i: ranks[table[i].ok])
    missed = sum(m.ok is False for m in table)
    first = set(order[: max(count, missed)])
    return (
        tuple(m for i, m in enumerate(table) if i in first),
        tuple(m for i, m in enumerate(table) if i not in first),
    )


def _rounded(value: float | int, resolution: float) -> float | int:
    """Value rounded to its resolution; 0 leaves it unchanged."""
    if resolution == 0 or not math.isfinite(value):
        return value
    return round(value, math.ceil(-math.log10(resolution)))


def short(value: float | int) -> str:
    """Three significant digits; whole numbers in full."""
    return str(int(value)) if float(value).is_integer() and abs(value) < 1e9 else f"{value:.3g}"


def flatten(mapping: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one, keys joined by dots."""
    flat: dict[str, Any] = {}
    for key, value in mapping.items():
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


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
    template = page_templates().get_template("report.html")
    return template.render(
        title=title,
        reports=reports,
        linked=linked if len(reports) == 1 else (),
        common={name: [tables[i].get(name) for i in compared] for name in common},
        compared=[i + 1 for i in compared],
        base64=lambda content: base64.b64encode(content).decode("ascii"),
        leading=leading,
        flatten=flatten,
    )


def page_templates(package: str = "hrc_learn.viz") -> Any:
    """Templates of pages, in the folder of a package."""
    # Used only here; it takes some hundredths of a second to import.
    from jinja2 import Environment, PackageLoader

    return Environment(
        loader=PackageLoader(package, ""), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )


REPORT = "report.json"
"""File that marks the folder of a run with a report."""
PAGE = "report.html"
FIGURES = "figures"
NARROW = "narrow"
"""Subfolder of `FIGURES` with the figures for phones."""
FILM = "film.mp4"
LINKED = (".rrd", ".mp4", ".npz")
"""Suffixes of recordings, films and logs in the folder, to which the page links."""


@dataclass(frozen=True, kw_only=True)
class _Row(Measurement):
    value: float | int | None  # pyright: ignore[reportIncompatibleVariableOverride]
    """Value; None if it is not finite, which JSON cannot represent."""


@dataclass(frozen=True, kw_only=True)
class _ReportFile(Report):
    """Content of `report.json`: pictures and film are files next to it."""

    format: Literal["hrc_learn report"] = "hrc_learn report"
    version: Literal[1] = 1
    table: Sequence[_Row]  # pyright: ignore[reportGeneralTypeIssues]
    film: str | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    """Caption of the film; None without one."""


def write_report(folder: str | os.PathLike[str], report: Report) -> None:
    """Write `report.json`, pictures, `film.mp4` and the self-contained `report.html`.

    Args:
        folder: Folder of the run. Each file appears only when complete, `report.json` last;
            pictures go to `figures/`, those for phones to `figures/narrow/`.
        report: Content of the report.
    """
    folder = Path(folder)
    drawn = {f"{picture.name}.png": picture.png for picture in report.pictures}
    drawn |= {f"{NARROW}/{p.name}.png": p.narrow for p in report.pictures if p.narrow}
    (folder / FIGURES / NARROW).mkdir(parents=True, exist_ok=True)
    for name, png in drawn.items():
        with new_file(folder / FIGURES / name) as part:
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
            "before its report was written."
        )
    advice = "read it with the package that wrote it, or repeat the run"
    return _from_file(read_json(path, _ReportFile, advice), folder)


def _as_file(report: Report) -> dict[str, Any]:
    """Content of `report.json`, which fits `_ReportFile`."""
    sections = [
        {**vars(s), "figures": [{"name": p.name, "caption": p.caption} for p in s.figures]}
        for s in report.sections
    ]
    return {
        "format": "hrc_learn report",
        "version": 1,
        **vars(report),
        "film": None if report.film is None else report.film.caption,
        "sections": sections,
        "configuration": flatten(report.configuration),
    }


def _from_file(content: _ReportFile, folder: Path) -> Report:
    def with_pictures(section: Section) -> Section:
        drawn = []
        for picture in section.figures:
            wide, narrow = (
                folder / FIGURES / place / f"{picture.name}.png" for place in ("", NARROW)
            )
            phone = narrow.read_bytes() if narrow.is_file() else b""
            drawn.append(replace(picture, drawing=wide.read_bytes(), narrow=phone))
        return replace(section, figures=drawn)

    values = {field.name: getattr(content, field.name) for field in fields(Report)}
    values["sections"] = [with_pictures(section) for section in content.sections]
    values["table"] = [
        Measurement(**{**vars(row), "value": math.nan if row.value is None else row.value})
        for row in content.table
    ]
    if content.film is not None:
        values["film"] = Film((folder / FILM).read_bytes(), content.film)
    return Report(**values)


_LIBRARIES = ("torch", "mujoco", "lerobot", "opencv-python-headless", "rerun-sdk", "viser")


def software_versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on, by name."""
    found = {"python": platform.python_version()}
    for name in ("hrc-learn", *_LIBRARIES):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def show_command(path: str | os.PathLike[str]) -> str:
    """Shell command that opens the dashboard of a run or a recording.

    The command contains the program's path, unless the search path leads to this program.
    """
    python = Path(sys.executable)
    program = python.with_name("hrc")
    if shutil.which("hrc") == str(program):
        return shlex.join(["hrc", "show", str(path)])
    words = [str(program)] if program.is_file() else [str(python), "-m", "hrc_learn.cli"]
    return shlex.join([*(shortest(word) for word in words), "show", str(path)])


def shortest(word: str) -> str:
    """A word of a command; a path below the current folder becomes a relative path."""
    path = Path(word)
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else word


_ROWS = 8
"""Rows of a table in the terminal, few enough to stay in view."""


def show_measurements(
    table: Sequence[Measurement],
    *,
    title: str = "Measured",
    more: int = 0,
    elsewhere: str = "the report",
) -> None:
    """Print measured values with their targets: all missed ones, and the first others.

    Args:
        table: The values.
        title: Title of the table.
        more: Number of further values that are not in the table.
        elsewhere: Place of the values that are not shown.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    # As Text, so that brackets in the name of a folder are not read as markup.
    shown = Table("measured", "value", "target", "", title=Text(title))
    marks = {True: "[green]ok[/]", False: "[red]missed[/]", None: ""}
    first, others = leading(table, _ROWS)
    for m in first:
        shown.add_row(m.name, m.shown, m.bound, marks[m.ok])
    if left := more + len(others):
        shown.caption = f"{left} more: {elsewhere}"
    Console().print(shown)
