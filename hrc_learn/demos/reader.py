"""Reading any LeRobot dataset into demonstrations, on pyarrow alone."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from .demonstration import JOINT_FIELDS, Demonstration, joint_columns
from .demonstration_set import DemonstrationSet
from .explicit_mapping import MappingSpec
from .finding import DatasetError, UnitsWarning
from .frames import RawFrames, read_frames
from .layout import DatasetFolder, EpisodeEntry, open_folder
from .matching import Matching, match_columns
from .poses import matrix_position, to_quaternion
from .quantities import Quantities, frame_step, select_quantities
from .roles import ORIENTATION_ROLES
from .sidecar import read_sidecar
from .stamps import stamps
from .units import UnitDecision, decide_units


def load_demos(
    path: str | Path,
    episodes: Sequence[int] | None = None,
    mapping: MappingSpec | None = None,
    units: Mapping[str, str] | None = None,
    joint_names: Sequence[str] | None = None,
) -> DemonstrationSet:
    """Read the demonstrations of a LeRobot dataset (version 2.0, 2.1 or 3.0).

    Columns are found by name; videos are not needed. What had to be guessed stands in the
    result's `notes`, and a guessed unit that changes values raises a `UnitsWarning`.

    Args:
        path: The dataset's folder.
        episodes: Indices of the episodes wanted, in that order; None reads all.
        mapping: Where to find quantities that are not found by name, or are found wrongly:
            role -> feature ("observation.qpos"), range of a feature ("observation.state[0:7]")
            or list of components. Roles are the keys of `demos.ROLES`.
        units: Units on disk by role, such as {"joint_position": "deg", "position": "mm"};
            they win over the dataset's sidecar and over guesses.
        joint_names: Joints wanted, in the order wanted; None takes all as they come.

    Raises:
        DatasetError: The dataset cannot be read as a whole; says file, episode, frame and
            key where known, and what to do.
    """
    folder = open_folder(path)
    sidecar = read_sidecar(folder.root)
    matching = match_columns(folder.features, sidecar, mapping)
    entries = _select_episodes(folder, episodes)
    raw = _read_quantities(folder, entries, matching)
    largest = {
        role: max(float(np.abs(quantities[role]).max()) for _, quantities in raw.values())
        for role in matching.selections
    }
    _, first = raw[entries[0].index]
    step = frame_step(first.get("time"), folder.fps)
    decisions = decide_units(largest, sidecar.units, units or {}, step)
    demos = [
        _demonstration(folder, entry, *raw[entry.index], matching, decisions)
        for entry in entries
    ]
    if joint_names is not None:
        joint_columns(matching.joint_names, joint_names)
        demos = [demo.select_joints(joint_names) for demo in demos]
    for decision in decisions.values():
        if decision.converts:
            warnings.warn(f"{path}: {decision.note}", UnitsWarning, stacklevel=2)
    guesses = [decision.note for decision in decisions.values() if decision.note]
    return DemonstrationSet(demos, notes=[*matching.notes, *guesses], source=str(path))


def _select_episodes(folder: DatasetFolder, wanted: Sequence[int] | None) -> list[EpisodeEntry]:
    by_index = {entry.index: entry for entry in folder.episodes}
    if not by_index:
        raise DatasetError("the dataset holds no episodes", file=folder.root)
    if wanted is not None and not len(wanted):
        raise DatasetError("no episode was asked for; None reads all", file=folder.root)
    missing = [index for index in wanted or () if index not in by_index]
    if missing:
        raise DatasetError(
            f"there is no such episode; the dataset has {min(by_index)} to {max(by_index)}",
            file=folder.root,
            episode=missing[0],
        )
    return list(by_index.values() if wanted is None else (by_index[i] for i in wanted))


def _read_quantities(
    folder: DatasetFolder, entries: Sequence[EpisodeEntry], matching: Matching
) -> dict[int, tuple[RawFrames, Quantities]]:
    """Raw frames and the quantities among them, in the units on disk, by episode."""
    keys = {key for s in matching.selections.values() for key, _ in s.columns}
    ordered = sorted({entry.index: entry for entry in entries}.values(), key=_place)
    read = {}
    for entry, frames in read_frames(folder, ordered, sorted(keys | {*matching.extra})):
        if not entry.length:
            raise DatasetError("has no frames", file=entry.file, episode=entry.index)
        quantities = select_quantities(frames, matching.selections)
        _refuse_non_finite(entry, quantities, matching)
        read[entry.index] = frames, quantities
    return read


def _place(entry: EpisodeEntry) -> tuple[str, int]:
    return entry.file, entry.start


def _refuse_non_finite(entry: EpisodeEntry, quantities: Quantities, matching: Matching) -> None:
    seen = quantities.get("feature_visible")
    for role, values in quantities.items():
        # The sum is finite unless a value is not: far cheaper than a mask.
        if np.isfinite(values.sum()):
            continue
        bad = ~np.isfinite(values)
        if role == "feature" and seen is not None:
            values[bad & (seen == 0)] = 0.0
            bad &= seen != 0
        if bad.any():
            frame, component = (int(i) for i in np.argwhere(bad)[0])
            selection = matching.selections[role]
            raise DatasetError(
                f"{role} is {values[frame, component]} there; leave the episode out "
                f"(episodes=[...]) or repair the recording",
                file=entry.file,
                episode=entry.index,
                frame=frame,
                key=f"{selection.columns[component][0]} ({selection.labels[component]})",
            )


def _demonstration(
    folder: DatasetFolder,
    entry: EpisodeEntry,
    frames: RawFrames,
    quantities: Quantities,
    matching: Matching,
    decisions: Mapping[str, UnitDecision],
) -> Demonstration:
    scaled = {
        role: values if decisions[role].factor == 1 else values * decisions[role].factor
        for role, values in quantities.items()
    }
    time = stamps(folder, entry, frames, scaled.get("time"))
    fields = {role: scaled[role] for role in JOINT_FIELDS if role in scaled}
    fields |= {role: scaled[role] for role in ("position", "feature") if role in scaled}
    if "gripper" in scaled:
        fields["gripper"] = scaled["gripper"][:, 0]
    if "feature_visible" in scaled:
        fields["feature_visible"] = scaled["feature_visible"][:, 0] > 0
    return Demonstration(
        time=time - time[0],
        start_time=float(time[0]),
        fps=folder.fps,
        episode=entry.index,
        task=_task(folder, entry, frames),
        joint_names=matching.joint_names,
        extra={key: frames[key].astype(float) for key in matching.extra},
        **fields | _pose(entry, quantities, scaled, decisions),
    )


def _pose(
    entry: EpisodeEntry,
    quantities: Quantities,
    scaled: Quantities,
    decisions: Mapping[str, UnitDecision],
) -> dict[str, np.ndarray]:
    """Orientation and, from a transform, position."""
    role = next((role for role in ORIENTATION_ROLES if role in quantities), None)
    if role is None:
        return {}
    try:
        if role != "pose_matrix":
            return {"orientation": to_quaternion(role, scaled[role])}
        # Of a transform only the translation has a unit.
        orientation = to_quaternion(role, quantities[role])
        if "position" in scaled:
            return {"orientation": orientation}
        position = matrix_position(quantities[role]) * decisions[role].factor
        return {"orientation": orientation, "position": position}
    except ValueError as error:
        raise DatasetError(
            str(error), file=entry.file, episode=entry.index, key=role
        ) from error


def _task(folder: DatasetFolder, entry: EpisodeEntry, frames: RawFrames) -> str:
    if entry.tasks:
        return entry.tasks[0]
    if "task_index" in frames:
        return folder.tasks.get(int(frames["task_index"][0, 0]), "")
    return ""
