"""What is wrong with a dataset, and where: the one form that errors and reports share."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

_UNPRINTABLE = re.compile(
    # Control characters, and those that turn the direction of text or hide it.
    "[\x00-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u2069\ufeff\ud800-\udfff]"
)
_LONGEST_NAME = 300


def plain_text(text: str) -> str:
    """Text from a file as it may be shown in a terminal: without escapes, and not too long."""
    shown = _UNPRINTABLE.sub(lambda found: f"\\x{ord(found[0]):02x}", text)
    return shown if len(shown) <= _LONGEST_NAME else f"{shown[:_LONGEST_NAME]}..."


@dataclass(frozen=True, kw_only=True)
class Issue:
    """One fault or oddity of a dataset, located as closely as is known."""

    message: str
    """What is wrong and what to do about it."""
    file: str | None = None
    """File the fault lies in, relative to the dataset where possible."""
    episode: int | None = None
    """Episode index."""
    frame: int | None = None
    """First frame concerned, counted from the start of the episode."""
    key: str | None = None
    """Column (feature) concerned, with the name of its component where one is to blame."""
    severity: float = 0.0
    """How bad it is among findings of its kind, in the kind's own measure."""
    names: tuple[str, ...] = ()
    """Components that the message names."""

    @property
    def kind(self) -> tuple[str, str]:
        """What findings that differ in place, components and figures alone have in common."""
        column = (self.key or "").split(" (")[0]
        # Of some components or of another number of them: the same kind.
        words = (w for w in self.message.split() if w.strip(".,:;") not in self.names)
        text = re.sub(r"[-+]?\d[\d.e+-]*|'[^']*'", "#", " ".join(words))
        return column, " ".join(w for w in text.split() if "." not in w.strip(".,:;"))[:120]

    def __str__(self) -> str:
        episode = None if self.episode is None else f"episode {self.episode}"
        frame = None if self.frame is None else f"frame {self.frame}"
        place = ", ".join(part for part in (self.file, episode, frame, self.key) if part)
        return plain_text(f"{place}: {self.message}" if place else self.message)


class DatasetError(ValueError):
    """A dataset that cannot be read, with the place of the fault as attributes.

    Attributes:
        finding: The fault and its place; `.file`, `.episode`, `.frame`, `.key` are its own.
    """

    def __init__(
        self,
        message: str,
        *,
        file: str | Path | None = None,
        episode: int | None = None,
        frame: int | None = None,
        key: str | None = None,
    ):
        self.finding = Issue(
            message=message,
            file=None if file is None else str(file),
            episode=episode,
            frame=frame,
            key=key,
        )
        super().__init__(str(self.finding))

    @property
    def file(self) -> str | None:
        return self.finding.file

    @property
    def episode(self) -> int | None:
        return self.finding.episode

    @property
    def frame(self) -> int | None:
        return self.finding.frame

    @property
    def key(self) -> str | None:
        return self.finding.key


class UnitsWarning(UserWarning):
    """Values were converted from units that the dataset does not declare."""


# The findings about one dataset.

_KINDS_SHOWN = 16
"""Lines of errors and of warnings: both fit on one screen."""
_PLACES_SHOWN = 8


@dataclass(kw_only=True)
class ValidationReport:
    """What is wrong with a dataset (errors), and what is odd (warnings)."""

    path: Path
    errors: list[Issue] = field(default_factory=list)
    """Faults that lose data or mislead a reader."""
    warnings: list[Issue] = field(default_factory=list)
    """Oddities worth a look before training."""
    episodes: int = 0
    """Episodes whose frames could be read."""
    frames: int = 0
    """Frames of those episodes."""
    contract: Any = None
    """What each column means (`read.contract.Contract`); None where nothing could be read."""

    @property
    def ok(self) -> bool:
        """Whether there are no errors; warnings are allowed."""
        return not self.errors

    def error(self, message: str, **place) -> None:
        """Add an error; `place` as in `Issue`."""
        self.errors.append(Issue(message=message, **place))

    def warning(self, message: str, **place) -> None:
        """Add a warning; `place` as in `Issue`."""
        self.warnings.append(Issue(message=message, **place))

    def add(self, error: DatasetError) -> None:
        """Add what a reading function raised."""
        if error.finding not in self.errors:
            self.errors.append(error.finding)

    def lines(self, full: bool = False) -> Iterator[str]:
        """The report in words: findings of a kind share a line that names the worst place.

        Args:
            full: Every finding on a line of its own.
        """
        for level, findings in (("error", self.errors), ("warning", self.warnings)):
            if full:
                yield from (f"{level}: {finding}" for finding in findings)
                continue
            kinds: dict[tuple, list[Issue]] = {}
            for finding in findings:
                kinds.setdefault(finding.kind, []).append(finding)
            # Errors of many kinds come from one broken file: the first ones tell the rest.
            for alike in list(kinds.values())[:_KINDS_SHOWN]:
                worst = max(alike, key=lambda finding: finding.severity)
                yield f"{level}: {worst}{_elsewhere(worst, alike)}"
            if len(kinds) > _KINDS_SHOWN:
                yield f"{level}: and {len(kinds) - _KINDS_SHOWN} kinds more (--full)"
        yield (
            f"{self.path}: {self.episodes} episodes, {self.frames} frames, "
            f"{len(self.errors)} errors, {len(self.warnings)} warnings"
        )

    def records(self) -> list[dict]:
        """Every finding as plain values: kind, message, file, episode, frame, key."""
        kinds = (("error", self.errors), ("warning", self.warnings))
        return [{"kind": kind, **vars(finding)} for kind, found in kinds for finding in found]

    def __str__(self) -> str:
        return "\n".join(self.lines())


def _elsewhere(worst: Issue, alike: list[Issue]) -> str:
    """Where else findings of the kind are."""
    if len(alike) == 1:
        return ""
    others = [finding for finding in alike if finding is not worst]
    places = dict.fromkeys(f.episode for f in others if f.episode is not None)
    shown = ", ".join(map(str, [*places][:_PLACES_SHOWN]))
    more = ", ..." if len(places) > _PLACES_SHOWN else ""
    where = f"; episodes {shown}{more}" if places else ""
    return f" (and {len(others)} times more{where})"
