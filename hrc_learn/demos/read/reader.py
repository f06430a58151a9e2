"""Reading any LeRobot dataset into demonstrations, on pyarrow alone."""

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import overload

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from hrc_learn.demos.demonstration import (
    JOINT_FIELDS,
    Demonstration,
    DemonstrationSet,
    joint_columns,
)
from hrc_learn.demos.format.dataset_folder import DatasetFolder, EpisodeEntry
from hrc_learn.demos.format.metadata import SIDECAR_PATH
from hrc_learn.demos.image_features import missing_note, with_feature
from hrc_learn.demos.issue import DatasetError, UnitsWarning
from hrc_learn.demos.read.column_mapping import ColumnMapping, MappingSpec, map_columns
from hrc_learn.demos.read.contract import infer_contract, keep_contract
from hrc_learn.demos.read.episodes import (
    EpisodeFilter,
    EpisodeReader,
    OpenDataset,
    Quantities,
    RawEpisode,
    open_reader,
)
from hrc_learn.demos.read.frames import RawFrames, disk_runs, frame_timestamps
from hrc_learn.demos.read.profiles import EpisodeProfile, profile_columns, track_quantities
from hrc_learn.demos.read.roles import ORIENTATION_ROLES, UnitDecision
from hrc_learn.geometry import quaternion

# From quantities in the units on disk to a `Demonstration`.


def to_demonstration(
    folder: DatasetFolder,
    episode: RawEpisode,
    column_mapping: ColumnMapping,
    decisions: Mapping[str, UnitDecision],
) -> Demonstration:
    """Convert one episode.

    Raises:
        DatasetError: Its timestamps do not increase, or its orientations are none.
    """
    entry, frames, quantities = episode.entry, episode.frames, episode.quantities
    scaled = {
        role: values if np.all(factor == 1) else values * factor
        for role, values in quantities.items()
        for factor in (decisions[role].factor,)
    }
    time = frame_timestamps(folder, entry, frames, scaled.get("time"))
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
        joint_names=column_mapping.joint_names,
        extra={key: frames[key].astype(float) for key in column_mapping.extra},
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
        matrices = _as_transforms(torch.from_numpy(quantities[role]))
        position = matrices[:, :3, 3].numpy() * decisions[role].factor
        return {"orientation": orientation, "position": position}
    except ValueError as error:
        raise DatasetError(str(error), **entry.location, key=role) from error


def _task(folder: DatasetFolder, entry: EpisodeEntry, frames: RawFrames) -> str:
    if entry.tasks:
        return entry.tasks[0]
    if "task_index" in frames:
        return folder.tasks.get(int(frames["task_index"][0, 0]), "")
    return ""


# Orientations in the encodings datasets use, as continuous unit quaternions.


def to_quaternion(
    role: str, values: Float64[np.ndarray, "frames components"]
) -> Float64[np.ndarray, "frames 4"]:
    """Unit quaternions (w, x, y, z), neighbours on the same half of the sphere.

    Args:
        role: One of `roles.ORIENTATION_ROLES`.
        values: Its components in our units.

    Raises:
        ValueError: Quaternions are far from unit length, matrices are no transforms, or two
            columns span no plane.
    """
    numbers = torch.from_numpy(values)
    match role:
        case "quaternion_wxyz":
            orientation = _unit(numbers)
        case "quaternion_xyzw":
            orientation = _unit(numbers.roll(1, dims=-1))
        case "rotation_vector":
            orientation = quaternion.exp(numbers)
        case "euler_xyz":
            orientation = _from_euler(numbers, (2, 1, 0))
        case "euler_intrinsic_xyz":
            orientation = _from_euler(numbers, (0, 1, 2))
        case "rotation_6d":
            orientation = _from_two_columns(numbers)
        case _:
            orientation = quaternion.from_matrix(_as_transforms(numbers)[:, :3, :3])
    return quaternion.continuous(orientation).numpy()


def _as_transforms(values: Tensor) -> Tensor:
    """4x4 transforms from 16 numbers, whether written by rows or, as libfranka, by columns.

    Raises:
        ValueError: Neither reading has (0, 0, 0, 1) for its last row.
    """
    by_rows = values.reshape(-1, 4, 4)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=values.dtype)
    for matrices in (by_rows, by_rows.mT):
        # Room for float32 and for few printed digits.
        if torch.allclose(matrices[:, 3], last.expand(len(matrices), 4), atol=1e-4):
            return matrices
    raise ValueError("16 numbers that are no 4x4 transform: no last row 0, 0, 0, 1")


def _unit(q: Tensor) -> Tensor:
    # Rounding leaves far less; what is no quaternion is further off.
    wrong = ((q.norm(dim=-1) - 1).abs() > 0.01).nonzero()
    if len(wrong):
        k = int(wrong[0])
        raise ValueError(
            f"quaternion of length {float(q[k].norm()):.4g} at frame {k}: the columns hold no "
            f"quaternion, or it was lost there"
        )
    return quaternion.normalize(q)


def _from_euler(angles: Tensor, order: tuple[int, int, int]) -> Tensor:
    """Turns about the axes x, y, z, multiplied from left to right in this order.

    About fixed axes, R = Rz(yaw) Ry(pitch) Rx(roll); about turning ones, R = Rx Ry Rz.
    """
    axes = torch.eye(3, dtype=angles.dtype)
    first, second, third = (quaternion.exp(angles[:, k, None] * axes[k]) for k in order)
    return quaternion.multiply(first, quaternion.multiply(second, third))


def _from_two_columns(values: Tensor) -> Tensor:
    """Two columns of a rotation matrix, made orthonormal (Zhou et al., CVPR 2019, eq. 15)."""
    first, second = values[:, :3], values[:, 3:]
    third = torch.linalg.cross(first, second)
    # Parallel columns, or zeros where nothing was recorded.
    lost = (third.norm(dim=-1) < 1e-6).nonzero()
    if len(lost):
        raise ValueError(
            f"the two columns at frame {int(lost[0])} span no plane: they hold no rotation"
        )
    first = first / first.norm(dim=-1, keepdim=True)
    third = third / third.norm(dim=-1, keepdim=True)
    matrix = torch.stack([first, torch.linalg.cross(third, first), third], dim=-1)
    return quaternion.from_matrix(matrix)


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
    ):
        """
        Args:
            reader: The episodes, in order.
            decisions: Unit of each quantity on disk, by role.
            joint_names: Joints wanted, all of the dataset; None: all as they come.

        Raises:
            DatasetError: A joint wanted is not of the dataset.
        """
        self._reader = reader
        self._decisions = dict(decisions)
        names = reader.column_mapping.joint_names if joint_names is None else joint_names
        joint_columns(reader.column_mapping.joint_names, names)
        self.joint_names = tuple(names)
        guesses = (decision.note for decision in decisions.values() if decision.note)
        self.notes = (*reader.notes, *guesses)
        if reader.extracted is not None:
            wanted = [entry.index for entry in reader.entries]
            self.notes += tuple(missing_note(reader.extracted, wanted))
        self.source = str(reader.folder.root)

    @overload
    def __getitem__(self, index: int) -> Demonstration: ...
    @overload
    def __getitem__(self, index: slice) -> "DemonstrationSource": ...
    def __getitem__(self, index):
        if isinstance(index, slice):
            return self._of(self._reader.entries[index])
        (episode,) = self._reader.read([self._reader.entries[index]])
        return self.convert(episode)

    def spread(self, most: int) -> "DemonstrationSource":
        """Some of them, `most` at most, evenly over the sequence and still unread."""
        entries = self._reader.entries
        places = np.linspace(0, len(entries) - 1, min(len(entries), most)).astype(int)
        return self._of(entries[place] for place in places.tolist())

    def _of(self, entries: Iterable[EpisodeEntry]) -> "DemonstrationSource":
        reader = replace(self._reader, entries=tuple(entries))
        return DemonstrationSource(reader, self._decisions, self.joint_names)

    def __len__(self) -> int:
        return len(self._reader.entries)

    def __iter__(self) -> Iterator[Demonstration]:
        for run in disk_runs(self._reader.entries):
            yield from map(self.convert, self._reader.read(run))

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

    def convert(self, episode: RawEpisode) -> Demonstration:
        """The demonstration of an episode that its reader has read."""
        reader = self._reader
        demo = to_demonstration(reader.folder, episode, reader.column_mapping, self._decisions)
        if reader.extracted is not None:
            demo = with_feature(demo, reader.extracted, if_known=True)
        return demo.select_joints(self.joint_names)


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
    raw = {e.entry.index: e for e in reader.read(tuple(dict.fromkeys(reader.entries)))}
    decisions = reader.decide_units(raw.values(), units or {})
    source = DemonstrationSource(reader, decisions, joint_names)
    demos = [source.convert(raw[entry.index]) for entry in reader.entries]
    _warn_of_conversions(reader.folder.root, decisions)
    return DemonstrationSet(demos, notes=source.notes, source=source.source)


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
    if joint_names is not None:  # before anything long is read
        joint_columns(reader.column_mapping.joint_names, joint_names)
    decisions = reader.survey(units or {})
    _warn_of_conversions(reader.folder.root, decisions)
    return DemonstrationSource(reader, decisions, joint_names)


def _warn_of_conversions(root: Path, decisions: Mapping[str, UnitDecision]) -> None:
    for decision in decisions.values():
        if decision.converts:
            warnings.warn(f"{root}: {decision.note}", UnitsWarning, stacklevel=3)


# What the columns of a dataset mean, kept with it when it is first learned from.

_CONTRACT_EPISODES = 200
"""Episodes that a contract is inferred from: more say the same, and take longer."""


def keep_first_contract(path: str | Path, units: Mapping[str, str] | None = None) -> str:
    """Keep beside a dataset what its columns mean, where nobody has said it yet.

    What reads the dataset later then takes them for the same, whatever is added, and says that
    it changed. Datasets that declare their columns, as those of `DatasetWriter`, need none.

    Args:
        path: The dataset's folder.
        units: Units on disk by role, as in `load_demos`.

    Returns:
        What was kept, or why nothing, in words; empty where there is nothing to keep.

    Raises:
        DatasetError: The metadata are missing or damaged.
    """
    reader = open_reader(path, None, None, None, None)
    folder, sidecar = reader.folder, reader.sidecar
    if sidecar.contract or sidecar.columns:
        return ""
    profiles = []
    try:
        decisions = reader.survey(units or {})
        for entry in reader.sample(_CONTRACT_EPISODES):
            (episode,) = reader.read([entry])
            profiles.append(
                EpisodeProfile(
                    index=entry.index,
                    length=entry.length,
                    columns=profile_columns(episode.frames),
                    tracking=track_quantities(episode.quantities, folder.fps),
                )
            )
    except DatasetError as error:
        return f"no contract of the columns is kept: {error}"
    contract = infer_contract(folder, reader.column_mapping, decisions, profiles)
    kept = map_columns(folder.features, sidecar, kept=contract.selections(folder.features))
    if not _alike(kept, reader.column_mapping):
        return ""  # such as components in an order that a contract cannot say
    try:
        keep_contract(folder.root, contract)
    except OSError as error:
        return f"no contract of the columns is kept: {error.strerror or error}"
    return f"what the columns mean is kept in {folder.root / SIDECAR_PATH}: edit it there"


def _alike(one: ColumnMapping, other: ColumnMapping) -> bool:
    """Whether two mappings read the same numbers under the same names."""

    def read(mapping: ColumnMapping) -> tuple:
        columns = {role: s.columns for role, s in mapping.selections.items()}
        return columns, mapping.joint_names, {*mapping.extra}

    return read(one) == read(other)
