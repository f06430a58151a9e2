"""Repaired copies of datasets, even of datasets whose recorder (LeRobot's) was killed."""

import shutil
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import chain, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hrc_learn.demos.dataset_assembly import put
from hrc_learn.demos.issues import DatasetError, counted
from hrc_learn.demos.quality import column_rewriter as copying
from hrc_learn.demos.quality import episode_edits as edits
from hrc_learn.demos.quality.video_checks import read_stream
from hrc_learn.demos.read.columns import MappingSpec
from hrc_learn.demos.read.dataset_files import (
    INFO_PATH,
    finished_parquet,
    is_unfinished,
    open_parquet,
    read_rows,
    read_table,
    write_parquet,
)
from hrc_learn.demos.read.dataset_folder import (
    EpisodeEntry,
    Progress,
    episode_lists,
    open_folder,
    read_info,
)
from hrc_learn.demos.read.frames import RawFrames, read_each, recorded_stamps, select_quantities
from hrc_learn.demos.read.source import OpenedDataset
from hrc_learn.demos.read.units import Quantities, calibrations
from hrc_learn.demos.recorded_episode import to_table
from hrc_learn.demos.videos import read_segments, video_keys
from hrc_learn.store import write_json

_LISTS, _INDEX = "meta/episodes", ("episode_index",)
_STAMP_TOLERANCE = 1e-3
"""Deviation from a regular clock above which old stamps are kept [s]. It exceeds the rounding
errors of float32."""


@dataclass(frozen=True, kw_only=True)
class RepairOptions:
    """Changes that a repair may make in the copy."""

    trim: bool = True
    """Shorten the standstill before and after the motion to 0.1 s."""
    drop_late: bool = True
    """Drop frames whose measured time is not later than all earlier times."""
    drop_repeats: bool = False
    """Drop frames that repeat the previous one, commands included, for up to 0.1 s."""
    unwrap: bool = True
    """Remove jumps by whole turns from measured joints and angles of the arm."""
    fix_signs: bool = True
    """Choose the signs of quaternions such that they do not jump."""
    drop_bad_frames: bool = False
    """Drop frames with values that are not finite."""
    drop_bad_episodes: bool = False
    """Leave out episodes that cannot be read or repaired."""
    offsets: Mapping[str, float] = field(default_factory=dict)
    """Angles that are added to measured joint positions [deg], by joint."""
    fps: float | int | None = None
    """Rate of a regular grid to resample to [1/s]; None keeps the frames."""
    videos: bool = True
    """Keep the videos. Resampling, or dropping frames in the middle, needs new videos."""
    dry_run: bool = False
    """Report the changes without writing anything."""

    def __post_init__(self) -> None:
        if self.fps is not None and not 0 < self.fps < np.inf:
            raise ValueError(f"fps must be positive, got {self.fps}")
        if not np.isfinite([*self.offsets.values()]).all():
            raise ValueError(f"offsets must be finite angles, got {dict(self.offsets)}")


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
            f"{self.path}{' (nothing written)' * self.dry_run}: {len(self.changes)} episodes, "
            f"{self.frames} of {self.frames_before} frames, {self.changed} episodes changed, "
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

    The old dataset is not changed. If LeRobot's recorder was killed, the episodes that it had
    saved are recovered first. Columns keep their keys, names and units. The new
    `timestamp` is frame / fps by definition. If no column holds measured times (true stamps),
    the old stamps may be needed. They are added as `time` if they differ from frame / fps, or
    if frames may be dropped in the middle.

    Args:
        path: The dataset to repair.
        out: Folder of the new dataset, which must not exist.
        options: Permitted changes.
        mapping: Columns of quantities that are not found by name, as in `load_demos`.
        units: Units on disk by role, as in `load_demos`; kept in the new dataset. A calibration
            file is applied: the new dataset holds degrees.
        progress: Function that iterates over the episodes and shows the progress.
        kept: Episode index -> frames to keep; all other episodes are left out. None keeps all.

    Raises:
        DatasetError: An episode cannot be read or repaired, and may not be left out.
        FileExistsError: `out` exists.
    """
    with _finished(Path(path)) as (root, notes):
        dataset = OpenedDataset.of(open_folder(root), mapping)
        if not dataset.folder.episodes:
            raise DatasetError("the dataset holds no episodes", file=dataset.folder.root)
        repair = _Repair(dataset, options or RepairOptions(), units or {}, kept)
        repair.report.path = Path(out)
        repair.report.notes[:0] = notes
        repair.finished = bool(notes)
        rewritten = repair.episodes(progress)
        if repair.options.dry_run:
            for _ in rewritten:
                pass
        else:
            copying.write_copy(Path(out), rewritten, repair.tasks, notes_of=root)
        return repair.report


@contextmanager
def _finished(root: Path) -> Iterator[tuple[Path, list[str]]]:
    """Folder of the dataset, or of a readable copy if its recorder was killed; and notes."""
    if not (unfinished := unfinished_files(root)):
        yield root, []
        return
    with TemporaryDirectory(dir=root.parent, prefix=f".{root.name}.finished_") as copy:
        lost, files = finish_recording(root, Path(copy)), ", ".join(unfinished)
        yield Path(copy), [f"the recorder ended early: {files}; episodes lost: {lost}"]


def unfinished_files(root: Path) -> list[str]:
    """Files that LeRobot's recorder (version 3.0) left unfinished when it was killed or failed.

    The recorder writes the rows of an episode when it saves the episode, but the footers of its
    files and the list of episodes only when it ends. If saving an episode fails, the episode
    has rows, but no entry in the list.
    """
    data, lists = (sorted(root.glob(f"{part}/*/file-*.parquet")) for part in ("data", _LISTS))
    files = [str(path.relative_to(root)) for path in (*data, *lists) if is_unfinished(path)]
    names = [f"{file} was not closed" for file in files]
    if data and not lists:
        names.append(f"{_LISTS} is missing")
    if not names and data:
        rows = [read_rows(root, file, ("length",), ()) for file in episode_lists(root)]
        known = [row["length"] for row in chain(*rows)]
        # The columns of an intact recording need not be read.
        if sum(pq.read_metadata(path).num_rows for path in data) > sum(known):
            takes = [end - begin for path in data for _, begin, end in _takes(root, path)]
            if (extra := len(takes) - len(known)) > 0 and not Counter(known) - Counter(takes):
                names.append(f"data/ holds {counted(extra, 'episode')} whose save failed")
    return names


def _takes(root: Path, path: Path) -> list[tuple[int, int, int]]:
    """Index, first row and end row (exclusive) of each episode in a file.

    After a failed save, the recorder gives the next episode the same index.
    """
    file = str(path.relative_to(root))
    table = read_table(open_parquet(root, file), file, ["episode_index", "frame_index"])
    episode, frame = (column.to_numpy() for column in table.columns)
    starts = np.flatnonzero((frame == 0) | (np.diff(episode, prepend=-1) != 0))
    return [(int(episode[a]), a, b) for a, b in pairwise([*starts.tolist(), len(frame)])]


def finish_recording(root: Path, target: Path) -> int:
    """Copy an unfinished recording into an empty folder such that it can be read there.

    Complete files are linked. If several episodes have the same index, the last one counts.

    Returns:
        Number of episodes that `meta/info.json` counts, but that are lost.

    Raises:
        DatasetError: No saved episode is complete, or the metadata are damaged.
    """
    info, rows, frames = read_info(root), [], 0
    features = {k: f for k, f in info["features"].items() if f["dtype"] != "video"}
    shutil.copytree(root, target, copy_function=put, dirs_exist_ok=True)
    for file in (file for file in episode_lists(root) if is_unfinished(root / file)):
        (target / file).unlink()
    known = [row for file in episode_lists(target) for row in read_rows(target, file, _INDEX)]
    listed, takes = {row["episode_index"] for row in known}, {}
    for path in sorted(target.glob("data/*/file-*.parquet")):
        if is_unfinished(path):
            content = finished_parquet(path.read_bytes(), _example(features))
            path.unlink()  # it may be a link to the file of the recording
            path.write_bytes(content)
        takes[path] = _takes(target, path)
    last = {index: (path, begin) for path in takes for index, begin, _ in takes[path]}
    for path, found in takes.items():
        kept = [one for one in found if last[one[0]] == (path, one[1])]
        if len(kept) < len(found):
            table = pq.read_table(path)
            path.unlink()
            write_parquet(pa.concat_tables(table[b:e] for _, b, e in kept), path)
        for index, begin, end in kept:
            row = {"episode_index": index, "length": end - begin, "dataset_from_index": frames}
            rows += [] if index in listed else [row | _place("data", path)]
            frames += end - begin
    if not (known or rows):
        raise DatasetError("the recording holds no complete episode", file=root)
    for key in info["features"].keys() - features.keys():
        _place_videos(target, key, known, rows, info["fps"])
    file = target / _LISTS / "chunk-000" / f"file-{len(episode_lists(target)):03d}.parquet"
    file.parent.mkdir(parents=True, exist_ok=True)
    if rows:
        write_parquet(pa.Table.from_pylist(rows), file)
    count = len(known) + len(rows)
    write_json(target / INFO_PATH, info | {"total_episodes": count, "total_frames": frames})
    return max(0, info.get("total_episodes", 0) - count)


def _example(features: Mapping[str, Mapping]) -> pa.Table:
    """Table of the features with a single row of placeholders."""
    others = {
        key: pa.array(["" if feature["dtype"] == "string" else {"bytes": b"", "path": ""}])
        for key, feature in features.items()
        if feature["dtype"] in ("image", "string")
    }
    values = {k: np.zeros((1, *features[k]["shape"])) for k in features.keys() - others}
    return to_table(values, features, others)


def _place(kind: str, path: Path) -> dict[str, int]:
    """Columns of the list of episodes that name a file, such as chunk-000/file-001.mp4."""
    numbers = (int(name.rpartition("-")[2]) for name in (path.parent.name, path.stem))
    return dict(zip((f"{kind}/chunk_index", f"{kind}/file_index"), numbers, strict=True))


def _place_videos(
    root: Path, key: str, known: Sequence[dict], rows: Sequence[dict], fps: float
) -> None:
    """Assign the unused videos of a camera to the episodes in `rows`, in recording order."""
    kind, left = f"videos/{key}", [*rows]
    for path in sorted(root.glob(f"{kind}/*/file-*.mp4")):
        place, begin = _place(kind, path), 0
        if any(place.items() <= row.items() for row in known):
            continue
        with suppress(DatasetError):  # episodes without a video are reported later
            images = read_stream(path).images
            while left and begin + left[0]["length"] <= images:
                row = left.pop(0)
                end = begin + row["length"]
                times = {"from_timestamp": begin / fps, "to_timestamp": end / fps}
                row |= place | {f"{kind}/{name}": time for name, time in times.items()}
                begin = end


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
        """True if LeRobot's stamps, where they increase, are 1/fps apart in all episodes."""
        self.decisions, faults = dataset.units_from(self._readable(), units)
        self.finished = False
        """True if the recorder was killed, so that episodes may lack their videos."""
        self.faults = {fault.episode: fault for fault in faults}
        """Episode index -> error, for episodes that contradict the units of the others."""
        self._calibrated = bool(calibrations(units))
        if self._calibrated:
            joints = {r: d.plain for r, d in self.decisions.items() if d.plain != d}
            units = {**units, **{role: plain.unit for role, plain in joints.items()}}
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
        """Repaired episodes; the report counts them and lists the episodes left out."""
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
                # A killed recorder loses the video of an episode whose save failed.
                lost = self.finished and error.key in self.writer.cameras
                if not (lost or self.options.drop_bad_episodes):
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
        edit = edits.apply_calibration(edit) if self._calibrated else edit
        edit = edits.move_zeros(edit, options.offsets)
        for name in ("drop_late", "trim", "drop_repeats", "unwrap", "fix_signs"):
            if getattr(options, name):
                edit = getattr(edits, name)(edit)
        stalled = np.flatnonzero(np.diff(edit.time) <= 0)
        if len(stalled):
            text = "stamps must increase; drop the late frames (drop_late), or leave the"
            text += " episode out (--drop bad-episodes)"
            raise edit.fault(text, frame=int(stalled[0]) + 1)
        return edit if options.fps is None else edits.resample_to_grid(edit, options.fps)
