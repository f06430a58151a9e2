"""A dataset repaired into a copy."""

import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from hrc_learn.demos.format.dataset_folder import (
    DatasetFolder,
    EpisodeEntry,
    open_folder,
    open_parquet,
    read_table,
    recorded_statistics,
)
from hrc_learn.demos.format.metadata import (
    INDEX_FEATURES,
    NUMERIC,
    SIDECAR_PATH,
    Sidecar,
    episode_statistics,
    image_statistics,
    read_sidecar,
    sidecar_copy,
    write_json,
)
from hrc_learn.demos.format.videos import (
    Segments,
    VideoSegment,
    decode_image,
    image_at,
    read_segments,
    sampled_pixels,
    video_keys,
)
from hrc_learn.demos.issue import DatasetError
from hrc_learn.demos.read.column_mapping import MappingSpec
from hrc_learn.demos.read.contract import (
    changed_since,
    contract_content,
    contract_of,
    fingerprint,
)
from hrc_learn.demos.read.episodes import (
    Quantities,
    declared_units,
    read_mapping,
    select_quantities,
    units_on_disk,
)
from hrc_learn.demos.read.frames import RawFrames, read_each, recorded_stamps
from hrc_learn.demos.read.roles import INDEX_KEYS, is_hand
from hrc_learn.demos.repair.episode_edit import (
    ColumnSemantics,
    EpisodeEdit,
    RepairOptions,
    RepairReport,
    drop_bad_frames,
    drop_late,
    drop_repeats,
    fix_signs,
    renew_stamps,
    resample_to_grid,
    trim,
    unwrap,
)
from hrc_learn.demos.write.assembly import assemble
from hrc_learn.demos.write.episode import (
    TIME_KEY,
    RecordingHeader,
    StagedEpisode,
    episode_path,
    index_columns,
    to_table,
    write_episode,
)
from hrc_learn.store import DATASET, replacing

Progress = Callable[[Sequence[EpisodeEntry]], Iterable[EpisodeEntry]]


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

    The old one is left as it is. Columns keep their keys, names and units. Where no column
    holds true stamps and the frames are not resampled, `observation.time` is added with
    LeRobot's old ones, because the new `timestamp` is frame / fps by definition.

    Args:
        path: The dataset to repair.
        out: Folder of the new one, which must not exist.
        options: What may be changed.
        mapping: Where quantities are that are not found by name, as in `load_demos`.
        units: Units on disk by role, as in `load_demos`; kept in the new dataset.
        progress: Called with the episodes one after another, and gives them back: a hook for
            a progress bar.
        kept: Episodes that stay, and which of their frames; None: all.

    Raises:
        DatasetError: An episode cannot be read or repaired, and may not be left out.
        FileExistsError: There is something at `out`.
    """
    options, units = options or RepairOptions(), units or {}
    folder, sidecar = open_folder(path), read_sidecar(Path(path))
    if not folder.episodes:
        raise DatasetError("the dataset holds no episodes", file=folder.root)
    semantics = _resolve(folder, sidecar, mapping, units)
    segments = read_segments(folder) if options.videos else {}
    recast = ColumnRewriter(folder, sidecar, semantics, options, units, segments, kept)
    report = RepairReport(path=Path(out), notes=recast.notes, dry_run=options.dry_run)
    entries = progress(folder.episodes) if progress else folder.episodes
    if options.dry_run:
        for entry, frames in zip(entries, _read(folder), strict=True):
            report.frames_before += entry.length
            if (edit := _edited(recast, entry, frames, options, report)) is not None:
                report.changes[entry.index] = edit.changes
                report.frames += len(edit)
        return report
    with replacing(out, DATASET) as target:
        staging = target / "episodes"
        staging.mkdir(parents=True)
        videos: list[Segments] = []
        for entry, frames in zip(entries, _read(folder), strict=True):
            report.frames_before += entry.length
            edit = _edited(recast, entry, frames, options, report)
            if edit is None:
                continue
            recast.stage(episode_path(staging, len(report.changes)), edit, report.frames)
            videos.append(recast.videos_of(edit))
            report.changes[entry.index] = edit.changes
            report.frames += len(edit)
        if not report.changes:
            raise DatasetError("no episode could be repaired", file=folder.root)
        paths = [episode_path(staging, i) for i in range(len(report.changes))]
        assemble(paths, target, videos=videos, tasks=recast.tasks, share=False)
        _copy_notes(folder.root, target)
        if (contract := contract_of(sidecar)) is not None:
            given = {
                column: units[role]
                for role in units
                if role in semantics.column_mapping.selections
                for column in semantics.column_mapping.selections[role].columns
            }
            parts = (
                replace(part, unit=given.get((part.key, part.index), part.unit))
                for part in contract.components
            )
            copied = fingerprint(open_folder(target))
            carried = replace(contract, components=tuple(parts), fingerprint=copied)
            content = read_sidecar(target)
            content = replace(content, contract=contract_content(carried))
            write_json(target / SIDECAR_PATH, sidecar_copy(content, content.units))
        shutil.rmtree(staging)
    return report


def _edited(
    recast: "ColumnRewriter",
    entry: EpisodeEntry,
    frames: RawFrames | DatasetError,
    options: RepairOptions,
    report: RepairReport,
) -> EpisodeEdit | None:
    """The episode repaired; None, and the reason in the report, where it is left out."""
    if recast.kept is not None and entry.index not in recast.kept:
        report.left_out[entry.index] = "not kept"
        return None
    try:
        edit = _repair(recast, entry, frames, options)
        recast.videos_of(edit)
        recast.require_images(edit)
    except DatasetError as error:
        if not options.drop_bad_episodes:
            raise
        report.left_out[entry.index] = error.finding.message
        return None
    return edit


_NOTE_BYTES = 2**20


def _copy_notes(source: Path, target: Path) -> None:
    """What else stands beside the data: a card, a licence, other programs' metadata."""
    for path in (*source.glob("*.md"), *source.glob("LICENSE*"), *source.glob("meta/*.json")):
        there = target / path.relative_to(source)
        ordinary = path.is_file() and not path.is_symlink()
        if ordinary and not there.exists() and path.stat().st_size < _NOTE_BYTES:
            shutil.copyfile(path, there)


def _resolve(
    folder: DatasetFolder,
    sidecar: Sidecar,
    mapping: MappingSpec | None,
    units: Mapping[str, str],
) -> ColumnSemantics:
    """Find the quantities, and guess units from whatever can be read and is finite."""
    column_mapping = read_mapping(folder, sidecar, mapping)

    def readable() -> Iterator[tuple[EpisodeEntry, Quantities]]:
        for entry, frames in zip(folder.episodes, _read(folder), strict=True):
            # What cannot be read is reported, or left out, when its turn comes.
            if not isinstance(frames, DatasetError):
                yield entry, select_quantities(frames, column_mapping.selections)

    declared = declared_units(sidecar, column_mapping.selections)
    decisions, faults = units_on_disk(
        column_mapping.selections, readable(), folder.fps, declared, units
    )
    bad = {fault.episode: fault for fault in faults}
    hands = frozenset(filter(is_hand, column_mapping.joint_names))
    return ColumnSemantics(column_mapping=column_mapping, units=decisions, hands=hands, bad=bad)


def _read(folder: DatasetFolder) -> Iterator[RawFrames | DatasetError]:
    """Numbers of every episode."""
    keys = [key for key, f in folder.features.items() if f.numeric and key not in INDEX_KEYS]
    return read_each(folder, folder.episodes, keys)


def _repair(
    recast: "ColumnRewriter",
    entry: EpisodeEntry,
    frames: RawFrames | DatasetError,
    options: RepairOptions,
) -> EpisodeEdit:
    folder, semantics, time = recast.folder, recast.semantics, None
    if (fault := semantics.bad.get(entry.index)) is not None:
        raise fault
    if isinstance(frames, DatasetError):
        raise frames
    if "time" in semantics.column_mapping.selections:
        ((key, index),) = semantics.column_mapping.selections["time"].columns
        time = frames[key][:, index].astype(float) * semantics.units["time"].factor
    edit = EpisodeEdit(
        entry=entry,
        frames={k: v for k, v in frames.items() if k not in INDEX_KEYS or k == "task_index"},
        time=recorded_stamps(folder, frames) if time is None else time,
        kept=np.arange(entry.length),
    )
    if recast.kept is not None:
        part = recast.kept[entry.index]
        wanted = np.zeros(entry.length, dtype=bool)
        wanted[part] = True
        edit = edit.only(wanted, f"cut to frames {part.start} to {part.stop}")
    if time is None:
        edit = renew_stamps(edit, folder.fps)
    edit = drop_bad_frames(edit, semantics, options.drop_bad_frames)
    if options.drop_late:
        edit = drop_late(edit)
    if options.trim:
        edit = trim(edit, semantics, options.keep_rest)
    if options.drop_repeats:
        edit = drop_repeats(edit)
    if options.unwrap:
        edit = unwrap(edit, semantics, options.unwrap_commands)
    if options.fix_signs:
        edit = fix_signs(edit, semantics)
    if options.fps is not None:
        edit = resample_to_grid(edit, semantics, options.fps)
    stalled = np.flatnonzero(np.diff(edit.time) <= 0)
    if len(stalled):
        raise edit.bad(
            "stamps must increase; let frames that are stamped no later be dropped "
            "(drop_late), or leave the episode out (drop_bad_episodes)",
            frame=int(stalled[0]) + 1,
        )
    return edit


# The columns of a repaired dataset, as LeRobot wants them.


class ColumnRewriter:
    """How episodes of one dataset are written into another of version 3.0.

    Attributes:
        folder: The old dataset.
        semantics: What its columns mean.
        tasks: Task texts by index.
        kept: Episodes that stay, and which of their frames; None: all.
        notes: What is changed in all episodes.
    """

    def __init__(
        self,
        folder: DatasetFolder,
        sidecar: Sidecar,
        semantics: ColumnSemantics,
        options: RepairOptions,
        units: Mapping[str, str],
        segments: Mapping[int, Segments],
        kept: Mapping[int, slice] | None = None,
    ):
        self.kept = kept
        changed = changed_since(folder, contract_of(sidecar))
        self.notes: list[str] = [] if changed is None else [changed]
        self.folder = folder
        self.semantics = semantics
        self._segments = segments
        self._cameras = self._choose_cameras(options)
        self._statistics = recorded_statistics(folder) if self._pictures() else {}
        self._task_index = {index: n for n, index in enumerate(sorted(folder.tasks))}
        self.tasks = [folder.tasks[index] for index in self._task_index]
        listed = (task for entry in folder.episodes for task in entry.tasks)
        self.tasks += [t for t in dict.fromkeys(listed) if t not in self.tasks]
        if not self.tasks:
            self.tasks = [_NO_TASK]
            self.notes.append(f"no task is listed: every episode shows {_NO_TASK!r} now")
        self._add_time = (
            "time" not in semantics.column_mapping.selections and options.fps is None
        )
        self._header = RecordingHeader(
            fps=float(options.fps or folder.fps),
            robot_type=folder.robot_type or "unknown",
            features=self._features(),
            sidecar=self._sidecar(sidecar, units),
        )

    def videos_of(self, edit: EpisodeEdit) -> Segments:
        """The parts of the old videos that show the frames that are left.

        Raises:
            DatasetError: Some of them are not there, or those frames are not in one piece.
        """
        found, fps = self._segments.get(edit.entry.index, {}), self.folder.fps
        missing = [key for key in self._cameras if key not in found]
        if missing:
            raise DatasetError(
                "the video of this episode is missing: leave out the videos (videos=False), or "
                "the episode (drop_bad_episodes)",
                episode=edit.entry.index,
                key=missing[0],
            )
        if self._cameras and (edit.resampled or (np.diff(edit.kept) != 1).any()):
            raise edit.bad(
                "its videos would have to be encoded anew, because frames were dropped in the "
                "middle or resampled: leave the videos out (videos=False), or the frames as "
                "they are (drop_repeats=False, drop_bad_frames=False, fps=None)"
            )
        first = int(edit.kept[0])
        return {
            key: VideoSegment(
                file=found[key].file,
                start=found[key].start + first / fps,
                stop=found[key].start + (first + len(edit)) / fps,
            )
            for key in self._cameras
        }

    def require_images(self, edit: EpisodeEdit) -> None:
        """Refuse to make images of moments at which none was taken.

        Raises:
            DatasetError: The dataset has a column of images, and the frames were resampled.
        """
        images = [k for k, f in self.folder.features.items() if f.dtype == "image"]
        if images and edit.resampled:
            raise edit.bad("its images cannot be resampled (no fps)", key=images[0])

    def stage(self, path: Path, edit: EpisodeEdit, frames_before: int) -> None:
        """Write one episode beside the new dataset."""
        number = int(path.stem.rpartition("_")[2])
        tasks = self._tasks(edit)
        values = edit.frames | {TIME_KEY: edit.time[:, None]} if self._add_time else edit.frames
        values = values | index_columns(self._header.fps, number, frames_before, tasks)
        features = self._header.features
        numeric = {key: values[key] for key in features if key in values}
        statistics = episode_statistics(numeric)
        for key, of_columns in statistics.items():
            if len(shape := features[key]["shape"]) > 1:
                statistics[key] = {
                    name: v if name == "count" else np.reshape(v, shape).tolist()
                    for name, v in of_columns.items()
                }
        others = self._others(edit)
        for key in self._pictures():
            statistics[key] = self._image_statistics(edit, key, others.get(key))
        write_episode(
            path,
            StagedEpisode(
                header=self._header,
                tasks=[self.tasks[i] for i in dict.fromkeys(tasks.tolist())],
                statistics=statistics,
                table=to_table(numeric, features, others),
            ),
        )

    def _others(self, edit: EpisodeEdit) -> dict[str, pa.ChunkedArray]:
        """Columns that hold no numbers, of the frames that are left."""
        keys = [
            key
            for key, feature in self._header.features.items()
            if feature["dtype"] != "video" and not feature["dtype"].startswith(NUMERIC)
        ]
        if not keys:
            return {}
        entry = edit.entry
        parquet = open_parquet(self.folder.root, entry.file, entry.index)
        rows = slice(entry.start, entry.start + entry.length)
        table = read_table(parquet, entry.file, keys, rows).take(pa.array(edit.kept))
        return {key: table.column(key) for key in keys}

    def _pictures(self) -> list[str]:
        """Features that are images, whether in videos or in a column."""
        images = [k for k, f in self.folder.features.items() if f.dtype == "image"]
        return [*self._cameras, *images]

    def _image_statistics(
        self, edit: EpisodeEdit, key: str, column: pa.ChunkedArray | None
    ) -> dict[str, list]:
        """As recorded where all frames are left, of some images of the others."""
        recorded = self._statistics.get(edit.entry.index, {}).get(key)
        if recorded is not None and len(edit) == edit.entry.length:
            return recorded
        chosen = np.linspace(0, len(edit) - 1, min(len(edit), _STATISTICS_IMAGES)).astype(int)
        if column is not None:
            images = [decode_image(column[int(i)].as_py()["bytes"]) for i in chosen]
        else:
            segment = self.videos_of(edit)[key]
            images = [image_at(segment, int(i), self.folder.fps) for i in chosen]
        return image_statistics(np.stack([sampled_pixels(image) for image in images]))

    def _choose_cameras(self, options: RepairOptions) -> list[str]:
        keys = video_keys(self.folder)
        if not options.videos:
            self.notes += [f"{key}: videos left out" for key in keys]
            return []
        there = {key for segments in self._segments.values() for key in segments}
        self.notes += [
            f"{key}: declared, but no video of it is here; left out"
            for key in keys
            if key not in there
        ]
        return [key for key in keys if key in there]

    def _features(self) -> dict[str, dict]:
        declared = self.folder.info["features"]
        features = {}
        for key, feature in self.folder.features.items():
            if key in INDEX_KEYS:
                continue
            if feature.numeric:
                features[key] = declared[key] | {
                    "shape": list(feature.shape) or [1],
                    "names": list(feature.names) if feature.names else None,
                }
            elif feature.dtype != "video" or key in self._cameras:
                features[key] = declared[key]
        if self._add_time:
            features[TIME_KEY] = {"dtype": "float64", "shape": [1], "names": ["time"]}
        return {**features, **INDEX_FEATURES}

    def _sidecar(self, sidecar: Sidecar, units: Mapping[str, str]) -> dict:
        columns, units = dict(sidecar.columns), {**sidecar.units, **units}
        if self._add_time and columns:
            columns["time"] = {"key": TIME_KEY, "names": ["time"]}
            units["time"] = "s"
        return sidecar_copy(replace(sidecar, columns=columns), units)

    def _tasks(self, edit: EpisodeEdit) -> np.ndarray:
        texts = edit.entry.tasks or self.tasks[:1]
        if "task_index" not in edit.frames or not self.folder.tasks:
            return np.full(len(edit), self.tasks.index(texts[0]))
        indices = edit.frames["task_index"][:, 0]
        unknown = np.flatnonzero(~np.isin(indices, list(self._task_index)))
        if len(unknown):
            raise edit.bad(
                f"task {indices[unknown[0]]:g} is not in the list of tasks: leave the episode "
                f"out (drop_bad_episodes)",
                frame=int(unknown[0]),
                key="task_index",
            )
        return np.array([self._task_index[int(i)] for i in indices])


_NO_TASK = "unnamed task"
_STATISTICS_IMAGES = 20
"""Images of an episode that statistics are taken of: LeRobot takes as few of short ones."""
