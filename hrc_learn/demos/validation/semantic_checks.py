"""Faults that show only once columns are known for what they mean."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from hrc_learn.demos.demonstration import JOINT_FIELDS
from hrc_learn.demos.format.dataset_folder import DatasetFolder, EpisodeEntry
from hrc_learn.demos.format.features import read_sidecar
from hrc_learn.demos.issue import DatasetError, ValidationReport
from hrc_learn.demos.read.column_mapping import ColumnMapping, MappingSpec, map_columns
from hrc_learn.demos.read.component_names import ORIENTATION_ROLES
from hrc_learn.demos.read.episodes import Quantities, frame_step, select_quantities
from hrc_learn.demos.read.frames import RawFrames
from hrc_learn.demos.read.value_encodings import UnitDecision, decide_units, to_quaternion


@dataclass(frozen=True, kw_only=True)
class DatasetSemantics:
    """One episode in our units."""

    entry: EpisodeEntry
    time: Float64[np.ndarray, " frames"]
    """True stamps where there are any, LeRobot's otherwise [s]."""
    quantities: Quantities


def resolve_semantics(
    folder: DatasetFolder,
    episodes: Sequence[tuple[EpisodeEntry, RawFrames]],
    mapping: MappingSpec,
    units: Mapping[str, str],
    report: ValidationReport,
) -> tuple[ColumnMapping, list[DatasetSemantics]]:
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
    largest = {
        role: max((float(np.abs(q[role]).max()) for _, _, q in raw), default=0.0)
        for role in column_mapping.selections
    }
    step = frame_step(raw[0][2].get("time"), folder.fps) if raw else 1.0
    decisions = decide_units(largest, sidecar.units, units, step) if raw else {}
    _report_guesses(column_mapping, decisions, report)
    semantics = []
    for entry, frames, quantities in raw:
        scaled = {role: v * decisions[role].factor for role, v in quantities.items()}
        _check_orientation(entry, quantities, scaled, report)
        time = scaled["time"][:, 0] if "time" in scaled else _timestamps(folder, entry, frames)
        semantics.append(DatasetSemantics(entry=entry, time=time, quantities=scaled))
    return column_mapping, semantics


def check_joint_sets(column_mapping: ColumnMapping, report: ValidationReport) -> None:
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
        report.add(DatasetError(str(error), file=entry.file, episode=entry.index, key=role))
        return
    if role.startswith("quaternion"):
        flips = np.flatnonzero((values[1:] * values[:-1]).sum(1) < 0)
        if len(flips):
            report.warning(
                f"the quaternion changes its sign {len(flips)} times without turning; "
                f"load_demos makes it continuous, hrc repair does so on disk",
                file=entry.file,
                episode=entry.index,
                frame=int(flips[0]) + 1,
                key=role,
            )


def _timestamps(
    folder: DatasetFolder, entry: EpisodeEntry, frames: RawFrames
) -> Float64[np.ndarray, " frames"]:
    if "timestamp" in frames:
        return frames["timestamp"][:, 0].astype(float)
    return np.arange(entry.length) / folder.fps
