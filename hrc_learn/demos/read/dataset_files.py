"""Metadata and Parquet files of a dataset, read defensively: foreign files may be anything.

Every fault becomes a `DatasetError` that names the file and the remedy. No file outside the
dataset is opened, whatever a template in `meta/info.json` says.
"""

import json
import re
import stat
from bisect import bisect_left, bisect_right
from collections.abc import Collection, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any

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
        episode: Episode that needs it.

    Raises:
        DatasetError: There is no such file, it is a device or a pipe, may not be read, is a
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
    except OSError as error:  # circular links too
        raise DatasetError(f"cannot be read: {error.strerror}", **place) from error
    if head == _POINTER:
        text = "is a pointer of Git LFS, not the file itself: run `git lfs pull` in the dataset"
        raise DatasetError(text, **place)
    if not is_inside(root, file):
        raise DatasetError(_OUTSIDE, **place)


def is_inside(root: Path, file: str | Path) -> bool:
    """True if a file lies in the dataset once links are followed.

    The Hub's cache keeps files in a folder of blobs next to its snapshots, which counts too.
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
    absent = template is None and key == "data_path"  # videos may be declared without a file
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
    """JSON objects of a file with one a line.

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
    except (ValueError, RecursionError) as error:  # ValueError: numbers of too many digits too
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
            "unreadable: the file is truncated, because the recording was not finalized or "
            "the copy is incomplete"
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
        raise DatasetError(
            f"unreadable: the file is damaged ({error}); copy it again", file=file
        ) from error


def row_group_starts(metadata: pq.FileMetaData) -> list[int]:
    """First row of each row group."""
    sizes = [metadata.row_group(i).num_rows for i in range(metadata.num_row_groups)]
    return [0, *accumulate(sizes)][:-1]


def write_parquet(table: pa.Table, path: Path) -> None:
    """Write a table with a checksum of each page, which readers verify."""
    pq.write_table(table, path, write_page_checksum=True)
