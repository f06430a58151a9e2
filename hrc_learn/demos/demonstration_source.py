"""Demonstrations that stay on disk until they are asked for."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby, pairwise
from typing import overload

from .conversion import to_demonstration
from .demonstration import Demonstration
from .demonstration_set import DemonstrationSet
from .episode_reader import EpisodeReader, RawEpisode
from .image_features.attaching import with_feature
from .layout import EpisodeEntry
from .units import UnitDecision


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
