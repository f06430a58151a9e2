"""Issues of a dataset and their places, raised by readers or listed in validation reports."""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from shutil import get_terminal_size
from typing import Any, Literal

_UNPRINTABLE = re.compile(
    # Control characters, and characters that hide text or reverse its direction.
    "[\x00-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u2069\ufeff\ud800-\udfff]"
)
_LONGEST_TEXT, _END = 300, 120
"""`_LONGEST_TEXT`: largest number of characters shown of a text from a file.
`_END`: number of characters that a shortened text keeps at its end, where the advice stands."""
_LONGEST_MESSAGE = 1000
"""Largest number of characters shown of a message; large enough to keep its paths whole."""
_FIGURE_OR_QUOTE = re.compile(r"[-+]?\d[\d.e+-]*|'[^']*'")


def plain_text(text: str, longest: int = _LONGEST_TEXT) -> str:
    """Text from a file, safe to print in a terminal: its length is bounded, and characters that
    act on the terminal are replaced by their codes.

    Args:
        text: The text.
        longest: Number of characters shown; a longer text loses its middle.
    """
    shown = _UNPRINTABLE.sub(lambda found: f"\\x{ord(found[0]):02x}", text)
    return shown if len(shown) <= longest else f"{shown[: longest - _END]} ... {shown[-_END:]}"


def counted(number: int, noun: str) -> str:
    """A number and a noun in singular or plural, such as "1 warning" or "2 warnings"."""
    return f"{number} {noun}{'s' * (number != 1)}"


def aligned(rows: Sequence[tuple[str, ...]], side: Literal["<", ">"] = "<") -> Iterator[str]:
    """A table as text; the last column is not padded.

    If a terminal is too narrow for all columns but the last, the first cell of each row has a
    line of its own.

    Args:
        rows: Cells of each row.
        side: "<" for cells at the left of their columns, ">" at the right.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)][:-1]
    # A file or a pipe has no width.
    narrow = sum(widths) + 2 * len(widths) > get_terminal_size((100_000, 24)).columns
    for row in rows:
        cells = [f"{cell:{side}{w}}" for cell, w in zip(row, widths, strict=False)]
        if narrow:
            cells[0] = f"{row[0]}\n"
        yield "  ".join([*cells, row[-1]]).rstrip()


@dataclass(frozen=True, kw_only=True)
class Issue:
    """One fault or oddity of a dataset and its place."""

    message: str
    """The fault, and the remedy."""
    file: str | None = None
    """Faulty file, relative to the dataset where possible."""
    episode: int | None = None
    """Episode index."""
    frame: int | None = None
    """First frame concerned, counted from the start of the episode."""
    key: str | None = None
    """Column (feature) concerned, with the component in brackets if only one is at fault."""
    components: tuple[str, ...] = ()
    """Names of the components concerned."""
    severity: float = 0.0
    """Size of the fault, comparable among issues of one kind."""
    level: Literal["error", "warning"] = "error"

    @property
    def kind(self) -> tuple[str, str]:
        """Column and text of the issue, without its place, components, numbers and quotes."""
        column = (self.key or "").split(" (")[0]
        words = (w for w in self.message.split() if w.strip(".,:;") not in self.components)
        text = _FIGURE_OR_QUOTE.sub("#", " ".join(words))
        return column, " ".join(w for w in text.split() if "." not in w.strip(".,:;"))[:120]

    @property
    def reason(self) -> str:
        """Column and message, for a list of the issues of one episode."""
        return plain_text(f"{self.key}: {self.message}" if self.key else self.message)

    def __str__(self) -> str:
        episode = None if self.episode is None else f"episode {self.episode}"
        frame = None if self.frame is None else f"frame {self.frame}"
        place = ", ".join(part for part in (self.file, episode, frame, self.key) if part)
        text = f"{place}: {self.message}" if place else self.message
        return plain_text(text, _LONGEST_MESSAGE)


warning = partial(Issue, level="warning")


class DatasetError(ValueError):
    """A dataset that cannot be read; `file`, `episode`, `frame` and `key` locate the fault."""

    def __init__(self, message: str, *, file: str | Path | None = None, **place: Any):
        name = None if file is None else str(file)
        self.issue = Issue(message=message, file=name, **place)
        self.file, self.episode = name, self.issue.episode
        self.frame, self.key = self.issue.frame, self.issue.key
        super().__init__(str(self.issue))


class UnitsWarning(UserWarning):
    """Values were converted from units that the dataset does not declare."""


_KINDS_SHOWN = 16
"""Largest number of error lines and of warning lines in a summary: both fit on one screen."""
_PLACES_SHOWN = 8


@dataclass(kw_only=True)
class ValidationReport:
    """Errors and warnings about one dataset."""

    path: Path
    errors: list[Issue] = field(default_factory=list)
    """Faults that lose data or mislead a reader."""
    warnings: list[Issue] = field(default_factory=list)
    """Oddities worth a look before training."""
    episodes: int = 0
    """Readable episodes."""
    frames: int = 0
    """Frames of the readable episodes."""
    contract: Any = None
    """Contract of the columns (`read.contract.Contract`); None if nothing could be read."""

    @property
    def ok(self) -> bool:
        """True if there are no errors; warnings are allowed."""
        return not self.errors

    def add(self, issue: Issue) -> None:
        """Append an issue to the errors or the warnings."""
        (self.errors if issue.level == "error" else self.warnings).append(issue)

    def add_error(self, error: DatasetError) -> None:
        """Append the issue of a reading error, unless it is listed already."""
        if error.issue not in self.errors:
            self.errors.append(error.issue)

    def attempt[T](self, read: Callable[[], T]) -> T | None:
        """Run a step of the check; if it fails, add an error to the report and return None.

        Foreign data can make a step fail in unforeseen ways. The check then reports an error
        instead of crashing.
        """
        try:
            return read()
        except DatasetError as error:
            self.add_error(error)
        except Exception as error:
            text = f"{type(error).__name__}: {str(error)[:200]}"
            self.add(Issue(message=f"cannot be examined further ({text})", file=str(self.path)))
        return None

    def run[**P](
        self, check: Callable[P, Iterable[Issue]], *args: P.args, **kwargs: P.kwargs
    ) -> None:
        """Run a check and add its issues to the report."""
        self.attempt(lambda: [self.add(issue) for issue in check(*args, **kwargs)])

    def lines(self, full: bool = False) -> Iterator[str]:
        """The report as text; issues of one kind become one line that names the worst place.

        Args:
            full: Give every issue a line of its own.
        """
        for level, issues in (("error", self.errors), ("warning", self.warnings)):
            if full:
                yield from (f"{level}: {issue}" for issue in issues)
                continue
            kinds: dict[tuple[str, str], list[Issue]] = {}
            for issue in issues:
                kinds.setdefault(issue.kind, []).append(issue)
            # One broken file causes errors of many kinds: the first ones explain the rest.
            for alike in list(kinds.values())[:_KINDS_SHOWN]:
                yield f"{level}: {_summary(alike)}"
            if len(kinds) > _KINDS_SHOWN:
                yield f"{level}: and {len(kinds) - _KINDS_SHOWN} more kinds (--full)"
        yield (
            f"{self.path}: {counted(self.episodes, 'episode')}, "
            f"{counted(self.frames, 'frame')}, {counted(len(self.errors), 'error')}, "
            f"{counted(len(self.warnings), 'warning')}"
        )

    def records(self) -> list[dict]:
        """Every issue as a dictionary of its fields."""
        return [vars(issue) for issue in (*self.errors, *self.warnings)]

    def __str__(self) -> str:
        return "\n".join(self.lines())


def _summary(alike: list[Issue]) -> str:
    """The worst issue of a kind, and the places of the others."""
    worst = max(alike, key=lambda issue: issue.severity)
    if len(alike) == 1:
        return str(worst)
    others = [issue for issue in alike if issue is not worst]
    places = dict.fromkeys(issue.episode for issue in others if issue.episode is not None)
    shown = ", ".join(map(str, [*places][:_PLACES_SHOWN]))
    more = ", ..." if len(places) > _PLACES_SHOWN else ""
    where = f"; episodes {shown}{more}" if places else ""
    return f"{worst} (and {len(others)} more{where})"
