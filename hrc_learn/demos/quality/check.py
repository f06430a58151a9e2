"""Validation of a dataset before anything is learned from it."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hrc_learn.demos.demonstration import JOINT_FIELDS
from hrc_learn.demos.issues import DatasetError, Issue, ValidationReport, warning
from hrc_learn.demos.quality import consistency_checks as consistency
from hrc_learn.demos.quality import episode_checks, structure_checks
from hrc_learn.demos.quality.episode_checks import UsualMotion, motion_sketch
from hrc_learn.demos.quality.structure_checks import read_metadata, read_sound_episodes
from hrc_learn.demos.quality.video_checks import check_videos
from hrc_learn.demos.read.columns import ColumnMapping, MappingSpec, map_columns
from hrc_learn.demos.read.contract import infer_contract
from hrc_learn.demos.read.dataset_folder import EpisodeEntry
from hrc_learn.demos.read.frames import RawFrames, select_quantities
from hrc_learn.demos.read.metadata import SIDECAR_PATH
from hrc_learn.demos.read.profiles import (
    EpisodeProfile,
    FeatureProfiles,
    feature_profiles,
    profile_columns,
    track_quantities,
)
from hrc_learn.demos.read.quantities import ORIENTATION_ROLES
from hrc_learn.demos.read.source import DemonstrationSource, OpenedDataset
from hrc_learn.demos.read.units import Quantities, UnitDecision, require_known
from hrc_learn.kinematics import Arm

METADATA_CHECKS = (
    structure_checks.statistics_exist,
    structure_checks.task_texts,
    structure_checks.component_names,
    structure_checks.offsets,
    structure_checks.unlisted_files,
    structure_checks.unchanged_files,
)
RAW_EPISODE_CHECKS = (
    structure_checks.indices,
    episode_checks.finite_values,
    episode_checks.repetitions,
    episode_checks.episode_length,
    episode_checks.recorded_stamps,
)
MOTION_CHECKS = (
    episode_checks.motion_present,
    episode_checks.rest_at_ends,
    episode_checks.joint_speeds,
    episode_checks.joint_rates,
    episode_checks.copied_commands,
)
_PLACED = 5
"""Largest number of episodes in which joints and positions are compared."""
CONSISTENCY_CHECKS = (
    consistency.holds,
    consistency.noise,
    consistency.switches,
    consistency.exchanged_columns,
)


def check_dataset(
    path: str | Path,
    mapping: MappingSpec | None = None,
    units: Mapping[str, str] | None = None,
    robot: Arm | None = None,
) -> ValidationReport:
    """Validate a LeRobot dataset of version 2.0, 2.1 or 3.0.

    Everything that can be read is examined, one episode at a time, whatever else is broken.

    Args:
        path: Folder of the dataset.
        mapping: Columns of quantities that are not found by name, as in `load_demos`.
        units: Units on disk by role, as in `load_demos`.
        robot: Arm of the dataset. Its forward kinematics are compared with recorded positions.
            None for the arm of the dataset's robot type.

    Raises:
        DatasetError: `mapping` or `units` name an unknown quantity, column or unit.
    """
    require_known(units or {})
    report = ValidationReport(path=Path(path))
    folder = read_metadata(report.path, report)
    if folder is None:
        return report
    for check in METADATA_CHECKS:
        report.run(check, folder)
    # Errors in the mapping are raised. A faulty sidecar is reported, and columns are found by
    # name.
    columns = map_columns(folder.features, mapping)
    dataset = report.attempt(lambda: OpenedDataset.of(folder, mapping))
    dataset = dataset or OpenedDataset(folder=folder, columns=columns)
    dataset = replace(dataset, robot=robot)
    report.attempt(lambda: check_videos(folder, report))
    report.attempt(lambda: _check_content(dataset, report, units or {}))
    return report


def _first_pass(
    dataset: OpenedDataset,
    report: ValidationReport,
    profiles: list[EpisodeProfile],
    sound: list[EpisodeEntry],
) -> Iterator[tuple[EpisodeEntry, Quantities]]:
    """Run the checks that need no units, and yield the quantities of the sound episodes.

    An episode is sound if it has all columns of the quantities and all values are finite.
    Appends the profiles of all episodes to `profiles`, and the sound episodes to `sound`.
    """
    folder, columns = dataset.folder, dataset.columns
    for entry, frames in read_sound_episodes(folder, report):
        for check in RAW_EPISODE_CHECKS:
            report.run(check, folder, entry, frames)
        report.episodes += 1
        report.frames += entry.length
        is_sound = _is_sound(frames, columns)
        found = select_quantities(frames, columns.selections) if is_sound else {}
        profiled, tracking = profile_columns(frames), track_quantities(found, folder.fps)
        profiles.append(EpisodeProfile(entry=entry, columns=profiled, tracking=tracking))
        if is_sound:
            sound.append(entry)
            report.run(episode_checks.quaternion_signs, entry, found)
            yield entry, found


def _check_content(
    dataset: OpenedDataset, report: ValidationReport, units: Mapping[str, str]
) -> None:
    """Decide on the units, check every motion, and compare the episodes.

    Raises:
        DatasetError: A unit is unknown or does not fit its quantity.
    """
    folder, columns = dataset.folder, dataset.columns
    profiles: list[EpisodeProfile] = []
    sound: list[EpisodeEntry] = []
    if dataset.contract_note is not None:
        report.add(warning(message=dataset.contract_note, file=SIDECAR_PATH))
    episodes = _first_pass(dataset, report, profiles, sound)
    decisions, faults = dataset.units_from(episodes, units)
    for fault in faults:
        report.add_error(fault)
    report.run(_meaning, columns, decisions if profiles else {})
    features = [*feature_profiles(folder, profiles)]
    usual = _usual_motion(columns, decisions, {f.key: f for f in features})
    doubtful = {fault.episode for fault in faults}
    _check_motions(dataset, sound, decisions, report, usual, doubtful)
    report.run(consistency.column_ranges, features)
    report.run(structure_checks.statistics_fit, folder, features)
    report.run(consistency.lengths, [profile.entry for profile in profiles])
    commanded = [profile for profile in profiles if "command_position" in profile.tracking]
    if commanded and not decisions["command_position"].steps.any():
        command, state = (columns.selections[f"{who}_position"] for who in ("command", "joint"))
        report.run(consistency.command_tracking, command, commanded)
        unit = decisions["joint_position"]
        report.run(consistency.command_offsets, command, state, commanded, features, unit)
    for feature in features:
        report.run(consistency.sizes, feature)
        for check in CONSISTENCY_CHECKS:
            if len(feature.entries) >= consistency.FEWEST:
                report.run(check, feature)
    report.contract = infer_contract(folder, columns, decisions, features, profiles)
    if dataset.contract is not None:
        report.contract = report.contract.keeping(dataset.contract)


def _check_motions(
    dataset: OpenedDataset,
    entries: Sequence[EpisodeEntry],
    decisions: Mapping[str, UnitDecision],
    report: ValidationReport,
    usual: UsualMotion,
    doubtful: set[int | None],
) -> None:
    """Check the motion of every sound episode whose units are known, in a second pass."""
    sketches, placed = [], []
    # The checks do not need features extracted from videos.
    source = DemonstrationSource(replace(dataset, own_feature=True), entries, decisions)
    for entry, demo in zip(entries, source.each(), strict=True):
        if isinstance(demo, DatasetError):
            # Other faults were reported in the first pass.
            if demo.key in ("time", *ORIENTATION_ROLES):
                report.add_error(demo)
            continue
        if entry.index not in doubtful:
            if "time" in source.columns.selections:
                report.run(episode_checks.stamps, entry, "time", demo.time, source.fps)
            for check in MOTION_CHECKS:
                report.run(check, entry, demo)
            report.run(episode_checks.spikes_and_jumps, entry, demo, usual)
        if demo.joint_position is not None and demo.position is not None:
            placed = [*placed, demo][:_PLACED]
        if (motion := episode_checks.arm_motion(demo)) is not None:
            span = float(np.ptp(motion, axis=0).max())
            sketches.append((entry, motion_sketch(motion), span))
    if placed and source.joint_unit == "rad" and dataset.arm is not None:
        report.run(consistency.joint_zeros, *dataset.arm, placed)
    report.run(episode_checks.duplicates, sketches)


def _usual_motion(
    columns: ColumnMapping,
    decisions: Mapping[str, UnitDecision],
    features: Mapping[str, FeatureProfiles],
) -> UsualMotion:
    """Role -> usual fast step (99 % quantile) and usual range of each joint, in SI units."""
    usual = {}
    for role in ("joint_position", "command_position"):
        selection = columns.selections.get(role)
        if selection is not None and all(key in features for key, _ in selection.columns):
            step, span = (
                np.array([features[k].median(name)[i] for k, i in selection.columns])
                for name in ("step", "span")
            )
            factor = decisions[role].factor
            usual[role] = (step * factor, span * factor)
    return usual


def _is_sound(frames: RawFrames, mapping: ColumnMapping) -> bool:
    """True if all columns of the quantities exist and are finite."""
    columns = [column for s in mapping.selections.values() for column in s.columns]
    return all(
        key in frames and len(frames[key]) > 1 and index < frames[key].shape[1]
        for key, index in columns
    ) and all(np.isfinite(frames[key][:, index].sum(dtype=float)) for key, index in columns)


def _meaning(mapping: ColumnMapping, decisions: Mapping[str, UnitDecision]) -> Iterator[Issue]:
    """Report guesses, quantities whose joints do not match, and missing joints and poses."""
    for note in (*mapping.notes, *(decision.note for decision in decisions.values())):
        if note:
            yield warning(message=note)
    for role, note in mapping.unmatched.items():
        yield warning(message=note, key=role)
    if {*JOINT_FIELDS, "position", "pose_matrix"}.isdisjoint(mapping.selections):
        text = "no joints and no poses found among the columns: name them (mapping={...})"
        yield Issue(message=text)
