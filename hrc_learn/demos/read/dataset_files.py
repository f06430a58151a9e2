"""Metadata and Parquet files of a dataset, read defensively: files may hold anything.

Every fault becomes a `DatasetError` that names the file and the remedy. No file outside the
dataset is opened, whatever a template in `meta/info.json` says.
"""

import json
import re
import stat
from bisect import bisect_left, bisect_right
from collections.abc import Collection, Iterator, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from hrc_learn.demos.issues import DatasetError

INFO_PATH = "meta/info.json"
_LARGEST_TEXT = 2**28
"""Largest metadata file [bytes]: 10,000 episodes have 100 MB of statistics at most."""
_POINTER = b"version https://git-lfs.github.com/spec/"
_FIELD = re.compile(r"\{([a-z_]+)(?::0?(\d{1,2})d)?\}")
_OUTSIDE = "leads out of the dataset: it is not followed"


def require_file(root: Path, file: str, episode: int | None = None) -> None:
    """Check that a path is an ordinary, readable file of the dataset.

    Args:
        root: Folder of the dataset.
        file: Path relative to `root`.
        episode: Episode that needs the file, for the message.

    Raises:
        DatasetError: The file is missing, is a folder, device or pipe, cannot be read, is a
            pointer of Git LFS, or lies outside the dataset.
    """
    place: dict[str, Any] = {"file": file, "episode": episode}
    path = root / file
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            kind = "a folder" if stat.S_ISDIR(mode) else "a device or pipe"
            raise DatasetError(f"is {kind}, not a file", **place)
        with path.open("rb") as stream:
            head = stream.read(len(_POINTER))
    except FileNotFoundError as error:
        raise DatasetError("not found: the copy is incomplete", **place) from error
    except OSError as error:  # also circular links
        raise DatasetError(f"cannot be read: {error.strerror}", **place) from error
    if head == _POINTER:
        text = "is a pointer of Git LFS, not the file itself: run `git lfs pull` in the dataset"
        raise DatasetError(text, **place)
    if not is_inside(root, file):
        raise DatasetError(_OUTSIDE, **place)


def is_inside(root: Path, file: str | Path) -> bool:
    """True if a file lies in the dataset once links are followed.

    The Hub's cache keeps files in a folder of blobs next to its snapshots. This folder counts
    as a part of the dataset.
    """
    try:
        real, here = (root / file).resolve(), root.resolve()
    except (OSError, RuntimeError, ValueError):
        return False
    homes = [here]
    if here.parent.name == "snapshots":
        homes.append(here.parent.parent / "blobs")
    return ".." not in Path(file).parts and any(real.is_relative_to(home) for home in homes)


def path_in(root: Path, template: object, key: str, **places: int | str) -> str:
    """Path of a file, relative to the dataset, from its template in `meta/info.json`.

    Raises:
        DatasetError: The template does not fit the version, or leads out of the dataset.
    """
    text = str(template)
    absent = template is None and key == "data_path"  # videos may be declared without a path
    left = _FIELD.sub("", text)
    fields = {match[1] for match in _FIELD.finditer(text)}
    try:
        if absent or {"{", "}"} & set(left) or not fields <= places.keys():
            raise ValueError("does not fit the dataset's version")
        file = text.format(**places)
        if not is_inside(root, file):
            raise ValueError(f"({file!r}) {_OUTSIDE}")
    except ValueError as error:
        raise DatasetError(f"{key} {template!r} {error}", file=INFO_PATH, key=key) from error
    return file


def _read_text(root: Path, file: str) -> str:
    require_file(root, file)
    try:
        if (root / file).stat().st_size > _LARGEST_TEXT:
            raise DatasetError("is too large to be metadata", file=file)
        return (root / file).read_bytes().decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"cannot be read as text: {error}", file=file) from error


def read_json(root: Path, file: str) -> dict:
    """JSON object in a metadata file.

    Raises:
        DatasetError: The file is missing, too large, or holds no JSON object.
    """
    return _parse(_read_text(root, file), file)


def read_json_lines(root: Path, file: str, required: tuple[str, ...]) -> list[dict]:
    """JSON objects of a file with one object per line.

    Args:
        root: Folder of the dataset.
        file: Path relative to `root`.
        required: Fields that every object must have.

    Raises:
        DatasetError: A line is malformed or lacks a field.
    """
    rows = []
    for number, line in enumerate(_read_text(root, file).splitlines(), start=1):
        if not line.strip():
            continue
        row = _parse(line, file, f"line {number} ")
        missing = [key for key in required if key not in row]
        if missing:
            raise DatasetError(f"line {number} lacks {', '.join(missing)}", file=file)
        rows.append(row)
    return rows


def _parse(text: str, file: str, place: str = "") -> dict:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:  # ValueError: also too many digits
        raise DatasetError(f"{place}is no valid JSON: {error}", file=file) from error
    if not isinstance(content, dict):
        raise DatasetError(f"{place}is no JSON object", file=file)
    return content


def integer(value: object, name: str, file: str, lowest: int = 0) -> int:
    """Count or index from metadata.

    Raises:
        DatasetError: The value is no whole number, or is below `lowest`.
    """
    whole = isinstance(value, int) or (isinstance(value, float) and value.is_integer())
    if isinstance(value, bool) or not whole or not lowest <= int(value) < 2**53:  # type: ignore[arg-type]
        text = f"{name} must be a whole number of at least {lowest}, got {value!r}"
        raise DatasetError(text, file=file, key=name)
    return int(value)  # type: ignore[arg-type]


def open_parquet(root: Path, file: str, episode: int | None = None) -> pq.ParquetFile:
    """Open a Parquet file of the dataset.

    Raises:
        DatasetError: The file is missing, truncated, or outside the dataset.
    """
    require_file(root, file, episode)
    try:
        return pq.ParquetFile(root / file, page_checksum_verification=True)
    except (pa.ArrowException, OSError, ValueError) as error:
        text = (
            "unreadable: the file is truncated, because the recording was not finalized (hrc "
            "repair recovers its saved episodes) or the copy is incomplete"
        )
        raise DatasetError(text, file=file, episode=episode) from error


def read_rows(
    root: Path, file: str, required: Sequence[str], optional: Collection[str] | None = None
) -> list[dict]:
    """Rows of a Parquet metadata file.

    Args:
        root: Folder of the dataset.
        file: Path relative to `root`.
        required: Columns that must exist.
        optional: Further columns to read where they exist; None reads all.

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
    """Columns of an open file, for all rows or for a range of them.

    Only the row groups that a range touches are read: LeRobot writes one group per episode.

    Raises:
        DatasetError: The file is damaged.
    """
    wanted = None if columns is None else list(columns)
    try:
        if rows is None or (rows.start, rows.stop) == (0, parquet.metadata.num_rows):
            return parquet.read(columns=wanted)
        starts = row_group_starts(parquet.metadata)
        first = bisect_right(starts, rows.start) - 1
        groups = list(range(first, bisect_left(starts, rows.stop)))
        table = parquet.read_row_groups(groups, columns=wanted)
        return table.slice(rows.start - starts[first], rows.stop - rows.start)
    except (pa.ArrowException, OSError, ValueError, MemoryError, OverflowError) as error:
        text = f"unreadable: the file is damaged ({error}); copy it again"
        raise DatasetError(text, file=file) from error


def row_group_starts(metadata: pq.FileMetaData) -> list[int]:
    """First row of each row group."""
    sizes = [metadata.row_group(i).num_rows for i in range(metadata.num_row_groups)]
    return [0, *accumulate(sizes)][:-1]


def write_parquet(table: pa.Table, path: Path) -> None:
    """Write a table with a checksum of each page, which readers verify."""
    pq.write_table(table, path, write_page_checksum=True)


_MAGIC = b"PAR1"
_TRUE, _FALSE, _BYTE, _I32, _I64, _BINARY, _LIST, _STRUCT = 1, 2, 3, 5, 6, 8, 9, 12
"""Types of Thrift's compact protocol, in which Parquet writes its headers."""
_Struct = dict[int, tuple[int, Any]]
"""Number of a field -> its type and value."""


class _Page(NamedTuple):
    """One page of a column in a Parquet file."""

    start: int
    end: int
    plain_size: int
    """Size of the header and of the uncompressed content [bytes]."""
    values: int
    """Number of values, 0 for a dictionary."""


def is_unfinished(path: Path) -> bool:
    """True for a Parquet file without its footer: its writer was killed."""
    with path.open("rb") as stream:
        begin = stream.read(4)
        stream.seek(max(0, path.stat().st_size - 4))
        return begin == _MAGIC and stream.read() != _MAGIC


def finished_parquet(content: bytes, example: pa.Table) -> bytes:
    """A Parquet file whose writer was killed, with a new footer for its complete row groups.

    A footer holds the schema and repeats the content of the page headers. The new footer is
    made from the footer of an example; the pages are kept as they are.

    Args:
        content: Content of the file, with pages as pyarrow writes them (Snappy, dictionaries).
        example: Table with the columns of the file and one row.
    """
    sink = pa.BufferOutputStream()
    pq.write_table(example, sink)
    twin = sink.getvalue().to_pybytes()
    footer, _ = _read(twin, len(twin) - 8 - int.from_bytes(twin[-8:-4], "little"), _STRUCT)
    (group,) = footer[4][1][1]
    model = [column[3][1] for column in group[1][1][1]]
    pages, groups, end = [*_pages(content)], [], 4
    while (found := _row_group(pages, model)) is not None:
        count, group = found
        groups.append(group)
        pages, end = pages[count:], pages[count - 1].end
    footer |= {3: (_I64, sum(group[3][1] for group in groups)), 4: (_LIST, (_STRUCT, groups))}
    made = _written(_STRUCT, footer)
    return content[:end] + made + len(made).to_bytes(4, "little") + _MAGIC


def _pages(content: bytes) -> Iterator[_Page]:
    """Complete pages, in their order in the file."""
    at = len(_MAGIC)
    while True:
        try:
            header, begin = _read(content, at, _STRUCT)
            plain, end = begin - at + header[2][1], begin + header[3][1]
            # Number of values in a data page of either version.
            values = next((header[n][1][1][1] for n in (5, 8) if n in header), 0)
        except (IndexError, KeyError, TypeError, ValueError):
            return
        if end > len(content):
            return
        yield _Page(at, end, plain, values)
        at = end


def _row_group(pages: Sequence[_Page], model: Sequence[_Struct]) -> tuple[int, _Struct] | None:
    """Number of pages and metadata of the next row group; None if it is incomplete.

    A column begins with its dictionary, unless it holds Booleans. The first column has an
    unknown number of pages, so each page in turn is tried as the last page of this column.
    """
    for first in accumulate(page.values for page in pages):
        rows, columns, at = first // model[0][5][1], [], 0
        for column in model:
            wanted, values, begin = rows * column[5][1], 0, at
            while values < wanted and at < len(pages):
                values, at = values + pages[at].values, at + 1
            is_plain = column[1][1] == 0
            if not rows or values != wanted or bool(pages[begin].values) != is_plain:
                break
            columns.append({2: (_I64, 0), 3: (_STRUCT, _column(column, pages[begin:at]))})
        if len(columns) == len(model):
            size = sum(page.plain_size for page in pages[:at])
            parts = {1: (_LIST, (_STRUCT, columns)), 2: (_I64, size), 3: (_I64, rows)}
            return at, parts
    return None


def _column(model: _Struct, pages: Sequence[_Page]) -> _Struct:
    """Metadata of the pages of a column; type, name and codec are those of `model`."""
    sizes = {
        5: sum(page.values for page in pages),
        6: sum(page.plain_size for page in pages),
        7: pages[-1].end - pages[0].start,
        9: next(page.start for page in pages if page.values),
        11: pages[0].start,
    }
    if pages[0].values:  # no dictionary
        del sizes[11]
    made = {number: (_I64, size) for number, size in sizes.items()}
    # The encodings that pyarrow uses: plain values, run lengths and dictionaries.
    return made | {1: model[1], 2: (_LIST, (_I32, [0, 3, 8])), 3: model[3], 4: model[4]}


def _read(data: bytes, at: int, kind: int) -> tuple[Any, int]:
    """A value of Thrift's compact protocol, and the position after it."""
    if kind in (_TRUE, _FALSE):
        return kind == _TRUE, at
    if kind == _BYTE:
        return data[at], at + 1
    if kind == _STRUCT:
        fields, field = {}, 0
        while data[at]:
            step, part = divmod(data[at], 16)
            field, at = (field + step, at + 1) if step else _read(data, at + 1, _I32)
            value, at = _read(data, at, part)
            fields[field] = part, value
        return fields, at + 1
    if kind == _LIST:
        size, part = divmod(data[at], 16)
        size, at = _read_number(data, at + 1) if size == 15 else (size, at + 1)
        values = []
        for _ in range(size):
            value, at = _read(data, at, part)
            values.append(value)
        return (part, values), at
    number, at = _read_number(data, at)
    if kind == _BINARY:
        return data[at : at + number], at + number
    return (number >> 1) ^ -(number & 1), at  # all other types are integers


def _read_number(data: bytes, at: int) -> tuple[int, int]:
    """Unsigned number with seven bits per byte, the lowest bits first."""
    number = shift = 0
    while data[at] & 128:
        number |= (data[at] & 127) << shift
        at, shift = at + 1, shift + 7
    return number | data[at] << shift, at + 1


def _written(kind: int, value: Any) -> bytes:
    """A value in Thrift's compact protocol.

    The numbers of successive fields of a struct may differ by 15 at most.
    """
    if kind in (_TRUE, _FALSE):
        return b""
    if kind == _BYTE:
        return bytes([value])
    if kind == _BINARY:
        return _number(len(value)) + value
    if kind == _LIST:
        part, values = value
        head = bytes([240 | part]) + _number(len(values))
        return head + b"".join(_written(part, one) for one in values)
    if kind == _STRUCT:
        made, last = b"", 0
        for field, (own, one) in sorted(value.items()):
            made += bytes([(field - last) << 4 | own]) + _written(own, one)
            last = field
        return made + b"\0"
    return _number(value << 1 if value >= 0 else ~(value << 1))


def _number(number: int) -> bytes:
    low, high = number & 127, number >> 7
    return bytes([low | 128]) + _number(high) if high else bytes([low])
