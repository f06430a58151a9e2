"""Tables of numbers: text files as spreadsheets, loggers and numpy write them, and Parquet."""

import csv
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from hrc_learn.demos.issues import DatasetError

Table = dict[str, Shaped[np.ndarray, "_frames ..."]]
"""Column -> its values."""

UNNAMED = "array"
"""Name of an array that has none."""
_COMMENTS = ("#", "%", "//")
_MISSING = ("", "nan", "na", "n/a", "null", "none", "-")
_FLAGS = {"true": "1", "false": "0"}
_DECIMAL_COMMA = re.compile(r"[-+]?\d+(?:,\d+)?(?:[eE][-+]?\d+)?")
_DATE = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:[.,]\d+)?Z?")
_INDEX = ("", "index", "unnamed: 0", "__index_level_0__")
"""Names under which pandas writes the index of its rows."""


def read_text_table(path: Path, columns: Sequence[str] = ()) -> Table:
    """Columns of a text file.

    Fields are separated by commas, semicolons, tabs, bars or blanks; decimals may have a comma.
    Lines that begin with #, % or // are comments, and the last one before the numbers may name
    the columns. The unnamed index that pandas writes is left out, as are columns of text;
    dates become seconds.

    Args:
        path: The file.
        columns: Names for the columns of a file without a header.

    Raises:
        DatasetError: The file is empty or not in UTF-8, or a row differs from the first one.
    """
    try:
        # Spreadsheets mark UTF-8 by a byte order mark.
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        reason = f"is not encoded in UTF-8 ({error.reason} at byte {error.start})"
        raise DatasetError(f"{reason}: save it as UTF-8", file=path) from error
    header, rows, delimiter = _rows(path, lines)
    if not rows:
        if header:
            raise DatasetError("holds a header and no numbers", file=path)
        raise DatasetError("is empty", file=path)
    width = len(rows[0][1])
    for number, row in rows:
        if len(row) != width:
            text = f"line {number} does not hold {width} numbers separated by {delimiter!r}"
            raise DatasetError(f"{text}, but {len(row)} fields", file=path)
    if header and len(header) == width - 1 and _counts([row[0] for _, row in rows]):
        header = ["", *header]  # R and pandas name no column of row numbers
    if header and len(header) != width:
        text = f"names {len(header)} columns, but its rows hold {width}"
        raise DatasetError(text, file=path)
    values = _columns(path, header, rows, delimiter)
    names = header or list(columns)
    if not names:
        return {UNNAMED: np.stack([*values.values()], axis=1)}
    if not header and len(columns) != width:
        text = f"{len(columns)} column names for {width} columns"
        raise DatasetError(text, file=path)
    table: Table = {}
    for place, column in values.items():
        name, count = names[place], names[:place].count(names[place])
        table[f"{name} ({count + 1})" if count else name] = column
    return _without_index(path, table)


def _rows(
    path: Path, lines: Sequence[str]
) -> tuple[list[str], list[tuple[int, list[str]]], str]:
    """Header, rows with their line numbers, and the delimiter."""
    kept = [(k, line) for k, line in enumerate(lines, start=1) if line.strip(" ,;\t|")]
    plain = [not line.lstrip().startswith(_COMMENTS) for _, line in kept]
    comments = [line for _, line in kept[: plain.index(True) if any(plain) else 0]]
    kept = [(k, line) for k, line in kept if not line.lstrip().startswith(_COMMENTS)]
    if not kept:
        return [], [], ","
    probe = kept[min(1, len(kept) - 1)][1]
    delimiter = _delimiter(probe)
    try:
        rows = [(k, _split(line, delimiter)) for k, line in kept]
    except csv.Error as error:
        raise DatasetError(f"cannot be split into fields: {error}", file=path) from error
    while len(rows[0][1]) > 1 and all(not row[-1] for _, row in rows if len(row) > 1):
        rows = [(k, row[:-1]) for k, row in rows]  # every line ends with a delimiter
    if not any(_is_number(field) for field in rows[0][1]):
        return rows[0][1], rows[1:], delimiter
    if comments:
        named = _split(comments[-1].lstrip().lstrip("#%/ "), delimiter)
        if len(named) == len(rows[0][1]) and not any(map(_is_number, named)):
            return named, rows, delimiter
    return [], rows, delimiter


def _delimiter(line: str) -> str:
    for delimiter in (";", "\t", "|"):
        if delimiter in line:
            return delimiter
    words = line.split()
    if "," in line and not (len(words) > 1 and all(map(_DECIMAL_COMMA.fullmatch, words))):
        return ","
    return " "


def _split(line: str, delimiter: str) -> list[str]:
    if delimiter == " " and '"' not in line:
        return line.split()
    (row,) = csv.reader([line], delimiter=delimiter, skipinitialspace=True)
    return [field.strip() for field in row]


def _number(field: str) -> float | None:
    """Value of a field; None if it is no number, NaN if it is empty."""
    plain = field.strip().lower()
    if plain in _MISSING:
        return np.nan
    plain = _FLAGS.get(plain, plain)
    if plain.count(",") == 1 and "." not in plain:
        plain = plain.replace(",", ".")
    try:
        return float(plain)
    except ValueError:
        return None


def _is_number(field: str) -> bool:
    return field.strip().lower() not in _MISSING and _number(field) is not None


def _columns(
    path: Path, header: Sequence[str], rows: Sequence[tuple[int, list[str]]], delimiter: str
) -> dict[int, np.ndarray]:
    """Numbers of each column; columns of text are left out."""
    kept: dict[int, np.ndarray] = {}
    for place, first in enumerate(rows[0][1]):
        fields = [row[place] for _, row in rows]
        if _DATE.fullmatch(first):
            dates = [field.replace(",", ".").rstrip("Z") for field in fields]
            try:
                moments = np.array(dates, dtype="datetime64[ns]")
            except ValueError as error:
                raise DatasetError(f"holds a damaged date: {error}", file=path) from error
            kept[place] = moments.astype(np.int64) * 1e-9
            continue
        if _number(first) is None and header:
            continue
        numbers = [_number(field) for field in fields]
        if None in numbers:
            line = rows[numbers.index(None)][0]
            text = f"line {line} does not hold {len(rows[0][1])} numbers separated by"
            raise DatasetError(
                f"{text} {delimiter!r}: {fields[numbers.index(None)]!r}", file=path
            )
        kept[place] = np.array(numbers, dtype=float)
    if not kept:
        raise DatasetError("holds no column of numbers", file=path)
    return kept


def _counts(values: Sequence[object]) -> bool:
    """True if the values count rows from 0 or 1."""
    try:
        numbers = np.asarray([float(str(value)) for value in values])
    except ValueError:
        return False
    return bool(np.isin(numbers[0], (0, 1)) and (np.diff(numbers) == 1).all())


def _without_index(path: Path, table: Table) -> Table:
    """The table without the column that numbers its rows."""
    for name in [name for name in table if name.strip().lower() in _INDEX]:
        if _counts(table[name].tolist()) and len(table) > 1:
            del table[name]
        elif not name.strip():
            raise DatasetError(
                "holds a column without a name: name it in the header", file=path
            )
    return table


def read_parquet_table(path: Path) -> dict[str, np.ndarray | list[bytes]]:
    """Columns of a Parquet file: numbers, vectors of one length, and bytes of image files.

    Raises:
        DatasetError: The file is damaged, or the vectors of a column differ in length.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(path).flatten()  # {bytes, path} of images become columns
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(f"cannot be read as Parquet: {error}", file=path) from error
    found: dict[str, np.ndarray | list[bytes]] = {}
    for name, values in _arrow_columns(path, table):
        found[name.removesuffix(".bytes")] = values
    numbers = {name: v for name, v in found.items() if isinstance(v, np.ndarray)}
    kept = _without_index(path, numbers)
    return {name: v for name, v in found.items() if name in kept or isinstance(v, list)}


def _arrow_columns(path: Path, table) -> Iterator[tuple[str, np.ndarray | list[bytes]]]:
    import pyarrow as pa

    for name in table.column_names:
        column = table[name].combine_chunks()
        kind = column.type
        if pa.types.is_binary(kind) or pa.types.is_large_binary(kind):
            yield name, column.to_pylist()
        elif pa.types.is_timestamp(kind):
            yield name, column.cast(pa.timestamp("ns")).cast(pa.int64()).to_numpy() * 1e-9
        elif pa.types.is_primitive(kind):
            yield name, column.to_numpy(zero_copy_only=False).astype(float)
        elif pa.types.is_list(kind) or pa.types.is_large_list(kind) or _is_fixed(kind):
            rows = column.to_numpy(zero_copy_only=False)
            widths = {0 if row is None else len(row) for row in rows}
            if len(widths) > 1:
                text = f"holds vectors of {min(widths)} to {max(widths)} components"
                raise DatasetError(f"{text}: all frames need as many", file=path, key=name)
            stacked = np.stack([*rows])
            if stacked.dtype != object:
                yield name, stacked


def _is_fixed(kind) -> bool:
    import pyarrow as pa

    return pa.types.is_fixed_size_list(kind)
