"""A dataset repaired into a copy."""

import contextlib
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hrc_learn.demos.format.dataset_folder import DatasetFolder, EpisodeEntry, open_folder
from hrc_learn.demos.format.metadata import (
    INDEX_FEATURES,
    Sidecar,
    episode_statistics,
    read_sidecar,
    sidecar_copy,
)
from hrc_learn.demos.format.videos import Segments, VideoSegment, read_segments, video_keys
from hrc_learn.demos.issue import DatasetError
from hrc_learn.demos.read.column_mapping import MappingSpec, map_columns
from hrc_learn.demos.read.episodes import Quantities, select_quantities, units_on_disk
from hrc_learn.demos.read.frames import RawFrames, read_frames, recorded_stamps
from hrc_learn.demos.read.roles import INDEX_KEYS
from hrc_learn.demos.repair.episode_edit import (
    ColumnSemantics,
    EpisodeEdit,
    RepairOptions,
    RepairReport,
    drop_bad_frames,
    drop_late,
    drop_repeats,
    fix_signs,
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
    recast = ColumnRewriter(folder, sidecar, semantics, options, units, segments)
    report = RepairReport(path=Path(out), notes=recast.notes)
    with replacing(out, DATASET) as target:
        staging = target / "episodes"
        staging.mkdir(parents=True)
        videos: list[Segments] = []
        for entry in progress(folder.episodes) if progress else folder.episodes:
            report.frames_before += entry.length
            try:
                edit = _repair(folder, entry, semantics, options)
                cut = recast.videos_of(edit)
            except DatasetError as error:
                if not options.drop_bad_episodes:
                    raise
                report.left_out[entry.index] = error.finding.message
                continue
            recast.stage(episode_path(staging, len(report.changes)), edit, report.frames)
            videos.append(cut)
            report.changes[entry.index] = edit.changes
            report.frames += len(edit)
        if not report.changes:
            raise DatasetError("no episode could be repaired", file=folder.root)
        paths = [episode_path(staging, i) for i in range(len(report.changes))]
        assemble(paths, target, videos=videos, tasks=recast.tasks)
        shutil.rmtree(staging)
    return report


def _resolve(
    folder: DatasetFolder,
    sidecar: Sidecar,
    mapping: MappingSpec | None,
    units: Mapping[str, str],
) -> ColumnSemantics:
    """Find the quantities, and guess units from whatever can be read and is finite."""
    column_mapping = map_columns(folder.features, sidecar, mapping)

    def readable() -> Iterator[Quantities]:
        for entry in folder.episodes:
            # What cannot be read is reported, or left out, when its turn comes.
            with contextlib.suppress(DatasetError):
                yield select_quantities(_read(folder, entry), column_mapping.selections)

    decisions = units_on_disk(
        column_mapping.selections, readable(), folder.fps, sidecar.units, units
    )
    return ColumnSemantics(column_mapping=column_mapping, units=decisions)


def _read(folder: DatasetFolder, entry: EpisodeEntry) -> RawFrames:
    keys = [key for key, f in folder.features.items() if f.numeric and key not in INDEX_KEYS]
    ((_, frames),) = read_frames(folder, [entry], keys)
    return frames


def _repair(
    folder: DatasetFolder,
    entry: EpisodeEntry,
    semantics: ColumnSemantics,
    options: RepairOptions,
) -> EpisodeEdit:
    frames, time = _read(folder, entry), None
    if "time" in semantics.column_mapping.selections:
        ((key, index),) = semantics.column_mapping.selections["time"].columns
        time = frames[key][:, index].astype(float) * semantics.units["time"].factor
    edit = EpisodeEdit(
        entry=entry,
        frames={k: v for k, v in frames.items() if k not in INDEX_KEYS or k == "task_index"},
        time=recorded_stamps(folder, frames) if time is None else time,
        kept=np.arange(entry.length),
    )
    edit = drop_bad_frames(edit, semantics, options.drop_bad_frames)
    if options.drop_repeats:
        edit = drop_late(edit)
    if options.trim:
        edit = trim(edit, semantics, options.keep_rest)
    if options.drop_repeats:
        edit = drop_repeats(edit)
    if options.unwrap:
        edit = unwrap(edit, semantics)
    if options.fix_signs:
        edit = fix_signs(edit, semantics)
    if options.fps is not None:
        edit = resample_to_grid(edit, semantics, options.fps)
    stalled = np.flatnonzero(np.diff(edit.time) <= 0)
    if len(stalled):
        raise edit.bad(
            "stamps must increase; let repeated frames be dropped (drop_repeats), or leave the "
            "episode out (drop_bad_episodes)",
            frame=int(stalled[0]) + 1,
        )
    return edit


# The columns of a repaired dataset, as LeRobot wants them.


class ColumnRewriter:
    """How episodes of one dataset are written into another of version 3.0.

    Attributes:
        tasks: Task texts by index.
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
    ):
        self.notes: list[str] = []
        self._folder = folder
        self._segments = segments
        self._cameras = self._choose_cameras(options)
        self._task_index = {index: n for n, index in enumerate(sorted(folder.tasks))}
        self.tasks = [folder.tasks[index] for index in self._task_index]
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
        found, fps = self._segments.get(edit.entry.index, {}), self._folder.fps
        missing = [key for key in self._cameras if key not in found]
        if missing:
            raise DatasetError(
                "the video of this episode is missing: leave out the videos (videos=False), or "
                "the episode (drop_bad_episodes)",
                episode=edit.entry.index,
                key=missing[0],
            )
        if self._cameras and (edit.kept is None or (np.diff(edit.kept) != 1).any()):
            raise edit.bad(
                "its videos would have to be encoded anew, because frames were dropped in the "
                "middle or resampled: leave the videos out (videos=False), or the frames as "
                "they are (drop_repeats=False, drop_bad_frames=False, fps=None)"
            )
        first = 0 if edit.kept is None else int(edit.kept[0])
        return {
            key: VideoSegment(
                file=found[key].file,
                start=found[key].start + first / fps,
                stop=found[key].start + (first + len(edit)) / fps,
            )
            for key in self._cameras
        }

    def stage(self, path: Path, edit: EpisodeEdit, frames_before: int) -> None:
        """Write one episode beside the new dataset."""
        number = int(path.stem.rpartition("_")[2])
        tasks = self._tasks(edit)
        values = edit.frames | {TIME_KEY: edit.time[:, None]} if self._add_time else edit.frames
        values = values | index_columns(self._header.fps, number, frames_before, tasks)
        features = self._header.features
        numeric = {key: values[key] for key, f in features.items() if f["dtype"] != "video"}
        write_episode(
            path,
            StagedEpisode(
                header=self._header,
                tasks=[self.tasks[i] for i in dict.fromkeys(tasks.tolist())],
                statistics=episode_statistics(numeric),
                table=to_table(numeric, features),
            ),
        )

    def _choose_cameras(self, options: RepairOptions) -> list[str]:
        keys = video_keys(self._folder)
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
        declared = self._folder.info["features"]
        features = {}
        for key, feature in self._folder.features.items():
            if key in INDEX_KEYS:
                continue
            if feature.numeric:
                features[key] = {
                    "dtype": feature.dtype,
                    "shape": [feature.width],
                    "names": list(feature.names) if feature.names else None,
                }
            elif key in self._cameras:
                features[key] = declared[key]
            elif feature.dtype != "video":
                self.notes.append(f"{key}: a column of {feature.dtype}, which is left out")
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
        if "task_index" in edit.frames:
            return np.array([self._task_index[int(i)] for i in edit.frames["task_index"][:, 0]])
        texts = edit.entry.tasks or self.tasks[:1]
        return np.full(len(edit), self.tasks.index(texts[0]))
