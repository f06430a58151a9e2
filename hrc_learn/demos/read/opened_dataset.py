"""A dataset opened once: its metadata, the meaning of its columns, and its raw episodes."""

import contextlib
import warnings
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from hrc_learn.demos.format.dataset_files import INFO_PATH
from hrc_learn.demos.format.dataset_folder import DatasetFolder, EpisodeEntry, open_folder
from hrc_learn.demos.format.metadata import SIDECAR_PATH, Sidecar, read_sidecar
from hrc_learn.demos.issues import DatasetError, UnitsWarning
from hrc_learn.demos.read.columns import ColumnMapping, MappingSpec, map_columns
from hrc_learn.demos.read.contract import (
    Contract,
    contract_in,
    fingerprint,
    infer_contract,
    keep_contract,
)
from hrc_learn.demos.read.frames import RawFrames, read_frames, select_quantities
from hrc_learn.demos.read.profiles import profile_episode
from hrc_learn.demos.read.units import (
    Quantities,
    UnitDecision,
    guessed_from_values,
    unit_factor,
    units_from_episodes,
)

EpisodeFilter = Callable[[EpisodeEntry], bool]
"""True for an episode that is wanted, by its `index`, `length` and `tasks`."""

_SAMPLED_EPISODES = 32
"""Episodes that decide on units."""
_CONTRACT_EPISODES = 200
"""Episodes that a contract is inferred from; more change nothing and take longer."""


@dataclass(frozen=True, kw_only=True)
class RawEpisode:
    """One episode in the units on disk."""

    entry: EpisodeEntry
    frames: RawFrames
    quantities: Quantities


@dataclass(frozen=True, kw_only=True)
class OpenedDataset:
    """Metadata of a dataset and the meaning of its columns; no file stays open."""

    folder: DatasetFolder
    sidecar: Sidecar
    contract: Contract | None
    """Contract kept with the dataset."""
    columns: ColumnMapping
    own_feature: bool = False
    """True if the image feature is a column of the dataset, or left out by the caller."""

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
        contract = contract_in(sidecar)
        kept = None if contract is None else contract.selections(folder.features)
        columns = map_columns(folder.features, sidecar, mapping, kept)
        return cls(
            folder=folder,
            sidecar=sidecar,
            contract=contract,
            columns=columns,
            own_feature="feature" in columns.selections or "feature" in (mapping or {}),
        )

    @cached_property
    def contract_note(self) -> str | None:
        """Warning that the data changed since the contract was kept, or None."""
        if self.contract is None or self.contract.fingerprint == fingerprint(self.folder):
            return None
        return (
            f"the data changed since the contract in {SIDECAR_PATH} was kept: "
            f"hrc check --keep-contract renews it"
        )

    @cached_property
    def declared_units(self) -> Mapping[str, str | Sequence[str]]:
        """Units by role from the sidecar, or of each component from the contract."""
        known = {} if self.contract is None else self.contract.units(self.columns.selections)
        return {**self.sidecar.units, **known}

    def read(
        self, entries: Sequence[EpisodeEntry], roles: Iterable[str] | None = None
    ) -> Iterator[RawEpisode]:
        """Read episodes one after another, in the order they lie on disk.

        Args:
            entries: Episodes wanted, in any order, once each.
            roles: Quantities wanted; None for all, and all extra columns.

        Raises:
            DatasetError: An episode cannot be read, or holds values that are not finite.
        """
        selections, extra = self.columns.selections, self.columns.extra
        if roles is not None:
            selections, extra = {role: selections[role] for role in roles}, ()
        keys = {key for s in selections.values() for key, _ in s.columns} | {*extra}
        on_disk = sorted(entries, key=lambda entry: (entry.file, entry.start))
        for entry, frames in read_frames(self.folder, on_disk, sorted(keys)):
            quantities = select_quantities(frames, selections)
            self._require_finite(entry, quantities)
            yield RawEpisode(entry=entry, frames=frames, quantities=quantities)

    def _require_finite(self, entry: EpisodeEntry, quantities: Quantities) -> None:
        """Check all values; those of a feature that was not seen become 0."""
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
                raise entry.error(
                    f"{role} is {values[frame, component]} there; leave the episode out "
                    f"(episodes=[...]) or repair the recording",
                    frame=frame,
                    key=self.columns.selections[role].column_name(component),
                )

    def sample(self, most: int) -> Sequence[EpisodeEntry]:
        """Subset of `most` episodes, spread evenly over the dataset."""
        every = self.folder.episodes
        places = np.linspace(0, len(every) - 1, min(len(every), most))
        return [every[int(place)] for place in places]

    def decide_units(
        self,
        episodes: Iterable[RawEpisode],
        given: Mapping[str, str],
        wanted: Collection[EpisodeEntry],
    ) -> dict[str, UnitDecision]:
        """Unit of every quantity.

        Undeclared units are guessed from a sample of the dataset, so that the guess does not
        depend on the episodes that are loaded.

        Args:
            episodes: Episodes already read; the rest of the sample is read here.
            given: Units from the caller.
            wanted: Episodes that must not contradict the decision.

        Raises:
            DatasetError: A unit is unknown or does not fit its quantity, or an episode is in
                another unit than the rest.
        """
        selections, read = self.columns.selections, set()
        sample = self.sample(_SAMPLED_EPISODES)

        def all_episodes() -> Iterator[tuple[EpisodeEntry, Quantities]]:
            for episode in episodes:
                read.add(episode.entry.index)
                yield episode.entry, episode.quantities
            roles = guessed_from_values(selections, {*self.declared_units, *given})
            for entry in sample if roles else ():
                if entry.index not in read:
                    # Its faults are raised when the episode itself is read.
                    with contextlib.suppress(DatasetError):
                        for episode in self.read([entry], roles):
                            yield entry, episode.quantities

        decisions, faults = units_from_episodes(
            selections,
            all_episodes(),
            self.folder.fps,
            self.declared_units,
            given,
            {entry.index for entry in sample},
        )
        indices = {entry.index for entry in wanted}
        for fault in faults:
            if fault.episode in indices:
                raise fault
        return decisions

    def survey_units(
        self, entries: Sequence[EpisodeEntry], given: Mapping[str, str]
    ) -> dict[str, UnitDecision]:
        """Unit of every quantity, by a pass over the columns whose unit must be guessed.

        Raises:
            DatasetError: As in `read` and `decide_units`.
        """
        for role, unit in given.items():  # before any long read
            unit_factor(role, unit)
        stated = {*self.declared_units, *given}
        roles = {*guessed_from_values(self.columns.selections, stated)}
        read = entries if roles else entries[:1]
        if "time" in self.columns.selections and "time" not in stated:
            roles.add("time")
        episodes = self.read(tuple(dict.fromkeys(read)), roles) if roles else ()
        return self.decide_units(episodes, given, entries)

    def keep_first_contract(
        self, units: Mapping[str, str] | None = None
    ) -> tuple["OpenedDataset", str]:
        """Keep the inferred contract with a dataset that declares nothing itself.

        Later readers then interpret the dataset in the same way, whatever is added, and report
        changes. A dataset with a contract, or one of `DatasetWriter`, needs none. The contract
        never changes what is read: otherwise it is not kept.

        Args:
            units: Units on disk by role, as in `load_demos`.

        Returns:
            The dataset with its contract, and a note for the user, empty if nothing was kept.
        """
        if self.contract is not None or self.sidecar.columns:
            return self, ""
        folder = self.folder
        try:
            decisions = self.survey_units(folder.episodes, units or {})
            profiles = [
                profile_episode(
                    episode.entry.index, episode.frames, episode.quantities, folder.fps
                )
                for episode in self.read(self.sample(_CONTRACT_EPISODES))
            ]
        except DatasetError as error:
            return self, f"no contract of the columns is kept: {error}"
        contract = infer_contract(folder, self.columns, decisions, profiles)
        columns = map_columns(
            folder.features, self.sidecar, kept=contract.selections(folder.features)
        )
        if not columns.reads_like(self.columns):
            return self, ""  # such as an order of components that a contract cannot express
        try:
            keep_contract(folder.root, contract)
        except OSError as error:
            return self, f"no contract of the columns is kept: {error.strerror or error}"
        note = (
            f"the meaning of the columns is kept in {folder.root / SIDECAR_PATH}: edit it there"
        )
        sidecar = replace(self.sidecar, contract=contract.content())
        return replace(self, sidecar=sidecar, contract=contract, columns=columns), note


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


def count_faults(folder: DatasetFolder) -> Iterator[DatasetError]:
    """Contradictions between the counts of episodes and frames in the metadata."""
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
            yield entry.error("has no frames")


def select_episodes(
    folder: DatasetFolder,
    episodes: Sequence[int] | None = None,
    tasks: str | Sequence[str] | None = None,
    where: EpisodeFilter | None = None,
) -> tuple[EpisodeEntry, ...]:
    """Episodes wanted, in the order wanted.

    Args:
        folder: The dataset.
        episodes: Indices of the episodes; None for all, in their order.
        tasks: Select episodes of one of these tasks.
        where: Select episodes for which this is true.

    Raises:
        DatasetError: An episode or task does not exist, or no episode is left.
    """
    chosen = _by_index(folder, episodes)
    if tasks is not None:
        wanted = {tasks} if isinstance(tasks, str) else set(tasks)
        _require_tasks(folder, wanted)
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
    if wanted is None:
        return [*by_index.values()]
    if not len(wanted):
        raise DatasetError("no episode was asked for; None reads all", file=folder.root)
    for index in wanted:
        if index not in by_index:
            raise DatasetError(
                f"there is no such episode; the dataset has {min(by_index)} to {max(by_index)}",
                file=folder.root,
                episode=index,
            )
    return [by_index[index] for index in wanted]


def _require_tasks(folder: DatasetFolder, wanted: set[str]) -> None:
    known = {task for entry in folder.episodes for task in entry.tasks}
    unknown = sorted(wanted - known)
    if unknown:
        raise DatasetError(
            f"no episode shows the task {unknown[0]!r}; the list of episodes has "
            f"{', '.join(map(repr, sorted(known))) or 'none'}",
            file=folder.root,
        )


def warn_of_conversions(root: Path, decisions: Mapping[str, UnitDecision]) -> None:
    """Raise a `UnitsWarning` for each guess that changes values."""
    for decision in decisions.values():
        if decision.converts:
            warnings.warn(f"{root}: {decision.note}", UnitsWarning, stacklevel=3)
