"""Examining a dataset before anything is learned from it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from hrc_learn.demos.demonstration import JOINT_FIELDS
from hrc_learn.demos.format.dataset_folder import DatasetFolder, EpisodeEntry
from hrc_learn.demos.format.metadata import read_sidecar
from hrc_learn.demos.issue import DatasetError, ValidationReport
from hrc_learn.demos.read.column_mapping import (
    ColumnMapping,
    MappingSpec,
    map_columns,
    parse_mapping,
)
from hrc_learn.demos.read.episodes import Quantities, select_quantities, units_on_disk
from hrc_learn.demos.read.frames import RawFrames, recorded_stamps
from hrc_learn.demos.read.reader import to_quaternion
from hrc_learn.demos.read.roles import (
    ORIENTATION_ROLES,
    UnitDecision,
    unit_factor,
)
from hrc_learn.demos.validation.data_checks import (
    check_columns,
    check_commands,
    check_duplicates,
    check_finite,
    check_jumps,
    check_length,
    check_repeats,
    check_stillness,
    check_timestamps,
)
from hrc_learn.demos.validation.structure_checks import (
    check_file,
    check_indices,
    check_metadata,
)


@dataclass(frozen=True, kw_only=True)
class _SoundEpisode:
    """One episode whose values are all finite, in our units."""

    entry: EpisodeEntry
    time: Float64[np.ndarray, " frames"]
    """True stamps where there are any, LeRobot's otherwise [s]."""
    quantities: Quantities


def check_dataset(
    path: str | Path,
    mapping: MappingSpec | None = None,
    units: Mapping[str, str] | None = None,
    speed_limits: Mapping[str, float | int] | None = None,
) -> ValidationReport:
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
    report = ValidationReport(path=Path(path))
    folder = check_metadata(report.path, report)
    if folder is None:
        return report
    parse_mapping(mapping or {}, folder.features)
    episodes = _check_frames(folder, report)
    report.episodes = len(episodes)
    report.frames = sum(entry.length for entry, _ in episodes)
    check_columns(folder, episodes, report)
    try:
        column_mapping, semantics = _resolve_semantics(
            folder, episodes, mapping or {}, units or {}, report
        )
    except DatasetError as error:
        report.add(error)
        return report
    _check_joint_sets(column_mapping, report)
    for episode in semantics:
        _check_episode(folder, episode, column_mapping, speed_limits or {}, report)
    moving = [(episode.entry, _motion(episode)) for episode in semantics]
    check_duplicates([(e, m) for e, m in moving if m is not None], report)
    return report


def _check_frames(
    folder: DatasetFolder, report: ValidationReport
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
                check_timestamps(entry, "timestamp", stamps, folder.fps, report)
            sound.append((entry, frames))
    return sound


def _resolve_semantics(
    folder: DatasetFolder,
    episodes: Sequence[tuple[EpisodeEntry, RawFrames]],
    mapping: MappingSpec,
    units: Mapping[str, str],
    report: ValidationReport,
) -> tuple[ColumnMapping, list[_SoundEpisode]]:
    """Find the quantities, decide on their units, and convert what is sound.

    Raises:
        DatasetError: The mapping, the units or the sidecar are wrong.
    """
    sidecar = read_sidecar(folder.root)
    column_mapping = map_columns(folder.features, sidecar, mapping)
    raw = [
        (entry, frames, select_quantities(frames, column_mapping.selections))
        for entry, frames in episodes
        if _sound(frames, column_mapping)
    ]
    decisions = {}
    if raw:
        recorded = (quantities for _, _, quantities in raw)
        declared = sidecar.units
        decisions = units_on_disk(
            column_mapping.selections, recorded, folder.fps, declared, units
        )
    _report_guesses(column_mapping, decisions, report)
    semantics = []
    for entry, frames, quantities in raw:
        scaled = {role: v * decisions[role].factor for role, v in quantities.items()}
        _check_orientation(entry, quantities, scaled, report)
        time = scaled["time"][:, 0] if "time" in scaled else recorded_stamps(folder, frames)
        semantics.append(_SoundEpisode(entry=entry, time=time, quantities=scaled))
    return column_mapping, semantics


def _sound(frames: RawFrames, column_mapping: ColumnMapping) -> bool:
    columns = [column for s in column_mapping.selections.values() for column in s.columns]
    return all(
        key in frames
        and len(frames[key]) > 1
        and index < frames[key].shape[1]
        and np.isfinite(frames[key][:, index].astype(float)).all()
        for key, index in columns
    )


def _report_guesses(
    column_mapping: ColumnMapping,
    decisions: Mapping[str, UnitDecision],
    report: ValidationReport,
) -> None:
    unmatched = tuple(f"{role} is of other joints" for role in column_mapping.unmatched)
    for note in column_mapping.notes:
        if not note.startswith(unmatched):
            report.warning(note)
    for decision in decisions.values():
        if decision.note:
            report.warning(decision.note)


def _check_orientation(
    entry: EpisodeEntry, quantities: Quantities, scaled: Quantities, report: ValidationReport
) -> None:
    role = next((role for role in ORIENTATION_ROLES if role in quantities), None)
    if role is None:
        return
    values = quantities[role] if role == "pose_matrix" else scaled[role]
    try:
        to_quaternion(role, values)
    except ValueError as error:
        report.add(DatasetError(str(error), **entry.location, key=role))
        return
    if role.startswith("quaternion"):
        flips = np.flatnonzero((values[1:] * values[:-1]).sum(1) < 0)
        if len(flips):
            report.warning(
                f"the quaternion changes its sign {len(flips)} times without turning; "
                f"load_demos makes it continuous, hrc repair does so on disk",
                **entry.location,
                frame=int(flips[0]) + 1,
                key=role,
            )


def _check_joint_sets(column_mapping: ColumnMapping, report: ValidationReport) -> None:
    """Quantities that go by joints should be of the same ones."""
    for role, others in column_mapping.unmatched.items():
        message = (
            f"{role} is of the joints {', '.join(others)}, the rest of "
            f"{', '.join(column_mapping.joint_names)}"
        )
        if set(others) < set(column_mapping.joint_names):
            report.warning(f"{message}: it is left among the extra columns", key=role)
        elif len(others) == len(column_mapping.joint_names):
            report.warning(f"{message}: leader and follower? They are not compared", key=role)
        else:
            report.error(
                f"{message}: they cannot be matched; name them alike, or map one of them "
                f"(mapping={{{role!r}: [...]}}) or leave it out ({{{role!r}: None}})",
                key=role,
            )
    if not any(role in column_mapping.selections for role in (*JOINT_FIELDS, "position")):
        report.error(
            "no joints and no poses found among the columns: name them (mapping={...})"
        )


def _check_episode(
    folder: DatasetFolder,
    episode: _SoundEpisode,
    column_mapping: ColumnMapping,
    speed_limits: Mapping[str, float | int],
    report: ValidationReport,
) -> None:
    entry, time, quantities = episode.entry, episode.time, episode.quantities
    if "time" in quantities:
        check_timestamps(entry, "time", time, folder.fps, report)
    if (np.diff(time) <= 0).any():
        return  # reported as an error; speeds make no sense
    moving = _motion(episode)
    if moving is not None:
        check_stillness(entry, time, moving, report)
    joints = quantities.get("joint_position")
    if joints is None:
        return
    check_jumps(entry, time, joints, column_mapping.joint_names, speed_limits, report)
    if "command_position" in quantities:
        check_commands(entry, joints, quantities["command_position"], report)


def _motion(episode: _SoundEpisode) -> np.ndarray | None:
    """What moves: the joints, or the position where no joints are known."""
    return episode.quantities.get("joint_position", episode.quantities.get("position"))
