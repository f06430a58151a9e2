"""Episodes of a dataset whose columns are known: which are chosen, and their quantities
in the units on disk.
"""

import contextlib
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from hrc_learn.demos.format.dataset_folder import DatasetFolder, EpisodeEntry, open_folder
from hrc_learn.demos.format.metadata import INFO_PATH, Sidecar, read_sidecar
from hrc_learn.demos.image_features import FeatureCache, only_feature
from hrc_learn.demos.issue import DatasetError
from hrc_learn.demos.read.column_mapping import (
    ColumnMapping,
    ColumnSelection,
    MappingSpec,
    map_columns,
)
from hrc_learn.demos.read.contract import changed_since, contract_of
from hrc_learn.demos.read.frames import RawFrames, read_frames
from hrc_learn.demos.read.roles import (
    ORIENTATION_ROLES,
    UnitDecision,
    decide_units,
    guessed_from_values,
    is_hand,
    unit_factor,
)

# Episodes and frames counted in several places, which must agree.


def count_faults(folder: DatasetFolder) -> Iterator[DatasetError]:
    """What the metadata contradict each other in."""
    entries, info = folder.episodes, folder.info
    if not entries:
        yield DatasetError("the dataset holds no episodes", file=folder.root)
    for name, counted in (
        ("total_episodes", len(entries)),
        ("total_frames", sum(entry.length for entry in entries)),
    ):
        if info.get(name, counted) != counted:
            yield DatasetError(
                f"says {info[name]}, but the list of episodes counts {counted}: episodes were "
                f"lost, or the file belongs to another copy; hrc repair counts anew",
                file=INFO_PATH,
                key=name,
            )
    repeated = [index for index, n in Counter(e.index for e in entries).items() if n > 1]
    for index in repeated:
        yield DatasetError("is listed more than once", file="meta/episodes", episode=index)
    missing = sorted(set(range(len(entries))) - {entry.index for entry in entries})
    if missing and not repeated:
        yield DatasetError(
            "is missing from the list of episodes: indices must count from 0 without a gap",
            file="meta/episodes",
            episode=missing[0],
        )
    for entry in entries:
        if entry.length <= 0:
            yield DatasetError("has no frames", **entry.location)


_SAMPLED_EPISODES = 32
"""Episodes that decide on units."""

# Quantities picked out of raw columns, still in the units they have on disk.

Quantities = dict[str, Float64[np.ndarray, "_frames _components"]]
"""Role -> values during one episode."""


def select_quantities(
    frames: RawFrames, selections: Mapping[str, ColumnSelection]
) -> Quantities:
    """Values of every role, as float64."""
    return {role: _columns(frames, selection.columns) for role, selection in selections.items()}


Peaks = dict[str, Float64[np.ndarray, "_components"]]
"""Role -> size that the values of each component reach in one episode."""

# More frames of an episode tell no more about its size.
_SAMPLED_FRAMES = 1000


def usual_peaks(quantities: Quantities, roles: Sequence[str]) -> Peaks:
    """What the values of these roles reach in one episode, but for half a percent of them."""
    peaks: Peaks = {}
    for role in roles:
        values = quantities[role]
        sizes = np.abs(values[:: 1 + len(values) // _SAMPLED_FRAMES])
        sizes[~np.isfinite(sizes)] = 0.0
        if len(sizes):
            place = int(0.995 * (len(sizes) - 1))
            peaks[role] = np.partition(sizes, place, axis=0)[place]
    return peaks


def units_on_disk(
    selections: Mapping[str, ColumnSelection],
    episodes: Iterable[tuple[EpisodeEntry, Quantities]],
    fps: float,
    declared: Mapping[str, str | Sequence[str]],
    given: Mapping[str, str],
    sample: Collection[int] | None = None,
) -> tuple[dict[str, UnitDecision], list[DatasetError]]:
    """The unit of each of these quantities, from what their values usually reach.

    The size of a component is the median over episodes of what it reaches in each, so that no
    frame and no episode decides alone.

    Args:
        selections: Columns of the quantities.
        episodes: Episodes, in the units on disk.
        fps: Frame rate [1/s].
        declared: Units by the sidecar, as in `decide_units`.
        given: Units by the caller, which win.
        sample: Episodes that decide; None: all.

    Returns:
        The decisions, and what episodes and columns contradict them.

    Raises:
        DatasetError: A unit is unknown, or does not fit its quantity.
    """
    guessed = guessed_from_values(selections, {*declared, *given})
    steps: list[float] = []
    peaks: list[tuple[EpisodeEntry, Peaks]] = []
    for entry, quantities in episodes:
        peaks.append((entry, usual_peaks(quantities, [r for r in guessed if r in quantities])))
        time = quantities.get("time", np.empty((0, 1)))
        if len(time) > 1:
            # The usual one as a multiple of the nominal period.
            steps.append(float(np.nanmedian(np.diff(time[:, 0]))) * fps)
    usual: dict[str, float | Sequence[float]] = dict.fromkeys(selections, 0.0)
    deciding = [p for entry, p in peaks if sample is None or entry.index in sample] or [
        p for _, p in peaks
    ]
    for role in guessed:
        known = [p[role] for p in deciding if role in p]
        if known:
            usual[role] = np.median(known, axis=0).tolist()
    hands = {
        role: [is_hand(label) for label in selection.labels]
        for role, selection in selections.items()
    }
    step = float(np.median(steps)) if steps else 1.0
    decisions = decide_units(usual, declared, given, step, hands)
    faults = [
        fault
        for role in guessed
        if isinstance(usual[role], list)
        for fault in _unit_faults(selections[role], usual[role], decisions[role], peaks)
    ]
    return decisions, faults


_DEGREES = math.log(180 / math.pi)
_NEAR = math.log(2.5)
"""How far sizes may be from a factor of 57.3 and still speak for degrees."""


def _unit_faults(
    selection: ColumnSelection,
    usual: float | Sequence[float],
    decision: UnitDecision,
    peaks: Sequence[tuple[EpisodeEntry, Peaks]],
) -> Iterator[DatasetError]:
    """Episodes that are 57.3 times as large or small as the others, as degrees are."""
    role, size = selection.role, np.asarray(usual)
    if role not in ("joint_position", "command_position", *ORIENTATION_ROLES):
        return
    # What hardly moves has no size to compare; a share is none of an angle.
    telling = (size > 1e-2) & (np.array([decision.unit_of(i) for i in range(len(size))]) != "1")
    if not telling.any():
        return
    known = [(entry, p[role]) for entry, p in peaks if role in p and len(p[role]) == len(size)]
    if not known:
        return
    reached = np.stack([own[telling] for _, own in known])
    ratios = np.median(np.log(np.maximum(reached, 1e-9) / size[telling]), axis=1)
    for (entry, _), ratio in zip(known, ratios.tolist(), strict=True):
        if abs(abs(ratio) - _DEGREES) < _NEAR:
            seems = "deg" if ratio > 0 else "rad"
            key, index = selection.columns[int(np.flatnonzero(telling)[0])]
            yield DatasetError(
                f"{role} is about {math.exp(abs(ratio)):.0f} times as "
                f"{'large' if seems == 'deg' else 'small'} as in the other episodes: {seems} "
                f"among {decision.unit}? Leave the episode out, or record it again",
                **entry.location,
                key=f"{key} ({selection.labels[selection.columns.index((key, index))]})",
            )


def _columns(
    frames: RawFrames, columns: Sequence[tuple[str, int]]
) -> Float64[np.ndarray, "frames components"]:
    keys = {key for key, _ in columns}
    if len(keys) > 1:
        return np.stack([frames[key][:, index] for key, index in columns], axis=1).astype(float)
    values, indices = frames[keys.pop()], [index for _, index in columns]
    if indices == list(range(indices[0], indices[-1] + 1)):  # a view: converted in one go
        return values[:, indices[0] : indices[-1] + 1].astype(float)
    return values[:, indices].astype(float)


# Which episodes of which dataset are meant.

EpisodeFilter = Callable[[EpisodeEntry], bool]
"""Says of an episode, by its `index`, `length` and `tasks`, whether it is wanted."""


@runtime_checkable
class OpenDataset(Protocol):
    """An open `LeRobotDataset`, as far as it is needed: its folder and its chosen episodes."""

    root: Path
    episodes: list[int] | None


def locate(
    dataset: str | Path | OpenDataset, episodes: Sequence[int] | None
) -> tuple[Path, Sequence[int] | None]:
    """Folder of a dataset, and the episodes wanted of it.

    Args:
        dataset: A folder, or an open `LeRobotDataset`.
        episodes: Episodes wanted; None: all, or all that the open dataset was opened with.
    """
    if isinstance(dataset, str | Path):
        return Path(dataset), episodes
    return Path(dataset.root), dataset.episodes if episodes is None else episodes


def select_episodes(
    folder: DatasetFolder,
    episodes: Sequence[int] | None = None,
    tasks: str | Sequence[str] | None = None,
    where: EpisodeFilter | None = None,
) -> tuple[EpisodeEntry, ...]:
    """The episodes wanted, in the order wanted.

    Args:
        folder: The dataset.
        episodes: Their indices; None: all, as they come.
        tasks: Only those that show one of these tasks.
        where: Only those of which this is true.

    Raises:
        DatasetError: One does not exist, or none is left.
    """
    chosen = _by_index(folder, episodes)
    if tasks is not None:
        wanted = {tasks} if isinstance(tasks, str) else set(tasks)
        _refuse_unknown_tasks(folder, wanted)
        chosen = [entry for entry in chosen if wanted & set(entry.tasks)]
    if where is not None:
        chosen = [entry for entry in chosen if where(entry)]
    if not chosen:
        raise DatasetError("no episode is left by the filters given", file=folder.root)
    return tuple(chosen)


def _by_index(folder: DatasetFolder, wanted: Sequence[int] | None) -> list[EpisodeEntry]:
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


def _refuse_unknown_tasks(folder: DatasetFolder, wanted: set[str]) -> None:
    known = {task for entry in folder.episodes for task in entry.tasks}
    unknown = sorted(wanted - known)
    if unknown:
        raise DatasetError(
            f"no episode shows the task {unknown[0]!r}; the list of episodes has "
            f"{', '.join(map(repr, sorted(known))) or 'none'}",
            file=folder.root,
        )


# Episodes of a dataset whose columns are known for what they mean.


@dataclass(frozen=True, kw_only=True)
class RawEpisode:
    """One episode in the units on disk."""

    entry: EpisodeEntry
    frames: RawFrames
    quantities: Quantities


@dataclass(frozen=True, kw_only=True)
class EpisodeReader:
    """The chosen episodes of a dataset, and how to read them."""

    folder: DatasetFolder
    sidecar: Sidecar
    column_mapping: ColumnMapping
    entries: tuple[EpisodeEntry, ...]
    extracted: FeatureCache | None = None
    """Image feature kept beside the dataset, where it has none itself."""

    def read(
        self, entries: Sequence[EpisodeEntry], roles: Iterable[str] | None = None
    ) -> Iterator[RawEpisode]:
        """Read episodes one after another, in the order they lie on disk.

        Args:
            entries: Episodes wanted, in any order, once each.
            roles: Quantities wanted; None: all, and what else is recorded.

        Raises:
            DatasetError: They cannot be read, or hold values that are not finite.
        """
        selections, extra = self.column_mapping.selections, self.column_mapping.extra
        if roles is not None:
            selections, extra = {role: selections[role] for role in roles}, ()
        keys = {key for s in selections.values() for key, _ in s.columns} | {*extra}
        for entry, frames in read_frames(
            self.folder, sorted(entries, key=_place), sorted(keys)
        ):
            quantities = select_quantities(frames, selections)
            _refuse_non_finite(entry, quantities, self.column_mapping)
            yield RawEpisode(entry=entry, frames=frames, quantities=quantities)

    @property
    def notes(self) -> list[str]:
        """What had to be guessed, or comes from elsewhere."""
        notes = [*self.column_mapping.notes]
        if (changed := changed_since(self.folder, contract_of(self.sidecar))) is not None:
            notes.append(changed)
        if self.extracted is not None:
            notes.append(f"feature: {self.extracted.name}, as it was extracted from the videos")
        return notes

    def decide_units(
        self, episodes: Iterable[RawEpisode], given: Mapping[str, str]
    ) -> dict[str, UnitDecision]:
        """The unit of every quantity, where not declared from the values of these episodes and
        of a sample of the dataset, the same whichever episodes are wanted.

        Raises:
            DatasetError: A unit is unknown, or does not fit its quantity, or an episode is in
                another one than the rest.
        """
        declared = self.declared_units
        selections, read = self.column_mapping.selections, set()

        def all_episodes() -> Iterator[tuple[EpisodeEntry, Quantities]]:
            for episode in episodes:
                read.add(episode.entry.index)
                yield episode.entry, episode.quantities
            roles = guessed_from_values(selections, {*declared, *given})
            for entry in self._sample if roles else ():
                if entry.index not in read:
                    # Its faults are told when it is asked for.
                    with contextlib.suppress(DatasetError):
                        for episode in self.read([entry], roles):
                            yield entry, episode.quantities

        decisions, faults = units_on_disk(
            selections,
            all_episodes(),
            self.folder.fps,
            declared,
            given,
            {entry.index for entry in self._sample},
        )
        wanted = {entry.index for entry in self.entries}
        for fault in faults:
            if fault.episode in wanted:
                raise fault
        return decisions

    @property
    def declared_units(self) -> Mapping[str, str | Sequence[str]]:
        """Units by role from the sidecar, of each component where a contract is kept."""
        return declared_units(self.sidecar, self.column_mapping.selections)

    @property
    def _sample(self) -> Sequence[EpisodeEntry]:
        """Episodes that decide on its units."""
        return self.sample(_SAMPLED_EPISODES)

    def sample(self, most: int) -> Sequence[EpisodeEntry]:
        """Episodes evenly over the dataset, `most` at most, whichever are wanted."""
        every = self.folder.episodes
        places = np.linspace(0, len(every) - 1, min(len(every), most))
        return [every[int(place)] for place in places]

    def survey(self, given: Mapping[str, str]) -> dict[str, UnitDecision]:
        """The same from a pass of its own over those columns whose unit must be guessed.

        Raises:
            DatasetError: As in `read` and `decide_units`.
        """
        for role, unit in given.items():  # before anything long is read
            unit_factor(role, unit)
        stated = {*self.declared_units, *given}
        roles = {*guessed_from_values(self.column_mapping.selections, stated)}
        entries = self.entries if roles else self.entries[:1]
        if "time" in self.column_mapping.selections and "time" not in stated:
            roles.add("time")
        episodes = self.read(tuple(dict.fromkeys(entries)), roles) if roles else ()
        return self.decide_units(episodes, given)


def declared_units(
    sidecar: Sidecar, selections: Mapping[str, ColumnSelection]
) -> dict[str, str | Sequence[str]]:
    """Units of these quantities by the sidecar, of each component where a contract is kept.

    Raises:
        DatasetError: The contract is damaged.
    """
    contract = contract_of(sidecar)
    return {**sidecar.units, **({} if contract is None else contract.units(selections))}


def read_mapping(
    folder: DatasetFolder, sidecar: Sidecar, mapping: MappingSpec | None
) -> ColumnMapping:
    """The quantities among the columns: the caller's, the contract's, or those found by name.

    Raises:
        DatasetError: The mapping or the contract name what does not exist, or the sidecar is
            damaged.
    """
    contract = contract_of(sidecar)
    kept = None if contract is None else contract.selections(folder.features)
    return map_columns(folder.features, sidecar, mapping, kept)


def open_reader(
    dataset: str | Path | OpenDataset,
    episodes: Sequence[int] | None,
    mapping: MappingSpec | None,
    tasks: str | Sequence[str] | None,
    where: EpisodeFilter | None,
) -> EpisodeReader:
    """Read the metadata and find the quantities; arguments as in `load_demos`.

    Raises:
        DatasetError: The metadata are missing or damaged, or no such episode exists.
    """
    root, episodes = locate(dataset, episodes)
    folder = open_folder(root)
    for fault in count_faults(folder):
        raise fault
    sidecar = read_sidecar(folder.root)
    column_mapping = read_mapping(folder, sidecar, mapping)
    has_own = "feature" in column_mapping.selections or "feature" in (mapping or {})
    return EpisodeReader(
        folder=folder,
        sidecar=sidecar,
        column_mapping=column_mapping,
        extracted=None if has_own else only_feature(folder.root),
        entries=select_episodes(folder, episodes, tasks, where),
    )


def _place(entry: EpisodeEntry) -> tuple[str, int]:
    return entry.file, entry.start


def _refuse_non_finite(
    entry: EpisodeEntry, quantities: Quantities, column_mapping: ColumnMapping
) -> None:
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
            selection = column_mapping.selections[role]
            raise DatasetError(
                f"{role} is {values[frame, component]} there; leave the episode out "
                f"(episodes=[...]) or repair the recording",
                **entry.location,
                frame=frame,
                key=f"{selection.columns[component][0]} ({selection.labels[component]})",
            )
