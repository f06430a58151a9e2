"""Content of a report: text, measured values with their targets, pictures, versions."""

import math
import os
import platform
import re
import shlex
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
        """True if the target is met, None without a target. NaN meets none."""
        if self.target is None:
            return None
        # A bool of Python's own: numpy's is neither True nor False to an `is`.
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


@dataclass(frozen=True)
class Picture:
    """A picture with its caption."""

    name: str
    """Name of its file without suffix: letters, digits, hyphens and underscores."""
    drawing: "Figure | UInt8[np.ndarray, 'height width 3'] | bytes"
    """A matplotlib figure, an image, or a finished PNG file."""
    caption: str

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
            self.drawing.savefig(buffer, format="png", dpi=_DPI)
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
    """Plain text; blank lines part paragraphs."""
    figures: Sequence[Picture] = ()


@dataclass(frozen=True, kw_only=True)
class Report:
    """Results of a run.

    Raises:
        ValueError: If two pictures have the same name.
    """

    title: str
    summary: str
    """Description of the run, in plain text; blank lines part paragraphs."""
    table: Sequence[Measurement] = ()
    """All measured values."""
    sections: Sequence[Section] = ()
    film: Film | None = None
    """Film of the run."""
    configuration: Mapping[str, object] = field(default_factory=dict)
    """Configuration of the run; nested mappings are flattened."""
    versions: Mapping[str, str] = field(default_factory=dict)
    """Versions of the software, by name."""
    command: str = ""
    """Command line that repeats the run."""

    def __post_init__(self) -> None:
        names = [picture.name for section in self.sections for picture in section.figures]
        twice = {name for name in names if names.count(name) > 1}
        if twice:
            raise ValueError(f"report {self.title!r} has two pictures named {twice.pop()!r}.")

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

    Those that missed their targets come first, however many; then others with a target.

    Args:
        table: All measurements.
        count: Number of measurements shown first, unless more missed.
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


def flatten(mapping: Mapping[str, object], prefix: str = "") -> dict[str, object]:
    """Nested mappings as one, keys joined by dots."""
    flat: dict[str, object] = {}
    for key, value in mapping.items():
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


_PACKAGES = (
    "hrc-learn",
    "torch",
    "mujoco",
    "lerobot",
    "opencv-python-headless",
    "rerun-sdk",
    "viser",
)


def software_versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on, by name."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def show_command(path: str | os.PathLike[str]) -> str:
    """Shell command that opens the dashboard of a run or a recording.

    It names the program by its path if another one, or none, is on the search path.
    """
    python = Path(sys.executable)
    program = python.with_name("hrc")
    if shutil.which("hrc") == str(program):
        return shlex.join(["hrc", "show", str(path)])
    words = [str(program)] if program.is_file() else [str(python), "-m", "hrc_learn.cli"]
    return shlex.join([*(_shortest(word) for word in words), "show", str(path)])


def _shortest(word: str) -> str:
    path = Path(word)
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else word


_ROWS = 8
"""Rows of a table in the terminal, few enough to stay in view."""


def show_measurements(
    table: Sequence[Measurement],
    everything: bool = False,
    *,
    title: str = "Measured",
    more: int = 0,
    elsewhere: str = "the report",
) -> None:
    """Print measured values with their targets.

    Args:
        table: The values.
        everything: Print all values, not only the missed and the first of the others.
        title: Title of the table.
        more: Number of further values that are not in the table.
        elsewhere: Place of the values that are not shown.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    # As text: brackets in the name of a folder are no markup.
    shown = Table("measured", "value", "target", "", title=Text(title))
    marks = {True: "[green]ok[/]", False: "[red]missed[/]", None: ""}
    first, others = (tuple(table), ()) if everything else leading(table, _ROWS)
    for m in first:
        shown.add_row(m.name, m.shown, m.bound, marks[m.ok])
    if left := more + len(others):
        shown.caption = f"{left} more: {elsewhere}"
    Console().print(shown)
