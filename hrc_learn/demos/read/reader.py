"""Reading any LeRobot dataset into demonstrations, on pyarrow alone."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import overload

import numpy as np

from hrc_learn.demos.demonstration import (
    JOINT_FIELDS,
    Demonstration,
    DemonstrationSet,
    joint_columns,
)
from hrc_learn.demos.format.dataset_folder import DatasetFolder, EpisodeEntry
from hrc_learn.demos.image_features import with_feature
from hrc_learn.demos.issue import DatasetError, UnitsWarning
from hrc_learn.demos.read.column_mapping import MappingSpec, Matching
from hrc_learn.demos.read.component_names import ORIENTATION_ROLES
from hrc_learn.demos.read.episodes import (
    EpisodeFilter,
    EpisodeReader,
    OpenDataset,
    Quantities,
    RawEpisode,
    open_reader,
)
from hrc_learn.demos.read.frames import RawFrames, stamps
from hrc_learn.demos.read.value_encodings import UnitDecision, matrix_position, to_quaternion

# From quantities in the units on disk to a `Demonstration`.


def to_demonstration(
    folder: DatasetFolder,
    episode: RawEpisode,
    matching: Matching,
    decisions: Mapping[str, UnitDecision],
) -> Demonstration:
    """Convert one episode.

    Raises:
        DatasetError: Its stamps do not increase, or its orientations are none.
    """
    entry, frames, quantities = episode.entry, episode.frames, episode.quantities
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


# Demonstrations that stay on disk until they are asked for.


class DemonstrationSource(Sequence[Demonstration]):
    """A sequence of demonstrations in bounded memory, made by `open_demos`.

        source = open_demos(path)
        len(source), source.frames, source.joint_names  # known without reading
        for demo in source:  # in order; at most one file's batch of frames in memory
            ...
        source[3]  # that one alone
        source[rank::world_size]  # a share of it, still unread
        source.load()  # all, as `load_demos` gives them

    Each pass reads anew. Nothing is held open between calls, so a source may be handed to
    other processes.

    Attributes:
        notes: What the reader guessed or converted, one sentence each; show it to the user.
        source: The dataset's folder.
    """

    def __init__(
        self,
        reader: EpisodeReader,
        decisions: Mapping[str, UnitDecision],
        joint_names: Sequence[str] | None = None,
        notes: Sequence[str] = (),
    ):
        """
        Args:
            reader: The episodes, in order.
            decisions: Unit of each quantity on disk, by role.
            joint_names: Joints wanted, all of the dataset; None: all as they come.
            notes: What to tell the user.
        """
        self._reader = reader
        self._decisions = dict(decisions)
        names = reader.matching.joint_names if joint_names is None else joint_names
        self.joint_names = tuple(names)
        self.notes = tuple(notes)
        self.source = str(reader.folder.root)

    @overload
    def __getitem__(self, index: int) -> Demonstration: ...
    @overload
    def __getitem__(self, index: slice) -> "DemonstrationSource": ...
    def __getitem__(self, index):
        if isinstance(index, slice):
            chosen = replace(self._reader, entries=self._reader.entries[index])
            return DemonstrationSource(chosen, self._decisions, self.joint_names, self.notes)
        (episode,) = self._reader.read([self._reader.entries[index]])
        return self._convert(episode)

    def __len__(self) -> int:
        return len(self._reader.entries)

    def __iter__(self) -> Iterator[Demonstration]:
        for run in _runs(self._reader.entries):
            yield from map(self._convert, self._reader.read(run))

    def __repr__(self) -> str:
        return (
            f"DemonstrationSource({self.source!r}: {len(self)} demonstrations, "
            f"{self.frames} frames, joints: {', '.join(self.joint_names) or 'none'})"
        )

    @property
    def lengths(self) -> tuple[int, ...]:
        """Frames of each demonstration."""
        return tuple(entry.length for entry in self._reader.entries)

    @property
    def frames(self) -> int:
        """Frames of all demonstrations together."""
        return sum(self.lengths)

    @property
    def fps(self) -> float:
        """Nominal frame rate [1/s]."""
        return self._reader.folder.fps

    def load(self) -> DemonstrationSet:
        """Read all into memory.

        Raises:
            DatasetError: An episode cannot be read.
        """
        return DemonstrationSet([*self], notes=self.notes, source=self.source)

    def _convert(self, episode: RawEpisode) -> Demonstration:
        reader = self._reader
        demo = to_demonstration(reader.folder, episode, reader.matching, self._decisions)
        if reader.extracted is not None:
            demo = with_feature(demo, reader.extracted)
        return demo.select_joints(self.joint_names)


def _runs(entries: Sequence[EpisodeEntry]) -> Iterator[list[EpisodeEntry]]:
    """Cut a sequence into runs of episodes that lie on disk in this order."""
    place = [(entry.file, entry.start) for entry in entries]
    cuts = [0]
    for before, here in pairwise(place):
        cuts.append(cuts[-1] + (here <= before))
    for _, run in groupby(zip(cuts, entries, strict=True), key=lambda pair: pair[0]):
        yield [entry for _, entry in run]


# Reading any LeRobot dataset into demonstrations, on pyarrow alone.


def load_demos(
    path: str | Path | OpenDataset,
    episodes: Sequence[int] | None = None,
    mapping: MappingSpec | None = None,
    units: Mapping[str, str] | None = None,
    joint_names: Sequence[str] | None = None,
    *,
    tasks: str | Sequence[str] | None = None,
    where: EpisodeFilter | None = None,
) -> DemonstrationSet:
    """Read the demonstrations of a LeRobot dataset (version 2.0, 2.1 or 3.0) into memory.

    Columns are found by name; videos are not needed. What had to be guessed stands in the
    result's `notes`, and a guessed unit that changes values raises a `UnitsWarning`.

    Args:
        path: The dataset's folder, or an open `LeRobotDataset`, of which the episodes are
            taken that it was opened with.
        episodes: Indices of the episodes wanted, in that order; None reads all.
        mapping: Where to find quantities that are not found by name, or are found wrongly:
            role -> feature ("observation.qpos"), range of a feature ("observation.state[0:7]")
            or list of components. Roles are the keys of `demos.ROLES`.
        units: Units on disk by role, such as {"joint_position": "deg", "position": "mm"};
            they win over the dataset's sidecar and over guesses.
        joint_names: Joints wanted, in the order wanted; None takes all as they come.
        tasks: Only episodes that show one of these tasks.
        where: Only episodes for which this is true; it sees their `index`, `length` and
            `tasks`. By what they hold, choose with `DemonstrationSet.filter`.

    Raises:
        DatasetError: The dataset cannot be read as a whole; says file, episode, frame and
            key where known, and what to do.
    """
    reader = open_reader(path, episodes, mapping, tasks, where)
    matching = reader.matching
    raw = {e.entry.index: e for e in reader.read(tuple(dict.fromkeys(reader.entries)))}
    decisions = reader.decide_units(raw.values(), units or {})
    demos = [
        to_demonstration(reader.folder, raw[entry.index], matching, decisions)
        for entry in reader.entries
    ]
    if reader.extracted is not None:
        demos = [with_feature(demo, reader.extracted) for demo in demos]
    if joint_names is not None:
        joint_columns(matching.joint_names, joint_names)
        demos = [demo.select_joints(joint_names) for demo in demos]
    _warn_of_conversions(reader.folder.root, decisions)
    notes = [*reader.notes, *_guesses(decisions)]
    return DemonstrationSet(demos, notes=notes, source=str(reader.folder.root))


def open_demos(
    path: str | Path | OpenDataset,
    episodes: Sequence[int] | None = None,
    mapping: MappingSpec | None = None,
    units: Mapping[str, str] | None = None,
    joint_names: Sequence[str] | None = None,
    *,
    tasks: str | Sequence[str] | None = None,
    where: EpisodeFilter | None = None,
) -> DemonstrationSource:
    """The same demonstrations as of `load_demos`, read from disk only as they are asked for.

    Arguments, errors and warnings are those of `load_demos`, but faults of an episode show
    when it is read. Where units must be guessed from the size of the values, the columns in
    question are read once through here; a declared or given unit spares that.
    """
    reader = open_reader(path, episodes, mapping, tasks, where)
    if joint_names is not None:
        joint_columns(reader.matching.joint_names, joint_names)
    decisions = reader.survey(units or {})
    _warn_of_conversions(reader.folder.root, decisions)
    notes = (*reader.notes, *_guesses(decisions))
    return DemonstrationSource(reader, decisions, joint_names, notes)


def _warn_of_conversions(root: Path, decisions: Mapping[str, UnitDecision]) -> None:
    for decision in decisions.values():
        if decision.converts:
            warnings.warn(f"{root}: {decision.note}", UnitsWarning, stacklevel=3)


def _guesses(decisions: Mapping[str, UnitDecision]) -> list[str]:
    return [decision.note for decision in decisions.values() if decision.note]
