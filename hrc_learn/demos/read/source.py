"""Demonstrations read from a LeRobot dataset, all together or one after another."""

import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol, overload, runtime_checkable

import numpy as np

from hrc_learn.demos.demonstration import Demonstration, DemonstrationSet, joint_columns
from hrc_learn.demos.image_features import extracted_features
from hrc_learn.demos.issues import DatasetError, UnitsWarning
from hrc_learn.demos.read import profiles
from hrc_learn.demos.read.columns import ColumnMapping, MappingSpec, map_columns
from hrc_learn.demos.read.contract import Contract, Sidecar, fingerprint, read_sidecar
from hrc_learn.demos.read.dataset_folder import (
    DatasetFolder,
    EpisodeEntry,
    EpisodeFilter,
    count_faults,
    open_folder,
    select_episodes,
)
from hrc_learn.demos.read.frames import RawEpisode, frame_timestamps, raising, read_quantities
from hrc_learn.demos.read.kinematic_evidence import agreement, arm_columns
from hrc_learn.demos.read.metadata import SIDECAR_PATH
from hrc_learn.demos.read.naming import is_hand
from hrc_learn.demos.read.quantities import ORIENTATION_ROLES, demonstration_fields
from hrc_learn.demos.read.unit_evidence import FEWEST_JOINTS
from hrc_learn.demos.read.units import (
    Quantities,
    UnitDecision,
    calibrations,
    guessed_from_values,
    unit_factor,
    units_from_episodes,
    units_of,
)
from hrc_learn.kinematics import Arm
from hrc_learn.kinematics.registry import arm_of_robot

_SAMPLED = 32
"""Number of episodes that decide on units."""
_POSES = 5
"""Number of episodes whose poses are compared with the kinematics."""
_COMMAND = "command_position"
_WHOLE_STEP, _SPEED = (0.1, 1.5), (2 / 3, 1.5)
"""Ranges of the joint motion per unit of a command. `_WHOLE_STEP`: motion in one step, for
commands that are the change of one step. `_SPEED`: motion in one second, for commands that may
be velocities."""


@dataclass(frozen=True, kw_only=True)
class OpenedDataset:
    """Metadata of a dataset and the meaning of its columns; no file stays open."""

    folder: DatasetFolder
    columns: ColumnMapping
    sidecar: Sidecar = field(default_factory=Sidecar)
    own_feature: bool = False
    """True if the image feature is a column of the dataset, or has an entry in the mapping."""
    robot: Arm | None = None
    """Arm that the caller names; None for the arm of the dataset's robot type."""

    @classmethod
    def of(cls, folder: DatasetFolder, mapping: MappingSpec | None = None) -> "OpenedDataset":
        """Find the quantities of a dataset.

        Args:
            folder: Metadata of the dataset.
            mapping: Role -> columns, as in `load_demos`; takes precedence over the contract,
                which takes precedence over names.

        Raises:
            DatasetError: Mapping or contract name columns that do not exist, or the sidecar is
                damaged.
        """
        sidecar = read_sidecar(folder.root)
        columns = map_columns(folder.features, mapping, sidecar.selections(folder.features))
        return cls(
            folder=folder,
            sidecar=sidecar,
            columns=columns,
            own_feature="feature" in columns.selections or "feature" in (mapping or {}),
        )

    @property
    def contract(self) -> Contract | None:
        """Contract kept with the dataset."""
        return self.sidecar.contract if self.sidecar.contract.components else None

    @cached_property
    def arm(self) -> tuple[Arm, tuple[int, ...]] | None:
        """Arm of the dataset and the columns of its joints; None if it is not known.

        Raises:
            DatasetError: The caller named an arm with other joints.
        """
        arm = self.robot or arm_of_robot(self.folder.robot_type)
        try:
            return arm and (arm, arm_columns(self.columns.joint_names, arm))
        except DatasetError:
            if self.robot is None:
                return None
            raise

    @cached_property
    def contract_note(self) -> str | None:
        """Warning that the data changed since the contract was kept, or None."""
        if self.contract is None or self.contract.fingerprint == fingerprint(self.folder):
            return None
        text = f"the data changed since the contract in {SIDECAR_PATH} was kept"
        return f"{text}: hrc check --keep-contract renews it"

    @cached_property
    def declared_units(self) -> Mapping[str, str | Sequence[str]]:
        """Units by role from the sidecar, or of each component from the contract."""
        known = self.sidecar.contract.units(self.columns.selections)
        return {**self.sidecar.units, **known}

    def decide_units(
        self, entries: Sequence[EpisodeEntry], given: Mapping[str, str]
    ) -> tuple[dict[str, UnitDecision], list[DatasetError]]:
        """Unit of every quantity, from one pass over the columns whose unit must be guessed.

        Undeclared units are guessed from a sample of the dataset, so that the guess does not
        depend on the episodes that are loaded. Episodes that cannot be read are ignored.

        Args:
            entries: Episodes that must not contradict the decision.
            given: Units from the caller.

        Returns:
            The decisions, and an error for each of the `entries` that contradicts them.

        Raises:
            DatasetError: A unit is unknown or does not fit its quantity.
        """
        known = {*self.declared_units, *given} - calibrations(given).keys()
        guessed = guessed_from_values(self.columns.selections, known)
        # Commands are identified by comparing them with the joints.
        more = {"time"} - known | ({"joint_position"} if _COMMAND in guessed else set())
        # The kinematics of a known arm show the unit of its joints.
        more |= {"position"} if "joint_position" in guessed else set()
        roles = {*guessed, *(more & self.columns.selections.keys())}
        sample = {entry.index for entry in _spread(self.folder.episodes, _SAMPLED)}
        wanted = {entry.index for entry in entries}
        chosen = wanted | sample if guessed else {entries[0].index} if roles else set()

        def episodes() -> Iterator[tuple[EpisodeEntry, Quantities]]:
            listed = [entry for entry in self.folder.episodes if entry.index in chosen]
            for found in read_quantities(self.folder, self.columns, listed, roles):
                if not isinstance(found, DatasetError):
                    yield found.entry, found.quantities

        decisions, faults = self.units_from(episodes(), given, sample)
        return decisions, [fault for fault in faults if fault.episode in wanted]

    def units_from(
        self,
        episodes: Iterable[tuple[EpisodeEntry, Quantities]],
        given: Mapping[str, str],
        sample: Collection[int] | None = None,
    ) -> tuple[dict[str, UnitDecision], list[DatasetError]]:
        """Decide on units by `units_from_episodes`, and find commands that are changes per
        step.
        """
        fps, trackings, poses = self.folder.fps, [], []
        asked = _COMMAND in self.columns.selections.keys() - {*self.declared_units, *given}

        def tracked() -> Iterator[tuple[EpisodeEntry, Quantities]]:
            for entry, quantities in episodes:
                if asked and len(trackings) < _SAMPLED:
                    trackings.append(profiles.track_quantities(quantities, fps))
                if len(poses) < _POSES and {"joint_position", "position"} <= quantities.keys():
                    poses.append((quantities["joint_position"], quantities["position"]))
                yield entry, quantities

        columns, declared = self.columns, self.declared_units
        robot = self.folder.robot_type or ""
        decisions, faults = units_from_episodes(
            columns.selections, tracked(), fps, declared, given, sample, robot
        )
        joints = decisions.get("joint_position")
        if joints is not None and joints.guessed and poses:
            decisions |= self._by_kinematics(joints, decisions["position"], poses)
        if asked:
            decisions |= _meaning_of_commands(columns, decisions, trackings, fps)
        return decisions, faults

    def _by_kinematics(
        self,
        joints: UnitDecision,
        place: UnitDecision,
        poses: Sequence[tuple[np.ndarray, np.ndarray]],
    ) -> dict[str, UnitDecision]:
        """Units of joints and positions that the kinematics confirm; {} if they confirm none.

        Args:
            joints: Decision on the joints, made from their values.
            place: Decision on the positions of the end effector.
            poses: Joint positions and positions of the end effector, as recorded.
        """
        if self.arm is None:
            return {}
        arm, columns = self.arm
        values, position = map(np.concatenate, zip(*poses, strict=True))
        lengths = [place.unit, *(units_of("position") if place.guessed else ())]
        for length in dict.fromkeys(lengths):
            metres = position * unit_factor("position", length)
            if (found := agreement(arm, values[:, columns], metres)) is not None:
                break
        else:
            return {}
        text = f"the forward kinematics of {arm.name} give the position within"
        text += f" {1e3 * found.residual:.2g} mm"
        if found.change:
            left = f"the error is {1e3 * found.other:.2g} mm"
            text += f" only with {found.change}; as recorded, {left}"
        units = [joints.unit_of(i) for i in range(values.shape[1])]
        for column in columns:
            units[column] = found.unit
        sure = {"confidence": 0.4 if found.change else 0.99, "evidence": text}
        several = tuple(units) if len({*units}) > 1 else ()
        joints = replace(joints, unit=found.unit, units=several, **sure)
        place = replace(place, unit=length, **sure) if place.guessed else place
        return {joints.role: joints, place.role: place}


def _meaning_of_commands(
    columns: ColumnMapping,
    decisions: Mapping[str, UnitDecision],
    trackings: Sequence[Mapping[str, profiles.Tracking]],
    fps: float,
) -> dict[str, UnitDecision]:
    """New decisions by role if the commands are not positions of the joints; else {}."""
    command, selection = decisions[_COMMAND], columns.selections[_COMMAND]
    if (found := profiles.commanded_rates(trackings, fps)) is None:
        if not selection.numbered or profiles.are_positions(trackings, fps):
            return {}
        text = "names no components, and the joints do not follow it"
        evidence = f"{selection.columns[0][0]} {text}"
        return {_COMMAND: replace(command, confidence=0.3, evidence=evidence, leader="")}
    slope, fit = found
    scale = float(np.nanmedian(slope)) / fps
    # A lagging controller performs only a part of each step.
    factor = "" if _WHOLE_STEP[0] < scale < _WHOLE_STEP[1] else f"{scale:.2g} "
    # If no name marks the gripper, it is the last column.
    hands = [is_hand(label) for label in selection.labels[:-1]]
    hands.append(selection.numbered or is_hand(selection.labels[-1]))
    units = tuple(
        command.unit_of(i) if no and hand else f"{factor}{command.unit_of(i)}/step"
        for i, (no, hand) in enumerate(zip(np.isnan(slope), hands, strict=True))
    )
    evidence = (
        f"the joints follow the sum of the commands ({scale:.2g} {command.unit} per unit, R2 "
        f"{fit:.2f}), so that they are changes, not positions"
    )
    if _SPEED[0] < scale * fps < _SPEED[1]:
        evidence += f" (velocities in {command.unit}/s: map them to command_velocity)"
    steps = replace(command, unit=units[0], guessed=True, evidence=evidence)
    steps = replace(steps, units=units if len({*units}) > 1 else ())
    joints = decisions["joint_position"]
    if not columns.selections["joint_position"].numbered or len(units) >= FEWEST_JOINTS:
        return {_COMMAND: steps}
    text = f"{joints.evidence}; the commands are changes, so these {len(units)} columns without"
    text += " names may be a pose, which is read with --mapping position KEY[0:3]"
    return {_COMMAND: steps, joints.role: replace(joints, confidence=0.5, evidence=text)}


def _spread(entries: Sequence[EpisodeEntry], most: int) -> list[EpisodeEntry]:
    places = np.linspace(0, len(entries) - 1, min(len(entries), most))
    return [entries[int(place)] for place in places]


def open_dataset(path: str | Path, mapping: MappingSpec | None = None) -> OpenedDataset:
    """Read the metadata of a dataset and find its quantities.

    Args:
        path: Folder of the dataset.
        mapping: Role -> columns, as in `load_demos`.

    Raises:
        DatasetError: The metadata are missing, damaged or contradictory.
    """
    folder = open_folder(path)
    for fault in count_faults(folder):
        raise fault
    return OpenedDataset.of(folder, mapping)


@runtime_checkable
class OpenLeRobotDataset(Protocol):
    """Attributes of an open `LeRobotDataset` that are used here."""

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
    `notes`. A guessed unit that changes values or is doubtful causes a `UnitsWarning`.

    Args:
        path: Folder of the dataset, or an open `LeRobotDataset`, whose own selection of
            episodes is then the default.
        episodes: Indices of the episodes wanted, in that order; None reads all.
        mapping: Columns of quantities that are not found by name, or are found wrongly: role
            -> feature ("observation.qpos"), range of a feature ("observation.state[0:7]") or
            list of components. Roles are the keys of `demos.ROLES`; None leaves a role out.
        units: Units on disk by role, such as {"joint_position": "deg", "position": "mm"};
            they take precedence over the dataset's sidecar and over guesses. For joints that
            LeRobot stored as -100..100, give the path of LeRobot's calibration file (.json) of
            the arm instead of a unit.
        joint_names: Joints wanted, in the order wanted; None takes all in their order.
        tasks: Read only episodes that show one of these tasks.
        where: Read only episodes for which this condition is true; it receives their `index`,
            `length` and `tasks`. To select by content, use `DemonstrationSet.filter`.

    Raises:
        DatasetError: The dataset cannot be read; the message names file, episode, frame and key
            where known, and the remedy.
    """
    source = open_demos(path, episodes, mapping, units, joint_names, tasks=tasks, where=where)
    return source.load()


def open_demos(
    path: str | Path | OpenLeRobotDataset,
    episodes: Sequence[int] | None = None,
    mapping: MappingSpec | None = None,
    units: Mapping[str, str] | None = None,
    joint_names: Sequence[str] | None = None,
    *,
    tasks: str | Sequence[str] | None = None,
    where: EpisodeFilter | None = None,
    refuse_doubt: bool = False,
) -> "DemonstrationSource":
    """Open a dataset whose demonstrations are read from disk when they are used.

    Arguments, errors and warnings are those of `load_demos`, but faults of an episode appear
    when it is read. If units must be guessed from the size of the values, the columns in
    question are read once here. This is not necessary if the units are declared or given.

    Args:
        path: Folder of the dataset, or an open `LeRobotDataset`.
        episodes: Indices of the episodes wanted.
        mapping: Columns by role.
        units: Units on disk by role.
        joint_names: Joints wanted.
        tasks: Tasks wanted.
        where: Condition on the episodes wanted.
        refuse_doubt: Raise an error instead of a warning if a guessed unit is doubtful.

    Raises:
        DatasetError: The metadata are damaged, an argument names an episode, task, column or
            joint that does not exist, or a guessed unit is doubtful with `refuse_doubt`.
    """
    if isinstance(path, str | Path):
        root = path
    else:
        root, episodes = path.root, path.episodes if episodes is None else episodes
    dataset = open_dataset(root, mapping)
    entries = select_episodes(dataset.folder, episodes, tasks, where)
    if joint_names is not None:  # before any long read
        joint_columns(dataset.columns.joint_names, joint_names)
    decisions, faults = dataset.decide_units(entries, units or {})
    for fault in faults:
        raise fault
    doubts = [decision.doubt for decision in decisions.values() if decision.doubt]
    if doubts and refuse_doubt:
        raise DatasetError(f"{dataset.folder.root}: {'; '.join(doubts)}")
    for decision in decisions.values():
        if decision.converts or decision.doubt:
            text = f"{dataset.folder.root}: {decision.doubt or decision.note}"
            warnings.warn(text, UnitsWarning, stacklevel=2)
    return DemonstrationSource(dataset, entries, decisions, joint_names)


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
        folder: Metadata of the dataset.
        columns: Columns of each quantity.
        entries: Episodes of the sequence, as the metadata list them.
        units: Unit on disk of each quantity, and its evidence.
        joint_names: Names of the joints.
        joint_unit: Unit of the joints as read: "rad", or "1" for a fraction of a range.
        lengths: Number of frames of each demonstration.
        frames: Number of frames of all demonstrations together.
        fps: Nominal frame rate [1/s].
        notes: Guesses and conversions of the reader, one sentence each, for the user.
        source: Folder of the dataset.
    """

    def __init__(
        self,
        dataset: OpenedDataset,
        entries: Sequence[EpisodeEntry],
        decisions: Mapping[str, UnitDecision],
        joint_names: Sequence[str] | None = None,
    ):
        """
        Args:
            dataset: The opened dataset.
            entries: Episodes, in order.
            decisions: Unit of each quantity on disk, by role.
            joint_names: Joints wanted; None takes all in their order.
        """
        columns, root = dataset.columns, dataset.folder.root
        self._dataset, self.folder, self.columns = dataset, dataset.folder, columns
        self.entries, self.units = tuple(entries), dict(decisions)
        names = columns.joint_names if joint_names is None else joint_names
        self.joint_names, self.source = tuple(names), str(root)
        joint = self.units.get("joint_position")
        self.joint_unit = "rad" if joint is None else joint.si_unit
        self.lengths = tuple(entry.length for entry in self.entries)
        self.frames, self.fps = sum(self.lengths), dataset.folder.fps
        noted = [*columns.notes]
        noted += [f"{role} {note}" for role, note in columns.unmatched.items()]
        noted += [dataset.contract_note, *(d.note for d in decisions.values())]
        extracted = [] if dataset.own_feature else extracted_features(root)
        self._extracted = extracted[0] if len(extracted) == 1 else None
        if self._extracted is not None:
            noted.append(f"feature: {self._extracted.name}, extracted from the videos")
            noted += self._extracted.note([entry.index for entry in entries])
        self.notes = tuple(note for note in noted if note)

    @overload
    def __getitem__(self, index: int) -> Demonstration: ...
    @overload
    def __getitem__(self, index: slice) -> "DemonstrationSource": ...
    def __getitem__(self, index):
        if isinstance(index, slice):
            return self._part(self.entries[index])
        (demo,) = self._part([self.entries[index]])
        return demo

    def spread(self, most: int) -> "DemonstrationSource":
        """Subset of at most `most` demonstrations, evenly spaced in the sequence and unread."""
        return self._part(_spread(self.entries, most))

    def _part(self, entries: Sequence[EpisodeEntry]) -> "DemonstrationSource":
        return DemonstrationSource(self._dataset, entries, self.units, self.joint_names)

    def __len__(self) -> int:
        return len(self.entries)

    def __iter__(self) -> Iterator[Demonstration]:
        return raising(self.each())

    def each(self) -> Iterator[Demonstration | DatasetError]:
        """Every demonstration, or the error if an episode cannot be read."""
        for found in read_quantities(self.folder, self.columns, self.entries):
            try:
                yield found if isinstance(found, DatasetError) else self._convert(found)
            except DatasetError as error:
                yield error

    def __repr__(self) -> str:
        return (
            f"DemonstrationSource({self.source!r}: {len(self)} demonstrations, "
            f"{self.frames} frames, joints: {', '.join(self.joint_names) or 'none'})"
        )

    def load(self) -> DemonstrationSet:
        """Read all demonstrations into memory.

        Raises:
            DatasetError: An episode cannot be read.
        """
        return DemonstrationSet(
            [*self], notes=self.notes, source=self.source, joint_unit=self.joint_unit
        )

    def _convert(self, episode: RawEpisode) -> Demonstration:
        """Demonstration of a raw episode of this dataset.

        Raises:
            DatasetError: The stamps do not increase, or the orientations are invalid.
        """
        entry, frames, quantities = episode.entry, episode.frames, episode.quantities
        factors = {role: self.units[role].factor for role in quantities}
        stamps = quantities["time"] * factors["time"] if "time" in quantities else None
        time = frame_timestamps(self.folder, entry, frames, stamps)
        try:
            fields = demonstration_fields(quantities, factors)
        except ValueError as error:
            key = next(role for role in ORIENTATION_ROLES if role in quantities)
            raise entry.error(str(error), key=key) from error
        if _COMMAND in fields and (steps := self.units[_COMMAND].steps).any():
            fields[_COMMAND] = fields[_COMMAND] + steps * fields.get("joint_position", 0.0)
        task = entry.tasks[0] if entry.tasks else ""
        if not entry.tasks and "task_index" in frames:
            task = self.folder.tasks.get(int(frames["task_index"][0, 0]), "")
        demo = Demonstration(
            time=time - time[0],
            start_time=float(time[0]),
            fps=self.fps,
            episode=entry.index,
            task=task,
            joint_names=self.columns.joint_names,
            extra={key: frames[key].astype(float) for key in self.columns.extra},
            **fields,
        )
        if self._extracted is not None:
            demo = self._extracted.attach(demo, if_known=True)
        return demo.select_joints(self.joint_names)
