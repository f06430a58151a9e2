"""Arrays read from .npz, .npy and .csv files."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from .finding import DatasetError

Table = dict[str, Float64[np.ndarray, "_demos _frames _components"]]
"""Array or column name -> its values, demonstration by demonstration."""

UNNAMED = "array"
"""Name of an array whose columns have none."""


def read_table(path: Path, columns: Sequence[str] = ()) -> Table:
    """Read the arrays of a file.

    Arrays of one axis are columns, of two axes (frames, components), of three (demonstrations,
    frames, components).

    Args:
        path: A .npz, .npy or .csv file.
        columns: Names for the columns of a .npy file, or of a .csv file without a header.

    Raises:
        DatasetError: The file is missing, of another kind, or holds no such arrays.
    """
    if not path.is_file():
        raise DatasetError("not found", file=path)
    match path.suffix.lower():
        case ".npz":
            with _load(path) as file:
                return {name: _three_axes(file[name], path, name) for name in _numeric(file)}
        case ".npy":
            return _split(_three_axes(_load(path), path, UNNAMED), columns, path)
        case ".csv" | ".txt":
            names, values = _read_csv(path)
            return _split(values[None], columns or names, path)
    raise DatasetError("is neither .npz, .npy nor .csv", file=path)


def _load(path: Path):
    try:
        return np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise DatasetError(f"cannot be read as numpy arrays: {error}", file=path) from error


def _numeric(file) -> list[str]:
    """Names of the arrays that can be tables of numbers."""
    return [
        name
        for name in file.files
        if file[name].dtype.kind in "fiu" and 1 <= file[name].ndim <= 3
    ]


def _three_axes(array: np.ndarray, path: Path, name: str) -> np.ndarray:
    if array.dtype.kind not in "fiu" or not 1 <= array.ndim <= 3 or 0 in array.shape:
        raise DatasetError(
            f"an array of shape {array.shape} and type {array.dtype} holds no frames of "
            f"numbers",
            file=path,
            key=name,
        )
    array = array.astype(np.float64)
    if array.ndim == 1:
        array = array[:, None]
    return array if array.ndim == 3 else array[None]


def _split(array: np.ndarray, columns: Sequence[str], path: Path) -> Table:
    if not columns:
        return {UNNAMED: array}
    if len(columns) != array.shape[-1]:
        raise DatasetError(
            f"{len(columns)} column names for {array.shape[-1]} columns", file=path
        )
    return {name: array[..., i : i + 1] for i, name in enumerate(columns)}


def _read_csv(path: Path) -> tuple[list[str], np.ndarray]:
    """Header, [] where there is none, and numbers of a file with commas or semicolons."""
    lines = path.read_text().splitlines()
    if not lines:
        raise DatasetError("is empty", file=path)
    delimiter = max(",;\t ", key=lines[0].count)
    rows = [
        [field.strip() for field in row if field.strip()]
        for row in csv.reader(lines, delimiter=delimiter, skipinitialspace=True)
        if row
    ]
    header = [] if _are_numbers(rows[0]) else rows[0]
    numbers = rows[1:] if header else rows
    for line, row in enumerate(numbers, start=2 if header else 1):
        if len(row) != len(rows[0]) or not _are_numbers(row):
            raise DatasetError(
                f"line {line} does not hold {len(rows[0])} numbers separated by {delimiter!r}",
                file=path,
            )
    if not numbers:
        raise DatasetError("holds a header and no numbers", file=path)
    return header, np.array(numbers, dtype=np.float64)


def _are_numbers(fields: Sequence[str]) -> bool:
    try:
        [float(field) for field in fields]
    except ValueError:
        return False
    return True
