"""One episode on its way from the old dataset to the new."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64

from ..finding import DatasetError
from ..frames import RawFrames
from ..layout import EpisodeEntry
from ..matching import Matching
from ..quantities import Quantities, select_quantities
from ..units import UnitDecision


@dataclass(frozen=True, kw_only=True)
class Meaning:
    """What the columns of the dataset mean, and in which units."""

    matching: Matching
    units: dict[str, UnitDecision]

    def whole_turn(self, role: str) -> float:
        """A turn in the unit that the quantity has on disk."""
        return 2 * np.pi / self.units[role].factor


@dataclass(frozen=True, kw_only=True)
class Draft:
    """One episode as far as it has been repaired."""

    entry: EpisodeEntry
    """Its place in the old dataset."""
    frames: RawFrames
    """Columns that will be written, LeRobot's own but for `task_index` left out."""
    time: Float64[np.ndarray, " _frames"]
    """True stamps [s] where there are any, LeRobot's otherwise."""
    kept: Int64[np.ndarray, " _frames"] | None
    """Frames of the old episode that are left; None once it was resampled."""
    changes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.time)

    def quantities(self, meaning: Meaning) -> Quantities:
        """Quantities in the units on disk."""
        return select_quantities(self.frames, meaning.matching.selections)

    def only(self, wanted: Bool[np.ndarray, " _frames"], change: str) -> "Draft":
        """The wanted frames alone.

        Raises:
            DatasetError: Less than two would be left.
        """
        if wanted.all():
            return self
        if wanted.sum() < 2:
            raise self.bad(f"{change}: no two frames are left")
        return replace(
            self,
            frames={key: values[wanted] for key, values in self.frames.items()},
            time=self.time[wanted],
            kept=None if self.kept is None else self.kept[wanted],
            changes=(*self.changes, change),
        )

    def with_columns(self, columns: RawFrames, change: str) -> "Draft":
        """Some columns replaced."""
        return replace(self, frames=self.frames | columns, changes=(*self.changes, change))

    def bad(
        self, message: str, frame: int | None = None, key: str | None = None
    ) -> DatasetError:
        """An error that names the episode."""
        original = None if frame is None or self.kept is None else int(self.kept[frame])
        return DatasetError(
            message,
            file=self.entry.file,
            episode=self.entry.index,
            frame=original,
            key=key,
        )
