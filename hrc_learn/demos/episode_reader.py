"""Episodes of a dataset whose columns are known for what they mean."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .choosing import EpisodeFilter, OpenDataset, choose_episodes, locate
from .counts import count_faults
from .explicit_mapping import MappingSpec
from .finding import DatasetError
from .frames import RawFrames, read_frames
from .image_features.attaching import only_feature
from .image_features.cache import FeatureCache
from .layout import DatasetFolder, EpisodeEntry, open_folder
from .matching import Matching, match_columns
from .quantities import Quantities, frame_step, select_quantities
from .sidecar import Sidecar, read_sidecar
from .units import UnitDecision, decide_units, guessed_from_values, unit_factor


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
    matching: Matching
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
        selections, extra = self.matching.selections, self.matching.extra
        if roles is not None:
            selections, extra = {role: selections[role] for role in roles}, ()
        keys = {key for s in selections.values() for key, _ in s.columns} | {*extra}
        for entry, frames in read_frames(
            self.folder, sorted(entries, key=_place), sorted(keys)
        ):
            if not entry.length:
                raise DatasetError("has no frames", file=entry.file, episode=entry.index)
            quantities = select_quantities(frames, selections)
            _refuse_non_finite(entry, quantities, self.matching)
            yield RawEpisode(entry=entry, frames=frames, quantities=quantities)

    @property
    def notes(self) -> list[str]:
        """What had to be guessed, or comes from elsewhere."""
        if self.extracted is None:
            return [*self.matching.notes]
        beside = f"feature: {self.extracted.name}, as it was extracted from the videos"
        return [*self.matching.notes, beside]

    def decide_units(
        self, episodes: Iterable[RawEpisode], given: Mapping[str, str]
    ) -> dict[str, UnitDecision]:
        """The unit of every quantity, from the values of these episodes where not declared.

        Raises:
            DatasetError: A unit is unknown, or does not fit its quantity.
        """
        largest = dict.fromkeys(self.matching.selections, 0.0)
        steps = []
        for episode in episodes:
            for role, values in episode.quantities.items():
                largest[role] = max(largest[role], float(np.abs(values).max()))
            if not steps:
                steps.append(frame_step(episode.quantities.get("time"), self.folder.fps))
        return decide_units(largest, self.sidecar.units, given, *steps)

    def survey(self, given: Mapping[str, str]) -> dict[str, UnitDecision]:
        """The same from a pass of its own over those columns whose unit must be guessed.

        Raises:
            DatasetError: As in `read` and `decide_units`.
        """
        for role, unit in given.items():  # before anything long is read
            unit_factor(role, unit)
        stated = {*self.sidecar.units, *given}
        roles = {*guessed_from_values(self.matching.selections, stated)}
        entries = self.entries if roles else self.entries[:1]
        if "time" in self.matching.selections and "time" not in stated:
            roles.add("time")
        episodes = self.read(tuple(dict.fromkeys(entries)), roles) if roles else ()
        return self.decide_units(episodes, given)


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
    matching = match_columns(folder.features, sidecar, mapping)
    has_own = "feature" in matching.selections or "feature" in (mapping or {})
    return EpisodeReader(
        folder=folder,
        sidecar=sidecar,
        matching=matching,
        extracted=None if has_own else only_feature(folder.root),
        entries=choose_episodes(folder, episodes, tasks, where),
    )


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
