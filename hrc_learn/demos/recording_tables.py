"""Tables of numbers: text files from spreadsheets, loggers and numpy, and Parquet files."""

import csv
import io
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Shaped

from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.recording_files import UNNAMED

Table = dict[str, Shaped[np.ndarray, "_frames ..."]]
"""Column -> its values."""

_COMMENTS = ("#", "%", "//")
_MISSING = ["", "nan", "NaN", "NAN", "na", "NA", "N/A", "null", "NULL", "None", "-"]
_DECIMAL_COMMAS = re.compile(r"[-+]?\d+(?:,\d+)?(?:[eE][-+]?\d+)?")
_INDEX = ("", "index", "unnamed: 0", "__index_level_0__")
"""Names under which pandas writes the index of its rows."""
_WRONG_ROW = re.compile(r"Row #(\d+): Expected (\d+) columns, got (\d+)")


def read_text_table(path: Path, columns: Sequence[str] = ()) -> Table:
    """Columns of a text file.

    Fields are separated by commas, semicolons, tabs, bars or blanks; decimal commas are read.
    Lines that begin with #, % or // are comments; the last comment before the numbers may name
    the columns. The unnamed index that pandas writes and columns of text are left out. Dates
    and times of day become seconds.

    Args:
        path: The file.
        columns: Names for the columns of a file without a header.

    Raises:
        DatasetError: The file is empty or not in UTF-8, or a row does not hold the expected
            numbers.
    """
    try:
        # Spreadsheets mark UTF-8 by a byte order mark.
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        reason = f"is not encoded in UTF-8 ({error.reason} at byte {error.start})"
        raise DatasetError(f"{reason}: save it as UTF-8", file=path) from error
    rows = [(k, line) for k, line in enumerate(lines, start=1) if line.strip(" ,;\t|")]
    plain = [not line.lstrip().startswith(_COMMENTS) for _, line in rows]
    if not any(plain):
        raise DatasetError("is empty", file=path)
    remarks = [line.lstrip().lstrip("#%/ ") for _, line in rows[: plain.index(True)]]
    rows = [row for row, is_row in zip(rows, plain, strict=True) if is_row]
    delimiter = _delimiter(rows[min(1, len(rows) - 1)][1])
    fields = [_split(line, delimiter) for _, line in rows]
    header = _without_end(fields[0])
    start = 0 if header[0] else 1
    if len(header) > 3 and header[start:] == [str(k) for k in range(len(header) - start)]:
        # pandas numbers columns that have no names.
        rows, fields = rows[1:], [row[start:] for row in fields[1:]]
        header = _without_end(fields[0]) if fields else []
    if any(map(_is_number, header)):
        named = _split(remarks[-1], delimiter) if remarks else []
        header = named if len(named) in (len(header), len(fields[0])) else []
    else:
        rows, fields = rows[1:], fields[1:]
    units = header and len(fields) > 1 and not any(map(_is_number, fields[0]))
    if units and all(map(_is_number, fields[1])):
        header = [f"{name} [{unit}]" for name, unit in zip(header, fields[0], strict=False)]
        rows, fields = rows[1:], fields[1:]
    if not rows:
        raise DatasetError("holds a header and no numbers", file=path)
    width = len(fields[0])
    if width != len(header) and not any(len(row) == width and row[-1] for row in fields):
        width = len(_without_end(fields[0]))  # every line ends with a separator
    fields = [row if any(row[width:]) else row[:width] for row in fields]
    if header and len(header) == width - 1:
        header = ["", *header]  # R and pandas do not name the column of row numbers
    names = header or list(columns) or [str(place) for place in range(width)]
    if len(names) != width:
        raise DatasetError(f"{len(names)} column names for {width} columns", file=path)
    names = [
        f"{n} ({names[:k].count(n) + 1})" if n in names[:k] else n for k, n in enumerate(names)
    ]
    table = _parsed(path, [number for number, _ in rows], fields, names, delimiter)
    if not header and not columns:
        if len(table) < width:
            raise DatasetError("has text and no header: give all --columns", file=path)
        return {UNNAMED: np.stack([*table.values()], axis=1)}
    return _without_index(path, table)


def _delimiter(line: str) -> str:
    for delimiter in (";", "\t", "|"):
        if delimiter in line:
            return delimiter
    words = line.split()
    decimals = len(words) > 1 and all(map(_DECIMAL_COMMAS.fullmatch, words))
    return "," if "," in line and not decimals else " "


def _split(line: str, delimiter: str) -> list[str]:
    if delimiter == " " and '"' not in line:
        return line.split()
    fields = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
    return [field.strip() for field in fields]


def _without_end(fields: list[str]) -> list[str]:
    """The fields of a line without an empty field at the end."""
    return fields[:-1] if len(fields) > 1 and not fields[-1] else fields


def _is_number(field: str) -> bool:
    try:
        float(field.replace(",", "."))
    except ValueError:
        return False
    return True


def _parsed(
    path: Path,
    lines: Sequence[int],
    fields: Sequence[list[str]],
    names: Sequence[str],
    delimiter: str,
) -> Table:
    """Columns of numbers, parsed by Arrow; `lines` has the line number of each row."""
    from pyarrow.csv import ConvertOptions, ParseOptions, ReadOptions, read_csv

    text = io.StringIO()
    csv.writer(text, delimiter="\t").writerows(fields)
    comma = bool(re.search(r"\d,\d", text.getvalue()))
    read = ReadOptions(column_names=names, use_threads=False)
    convert = ConvertOptions(null_values=_MISSING, decimal_point="," if comma else ".")
    content = io.BytesIO(text.getvalue().encode())
    try:
        table = read_csv(content, read, ParseOptions(delimiter="\t"), convert)
    except pa.ArrowInvalid as error:
        wrong = _WRONG_ROW.search(str(error))
        place = f"line {lines[int(wrong[1]) - 1]}" if wrong else "a line"
        text = f"{place} does not hold {len(names)} numbers separated by {delimiter!r}"
        raise DatasetError(text, file=path) from error
    for name, column in zip(table.column_names, table.columns, strict=True):
        # A column of text begins with text. A word after numbers is an error in the file.
        words = column.to_pylist() if pa.types.is_string(column.type) else ["text"]
        wrong = [k for k, word in enumerate(words) if word is None or not _is_number(word)]
        if not wrong:
            raise DatasetError("mixes decimal points and decimal commas", file=path, key=name)
        if wrong[0] != 0:
            text = f"line {lines[wrong[0]]} does not hold {len(names)} numbers separated by"
            raise DatasetError(
                f"{text} {delimiter!r}: {words[wrong[0]]!r}", file=path, key=name
            )
    if not (found := _arrow_columns(path, table)):
        raise DatasetError("holds no column of numbers", file=path)
    return found


def _without_index(path: Path, table: Table) -> Table:
    """The table without the column that numbers its rows."""
    for name in [name for name in table if name.strip().lower() in _INDEX]:
        counts = table[name][0] in (0, 1) and (np.diff(table[name]) == 1).all()
        if counts and len(table) > 1:
            del table[name]
        elif not name.strip():
            text = "holds a column without a name: name it in the header"
            raise DatasetError(text, file=path)
    return table


def read_parquet_table(path: Path) -> Table:
    """Columns of a Parquet file: numbers, vectors of one length, and bytes of image files.

    Raises:
        DatasetError: The file is damaged, or the vectors of a column differ in length.
    """
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(path).flatten()  # {bytes, path} of images become columns
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(f"cannot be read as Parquet: {error}", file=path) from error
    return _without_index(path, _arrow_columns(path, table))


def _arrow_columns(path: Path, table: pa.Table) -> Table:
    """Columns of numbers, of vectors and of bytes; all others are left out."""
    found: Table = {}
    for name in table.column_names:
        column = table[name].combine_chunks()
        if pa.types.is_time(column.type):
            column = column.cast(pa.string())
        if pa.types.is_string(column.type):
            day = pc.binary_join_element_wise("1970-01-01", column, " ")  # pyright: ignore
            with suppress(pa.ArrowInvalid):  # other texts are no times of day
                column = day.cast(pa.timestamp("ns"))
        if pa.types.is_binary(column.type) or pa.types.is_large_binary(column.type):
            found[name.removesuffix(".bytes")] = column.to_numpy(zero_copy_only=False)
        elif pa.types.is_timestamp(column.type):
            stamps = column.cast(pa.timestamp("ns")).cast(pa.int64())
            found[name] = stamps.to_numpy(zero_copy_only=False) / 1e9
        elif pa.types.is_primitive(column.type):
            found[name] = column.to_numpy(zero_copy_only=False).astype(float)
        elif pa.types.is_nested(column.type):
            rows = column.to_numpy(zero_copy_only=False)
            widths = {0 if row is None else len(row) for row in rows}
            if len(widths) > 1:
                text = f"holds vectors of {min(widths)} to {max(widths)} components"
                raise DatasetError(f"{text}: all must be of one length", file=path, key=name)
            vectors = np.stack([*rows])
            if vectors.dtype != object:
                found[name] = vectors
    return found
