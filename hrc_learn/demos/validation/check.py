"""Examining a dataset before anything is learned from it."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hrc_learn.demos.format.dataset_folder import DatasetFolder, EpisodeEntry
from hrc_learn.demos.issue import DatasetError, Report
from hrc_learn.demos.read.column_mapping import MappingSpec, Matching, parse_mapping
from hrc_learn.demos.read.frames import RawFrames
from hrc_learn.demos.read.value_encodings import unit_factor
from hrc_learn.demos.validation.data_checks import (
    check_columns,
    check_commands,
    check_duplicates,
    check_finite,
    check_jumps,
    check_length,
    check_repeats,
    check_stamps,
    check_stillness,
)
from hrc_learn.demos.validation.semantic_checks import Understood, check_joint_sets, understand
from hrc_learn.demos.validation.structure_checks import (
    check_file,
    check_indices,
    check_metadata,
)


def check_dataset(
    path: str | Path,
    mapping: MappingSpec | None = None,
    units: Mapping[str, str] | None = None,
    speed_limits: Mapping[str, float | int] | None = None,
) -> Report:
    """Examine a LeRobot dataset of version 2.0, 2.1 or 3.0.

    Whatever can be read is looked at, whatever else is broken.

    Args:
        path: The dataset's folder.
        mapping: Where quantities are that are not found by name, as in `load_demos`.
        units: Units on disk by role, as in `load_demos`.
        speed_limits: Fastest each joint can turn [rad/s], by name; 12 rad/s where not given.

    Raises:
        DatasetError: `mapping` or `units` name what does not exist.
    """
    for role, unit in (units or {}).items():
        unit_factor(role, unit)
    report = Report(path=Path(path))
    folder = check_metadata(report.path, report)
    if folder is None:
        return report
    parse_mapping(mapping or {}, folder.features)
    episodes = _check_frames(folder, report)
    report.episodes = len(episodes)
    report.frames = sum(entry.length for entry, _ in episodes)
    check_columns(folder, episodes, report)
    try:
        matching, understood = understand(folder, episodes, mapping or {}, units or {}, report)
    except DatasetError as error:
        report.add(error)
        return report
    check_joint_sets(matching, report)
    for episode in understood:
        _check_episode(folder, episode, matching, speed_limits or {}, report)
    moving = [(episode.entry, _motion(episode)) for episode in understood]
    check_duplicates([(e, m) for e, m in moving if m is not None], report)
    return report


def _check_frames(
    folder: DatasetFolder, report: Report
) -> list[tuple[EpisodeEntry, RawFrames]]:
    """Everything that needs no understanding of the columns."""
    sound = []
    for file, entries in folder.files().items():
        for entry, frames in check_file(folder, file, entries, report):
            check_indices(folder, entry, frames, report)
            check_finite(folder.features, entry, frames, report)
            check_repeats(entry, frames, report)
            check_length(entry, folder.fps, report)
            if "timestamp" in frames:
                stamps = frames["timestamp"][:, 0].astype(float)
                check_stamps(entry, "timestamp", stamps, folder.fps, report)
            sound.append((entry, frames))
    return sound


def _check_episode(
    folder: DatasetFolder,
    episode: Understood,
    matching: Matching,
    speed_limits: Mapping[str, float | int],
    report: Report,
) -> None:
    entry, time, quantities = episode.entry, episode.time, episode.quantities
    if "time" in quantities:
        check_stamps(entry, "time", time, folder.fps, report)
    if (np.diff(time) <= 0).any():
        return  # reported as an error; speeds make no sense
    moving = _motion(episode)
    if moving is not None:
        check_stillness(entry, time, moving, report)
    joints = quantities.get("joint_position")
    if joints is None:
        return
    check_jumps(entry, time, joints, matching.joint_names, speed_limits, report)
    if "command_position" in quantities:
        check_commands(entry, joints, quantities["command_position"], report)


def _motion(episode: Understood) -> np.ndarray | None:
    """What moves: the joints, or the position where no joints are known."""
    return episode.quantities.get("joint_position", episode.quantities.get("position"))
