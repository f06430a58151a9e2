"""What was logged: columns of equal length, one row a step, and what happened when."""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..output import new_file


class Event(NamedTuple):
    """Something worth a line of text, such as a task entering its next phase."""

    time: float
    """[s]"""
    text: str


class LoggedSteps:
    """Columns of whatever a loop measured, one row a step.

    Attributes:
        events: What happened when, in order.
    """

    def __init__(self, blocks: Sequence[np.ndarray], length: int, events: Sequence[Event]):
        """Columns over blocks of rows, all but the last full.

        Args:
            blocks: Structured arrays of one type and length.
            length: Rows in use.
            events: What happened when.
        """
        self._blocks, self._length = list(blocks), length
        self.events = list(events)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns, in the order of the first row."""
        return (self._blocks[0].dtype.names or ()) if self._blocks else ()

    def __len__(self) -> int:
        return self._length

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def __getitem__(self, name: str) -> np.ndarray:
        """One column, (T, ...): a copy, whatever is logged afterwards."""
        if name not in self:
            raise KeyError(f"{name!r} is not logged; the columns are {list(self.names)}.")
        return np.concatenate([block[name] for block in self.blocks()])

    def blocks(self, start: int = 0) -> Iterator[np.ndarray]:
        """The rows from `start` on, as structured arrays that share memory with the log.

        Another thread may read while the loop appends.
        """
        length, before = self._length, 0
        for block in tuple(self._blocks):
            rows = block[max(start - before, 0) : max(length - before, 0)]
            before += len(block)
            if before > start:
                yield rows

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write columns and events as one .npz file, which appears only when complete."""
        arrays: dict[str, Any] = {f"column/{name}": self[name] for name in self.names}
        arrays["event/time"] = np.array([event.time for event in self.events], dtype=float)
        arrays["event/text"] = np.array([event.text for event in self.events], dtype=str)
        with new_file(Path(path)) as part, part.open("wb") as file:
            np.savez(file, **arrays)
