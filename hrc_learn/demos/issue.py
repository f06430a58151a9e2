"""What is wrong with a dataset, and where: the one form that errors and reports share."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

# What is wrong with a dataset, and where: the one form that errors and reports share.


@dataclass(frozen=True, kw_only=True)
class Finding:
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

    def __str__(self) -> str:
        episode = None if self.episode is None else f"episode {self.episode}"
        frame = None if self.frame is None else f"frame {self.frame}"
        place = ", ".join(part for part in (self.file, episode, frame, self.key) if part)
        return f"{place}: {self.message}" if place else self.message


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
        self.finding = Finding(
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


@dataclass(kw_only=True)
class Report:
    """What is wrong with a dataset (errors), and what is odd (warnings)."""

    path: Path
    errors: list[Finding] = field(default_factory=list)
    """Faults that lose data or mislead a reader."""
    warnings: list[Finding] = field(default_factory=list)
    """Oddities worth a look before training."""
    episodes: int = 0
    """Episodes whose frames could be read."""
    frames: int = 0
    """Frames of those episodes."""

    @property
    def ok(self) -> bool:
        """Whether there are no errors; warnings are allowed."""
        return not self.errors

    def error(self, message: str, **place) -> None:
        """Add an error; `place` as in `Finding`."""
        self.errors.append(Finding(message=message, **place))

    def warning(self, message: str, **place) -> None:
        """Add a warning; `place` as in `Finding`."""
        self.warnings.append(Finding(message=message, **place))

    def add(self, error: DatasetError) -> None:
        """Add what a reading function raised."""
        if error.finding not in self.errors:
            self.errors.append(error.finding)

    def lines(self) -> Iterator[str]:
        """The report in words; findings alike but for the episode share a line."""
        for kind, findings in (("error", self.errors), ("warning", self.warnings)):
            alike: dict[tuple, list[Finding]] = {}
            for finding in findings:
                alike.setdefault((finding.key, finding.message), []).append(finding)
            for first, *others in alike.values():
                also = f" (and {len(others)} times more)" if others else ""
                yield f"{kind}: {first}{also}"
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
