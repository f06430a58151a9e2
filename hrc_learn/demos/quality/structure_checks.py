"""Checks of metadata and files: missing parts and contradictions.

`read_metadata` and `read_sound_episodes` read as much of a broken dataset as possible and
report its faults. The other functions are checks, which `check_dataset` calls.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from hrc_learn.demos.issues import DatasetError, Issue, ValidationReport, plain_text, warning
from hrc_learn.demos.read.dataset_files import INFO_PATH, open_parquet, read_json
from hrc_learn.demos.read.dataset_folder import (
    DatasetFolder,
    EpisodeEntry,
    count_faults,
    read_episodes,
    read_info,
    read_tasks,
)
from hrc_learn.demos.read.frames import RawFrames, read_each, require_rows
from hrc_learn.demos.read.metadata import SIDECAR_PATH, flatten_names, read_feature
from hrc_learn.demos.read.profiles import FeatureProfiles
from hrc_learn.demos.read.quantities import INDEX_KEYS
from hrc_learn.store import MANIFEST, changed_files

_MOST_LISTED = 100_000
_STATISTICS = "meta/stats.json"
_PLACEHOLDERS = (
    *("test", "testing", "asdf", "todo", "tbd", "n/a", "na", "none", "null", "xxx", "foo"),
    *("task", "demo", "placeholder", "untitled"),
)
"""Task texts that were typed only to skip the recorder's question for the task."""


def read_metadata(root: Path, report: ValidationReport) -> DatasetFolder | None:
    """Read as much of the metadata as possible; None if episodes cannot be located."""
    info = report.attempt(lambda: read_info(root))
    episodes = None if info is None else report.attempt(lambda: read_episodes(root, info))
    if info is None or episodes is None:
        return None
    features = {}
    for key, declared in info["features"].items():
        feature = report.attempt(lambda key=key, declared=declared: read_feature(key, declared))
        features |= {} if feature is None else {key: feature}
    tasks = report.attempt(lambda: read_tasks(root, info)) or {}
    folder = DatasetFolder(
        root=root, info=info, features=features, episodes=episodes, tasks=tasks
    )
    for fault in count_faults(folder):
        report.add_error(fault)
    return folder


def read_sound_episodes(
    folder: DatasetFolder, report: ValidationReport
) -> Iterator[tuple[EpisodeEntry, RawFrames]]:
    """Episodes that can be read, with their numeric columns; faults go into the report."""
    for file, entries in folder.files.items():
        found = report.attempt(partial(_sound_keys, folder, file, entries, report))
        if not found:
            continue
        keys, rows = found
        listed = [e for e in entries if e.length > 0 and e.start + e.length <= rows]
        read = read_each(folder, listed, keys, strict=False) if keys else ()
        for entry, frames in zip(listed, read, strict=False):
            if isinstance(frames, DatasetError):
                report.add_error(frames)
            else:
                yield entry, frames


def _sound_keys(
    folder: DatasetFolder, file: str, entries: list[EpisodeEntry], report: ValidationReport
) -> tuple[list[str], int]:
    """Numeric columns that a file holds exactly once, and its number of rows."""
    parquet = open_parquet(folder.root, file, entries[0].index)
    rows, schema = parquet.metadata.num_rows, parquet.schema_arrow
    report.attempt(lambda: require_rows(folder, file, rows))
    report.run(_column_faults, folder, file, schema, report)
    numeric = [key for key, feature in folder.features.items() if feature.numeric]
    counts = Counter(schema.names)
    return [key for key in numeric if counts[key] == 1], rows


def _column_faults(
    folder: DatasetFolder, file: str, schema: pa.Schema, report: ValidationReport
) -> Iterator[Issue]:
    """Report columns of a file that are missing, repeated or of another type than declared."""
    counts = Counter(schema.names)  # Arrow makes a new list at each access
    missing = [key for key in INDEX_KEYS if key not in folder.features and not counts[key]]
    for key, feature in folder.features.items():
        count = counts[key]
        if feature.dtype == "video":
            continue
        if count > 1:
            yield Issue(message="the column is there more than once", file=file, key=key)
        elif count == 0:
            missing.append(key)
        elif feature.numeric:
            kind = _number_type(schema.field(key).type)
            if kind not in (None, feature.dtype):
                text = f"holds {kind}, but meta/info.json declares {feature.dtype}"
                yield warning(message=text, file=file, key=key)
    for key in missing:
        if key not in INDEX_KEYS:
            text = "the column is declared in meta/info.json, but missing"
            yield Issue(message=text, file=file, key=key)
        # All files come from the same recorder: report the first one only.
        elif not any(issue.key == key for issue in report.warnings):
            text = "the column is missing: LeRobot cannot open this file, hrc repair adds it"
            yield warning(message=text, file=file, key=key)


def _number_type(kind: pa.DataType) -> str | None:
    """LeRobot's name of the type of the numbers in a column; None for unknown nesting."""
    while pa.types.is_nested(kind) and not (pa.types.is_struct(kind) or pa.types.is_map(kind)):
        if not hasattr(kind, "value_type"):
            return None
        kind = kind.value_type
    names = {"double": "float64", "float": "float32", "halffloat": "float16"}
    return names.get(str(kind), str(kind))


def indices(folder: DatasetFolder, entry: EpisodeEntry, frames: RawFrames) -> Iterator[Issue]:
    """Check that LeRobot's index columns count up, name this episode, and name listed tasks."""
    count = np.arange(entry.length)
    expected = {"frame_index": count, "episode_index": np.full(entry.length, entry.index)}
    expected["index"] = folder.first_index[entry.index] + count
    for key, values in expected.items():
        wrong = np.flatnonzero(frames[key][:, 0] != values) if key in frames else []
        if len(wrong):
            k = int(wrong[0])
            text = f"is {frames[key][k, 0]:g}, expected {values[k]:g}"
            yield entry.fault(f"{text}; frames were lost, repeated or moved", frame=k, key=key)
    if "task_index" in frames and folder.tasks:
        tasks = frames["task_index"][:, 0].tolist()
        if unknown := {*tasks} - folder.tasks.keys():
            k = next(k for k, task in enumerate(tasks) if task in unknown)
            text = f"task {frames['task_index'][k, 0]:g} is not in the list of tasks"
            yield entry.fault(text, frame=k, key="task_index")


def statistics_exist(folder: DatasetFolder) -> Iterator[Issue]:
    """Check that a file of statistics exists: policies normalise their inputs with it."""
    files = (_STATISTICS, "meta/episodes_stats.jsonl")
    if not any((folder.root / file).is_file() for file in files):
        text = "no statistics: LeRobot's policies cannot normalise their inputs"
        yield warning(message=text, file=_STATISTICS)


def statistics_fit(
    folder: DatasetFolder, features: Sequence[FeatureProfiles]
) -> Iterator[Issue]:
    """Check that the statistics agree with the data."""
    exists = (folder.root / _STATISTICS).exists()
    recorded = read_json(folder.root, _STATISTICS) if exists else {}
    for feature in features:
        stated, width = recorded.get(feature.key), len(feature.names)
        if stated is None:
            continue
        place: dict[str, Any] = {"file": _STATISTICS, "key": feature.key}
        try:
            low, high, mean, std = (
                np.asarray(stated[name], float).reshape(-1)
                for name in ("min", "max", "mean", "std")
            )
        except (KeyError, TypeError, ValueError):
            yield warning(message="statistics are incomplete", **place)
            continue
        if {len(low), len(high), len(mean), len(std)} != {width}:
            text = f"statistics of {len(mean)} components for {width}: LeRobot cannot normalise"
            yield Issue(message=text, **place)
            continue
        least, most = feature.stack("low").min(0), feature.stack("high").max(0)
        span = np.maximum(most - least, 1e-6)
        wrong = ~np.isfinite(low + high + mean + std) | (std < 0) | (low > high)
        # A part of a dataset may keep the statistics of the whole, whose range is wider.
        wrong |= (least < low - 0.02 * span) | (most > high + 0.02 * span)
        wrong |= (mean < low - 0.02 * span) | (mean > high + 0.02 * span)
        # Far wider statistics belong to other data or to another unit.
        wrong |= (high - low) > 20 * span + 1
        if wrong.any():
            text = (
                f"statistics do not fit the data in {wrong.sum()} components: policies would "
                f"normalise wrongly; hrc repair computes them anew"
            )
            yield warning(message=text, **place)


def unchanged_files(folder: DatasetFolder) -> Iterator[Issue]:
    """Check that files are as this package wrote them; the sidecar may be edited."""
    try:
        changed = changed_files(folder.root)
    except ValueError as error:
        yield Issue(message=f"cannot be read ({error})", file=MANIFEST)
        return
    for name in changed:
        # A missing file is reported as such by the check of its content.
        if name != SIDECAR_PATH and (folder.root / name).is_file():
            text = (
                f"is not as it was written: its checksum differs. Copy it again, or delete "
                f"{MANIFEST} if it was changed on purpose"
            )
            yield Issue(message=text, file=name)


def unlisted_files(folder: DatasetFolder) -> Iterator[Issue]:
    """Report data files without an episode."""
    for path in sorted((folder.root / "data").glob("*/*"))[:_MOST_LISTED]:
        name = str(path.relative_to(folder.root))
        if name not in folder.files:
            yield warning(message="belongs to no episode", file=name)


def task_texts(folder: DatasetFolder) -> Iterator[Issue]:
    """Check that tasks have texts and are listed once, and that episodes name listed tasks."""
    texts, file = list(folder.tasks.values()), "meta/tasks"
    for index, task in folder.tasks.items():
        if not task.strip():
            yield warning(message=f"task {index} has no text", file=file)
        elif task.strip().lower() in _PLACEHOLDERS:
            text = f"task {index}, {task!r}, does not say what is shown: policies depend on it"
            yield warning(message=text, file=file)
    if len({*texts}) < len(texts):
        yield warning(message="a task is listed twice", file=file)
    said = folder.info.get("total_tasks", len(texts))
    if said != len(texts):
        text = f"says {said!r}, but {len(texts)} are listed"
        yield warning(message=text, file=INFO_PATH, key="total_tasks")
    for entry in folder.episodes:
        unknown = [task for task in entry.tasks if task not in texts]
        if unknown:
            yield entry.warning(f"task {unknown[0]!r} is not in the list of tasks")


def component_names(folder: DatasetFolder) -> Iterator[Issue]:
    """Check that component names fit the shape, are distinct and are printable."""
    for key, feature in folder.features.items():
        names = feature.names or ()
        declared = flatten_names(folder.info["features"][key].get("names")) or ()
        if feature.numeric and 1 < len(declared) != feature.width:
            text = f"{len(declared)} names for {feature.width} components: they are not used"
            yield warning(message=f"{text}; correct names or shape", file=INFO_PATH, key=key)
        if len({*names}) < len(names):
            yield warning(message="two components have the same name", file=INFO_PATH, key=key)
        if any(plain_text(name) != name for name in (key, *names)):
            text = "a name holds unprintable characters"
            yield warning(message=text, file=INFO_PATH, key=key)


def offsets(folder: DatasetFolder) -> Iterator[Issue]:
    """Check that the episodes of a file neither overlap nor leave gaps."""
    for entries in folder.files.values():
        ordered = sorted(entries, key=lambda entry: entry.start)
        for before, entry in pairwise(ordered):
            end = before.start + before.length
            if entry.start != end:
                text = f"begins at row {entry.start}, but episode {before.index} ends at {end}"
                yield entry.fault(f"{text}: offsets and lengths do not agree")
