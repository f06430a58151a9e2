"""Demonstrations read from a LeRobot dataset, at once or one after another."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Protocol, overload, runtime_checkable

import numpy as np

from hrc_learn.demos.demonstration import (
    JOINT_FIELDS,
    Demonstration,
    DemonstrationSet,
    joint_columns,
)
from hrc_learn.demos.format.dataset_folder import DatasetFolder, EpisodeEntry
from hrc_learn.demos.image_features import missing_note, only_feature, with_feature
from hrc_learn.demos.read.columns import MappingSpec
from hrc_learn.demos.read.frames import disk_runs, frame_timestamps
from hrc_learn.demos.read.opened_dataset import (
    EpisodeFilter,
    OpenedDataset,
    RawEpisode,
    open_dataset,
    select_episodes,
    warn_of_conversions,
)
from hrc_learn.demos.read.quantities import ORIENTATION_ROLES, to_quaternion, transforms
from hrc_learn.demos.read.units import UnitDecision


@runtime_checkable
class OpenLeRobotDataset(Protocol):
    """Attributes used of an open `LeRobotDataset`."""

    root: Path
    episodes: list[int] | None


def load_demos(
    path: str | Path | OpenLeRobotDataset,
    episodes: Sequence[int] | None = None,
    mapping: MappingSpec | None = None,
    units: Mapping[str, str] | None = None,
    joint_names: Sequence[str] | None = None,
    *,
    tasks: str | Sequence[str] | None = None,
    where: EpisodeFilter | None = None,
) -> DemonstrationSet:
    """Read the demonstrations of a LeRobot dataset (version 2.0, 2.1 or 3.0) into memory.

    Columns are found by name; videos are not needed. Guesses are listed in the result's
    `notes`, and a guessed unit that changes values raises a `UnitsWarning`.

    Args:
        path: Folder of the dataset, or an open `LeRobotDataset`, whose own selection of
            episodes is then the default.
        episodes: Indices of the episodes wanted, in that order; None reads all.
        mapping: Columns of quantities that are not found by name, or are found wrongly: role
            -> feature ("observation.qpos"), range of a feature ("observation.state[0:7]") or
            list of components. Roles are the keys of `demos.ROLES`; None leaves a role out.
        units: Units on disk by role, such as {"joint_position": "deg", "position": "mm"};
            they take precedence over the dataset's sidecar and over guesses.
        joint_names: Joints wanted, in the order wanted; None takes all in their order.
        tasks: Read only episodes that show one of these tasks.
        where: Read only episodes for which this is true; it receives their `index`, `length`
            and `tasks`. To select by content, use `DemonstrationSet.filter`.

    Raises:
        DatasetError: The dataset cannot be read; names file, episode, frame and key where
            known, and the remedy.
    """
    dataset, entries = _open(path, episodes, mapping, tasks, where)
    raw = {e.entry.index: e for e in dataset.read(tuple(dict.fromkeys(entries)))}
    decisions = dataset.decide_units(raw.values(), units or {}, entries)
    source = DemonstrationSource(dataset, entries, decisions, joint_names)
    demos = [source.convert(raw[entry.index]) for entry in entries]
    warn_of_conversions(dataset.folder.root, decisions)
    return DemonstrationSet(demos, notes=source.notes, source=source.source)


def open_demos(
    path: str | Path | OpenLeRobotDataset,
    episodes: Sequence[int] | None = None,
    mapping: MappingSpec | None = None,
    units: Mapping[str, str] | None = None,
    joint_names: Sequence[str] | None = None,
    *,
    tasks: str | Sequence[str] | None = None,
    where: EpisodeFilter | None = None,
    keep_contract: bool = False,
) -> "DemonstrationSource":
    """Open a dataset whose demonstrations are read from disk when they are used.

    Arguments, errors and warnings are those of `load_demos`, but faults of an episode appear
    when it is read. If units must be guessed from the size of the values, the columns in
    question are read once here; declared or given units make that unnecessary.

    Args:
        path: Folder of the dataset, or an open `LeRobotDataset`.
        episodes: Indices of the episodes wanted.
        mapping: Columns by role.
        units: Units on disk by role.
        joint_names: Joints wanted.
        tasks: Tasks wanted.
        where: Condition on the episodes wanted.
        keep_contract: Keep the inferred contract with a dataset that declares nothing itself,
            unless a mapping is given.

    Raises:
        DatasetError: The metadata are damaged, or an argument names what does not exist.
    """
    dataset, entries = _open(path, episodes, mapping, tasks, where)
    if joint_names is not None:  # before any long read
        joint_columns(dataset.columns.joint_names, joint_names)
    notes: tuple[str, ...] = ()
    if keep_contract and not mapping:
        dataset, note = dataset.keep_first_contract(units)
        notes = (note,) if note else ()
    decisions = dataset.survey_units(entries, units or {})
    warn_of_conversions(dataset.folder.root, decisions)
    return DemonstrationSource(dataset, entries, decisions, joint_names, notes)


def _open(
    path: str | Path | OpenLeRobotDataset,
    episodes: Sequence[int] | None,
    mapping: MappingSpec | None,
    tasks: str | Sequence[str] | None,
    where: EpisodeFilter | None,
) -> tuple[OpenedDataset, tuple[EpisodeEntry, ...]]:
    if isinstance(path, str | Path):
        root = path
    else:
        root, episodes = path.root, path.episodes if episodes is None else episodes
    dataset = open_dataset(root, mapping)
    return dataset, select_episodes(dataset.folder, episodes, tasks, where)


class DemonstrationSource(Sequence[Demonstration]):
    """A sequence of demonstrations in bounded memory, made by `open_demos`.

        source = open_demos(path)
        len(source), source.frames, source.joint_names  # known without reading
        for demo in source:  # in order; at most one batch of frames in memory
            ...
        source[3]  # reads one episode
        source[rank::world_size]  # the part of one process, still unread
        source.load()  # all, as `load_demos` gives them

    Each pass reads from disk again. No file stays open between calls, so a source can be passed
    to other processes.

    Attributes:
        notes: Guesses and conversions of the reader, one sentence each, for the user.
        source: Folder of the dataset.
    """

    def __init__(
        self,
        dataset: OpenedDataset,
        entries: Sequence[EpisodeEntry],
        decisions: Mapping[str, UnitDecision],
        joint_names: Sequence[str] | None = None,
        notes: Sequence[str] = (),
    ):
        """
        Args:
            dataset: The opened dataset.
            entries: Episodes, in order.
            decisions: Unit of each quantity on disk, by role.
            joint_names: Joints wanted; None takes all in their order.
            notes: Further notes for the user.

        Raises:
            DatasetError: A joint does not exist.
        """
        columns = dataset.columns
        self._dataset = dataset
        self._entries = tuple(entries)
        self._decisions = dict(decisions)
        names = columns.joint_names if joint_names is None else joint_names
        joint_columns(columns.joint_names, names)
        self.joint_names = tuple(names)
        self.source = str(dataset.folder.root)
        self._extracted = None if dataset.own_feature else only_feature(dataset.folder.root)
        self._own_notes = tuple(notes)
        self.notes = (*notes, *columns.notes)
        if dataset.contract_note is not None:
            self.notes += (dataset.contract_note,)
        if self._extracted is not None:
            self.notes += (f"feature: {self._extracted.name}, extracted from the videos",)
        self.notes += tuple(d.note for d in decisions.values() if d.note)
        if self._extracted is not None:
            self.notes += missing_note(self._extracted, [entry.index for entry in entries])

    @overload
    def __getitem__(self, index: int) -> Demonstration: ...
    @overload
    def __getitem__(self, index: slice) -> "DemonstrationSource": ...
    def __getitem__(self, index):
        if isinstance(index, slice):
            return self._part(self._entries[index])
        (episode,) = self._dataset.read([self._entries[index]])
        return self.convert(episode)

    def spread(self, most: int) -> "DemonstrationSource":
        """Subset of `most` demonstrations, spread evenly over the sequence and still unread."""
        places = np.linspace(0, len(self) - 1, min(len(self), most)).astype(int)
        return self._part(self._entries[place] for place in places.tolist())

    def _part(self, entries: Iterable[EpisodeEntry]) -> "DemonstrationSource":
        return DemonstrationSource(
            self._dataset, tuple(entries), self._decisions, self.joint_names, self._own_notes
        )

    def __len__(self) -> int:
        return len(self._entries)

    def __iter__(self) -> Iterator[Demonstration]:
        for run in disk_runs(self._entries):
            yield from map(self.convert, self._dataset.read(run))

    def __repr__(self) -> str:
        return (
            f"DemonstrationSource({self.source!r}: {len(self)} demonstrations, "
            f"{self.frames} frames, joints: {', '.join(self.joint_names) or 'none'})"
        )

    @property
    def folder(self) -> DatasetFolder:
        """Metadata of the dataset."""
        return self._dataset.folder

    @property
    def lengths(self) -> tuple[int, ...]:
        """Number of frames of each demonstration."""
        return tuple(entry.length for entry in self._entries)

    @property
    def frames(self) -> int:
        """Number of frames of all demonstrations together."""
        return sum(self.lengths)

    @property
    def fps(self) -> float:
        """Nominal frame rate [1/s]."""
        return self._dataset.folder.fps

    def load(self) -> DemonstrationSet:
        """Read all demonstrations into memory.

        Raises:
            DatasetError: An episode cannot be read.
        """
        return DemonstrationSet([*self], notes=self.notes, source=self.source)

    def convert(self, episode: RawEpisode) -> Demonstration:
        """Demonstration of a raw episode of this dataset.

        Raises:
            DatasetError: Its stamps do not increase, or its orientations are invalid.
        """
        folder, entry, frames = self._dataset.folder, episode.entry, episode.frames
        values = {}
        for role, on_disk in episode.quantities.items():
            factor = self._decisions[role].factor
            values[role] = on_disk if np.all(factor == 1) else on_disk * factor
        time = frame_timestamps(folder, entry, frames, values.get("time"))
        fields = {
            role: values[role]
            for role in (*JOINT_FIELDS, "position", "feature")
            if role in values
        }
        if "gripper" in values:
            fields["gripper"] = values["gripper"][:, 0]
        if "feature_visible" in values:
            fields["feature_visible"] = values["feature_visible"][:, 0] > 0
        demo = Demonstration(
            time=time - time[0],
            start_time=float(time[0]),
            fps=folder.fps,
            episode=entry.index,
            task=_task(folder, episode),
            joint_names=self._dataset.columns.joint_names,
            extra={key: frames[key].astype(float) for key in self._dataset.columns.extra},
            **fields | self._pose(episode, values),
        )
        if self._extracted is not None:
            demo = with_feature(demo, self._extracted, if_known=True)
        return demo.select_joints(self.joint_names)

    def _pose(
        self, episode: RawEpisode, values: Mapping[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Orientation, and position if a 4x4 transform holds both."""
        role = next((role for role in ORIENTATION_ROLES if role in values), None)
        if role is None:
            return {}
        try:
            if role != "pose_matrix":
                return {"orientation": to_quaternion(role, values[role])}
            # In a transform, the translation alone has a unit.
            matrix = episode.quantities[role]
            pose = {"orientation": to_quaternion(role, matrix)}
            if "position" not in values:
                translation = transforms(matrix)[:, :3, 3].numpy()
                pose["position"] = translation * self._decisions[role].factor
            return pose
        except ValueError as error:
            raise episode.entry.error(str(error), key=role) from error


def _task(folder: DatasetFolder, episode: RawEpisode) -> str:
    if episode.entry.tasks:
        return episode.entry.tasks[0]
    if "task_index" in episode.frames:
        return folder.tasks.get(int(episode.frames["task_index"][0, 0]), "")
    return ""
