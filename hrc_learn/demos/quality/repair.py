"""Repaired and curated copies of a dataset, and the decisions kept next to it."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from hrc_learn.demos.issues import DatasetError, counted
from hrc_learn.demos.quality import column_rewriter as copying
from hrc_learn.demos.quality import episode_edits as edits
from hrc_learn.demos.read.columns import MappingSpec
from hrc_learn.demos.read.dataset_folder import EpisodeEntry, Progress, open_folder
from hrc_learn.demos.read.frames import RawFrames, read_each, recorded_stamps, select_quantities
from hrc_learn.demos.read.source import OpenedDataset
from hrc_learn.demos.read.units import Quantities
from hrc_learn.demos.videos import read_segments, video_keys
from hrc_learn.store import Count, read_json, write_json

_STAMP_TOLERANCE = 1e-3
"""Deviation from a regular clock that is kept [s]: above the rounding of float32 stamps."""


@dataclass(frozen=True, kw_only=True)
class RepairOptions:
    """Changes that a repair may make in the copy."""

    trim: bool = True
    """Trim the rest before and after the motion to 0.1 s."""
    drop_late: bool = True
    """Drop frames that a column of true stamps has no later than the one before."""
    drop_repeats: bool = False
    """Drop frames that repeat the one before, commands included, for up to 0.1 s."""
    unwrap: bool = True
    """Remove jumps by whole turns from measured joints and angles of the arm."""
    fix_signs: bool = True
    """Choose the signs of quaternions such that they do not jump."""
    drop_bad_frames: bool = False
    """Drop frames with values that are not finite."""
    drop_bad_episodes: bool = False
    """Leave out episodes that cannot be read or repaired."""
    fps: float | int | None = None
    """Rate of a regular grid to resample to [1/s]; None keeps the frames."""
    videos: bool = True
    """Keep the videos. Resampling, and dropped frames in the middle, would need new ones."""
    dry_run: bool = False
    """Report the changes without writing anything."""

    def __post_init__(self) -> None:
        if self.fps is not None and not self.fps > 0:
            raise ValueError(f"fps must be positive, got {self.fps}")


@dataclass(kw_only=True)
class RepairReport:
    """Changes made to each episode."""

    path: Path = Path()
    """The new dataset."""
    changes: dict[int, tuple[str, ...]] = field(default_factory=dict)
    """Index of a kept episode in the old dataset -> its changes."""
    left_out: dict[int, str] = field(default_factory=dict)
    """Index of an episode that was left out -> the reason."""
    notes: list[str] = field(default_factory=list)
    """Changes to the whole dataset."""
    frames_before: int = 0
    """Number of frames of the old dataset."""
    frames: int = 0
    """Number of frames of the new dataset."""
    dry_run: bool = False
    """True if nothing was written."""

    @property
    def changed(self) -> int:
        """Number of episodes with changes."""
        return sum(map(bool, self.changes.values()))

    def __str__(self) -> str:
        lines = [*self.notes]
        for new, (old, changes) in enumerate(self.changes.items()):
            name = f"episode {old}" if new == old else f"episode {old} (now {new})"
            lines.append(f"{name}: {'; '.join(changes) or 'unchanged'}")
        lines += [f"episode {old}: left out: {why}" for old, why in self.left_out.items()]
        lines.append(
            f"{self.path}{' (nothing written)' * self.dry_run}: "
            f"{counted(len(self.changes), 'episode')}, {self.frames} of "
            f"{counted(self.frames_before, 'frame')}, {self.changed} changed, "
            f"{len(self.left_out)} left out"
        )
        return "\n".join(lines)


def repair_dataset(
    path: str | Path,
    out: str | Path,
    options: RepairOptions | None = None,
    *,
    mapping: MappingSpec | None = None,
    units: Mapping[str, str] | None = None,
    progress: Progress | None = None,
    kept: Mapping[int, slice] | None = None,
) -> RepairReport:
    """Repair a dataset of version 2.0, 2.1 or 3.0 into a new one of version 3.0.

    The old dataset is not changed. Columns keep their keys, names and units. The new
    `timestamp` is frame / fps by definition. If LeRobot's old stamps differ from that, or
    frames may be dropped in the middle, and no column holds true stamps, `time` is added with
    the old ones.

    Args:
        path: The dataset to repair.
        out: Folder of the new dataset, which must not exist.
        options: Permitted changes.
        mapping: Columns of quantities that are not found by name, as in `load_demos`.
        units: Units on disk by role, as in `load_demos`; kept in the new dataset.
        progress: Wraps the episodes, such as with a progress bar.
        kept: Episode index -> frames to keep, for the episodes to keep; None keeps all.

    Raises:
        DatasetError: An episode cannot be read or repaired, and must not be left out.
        FileExistsError: `out` exists.
    """
    dataset = OpenedDataset.of(open_folder(path), mapping)
    if not dataset.folder.episodes:
        raise DatasetError("the dataset holds no episodes", file=dataset.folder.root)
    repair = _Repair(dataset, options or RepairOptions(), units or {}, kept)
    repair.report.path = Path(out)
    rewritten = repair.episodes(progress)
    if repair.options.dry_run:
        for _ in rewritten:
            pass
    else:
        root = dataset.folder.root
        copying.write_copy(Path(out), rewritten, repair.tasks, notes_of=root)
    return repair.report


class _Repair:
    """One repair: the old dataset, the permitted changes, and the report."""

    def __init__(
        self,
        dataset: OpenedDataset,
        options: RepairOptions,
        units: Mapping[str, str],
        kept: Mapping[int, slice] | None,
    ):
        self.dataset, self.folder, self.kept = dataset, dataset.folder, kept
        self.options, self.tasks = options, copying.listed_tasks(dataset.folder)
        self._regular = True
        """True if the increasing stamps of LeRobot are 1/fps apart in all episodes."""
        self.decisions, faults = dataset.units_from(self._readable(), units)
        self.faults = {fault.episode: fault for fault in faults}
        """Episodes that contradict the units of the others."""
        add_time = (
            "time" not in dataset.columns.selections
            and options.fps is None
            and (options.drop_bad_frames or options.drop_repeats or not self._regular)
        )
        segments = read_segments(self.folder) if options.videos else {}
        cameras = {key for shown in segments.values() for key in shown}
        header = copying.new_header(dataset, units, cameras, fps=options.fps, add_time=add_time)
        self.writer = copying.ColumnRewriter(self.folder, header, segments)
        self.report = RepairReport(notes=self._notes(header.features), dry_run=options.dry_run)

    def _notes(self, features: Collection[str]) -> list[str]:
        """Changes to the whole dataset."""
        missing = "declared, but no video of it is here; left out"
        reason = missing if self.options.videos else "videos left out"
        notes = [self.dataset.contract_note] if self.dataset.contract_note else []
        notes += [f"{key}: {reason}" for key in video_keys(self.folder) if key not in features]
        if self.tasks == [copying.NO_TASK]:
            notes.append(f"no task is listed: every episode shows {copying.NO_TASK!r} now")
        return notes

    def _readable(self) -> Iterator[tuple[EpisodeEntry, Quantities]]:
        """Quantities of the readable episodes; the others are reported when repaired."""
        for entry, frames in zip(self.folder.episodes, self._read(), strict=True):
            if not isinstance(frames, DatasetError):
                time = recorded_stamps(self.folder, frames)
                off = np.abs(time - time[0] - np.arange(len(time)) / self.folder.fps).max()
                if off > _STAMP_TOLERANCE and (np.diff(time) > 0).all():
                    self._regular = False
                yield entry, select_quantities(frames, self.dataset.columns.selections)

    def _read(self) -> Iterator[RawFrames | DatasetError]:
        """Numeric columns of every episode."""
        return read_each(self.folder, self.folder.episodes, self.folder.numbers)

    def episodes(self, progress: Progress | None) -> Iterator[copying.Rewritten]:
        """Repaired episodes; the report counts them, and those that are left out."""
        report = self.report
        entries = progress(self.folder.episodes) if progress else self.folder.episodes
        for entry, frames in zip(entries, self._read(), strict=True):
            report.frames_before += entry.length
            if self.kept is not None and entry.index not in self.kept:
                report.left_out[entry.index] = "not kept"
                continue
            try:
                rewritten = self.writer.rewritten(self._repaired(entry, frames))
            except DatasetError as error:
                if not self.options.drop_bad_episodes:
                    raise
                report.left_out[entry.index] = error.issue.message
                continue
            report.changes[entry.index] = rewritten.edit.changes
            report.frames += len(rewritten.edit)
            yield rewritten

    def _repaired(
        self, entry: EpisodeEntry, frames: RawFrames | DatasetError
    ) -> edits.EpisodeEdit:
        """Apply the permitted edits to one episode."""
        options = self.options
        if (fault := self.faults.get(entry.index)) is not None:
            raise fault
        if isinstance(frames, DatasetError):
            raise frames
        edit = edits.unedited(self.dataset, self.decisions, entry, frames)
        if self.kept is not None:
            part, wanted = self.kept[entry.index], np.zeros(entry.length, dtype=bool)
            wanted[part] = True
            edit = edit.only(wanted, f"cut to frames {part.start} to {part.stop}")
        edit = edits.renew_stamps(edit, self.folder.fps)
        edit = edits.drop_bad_frames(edit, options.drop_bad_frames)
        for name in ("drop_late", "trim", "drop_repeats", "unwrap", "fix_signs"):
            if getattr(options, name):
                edit = getattr(edits, name)(edit)
        stalled = np.flatnonzero(np.diff(edit.time) <= 0)
        if len(stalled):
            raise edit.fault(
                "stamps must increase; have late frames dropped (drop_late), or leave the "
                "episode out (drop_bad_episodes)",
                frame=int(stalled[0]) + 1,
            )
        return edit if options.fps is None else edits.resample_to_grid(edit, options.fps)


Verdict = Literal["accept", "cut", "reject"]


@dataclass(frozen=True, kw_only=True)
class Decision:
    """Decision on one episode."""

    verdict: Verdict
    length: Count
    """Number of frames of the episode."""
    start: Count = 0
    """First frame kept by a cut."""
    stop: Count = 0
    """End of the frames kept by a cut (exclusive)."""

    def __post_init__(self) -> None:
        is_cut = self.verdict == "cut"
        if min(self.start, self.stop) < 0 or (
            is_cut and not self.start < self.stop - 1 < self.length
        ):
            raise ValueError(
                f"frames {self.start} to {self.stop} are no part of two frames or more of an "
                f"episode of {self.length} frames"
            )


Decisions = dict[int, Decision]
"""Episode index -> decision; episodes without one are accepted."""


@dataclass(frozen=True, kw_only=True)
class _DecisionFile:
    decisions: dict[Count, Decision]
    format: Literal[1] = 1


def decisions_path(root: Path) -> Path:
    """File of the decisions on a dataset, next to it."""
    root = root.resolve()
    return root.with_name(f"{root.name}.curation.json")


def read_decisions(root: Path) -> Decisions:
    """Decisions kept for the episodes of a dataset.

    Raises:
        DatasetError: The file is damaged, or belongs to another dataset.
    """
    path, advice = decisions_path(root), "delete it to begin anew"
    if not path.is_file():
        return {}
    lengths = {entry.index: entry.length for entry in open_folder(root).episodes}
    try:
        kept = read_json(path, _DecisionFile, advice).decisions
    except ValueError as error:
        raise DatasetError(str(error).removeprefix(f"{path}: "), file=path) from error
    for index, known in kept.items():
        if known.length != lengths.get(index):
            text = (
                f"decides on an episode of {known.length} frames, the dataset has "
                f"{lengths.get(index, 'no such episode')}: it belongs to another dataset; "
                f"{advice}"
            )
            raise DatasetError(text, file=path, episode=index)
    return kept


def keep_decisions(root: Path, decisions: Mapping[int, Decision]) -> None:
    """Write the decisions next to the dataset, which is not changed."""
    write_json(decisions_path(root), _DecisionFile(decisions=dict(decisions)))


def write_curated(
    path: str | Path,
    out: str | Path,
    decisions: Mapping[int, Decision],
    *,
    progress: Progress | None = None,
) -> RepairReport:
    """Write the accepted and cut episodes into a new dataset of version 3.0.

    Values stay as they are. Videos are copied, and cut by their times in the list of episodes.
    The old dataset is not changed.

    Args:
        path: The dataset.
        out: Folder of the new dataset, which must not exist.
        decisions: Decisions by episode; episodes without one are accepted.
        progress: Wraps the episodes, as in `repair_dataset`.

    Raises:
        DatasetError: No episode is left, or an accepted one cannot be read.
        FileExistsError: `out` exists.
    """
    kept = {entry.index: slice(0, entry.length) for entry in open_folder(path).episodes}
    for index, decision in decisions.items():
        if index not in kept:
            raise DatasetError("there is no such episode", file=path, episode=index)
        if decision.verdict == "cut":
            kept[index] = slice(decision.start, decision.stop)
        elif decision.verdict == "reject":
            del kept[index]
    if not kept:
        raise DatasetError("every episode is rejected: nothing is left to write", file=path)
    options = RepairOptions(trim=False, drop_late=False, unwrap=False, fix_signs=False)
    return repair_dataset(path, out, options, progress=progress, kept=kept)
