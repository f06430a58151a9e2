"""Faults of the metadata and the files: what is missing, and what contradicts what."""

from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa

from hrc_learn.demos.format.dataset_folder import (
    DatasetFolder,
    EpisodeEntry,
    open_parquet,
    read_episodes,
    read_info,
    read_json,
    read_tasks,
)
from hrc_learn.demos.format.metadata import INFO_PATH, Feature, read_features
from hrc_learn.demos.issue import DatasetError, ValidationReport, plain_text
from hrc_learn.demos.read.episodes import count_faults
from hrc_learn.demos.read.frames import BadRowError, RawFrames, require_rows, to_numpy
from hrc_learn.demos.read.roles import INDEX_KEYS
from hrc_learn.demos.validation.data_checks import ColumnSummary


def check_metadata(root: Path, report: ValidationReport) -> DatasetFolder | None:
    """Read as much of the metadata as can be read; None where nothing can be made of it."""
    info = attempt(report, lambda: read_info(root))
    if info is None:
        return None
    features: dict[str, Feature] = {}
    for key, declared in info["features"].items():
        single = {"features": {key: declared}}
        features |= attempt(report, lambda single=single: read_features(single)) or {}
    tasks = attempt(report, lambda: read_tasks(root, info)) or {}
    episodes = attempt(report, lambda: read_episodes(root, info))
    if episodes is None:
        return None
    folder = DatasetFolder(
        root=root,
        version=str(info["codebase_version"]),
        fps=float(info["fps"]),
        robot_type=info.get("robot_type"),
        features=features,
        episodes=tuple(episodes),
        tasks=tasks,
        info=info,
    )
    attempt(report, lambda: [report.add(fault) for fault in count_faults(folder)])
    statistics = ("meta/stats.json", "meta/episodes_stats.jsonl")
    if not any((root / file).is_file() for file in statistics):
        report.warning(
            "no statistics: LeRobot's policies cannot normalise their inputs",
            file=statistics[0],
        )
    for check in (_check_tasks, _check_names, _check_order, _check_leftovers):
        attempt(report, lambda check=check: check(folder, report))
    return folder


_BATCH_ROWS = 2**14
_LARGEST_EPISODE = 2**28
"""Bytes of one episode that are held: 75 minutes of 60 numbers at 100 Hz."""


def check_files(
    folder: DatasetFolder, report: ValidationReport
) -> Iterator[tuple[EpisodeEntry, RawFrames]]:
    """Read the data files as far as they go; their episodes with the columns that are sound.

    Files are read in pieces, and no more of them than the list of episodes promises.
    """
    for file, entries in folder.files().items():
        try:
            yield from _read_pieces(folder, file, entries, report)
        except DatasetError as error:
            report.add(error)
        except (pa.ArrowException, OSError, ValueError, MemoryError, OverflowError) as error:
            report.error(
                f"unreadable: the file is damaged ({type(error).__name__}: {error}); copy it "
                f"again",
                file=file,
                episode=entries[0].index,
            )


def _read_pieces(
    folder: DatasetFolder, file: str, entries: list[EpisodeEntry], report: ValidationReport
) -> Iterator[tuple[EpisodeEntry, RawFrames]]:
    parquet = open_parquet(folder.root, file, entries[0].index)
    existing, rows = parquet.schema_arrow.names, parquet.metadata.num_rows
    promised = max(entry.start + entry.length for entry in entries)
    attempt(report, lambda: require_rows(file, entries, rows, promised))
    wanted = _known_columns(folder, file, existing, parquet.schema_arrow, report)
    if not wanted:
        return
    width = sum(feature.width for key, feature in folder.features.items() if key in wanted)
    limit = max(1000, _LARGEST_EPISODE // (8 * max(width, 1)))
    pieces = parquet.iter_batches(batch_size=_BATCH_ROWS, columns=wanted)
    table, first = pa.table({}), 0
    told: set[str] = set()
    for entry in sorted(entries, key=lambda entry: entry.start):
        end = entry.start + entry.length
        if end > rows or entry.length <= 0 or entry.start < first:
            continue
        if entry.length > limit:
            report.warning(
                f"is too long to be examined as a whole: {entry.length} frames",
                **entry.location,
            )
            end = entry.start + limit
        while first + len(table) < end and (piece := next(pieces, None)) is not None:
            arrived = pa.Table.from_batches([piece])
            table = pa.concat_tables([table, arrived]) if len(table) else arrived
            if first + len(table) <= entry.start:  # between episodes
                first, table = first + len(table), table.slice(len(table))
        part = table.slice(entry.start - first, end - entry.start)
        frames = _sound_columns(folder, file, part, entry, told, report)
        if len(part) == entry.length and frames:
            yield entry, frames
        table = table.slice(end - first)
        first = end


def _known_columns(
    folder: DatasetFolder,
    file: str,
    existing: list[str],
    schema: pa.Schema,
    report: ValidationReport,
) -> list[str]:
    """Columns of numbers that are declared and there once."""
    wanted = []
    for key, feature in folder.features.items():
        if feature.dtype == "video":
            continue
        if existing.count(key) > 1:
            report.error("the column is there more than once", file=file, key=key)
        elif key not in existing:
            _report_missing(file, key, report)
        elif feature.numeric:
            kind = _innermost(schema.field(key).type)
            if (
                kind is not None
                and str(kind)
                .replace("double", "float64")
                .replace("float", "float32")
                .replace("float3264", "float64")
                != feature.dtype
            ):
                report.warning(
                    f"holds {kind}, but meta/info.json declares {feature.dtype}",
                    file=file,
                    key=key,
                )
            wanted.append(key)
    for key in INDEX_KEYS:
        if key not in folder.features and key not in existing:
            _report_missing(file, key, report)
    return wanted


def _innermost(kind: pa.DataType) -> pa.DataType | None:
    """Type of the numbers in a column; None where it is none of Arrow's own."""
    while pa.types.is_nested(kind):
        if pa.types.is_struct(kind) or pa.types.is_map(kind):
            return kind
        kind = kind.value_type
    return kind


def check_indices(
    folder: DatasetFolder, entry: EpisodeEntry, frames: RawFrames, report: ValidationReport
) -> None:
    """The columns by which LeRobot counts: contiguous, and of this episode."""
    count = np.arange(entry.length)
    expected = {"frame_index": count, "episode_index": np.full(entry.length, entry.index)}
    if "index" in frames:
        expected["index"] = folder.first_index[entry.index] + count
    for key, values in expected.items():
        wrong = np.flatnonzero(frames[key][:, 0] != values) if key in frames else []
        if len(wrong):
            k = int(wrong[0])
            report.error(
                f"is {frames[key][k, 0]:g}, expected {values[k]:g}; frames were lost, repeated "
                f"or moved",
                **entry.location,
                frame=k,
                key=key,
            )
    if "task_index" in frames and folder.tasks:
        known = np.isin(frames["task_index"][:, 0], list(folder.tasks))
        if not known.all():
            k = int(known.argmin())
            report.error(
                f"task {frames['task_index'][k, 0]:g} is not in the list of tasks",
                **entry.location,
                frame=k,
                key="task_index",
            )


def attempt[T](report: ValidationReport, read: Callable[[], T]) -> T | None:
    """What a step of the check returns; None, and an error in the report, where it fails.

    Data from elsewhere can fail in ways that no list foresees, and a check must tell so.
    """
    try:
        return read()
    except DatasetError as error:
        report.add(error)
    except Exception as error:
        report.error(
            f"cannot be examined further ({type(error).__name__}: {str(error)[:200]})",
            file=str(report.path),
        )
    return None


def _sound_columns(
    folder: DatasetFolder,
    file: str,
    table: pa.Table,
    entry: EpisodeEntry,
    told: set[str],
    report: ValidationReport,
) -> RawFrames:
    """Columns of one episode; what is wrong with all of a file is told once."""
    columns = {}
    for key in table.column_names:
        try:
            values = to_numpy(table.column(key))
        except (BadRowError, pa.ArrowException, TypeError) as error:
            row = error.row if isinstance(error, BadRowError) else 0
            report.error(str(error), **entry.location, frame=row, key=key)
            continue
        width = folder.features[key].width
        if len(values) and values.shape[1] != width:
            if key not in told:
                report.error(
                    f"has {values.shape[1]} components, but meta/info.json declares the shape "
                    f"{list(folder.features[key].shape)}",
                    file=file,
                    key=key,
                )
            told.add(key)
        columns[key] = values
    return columns


def _report_missing(file: str, key: str, report: ValidationReport) -> None:
    if key in INDEX_KEYS:
        # All files come from one recorder: the first one tells it for all.
        if not any(finding.key == key for finding in report.warnings):
            message = "the column is missing: LeRobot cannot open this, hrc repair adds it"
            report.warning(message, file=file, key=key)
    else:
        report.error(
            "the column is declared in meta/info.json, but missing", file=file, key=key
        )


def check_statistics(
    folder: DatasetFolder, columns: Mapping[str, ColumnSummary], report: ValidationReport
) -> None:
    """Statistics that policies normalise by, against the data."""
    path = folder.root / "meta/stats.json"
    if not path.exists():
        return
    recorded = attempt(report, lambda: read_json(path)) or {}
    for key, summary in columns.items():
        stated = recorded.get(key)
        if key in INDEX_KEYS or not summary.finite or not summary.count or stated is None:
            continue
        try:
            low, high, mean, std = (
                np.asarray(stated[name], float).reshape(-1)
                for name in ("min", "max", "mean", "std")
            )
            shapes = {len(low), len(high), len(mean), len(std)}
        except (KeyError, TypeError, ValueError):
            report.warning("statistics are incomplete", file="meta/stats.json", key=key)
            continue
        if shapes != {len(summary.low)}:
            report.error(
                f"statistics of {len(mean)} components for {len(summary.low)}: LeRobot cannot "
                f"normalise",
                file="meta/stats.json",
                key=key,
            )
            continue
        span = np.maximum(summary.high - summary.low, 1e-6)
        wrong = ~np.isfinite(low + high + mean + std) | (std < 0) | (low > high)
        # Of a part of a dataset the statistics of the whole may remain; they enclose it.
        wrong |= (summary.low < low - 0.02 * span) | (summary.high > high + 0.02 * span)
        wrong |= (mean < low - 0.02 * span) | (mean > high + 0.02 * span)
        wrong |= (high - low) > 20 * span + 1
        if wrong.any():
            report.warning(
                f"statistics are not those of the data, in {wrong.sum()} components: policies "
                f"would normalise wrongly; hrc repair makes them anew",
                file="meta/stats.json",
                key=key,
            )


def _check_leftovers(folder: DatasetFolder, report: ValidationReport) -> None:
    """Data files that no episode is in."""
    known = set(folder.files())
    files = sorted((folder.root / "data").glob("*/*"))[:_MOST_LISTED]
    for path in files:
        name = str(path.relative_to(folder.root))
        if name not in known:
            report.warning("belongs to no episode", file=name)


_MOST_LISTED = 100_000


_SAYS_NOTHING = frozenset(
    [
        "test",
        "testing",
        "asdf",
        "todo",
        "tbd",
        "n/a",
        "na",
        "none",
        "null",
        "xxx",
        "foo",
        "task",
        "demo",
        "placeholder",
        "untitled",
    ]
)
"""Texts that were typed to get past the question."""


def _check_tasks(folder: DatasetFolder, report: ValidationReport) -> None:
    texts = list(folder.tasks.values())
    empty = [index for index, text in folder.tasks.items() if not text.strip()]
    if empty:
        report.warning(f"task {empty[0]} has no text", file="meta/tasks")
    for index, text in folder.tasks.items():
        if text.strip().lower() in _SAYS_NOTHING:
            report.warning(
                f"task {index}, {text!r}, does not say what is shown: policies are told by it",
                file="meta/tasks",
            )
    if len({*texts}) < len(texts):
        report.warning("a task is listed twice", file="meta/tasks")
    for name, counted in (("total_tasks", len(texts)),):
        if folder.info.get(name, counted) != counted:
            report.warning(
                f"says {folder.info[name]!r}, but {counted} are listed",
                file=INFO_PATH,
                key=name,
            )
    for entry in folder.episodes:
        unknown = [task for task in entry.tasks if task not in texts]
        if unknown:
            report.warning(f"task {unknown[0]!r} is not in the list of tasks", **entry.location)


def _check_names(folder: DatasetFolder, report: ValidationReport) -> None:
    for key, feature in folder.features.items():
        names = feature.names or ()
        if len({*names}) < len(names):
            report.warning("two components have the same name", file=INFO_PATH, key=key)
        if any(plain_text(name) != name for name in (key, *names)):
            report.warning("a name holds unprintable characters", file=INFO_PATH, key=key)


def _check_order(folder: DatasetFolder, report: ValidationReport) -> None:
    """Episodes that share rows of a file."""
    for entries in folder.files().values():
        ordered = sorted(entries, key=lambda entry: entry.start)
        for before, entry in pairwise(ordered):
            if entry.start != before.start + before.length:
                report.error(
                    f"begins at row {entry.start}, but episode {before.index} ends at "
                    f"{before.start + before.length}: offsets and lengths contradict",
                    **entry.location,
                )
