"""The findings about one dataset."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from ..finding import DatasetError, Finding


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
