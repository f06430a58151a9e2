"""Log of a control loop: columns of equal length, one row per step, cheap to append to."""

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Shaped

from hrc_learn.store import new_file


class Event(NamedTuple):
    """Event with a line of text, such as the start of a phase of the task."""

    time: float
    """[s]"""
    text: str


class LoggedSteps:
    """Columns of the quantities that a loop measured, one row per step.

    Attributes:
        events: Events in order of time.
    """

    def __init__(self, blocks: Sequence[np.ndarray], length: int, events: Sequence[Event]):
        """Columns over blocks of rows, all but the last full.

        Args:
            blocks: Structured arrays of one type and length.
            length: Number of rows in use.
            events: Events of the run.
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
        """Copy of one column, (T, ...)."""
        if name not in self:
            raise KeyError(f"{name!r} is not logged; the columns are {list(self.names)}.")
        return np.concatenate([block[name] for block in self.blocks()])

    def blocks(self, start: int = 0) -> Iterator[np.ndarray]:
        """Rows from `start` on, as structured arrays that are views of the log.

        Another thread may read while the loop appends.
        """
        length, before = self._length, 0
        for block in tuple(self._blocks):
            rows = block[max(start - before, 0) : max(length - before, 0)]
            before += len(block)
            if before > start:
                yield rows

    def with_columns(self, **columns: Shaped[np.ndarray, "rows ..."]) -> "LoggedSteps":
        """Copy with further columns.

        Raises:
            ValueError: If a column has another number of rows.
        """
        wrong = {
            name: len(values) for name, values in columns.items() if len(values) != len(self)
        }
        if wrong:
            raise ValueError(f"the log has {len(self)} rows, but new columns have {wrong}.")
        every = {name: self[name] for name in self.names} | columns
        rows = np.zeros(len(self), [(n, v.dtype, v.shape[1:]) for n, v in every.items()])
        for name, values in every.items():
            rows[name] = values
        return LoggedSteps([rows], len(self), self.events)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write columns and events as one .npz file, which appears only when complete.

        Its arrays are `column/NAME`, `event/time` [s] and `event/text`.
        """
        arrays: dict[str, Any] = {f"column/{name}": self[name] for name in self.names}
        arrays["event/time"] = np.array([event.time for event in self.events], dtype=float)
        arrays["event/text"] = np.array([event.text for event in self.events], dtype=str)
        with new_file(Path(path)) as part, part.open("wb") as file:
            np.savez(file, **arrays)


Value = np.ndarray | np.generic | float | int | bool
"""A measurement of one step: an array of any shape, or a number."""


class StepLog(LoggedSteps):
    """Columns of the quantities that a loop measures, one row per step.

    The first row decides the columns and their shapes; every later row must bring the same
    ones. Numbers become float64, whatever their first value looks like (`time=0`); truth values
    stay so. Memory is taken in blocks and never moved, so no step pays for growth.

        log = StepLog()
        log.append(time=t, joint_position=q, feature=x, pushed=True)
        log["joint_position"]      # (T, 7)
    """

    def __init__(self, block: int = 8192):
        """Make an empty log.

        Args:
            block: Number of rows allocated at a time.
        """
        if block < 1:
            raise ValueError(f"block must be at least one row, but is {block}.")
        # The length is counted up last, so that another thread sees whole rows only.
        super().__init__(blocks=(), length=0, events=())
        self._block = block
        self._dtype: np.dtype | None = None
        self._columns: list[tuple[str, np.ndarray]] = []  # of the last block
        self._first = 0  # rows before the last block

    def snapshot(self, rows: int | None = None) -> LoggedSteps:
        """View of the present rows, which does not grow.

        Another thread may take it while the loop appends.

        Args:
            rows: Number of rows; None: all.
        """
        length = len(self) if rows is None else min(rows, len(self))
        return LoggedSteps(self._blocks, length, self.events)

    def append(self, **values: Value) -> None:
        """Add a row.

        Raises:
            ValueError: If the row lacks a column, brings a new one, or one of another shape.
        """
        if self._dtype is None:
            self._open(values)
        i = self._length - self._first
        if i == self._block:
            self._extend()
            i = 0
        try:
            for name, column in self._columns:
                column[i] = values[name]
        except (KeyError, ValueError, TypeError) as error:
            raise self._mismatch(values) from error
        if len(values) != len(self._columns):
            raise self._mismatch(values)
        self._length += 1

    def event(self, time: float, text: str) -> None:
        """Log an event at a time [s]."""
        self.events.append(Event(float(time), text))

    def _open(self, values: Mapping[str, Value]) -> None:
        kinds = {name: np.asarray(value).dtype == bool for name, value in values.items()}
        self._dtype = np.dtype(
            [(name, bool if kinds[name] else float, np.shape(v)) for name, v in values.items()]
        )
        self._extend()

    def _mismatch(self, values: Mapping[str, Value]) -> ValueError:
        assert self._dtype is not None
        expected = {name: self._dtype[name].shape for name in self.names}
        given = {name: np.shape(value) for name, value in values.items()}
        differing = [
            f"{name} is {given.get(name, 'missing')}, not {expected.get(name, 'a column')}"
            for name in sorted(expected.keys() | given.keys())
            if given.get(name) != expected.get(name)
        ]
        return ValueError(
            f"row {len(self)} does not fit the columns that the first row decided: "
            + "; ".join(differing)
            + ". Log every quantity at every step, with NaN where there is none."
        )

    def _extend(self) -> None:
        assert self._dtype is not None
        rows = np.zeros(self._block, dtype=self._dtype)
        self._blocks.append(rows)
        self._columns = [(name, rows[name]) for name in self.names]
        self._first = (len(self._blocks) - 1) * self._block
