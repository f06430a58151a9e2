"""Parquet files of a dataset as numpy arrays, with errors that say what to do."""

from bisect import bisect_left, bisect_right
from collections.abc import Collection, Sequence
from itertools import accumulate
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Shaped

from hrc_learn.demos.issue import DatasetError


class BadRowError(ValueError):
    """A row of a column that holds no usable value; `row` counts from the table's start."""

    def __init__(self, row: int, message: str):
        super().__init__(message)
        self.row = row


def open_parquet(root: Path, file: str, episode: int | None = None) -> pq.ParquetFile:
    """Open a file of the dataset.

    Raises:
        DatasetError: It is missing, or truncated.
    """
    try:
        return pq.ParquetFile(root / file)
    except FileNotFoundError as error:
        raise DatasetError(
            "not found: the copy is incomplete", file=file, episode=episode
        ) from error
    except (pa.ArrowInvalid, OSError) as error:
        raise DatasetError(
            "unreadable: the file is truncated, because the recording was not finalized or "
            "the copy is incomplete",
            file=file,
            episode=episode,
        ) from error


def read_rows(
    root: Path, file: str, required: Sequence[str], optional: Collection[str] | None = None
) -> list[dict]:
    """Rows of a metadata file as dicts.

    Args:
        root: The dataset.
        file: The file, relative to it.
        required: Columns that must be there.
        optional: Columns to read besides where they exist; None reads all.

    Raises:
        DatasetError: The file is missing, truncated, or lacks a required column.
    """
    parquet = open_parquet(root, file)
    existing = parquet.schema_arrow.names
    for name in required:
        if name not in existing:
            raise DatasetError("the column is missing", file=file, key=name)
    wanted = None if optional is None else [*required, *(n for n in optional if n in existing)]
    return read_table(parquet, file, wanted).to_pylist()


def read_table(
    parquet: pq.ParquetFile,
    file: str,
    columns: Sequence[str] | None = None,
    rows: slice | None = None,
) -> pa.Table:
    """Columns of an open file, of all rows or of a range of them.

    Of a range, only the row groups it touches are read: LeRobot writes one an episode.

    Raises:
        DatasetError: The file is damaged.
    """
    wanted = None if columns is None else list(columns)
    try:
        if rows is None or (rows.start, rows.stop) == (0, parquet.metadata.num_rows):
            return parquet.read(columns=wanted)
        groups, offset = _row_groups(parquet.metadata, rows)
        table = parquet.read_row_groups(groups, columns=wanted)
        return table.slice(rows.start - offset, rows.stop - rows.start)
    except (pa.ArrowInvalid, OSError) as error:
        raise DatasetError(
            f"unreadable: the file is damaged ({error}); copy it again", file=file
        ) from error


def to_numpy(column: pa.ChunkedArray) -> Shaped[np.ndarray, "rows components"]:
    """Values of a column, in their own type; lists and nested lists are laid flat.

    Raises:
        BadRowError: A value is missing, or rows differ in their number of components.
    """
    array = pa.concat_arrays(column.chunks or [pa.array([], column.type)])
    rows = len(array)
    while True:
        _refuse_nulls(array, rows)
        if isinstance(array, pa.ExtensionArray):
            array = array.storage
        elif pa.types.is_fixed_size_list(array.type):
            array = array.flatten()
        elif pa.types.is_list(array.type) or pa.types.is_large_list(array.type):
            array = _flatten_ragged(array, rows)
        else:
            break
    values = _without_pandas(array)
    return values.reshape(rows, len(values) // rows if rows else 0)


def row_group_starts(metadata: pq.FileMetaData) -> list[int]:
    """Row that each row group begins at."""
    sizes = [metadata.row_group(i).num_rows for i in range(metadata.num_row_groups)]
    return [0, *accumulate(sizes)][:-1]


def _row_groups(metadata: pq.FileMetaData, rows: slice) -> tuple[list[int], int]:
    """Row groups that hold a range of rows, and the row the first of them begins at."""
    starts = row_group_starts(metadata)
    first = bisect_right(starts, rows.start) - 1
    stop = bisect_left(starts, rows.stop)
    return list(range(first, stop)), starts[first]


def _flatten_ragged(array: pa.Array, rows: int) -> pa.Array:
    widths = _without_pandas(array.value_lengths())
    differing = np.flatnonzero(widths != widths[0]) if len(widths) else []
    if len(differing):
        row = int(differing[0]) * rows // len(array)
        found, expected = int(widths[differing[0]]), int(widths[0])
        raise BadRowError(row, f"holds {found} components, the first row {expected}")
    return array.flatten()


def _refuse_nulls(array: pa.Array, rows: int) -> None:
    if array.null_count:
        at = int(np.flatnonzero(_without_pandas(array.is_null()))[0])
        raise BadRowError(at * rows // len(array), "holds no value (null)")


def _without_pandas(array: pa.Array) -> Shaped[np.ndarray, " values"]:
    """Values of an array of numbers; its own `to_numpy` imports pandas, for a second."""
    if pa.types.is_boolean(array.type):  # packed to bits, which numpy cannot view
        return np.from_dlpack(array.cast(pa.uint8())).astype(bool)
    return np.from_dlpack(array)
