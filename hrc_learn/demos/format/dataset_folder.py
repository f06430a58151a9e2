"""Where the parts of a LeRobot dataset lie, for its versions 2.0, 2.1 and 3.0.

Reads the metadata alone. The three versions end in one form, `DatasetFolder`; what the frames
hold is the business of `read.frames` and `read.column_mapping`.
"""

import json
from bisect import bisect_left, bisect_right
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from hrc_learn.demos.format.metadata import INFO_PATH, Feature, read_features
from hrc_learn.demos.issue import DatasetError
from hrc_learn.demos.write.episode import staging_folder
from hrc_learn.store import settle


@dataclass(frozen=True, kw_only=True)
class EpisodeEntry:
    """One episode as the metadata know it."""

    index: int
    length: int
    """Frames."""
    tasks: tuple[str, ...]
    file: str
    """Data file, relative to the dataset."""
    start: int
    """Row of its first frame in that file."""

    @property
    def location(self) -> dict[str, Any]:
        """Where it lies, for a `DatasetError` or a report."""
        return {"file": self.file, "episode": self.index}


@dataclass(frozen=True, kw_only=True)
class DatasetFolder:
    """A dataset's metadata, the same for every version."""

    root: Path
    version: str
    fps: float
    robot_type: str | None
    features: dict[str, Feature]
    episodes: tuple[EpisodeEntry, ...]
    tasks: dict[int, str]
    """Task texts by index."""
    info: dict
    """`meta/info.json` as it is."""

    def files(self) -> dict[str, list[EpisodeEntry]]:
        """Data file -> the episodes in it."""
        files: dict[str, list[EpisodeEntry]] = {}
        for entry in self.episodes:
            files.setdefault(entry.file, []).append(entry)
        return files

    @cached_property
    def promised_rows(self) -> dict[str, int]:
        """Data file -> frames it should hold by the list of episodes."""
        return {
            file: max(entry.start + entry.length for entry in entries)
            for file, entries in self.files().items()
        }


def open_folder(path: str | Path) -> DatasetFolder:
    """Read the metadata of a dataset.

    Raises:
        DatasetError: There is no dataset, it was never finished, its version is unknown, or
            a part of its metadata is missing or damaged.
    """
    root = Path(path)
    info = read_info(root)
    return DatasetFolder(
        root=root,
        version=info["codebase_version"],
        fps=float(info["fps"]),
        robot_type=info.get("robot_type"),
        features=read_features(info),
        episodes=tuple(read_episodes(root, info)),
        tasks=read_tasks(root, info),
        info=info,
    )


def read_info(root: Path) -> dict:
    """`meta/info.json`, its version and frame rate known to be usable.

    Raises:
        DatasetError: It is missing, damaged, or unusable.
    """
    path = root / INFO_PATH
    settle(root)
    if not path.is_file():
        raise DatasetError(_why_no_info(root), file=path)
    info = read_json(path)
    missing = [key for key in ("codebase_version", "fps", "features") if key not in info]
    if missing:
        raise DatasetError(f"lacks {', '.join(missing)}", file=INFO_PATH)
    version = info["codebase_version"]
    if _generation(version) is None:
        raise DatasetError(
            f"dataset version {version!r} is unknown; versions 2.0, 2.1 and 3.0 can be read",
            file=INFO_PATH,
            key="codebase_version",
        )
    if not isinstance(info["fps"], int | float) or not info["fps"] > 0:
        raise DatasetError(
            f"fps must be positive, got {info['fps']!r}", file=INFO_PATH, key="fps"
        )
    return info


def read_episodes(root: Path, info: dict) -> list[EpisodeEntry]:
    """Every episode and where it lies.

    Raises:
        DatasetError: The list of episodes is missing or damaged.
    """
    generation = _generation(info["codebase_version"])
    entries = _episodes_v3(root, info) if generation == 3 else _episodes_v2(root, info)
    return sorted(entries, key=lambda entry: entry.index)


def read_tasks(root: Path, info: dict) -> dict[int, str]:
    """Task texts by index.

    Raises:
        DatasetError: The list of tasks is missing or damaged.
    """
    if _generation(info["codebase_version"]) == 3:
        file = "meta/tasks.parquet"
        rows = read_rows(root, file, ("task_index",))
        # The column of texts has no name when pandas wrote an index without one.
        texts = [
            row.get("task", row.get("__index_level_0__", row.get("index"))) for row in rows
        ]
        return {int(row["task_index"]): str(t) for row, t in zip(rows, texts, strict=True)}
    rows = _read_json_lines(root, "meta/tasks.jsonl", ("task_index", "task"))
    return {int(row["task_index"]): str(row["task"]) for row in rows}


def read_json(path: Path) -> dict:
    """A JSON object from a file.

    Raises:
        DatasetError: The file holds none.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise DatasetError(f"is no valid JSON: {error}", file=path) from error
    if not isinstance(content, dict):
        raise DatasetError("is no JSON object", file=path)
    return content


def _why_no_info(root: Path) -> str:
    if staging_folder(root).is_dir():
        return (
            f"not found: the recording was broken off before it became a dataset. "
            f"hrc_learn.demos.recover_dataset({str(root)!r}) makes one of its saved episodes"
        )
    if not root.exists():
        return "there is no dataset: the folder does not exist"
    return "not found: this folder is no LeRobot dataset, or its recording was not finalized"


def _generation(version: object) -> int | None:
    numbers = str(version).removeprefix("v").split(".")
    if numbers[0] == "3" or numbers[:2] in (["2", "0"], ["2", "1"]):
        return int(numbers[0])
    return None


def _episodes_v3(root: Path, info: dict) -> Iterable[EpisodeEntry]:
    folder = root / "meta/episodes"
    files = sorted(folder.glob("*/*.parquet"))
    if not files:
        raise DatasetError(
            "no list of episodes: the recording was not finalized, or the copy is incomplete",
            file="meta/episodes",
        )
    columns = (
        "episode_index",
        "length",
        "data/chunk_index",
        "data/file_index",
        "dataset_from_index",
    )
    rows = [
        row
        for file in files
        for row in read_rows(root, str(file.relative_to(root)), columns, optional=("tasks",))
    ]
    first_row: dict[tuple, int] = {}
    for row in rows:
        place = row["data/chunk_index"], row["data/file_index"]
        start = int(row["dataset_from_index"])
        first_row[place] = min(first_row.get(place, start), start)
    for row in rows:
        chunk, file = row["data/chunk_index"], row["data/file_index"]
        yield EpisodeEntry(
            index=row["episode_index"],
            length=row["length"],
            tasks=tuple(row.get("tasks") or ()),
            file=_data_file(info, chunk_index=chunk, file_index=file),
            start=row["dataset_from_index"] - first_row[chunk, file],
        )


def _episodes_v2(root: Path, info: dict) -> Iterable[EpisodeEntry]:
    rows = _read_json_lines(root, "meta/episodes.jsonl", ("episode_index", "length"))
    for row in rows:
        index = int(row["episode_index"])
        chunk = index // int(info.get("chunks_size", 1000))
        yield EpisodeEntry(
            index=index,
            length=int(row["length"]),
            tasks=tuple(row.get("tasks") or ()),
            file=_data_file(info, episode_chunk=chunk, episode_index=index),
            start=0,
        )


def _data_file(info: dict, **places: int) -> str:
    try:
        return str(info["data_path"]).format(**places)
    except (KeyError, ValueError, IndexError) as error:
        raise DatasetError(
            f"data_path {info.get('data_path')!r} does not fit the dataset's version",
            file=INFO_PATH,
            key="data_path",
        ) from error


def _read_json_lines(root: Path, file: str, required: tuple[str, ...]) -> list[dict]:
    path = root / file
    if not path.is_file():
        raise DatasetError("not found: the copy is incomplete", file=file)
    rows = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
        except json.JSONDecodeError as error:
            raise DatasetError(f"line {number} is no valid JSON: {error}", file=file) from error
        missing = [key for key in required if key not in row]
        if missing:
            raise DatasetError(f"line {number} lacks {', '.join(missing)}", file=file)
        rows.append(row)
    return rows


# Its files of Parquet, opened with errors that say what to do.


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
