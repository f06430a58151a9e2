"""Where the parts of a LeRobot dataset lie, for its versions 2.0, 2.1 and 3.0.

Reads the metadata alone. The three versions end in one form, `DatasetFolder`; what the frames
hold is the business of `read.frames` and `read.column_mapping`.
"""

import json
import re
import shlex
import stat
from bisect import bisect_left, bisect_right
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from hrc_learn.demos.format.metadata import (
    INFO_PATH,
    QUANTILES,
    Feature,
    Statistics,
    read_features,
)
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
    def first_index(self) -> dict[int, int]:
        """Episode -> frames of all episodes before it."""
        ordered = sorted(self.episodes, key=lambda entry: entry.index)
        starts = accumulate((entry.length for entry in ordered), initial=0)
        return {e.index: start for e, start in zip(ordered, starts, strict=False)}

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
        version=str(info["codebase_version"]),
        fps=float(info["fps"]),
        robot_type=info.get("robot_type"),
        features=read_features(info),
        episodes=tuple(read_episodes(root, info)),
        tasks=read_tasks(root, info),
        info=info,
    )


_FASTEST = 1e6
"""No robot reports more often [1/s]."""


def read_info(root: Path) -> dict:
    """`meta/info.json`, its version and frame rate known to be usable.

    Raises:
        DatasetError: It is missing, damaged, or unusable.
    """
    path = root / INFO_PATH
    settle(root)
    if not path.exists():
        raise DatasetError(_why_no_info(root), file=path)
    info = read_json(path)
    missing = [key for key in ("codebase_version", "fps", "features") if key not in info]
    if missing:
        raise DatasetError(f"lacks {', '.join(missing)}", file=INFO_PATH)
    version = info["codebase_version"]
    if generation(version) is None:
        raise DatasetError(
            f"dataset version {version!r} is unknown; versions 2.0, 2.1 and 3.0 can be read",
            file=INFO_PATH,
            key="codebase_version",
        )
    fps = info["fps"]
    number = isinstance(fps, int | float) and not isinstance(fps, bool)
    if not number or not 0 < fps < _FASTEST:
        raise DatasetError(
            f"fps must be positive and below {_FASTEST:g}, got {fps!r}",
            file=INFO_PATH,
            key="fps",
        )
    if not isinstance(info["features"], dict):
        raise DatasetError("features must be an object", file=INFO_PATH, key="features")
    return info


def read_episodes(root: Path, info: dict) -> list[EpisodeEntry]:
    """Every episode and where it lies.

    Raises:
        DatasetError: The list of episodes is missing or damaged.
    """
    read = _episodes_v3 if generation(info["codebase_version"]) == 3 else _episodes_v2
    entries = read(root, info)
    return sorted(entries, key=lambda entry: entry.index)


def read_tasks(root: Path, info: dict) -> dict[int, str]:
    """Task texts by index.

    Raises:
        DatasetError: The list of tasks is missing or damaged.
    """
    if generation(info["codebase_version"]) == 3:
        file = "meta/tasks.parquet"
        rows = read_rows(root, file, ("task_index",))
        # The column of texts has no name when pandas wrote an index without one.
        texts = [
            row.get("task", row.get("__index_level_0__", row.get("index"))) for row in rows
        ]
    else:
        file = "meta/tasks.jsonl"
        rows = _read_json_lines(root, file, ("task_index", "task"))
        texts = [row["task"] for row in rows]
    indices = [_integer(row["task_index"], "task_index", file) for row in rows]
    return {index: str(text) for index, text in zip(indices, texts, strict=True)}


def recorded_statistics(folder: DatasetFolder) -> dict[int, Statistics]:
    """Statistics of each episode's features, those that have all of LeRobot's figures.

    Raises:
        DatasetError: Their file is damaged.
    """
    found: dict[int, Statistics] = {}
    lines = "meta/episodes_stats.jsonl"
    if generation(folder.version) == 3:
        for path in sorted((folder.root / "meta/episodes").glob("*/*.parquet")):
            for row in read_rows(folder.root, str(path.relative_to(folder.root)), ()):
                statistics = found.setdefault(row["episode_index"], {})
                for name, value in row.items():
                    if name.startswith("stats/") and value is not None:
                        key, _, statistic = name.removeprefix("stats/").rpartition("/")
                        statistics.setdefault(key, {})[statistic] = value
    elif (folder.root / lines).is_file():
        for row in _read_json_lines(folder.root, lines, ("episode_index", "stats")):
            found[int(row["episode_index"])] = row["stats"]
    wanted = {*QUANTILES, "min", "max", "mean", "std", "count"}
    return {
        index: {key: s for key, s in statistics.items() if wanted <= s.keys()}
        for index, statistics in found.items()
    }


def read_json(path: Path) -> dict:
    """A JSON object from a file.

    Raises:
        DatasetError: The file holds none.
    """
    content = _parse(read_text(path), path)
    if not isinstance(content, dict):
        raise DatasetError("is no JSON object", file=path)
    return content


def _parse(text: str, file: str | Path, place: str = "") -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:  # of numbers with too many digits too
        raise DatasetError(f"{place}is no valid JSON: {error}", file=file) from error


_LARGEST_TEXT = 2**28
"""Bytes of metadata: 10,000 episodes have 100 MB of statistics at most."""
_POINTER = b"version https://git-lfs.github.com/spec/"


def read_text(path: Path) -> str:
    """Text of a metadata file.

    Raises:
        DatasetError: It is none, cannot be read, or is a pointer of Git LFS.
    """
    require_file(path, path)
    try:
        if path.stat().st_size > _LARGEST_TEXT:
            raise DatasetError("is too large to be metadata", file=path)
        return path.read_bytes().decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"cannot be read as text: {error}", file=path) from error


def require_file(path: Path, name: str | Path, episode: int | None = None) -> None:
    """Refuse what is no ordinary file of the dataset, before anything is read of it.

    Raises:
        DatasetError: There is no such file, it is a device or a pipe, may not be read, or is a
            pointer of Git LFS.
    """
    place: dict[str, Any] = {"file": name, "episode": episode}
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            kind = "a folder" if stat.S_ISDIR(mode) else "a device or pipe"
            raise DatasetError(f"is {kind}, not a file", **place)
        with path.open("rb") as stream:
            head = stream.read(len(_POINTER))
    except FileNotFoundError as error:
        raise DatasetError("not found: the copy is incomplete", **place) from error
    except OSError as error:  # loops of links too
        raise DatasetError(f"cannot be read: {error.strerror}", **place) from error
    if head == _POINTER:
        raise DatasetError(
            "is a pointer of Git LFS, not the file itself: run `git lfs pull` in the dataset",
            **place,
        )


_FIELD = re.compile(r"\{([a-z_]+)(?::0?(\d{1,2})d)?\}")


def path_in(root: Path, template: object, key: str, **places: int | str) -> str:
    """Path of a file of the dataset, relative to it, from its template in `meta/info.json`.

    Raises:
        DatasetError: The template does not fit the version, or leads out of the dataset.
    """
    text = str(template)
    left = _FIELD.sub("", text)
    if "{" in left or "}" in left or any(m[1] not in places for m in _FIELD.finditer(text)):
        raise DatasetError(
            f"{key} {template!r} does not fit the dataset's version", file=INFO_PATH, key=key
        )
    try:
        file = text.format(**places)
    except ValueError as error:
        raise DatasetError(f"{key} {template!r}: {error}", file=INFO_PATH, key=key) from error
    if not is_inside(root, file):
        raise DatasetError(
            f"{key} leads out of the dataset ({file!r}): it is not followed",
            file=INFO_PATH,
            key=key,
        )
    return file


def is_inside(root: Path, file: str | Path) -> bool:
    """Whether a file lies in the dataset once links are followed.

    The Hub's cache keeps files in a folder of blobs beside its snapshots, which counts too.
    """
    try:
        real, here = (root / file).resolve(), root.resolve()
    except (OSError, RuntimeError, ValueError):
        return False
    homes = [here]
    if here.parent.name == "snapshots":
        homes.append(here.parent.parent / "blobs")
    return ".." not in Path(file).parts and any(real.is_relative_to(home) for home in homes)


def _integer(value: object, name: str, file: str, lowest: int = 0, line: str = "") -> int:
    """A count or index from metadata.

    Raises:
        DatasetError: It is none.
    """
    whole = isinstance(value, int) or (isinstance(value, float) and value.is_integer())
    if isinstance(value, bool) or not whole or not lowest <= int(value) < 2**53:  # type: ignore[arg-type]
        raise DatasetError(
            f"{line}{name} must be a whole number of at least {lowest}, got {value!r}",
            file=file,
            key=name,
        )
    return int(value)  # type: ignore[arg-type]


def how_to_recover(root: Path) -> str:
    """The command, and the call, that make a dataset of an interrupted recording."""
    command = shlex.join(["hrc", "recover", "--path", str(root)])
    return f"`{command}`, or hrc_learn.demos.recover_dataset({str(root)!r}),"


def _why_no_info(root: Path) -> str:
    if staging_folder(root).is_dir():
        return (
            f"not found: the recording was broken off before it became a dataset. "
            f"{how_to_recover(root)} makes one of its saved episodes"
        )
    if not root.exists():
        return "there is no dataset: the folder does not exist"
    return "not found: this folder is no LeRobot dataset, or its recording was not finalized"


def generation(version: object) -> int | None:
    """2 or 3 of a version such as "v2.1"; None of one that is not known here."""
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
        place = tuple(
            _integer(row[name], name, "meta/episodes")
            for name in ("data/chunk_index", "data/file_index")
        )
        start = _integer(row["dataset_from_index"], "dataset_from_index", "meta/episodes")
        first_row[place] = min(first_row.get(place, start), start)
    # Looked up once a file: links are followed, which takes longer than all else of an episode.
    paths = {
        (chunk, number): path_in(
            root, info.get("data_path"), "data_path", chunk_index=chunk, file_index=number
        )
        for chunk, number in first_row
    }
    for row in rows:
        chunk, file = row["data/chunk_index"], row["data/file_index"]
        yield EpisodeEntry(
            index=_integer(row["episode_index"], "episode_index", "meta/episodes"),
            length=_integer(row["length"], "length", "meta/episodes"),
            tasks=_task_texts(row),
            file=paths[chunk, file],
            start=int(row["dataset_from_index"]) - first_row[chunk, file],
        )


def _episodes_v2(root: Path, info: dict) -> Iterable[EpisodeEntry]:
    name = "meta/episodes.jsonl"
    rows = _read_json_lines(root, name, ("episode_index", "length"))
    size = _integer(info.get("chunks_size", 1000), "chunks_size", INFO_PATH, lowest=1)
    for row in rows:
        index = _integer(row["episode_index"], "episode_index", name)
        yield EpisodeEntry(
            index=index,
            length=_integer(row["length"], "length", name),
            tasks=_task_texts(row),
            file=path_in(
                root,
                info.get("data_path"),
                "data_path",
                episode_chunk=index // size,
                episode_index=index,
            ),
            start=0,
        )


def _task_texts(row: dict) -> tuple[str, ...]:
    tasks = row.get("tasks") or ()
    return tuple(map(str, tasks)) if isinstance(tasks, list | tuple) else (str(tasks),)


def _read_json_lines(root: Path, file: str, required: tuple[str, ...]) -> list[dict]:
    path = root / file
    require_file(path, file)
    if not is_inside(root, file):
        raise DatasetError("leads out of the dataset: it is not followed", file=file)
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        row = _parse(line, file, f"line {number} ")
        if not isinstance(row, dict):
            raise DatasetError(f"line {number} is no JSON object", file=file)
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
    require_file(root / file, file, episode)
    if not is_inside(root, file):
        raise DatasetError(
            "leads out of the dataset: it is not followed", file=file, episode=episode
        )
    try:
        return pq.ParquetFile(root / file)
    except (pa.ArrowException, OSError, ValueError) as error:
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
    except (pa.ArrowException, OSError, ValueError) as error:
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
