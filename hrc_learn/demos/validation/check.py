"""Examining a dataset before anything is learned from it."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from hrc_learn.demos.demonstration import JOINT_FIELDS
from hrc_learn.demos.format.dataset_folder import DatasetFolder, EpisodeEntry
from hrc_learn.demos.format.metadata import SIDECAR_PATH, read_sidecar
from hrc_learn.demos.issue import DatasetError, ValidationReport
from hrc_learn.demos.read.column_mapping import ColumnMapping, MappingSpec, parse_mapping
from hrc_learn.demos.read.contract import (
    Contract,
    changed_since,
    contract_of,
    infer_contract,
)
from hrc_learn.demos.read.episodes import (
    Quantities,
    declared_units,
    read_mapping,
    select_quantities,
    units_on_disk,
)
from hrc_learn.demos.read.frames import RawFrames, recorded_stamps
from hrc_learn.demos.read.profiles import EpisodeProfile, profile_columns, track_quantities
from hrc_learn.demos.read.reader import to_quaternion
from hrc_learn.demos.read.roles import ORIENTATION_ROLES, UnitDecision, unit_factor
from hrc_learn.demos.validation.consistency_checks import check_consistency
from hrc_learn.demos.validation.data_checks import (
    ColumnSummary,
    Duplicates,
    check_columns,
    check_commands,
    check_finite,
    check_frozen,
    check_jumps,
    check_length,
    check_motion,
    check_repeats,
    check_spikes,
    check_stillness,
    check_timestamps,
)
from hrc_learn.demos.validation.structure_checks import (
    attempt,
    check_files,
    check_indices,
    check_metadata,
    check_statistics,
)
from hrc_learn.demos.validation.video_checks import check_videos


@dataclass(frozen=True, kw_only=True)
class _SoundEpisode:
    """One episode whose values are all finite, in our units."""

    entry: EpisodeEntry
    time: Float64[np.ndarray, " frames"]
    """True stamps where there are any, LeRobot's otherwise [s]."""
    quantities: Quantities


_KEPT_BYTES = 2**24
"""Frames that are kept for the second look; of larger datasets they are read twice."""


def check_dataset(
    path: str | Path,
    mapping: MappingSpec | None = None,
    units: Mapping[str, str] | None = None,
    speed_limits: Mapping[str, float | int] | None = None,
) -> ValidationReport:
    """Examine a LeRobot dataset of version 2.0, 2.1 or 3.0.

    Whatever can be read is looked at, whatever else is broken, an episode at a time.

    Args:
        path: The dataset's folder.
        mapping: Where quantities are that are not found by name, as in `load_demos`.
        units: Units on disk by role, as in `load_demos`.
        speed_limits: Fastest each joint can turn [rad/s], by name; 12 rad/s where not given.

    Raises:
        DatasetError: `mapping` or `units` name what does not exist.
        ValueError: `speed_limits` name no joint, or one is no positive number.
    """
    for role, unit in (units or {}).items():
        unit_factor(role, unit)
    report = ValidationReport(path=Path(path))
    folder = check_metadata(report.path, report)
    if folder is None:
        return report
    parse_mapping(mapping or {}, folder.features)
    if speed_limits:
        _refuse_limits(folder, mapping or {}, speed_limits)
    survey = _Survey(folder, report)
    episodes = survey.first_look()
    check_columns(folder, survey.columns, report)
    check_statistics(folder, survey.columns, report)
    attempt(report, lambda: check_videos(folder, report))
    attempt(
        report,
        lambda: _check_meaning(
            survey, episodes, mapping or {}, units or {}, speed_limits or {}
        ),
    )
    return report


def _refuse_limits(
    folder: DatasetFolder, mapping: MappingSpec, speed_limits: Mapping[str, float | int]
) -> None:
    """Raise ValueError where a limit is of no joint, or none that a speed can keep to."""
    try:
        names = read_mapping(folder, read_sidecar(folder.root), mapping).joint_names
    except DatasetError:
        return  # told where the columns are looked at
    for name, limit in speed_limits.items():
        if name not in names:
            raise ValueError(
                f"speed_limits: {folder.root} has no joint {name!r}; there are "
                f"{', '.join(names) or 'none'}"
            )
        if not limit > 0:
            raise ValueError(f"speed_limits: that of {name} must be positive, but is {limit}")


class _Survey:
    """The episodes of a dataset that can be read, first for themselves, then for their meaning.

    Attributes:
        columns: What the values of each feature reach over all episodes.
    """

    def __init__(self, folder: DatasetFolder, report: ValidationReport):
        self.folder = folder
        self.report = report
        self.columns: dict[str, ColumnSummary] = {}
        self._kept: list[tuple[EpisodeEntry, RawFrames]] = []
        self._whole = True

    def first_look(self) -> list[EpisodeEntry]:
        """Everything that needs no understanding of columns; the episodes that were read."""
        folder, report, size, read = self.folder, self.report, 0, []
        for entry, frames in check_files(folder, report):
            check_indices(folder, entry, frames, report)
            check_finite(folder.features, entry, frames, report)
            check_repeats(entry, frames, report)
            check_length(entry, folder.fps, report)
            if "timestamp" in frames:
                stamps = frames["timestamp"][:, 0].astype(float)
                check_timestamps(entry, "timestamp", stamps, folder.fps, report)
            for key, values in frames.items():
                self.columns.setdefault(key, ColumnSummary()).add(values)
            read.append(entry)
            report.frames += entry.length
            size += sum(values.nbytes for values in frames.values())
            if size < _KEPT_BYTES:
                # Views into a file's columns would keep them all.
                kept = {key: values.copy() for key, values in frames.items()}
                self._kept.append((entry, kept))
            else:
                self._whole, self._kept = False, []
        report.episodes = len(read)
        return read

    def again(self) -> Iterator[tuple[EpisodeEntry, RawFrames]]:
        """The same episodes once more; nothing is reported twice."""
        if self._whole:
            yield from self._kept
        else:
            yield from check_files(self.folder, ValidationReport(path=self.report.path))


def _check_meaning(
    survey: _Survey,
    episodes: Sequence[EpisodeEntry],
    mapping: MappingSpec,
    units: Mapping[str, str],
    speed_limits: Mapping[str, float | int],
) -> None:
    """Find the quantities and their units, and look at every motion and between them.

    Raises:
        DatasetError: The mapping, the units or the sidecar are wrong.
    """
    folder, report = survey.folder, survey.report
    sidecar = read_sidecar(folder.root)
    columns = read_mapping(folder, sidecar, mapping)
    contract = contract_of(sidecar)
    if (changed := changed_since(folder, contract)) is not None:
        report.warning(changed, file=SIDECAR_PATH)
    profiles: dict[int, EpisodeProfile] = {}

    def quantities() -> Iterator[tuple[EpisodeEntry, Quantities]]:
        for entry, frames in survey.again():
            profile = EpisodeProfile(
                index=entry.index, length=entry.length, columns=profile_columns(frames)
            )
            profiles[entry.index] = profile
            if _sound(frames, columns):
                found = select_quantities(frames, columns.selections)
                profile.tracking.update(track_quantities(found, folder.fps))
                yield entry, found

    declared = declared_units(sidecar, columns.selections)
    decisions, faults = units_on_disk(
        columns.selections, quantities(), folder.fps, declared, units
    )
    for fault in faults:
        report.add(fault)
    _report_guesses(columns, decisions if profiles else {}, report)
    _check_joint_sets(columns, report)
    sketches = Duplicates()
    bad = {fault.episode for fault in faults}
    usual = _usual_motion(columns, decisions, profiles)
    for entry, frames in survey.again():
        if not _sound(frames, columns):
            continue
        raw = select_quantities(frames, columns.selections)
        scaled = {role: v * decisions[role].factor for role, v in raw.items()}
        _check_orientation(entry, raw, scaled, report)
        time = scaled["time"][:, 0] if "time" in scaled else recorded_stamps(folder, frames)
        episode = _SoundEpisode(entry=entry, time=time, quantities=scaled)
        if entry.index not in bad:
            _check_episode(folder, episode, columns, speed_limits, usual, report)
        if (motion := _motion(episode)) is not None:
            sketches.add(entry, motion)
    sketches.report(report)
    check_consistency(folder, columns, profiles, report)
    report.contract = infer_contract(folder, columns, decisions, [*profiles.values()])
    if contract is not None:
        overruled = {*mapping, *units}
        if {*mapping} & {*ORIENTATION_ROLES}:  # one encoding takes the place of all
            overruled |= {*ORIENTATION_ROLES}
        report.contract = _renewed(contract, report.contract, folder, columns, overruled)


def _renewed(
    kept: Contract,
    inferred: Contract,
    folder: DatasetFolder,
    columns: ColumnMapping,
    overruled: Collection[str],
) -> Contract:
    """What was inferred anew, with the names, roles and units that the kept contract says.

    Args:
        kept: Beside the data, perhaps edited there.
        inferred: From the data as they are.
        folder: The dataset.
        columns: As they are read now.
        overruled: Quantities of which the caller says columns or units.
    """
    told = {(part.key, part.index): part for part in kept.components}
    quantities: dict[tuple[str, int], set[str]] = {}
    for selections in (kept.selections(folder.features), columns.selections):
        for role, selection in selections.items():
            for column in selection.columns:
                quantities.setdefault(column, set()).add(role)
    parts = []
    for part in inferred.components:
        column = (part.key, part.index)
        old = told.get(column)
        if old is not None:
            anew = (part.role, part.unit) == (old.role, old.unit)
            if anew or quantities.get(column, set()) & {*overruled}:
                part = replace(part, name=old.name)
            else:
                part = replace(old, low=part.low, high=part.high)
        parts.append(part)
    return replace(inferred, components=tuple(parts))


def _usual_motion(
    columns: ColumnMapping,
    decisions: Mapping[str, UnitDecision],
    profiles: Mapping[int, EpisodeProfile],
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Usual step and span of joints and commands, in our units, by quantity."""
    usual = {}
    for role in ("joint_position", "command_position"):
        if role not in columns.selections:
            continue
        places = columns.selections[role].columns
        known = [
            p
            for p in profiles.values()
            if all(k in p.columns and i < len(p.columns[k].start) for k, i in places)
        ]
        if known:
            usual[role] = tuple(
                np.median(
                    [[getattr(p.columns[k], name)[i] for k, i in places] for p in known], axis=0
                )
                * decisions[role].factor
                for name in ("step", "span")
            )
    return usual


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
            report.warning(
                f"{message}: leader and follower? Left among the extra columns; --mapping "
                f"{role} KEY pairs them in their order",
                key=role,
            )
        else:
            report.warning(
                f"{message}: they cannot be matched; left among the extra columns. Name them "
                f"alike, or map one of them (--mapping {role} KEY[0:7])",
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
    usual: Mapping[str, tuple[np.ndarray, np.ndarray]],
    report: ValidationReport,
) -> None:
    entry, time, quantities = episode.entry, episode.time, episode.quantities
    if "time" in quantities:
        check_timestamps(entry, "time", time, folder.fps, report)
    if (np.diff(time) <= 0).any():
        return  # reported as an error; speeds make no sense
    moving = _motion(episode)
    if moving is not None:
        check_motion(entry, moving, report)
        check_stillness(entry, time, moving, report)
    for role in usual:
        names = column_mapping.joint_names
        check_spikes(entry, role, quantities[role], names, *usual[role], report)
    joints = quantities.get("joint_position")
    if joints is None:
        return
    check_jumps(entry, time, joints, column_mapping.joint_names, speed_limits, report)
    if "command_position" in quantities:
        check_commands(entry, joints, quantities["command_position"], report)
        if "joint_position" in usual:
            span = usual["joint_position"][1]
            names = column_mapping.joint_names
            check_frozen(entry, joints, quantities["command_position"], names, span, report)


def _motion(episode: _SoundEpisode) -> np.ndarray | None:
    """What moves: the joints, or the position where no joints are known."""
    return episode.quantities.get("joint_position", episode.quantities.get("position"))
