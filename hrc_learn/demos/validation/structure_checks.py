"""Faults of the metadata and the files: what is missing, and what contradicts what."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from hrc_learn.demos.format.dataset_folder import (
    DatasetFolder,
    EpisodeEntry,
    open_parquet,
    read_episodes,
    read_info,
    read_table,
    read_tasks,
)
from hrc_learn.demos.format.metadata import Feature, read_features
from hrc_learn.demos.issue import DatasetError, ValidationReport
from hrc_learn.demos.read.episodes import count_faults
from hrc_learn.demos.read.frames import (
    BadRowError,
    RawFrames,
    require_rows,
    slice_frames,
    to_numpy,
)
from hrc_learn.demos.read.roles import INDEX_KEYS


def check_metadata(root: Path, report: ValidationReport) -> DatasetFolder | None:
    """Read as much of the metadata as can be read; None where nothing can be made of it."""
    info = _attempt(report, lambda: read_info(root))
    if info is None:
        return None
    features: dict[str, Feature] = {}
    for key, declared in info["features"].items():
        single = {"features": {key: declared}}
        features |= _attempt(report, lambda single=single: read_features(single)) or {}
    tasks = _attempt(report, lambda: read_tasks(root, info)) or {}
    episodes = _attempt(report, lambda: read_episodes(root, info))
    if episodes is None:
        return None
    folder = DatasetFolder(
        root=root,
        version=info["codebase_version"],
        fps=float(info["fps"]),
        robot_type=info.get("robot_type"),
        features=features,
        episodes=tuple(episodes),
        tasks=tasks,
        info=info,
    )
    for fault in count_faults(folder):
        report.add(fault)
    statistics = ("meta/stats.json", "meta/episodes_stats.jsonl")
    if not any((root / file).is_file() for file in statistics):
        report.warning(
            "no statistics: LeRobot's policies cannot normalise their inputs",
            file=statistics[0],
        )
    _check_videos(folder, report)
    return folder


def check_file(
    folder: DatasetFolder, file: str, entries: list[EpisodeEntry], report: ValidationReport
) -> list[tuple[EpisodeEntry, RawFrames]]:
    """Read one data file as far as it goes; its episodes with the columns that are sound."""
    try:
        parquet = open_parquet(folder.root, file, entries[0].index)
        table = read_table(parquet, file)
    except DatasetError as error:
        report.add(error)
        return []
    columns = _sound_columns(folder, file, table, entries, report)
    rows = table.num_rows
    promised = max(entry.start + entry.length for entry in entries)
    _attempt(report, lambda: require_rows(file, entries, rows, promised))
    return [
        (entry, slice_frames(columns, entry.start, entry.length))
        for entry in entries
        if entry.start + entry.length <= rows
    ]


def check_indices(
    folder: DatasetFolder, entry: EpisodeEntry, frames: RawFrames, report: ValidationReport
) -> None:
    """The columns by which LeRobot counts: contiguous, and of this episode."""
    count = np.arange(entry.length)
    expected = {"frame_index": count, "episode_index": np.full(entry.length, entry.index)}
    if "index" in frames:
        expected["index"] = frames["index"][0, 0] + count
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


def _attempt[T](report: ValidationReport, read: Callable[[], T]) -> T | None:
    try:
        return read()
    except DatasetError as error:
        report.add(error)
        return None


def _sound_columns(
    folder: DatasetFolder,
    file: str,
    table,
    entries: list[EpisodeEntry],
    report: ValidationReport,
) -> RawFrames:
    columns = {}
    for key, feature in folder.features.items():
        if not feature.numeric:
            continue
        if key not in table.column_names:
            _report_missing(file, key, report)
            continue
        try:
            values = to_numpy(table.column(key))
        except BadRowError as error:
            owner = next((e for e in entries if 0 <= error.row - e.start < e.length), None)
            report.error(
                str(error),
                file=file,
                episode=owner.index if owner else None,
                frame=error.row - owner.start if owner else error.row,
                key=key,
            )
            continue
        if len(values) and values.shape[1] != feature.width:
            report.error(
                f"has {values.shape[1]} components, but meta/info.json declares the shape "
                f"{list(feature.shape)}",
                file=file,
                key=key,
            )
        columns[key] = values
    for key in INDEX_KEYS:
        if key not in folder.features and key not in table.column_names:
            _report_missing(file, key, report)
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


def _check_videos(folder: DatasetFolder, report: ValidationReport) -> None:
    for key, feature in folder.features.items():
        if feature.dtype != "video":
            continue
        found = [p for p in (folder.root / "videos").glob("**/*.mp4") if key in p.parts]
        if not found:
            report.warning(
                "the video is declared, but no file of it is here; joints and poses can be "
                "read, LeRobot itself needs it",
                file=f"videos/**/{key}",
                key=key,
            )
