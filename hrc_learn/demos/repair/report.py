"""What a repair changed."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(kw_only=True)
class RepairReport:
    """What became of each episode."""

    path: Path
    """The new dataset."""
    changes: dict[int, tuple[str, ...]] = field(default_factory=dict)
    """Index of an episode that was kept, in the old dataset -> what was changed."""
    left_out: dict[int, str] = field(default_factory=dict)
    """Index of an episode that was left out -> why."""
    notes: list[str] = field(default_factory=list)
    """What was changed in all."""
    frames_before: int = 0
    frames: int = 0
    """Frames of the new dataset."""

    @property
    def changed(self) -> int:
        """Episodes of which something was changed."""
        return sum(map(bool, self.changes.values()))

    def lines(self) -> Iterator[str]:
        yield from self.notes
        for new, (old, changes) in enumerate(self.changes.items()):
            name = f"episode {old}" if new == old else f"episode {old} (now {new})"
            yield f"{name}: {'; '.join(changes) or 'as it was'}"
        for old, reason in self.left_out.items():
            yield f"episode {old}: left out: {reason}"
        yield (
            f"{self.path}: {len(self.changes)} episodes, {self.frames} of "
            f"{self.frames_before} frames, {self.changed} episodes changed, "
            f"{len(self.left_out)} left out"
        )

    def __str__(self) -> str:
        return "\n".join(self.lines())
