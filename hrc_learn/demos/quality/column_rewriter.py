"""Columns of a repaired dataset: features, statistics, tasks and videos in version 3.0."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from hrc_learn.demos import recorded_episode as recorded
from hrc_learn.demos.quality.episode_edits import EpisodeEdit
from hrc_learn.demos.read.dataset_files import open_parquet, read_table
from hrc_learn.demos.read.dataset_folder import recorded_statistics
from hrc_learn.demos.read.metadata import (
    INDEX_FEATURES,
    NUMERIC,
    Sidecar,
    SidecarColumn,
    Statistics,
    episode_statistics,
    image_statistics,
)
from hrc_learn.demos.read.quantities import INDEX_KEYS
from hrc_learn.demos.read.source import OpenedDataset
from hrc_learn.demos.videos import (
    Segments,
    VideoSegment,
    decode_image,
    image_at,
    subsampled,
    video_keys,
)

_NO_TASK = "unnamed task"
_STATISTICS_IMAGES = 20
"""Images of an episode that enter its statistics, as in LeRobot for short episodes."""


class ColumnRewriter:
    """Writer of repaired episodes of one dataset.

    Attributes:
        tasks: Task texts by index.
        notes: Changes to all episodes.
    """

    def __init__(
        self,
        dataset: OpenedDataset,
        units: Mapping[str, str],
        *,
        fps: float | int | None,
        segments: Mapping[int, Segments] | None,
    ):
        """
        Args:
            dataset: The old dataset.
            units: Units from the caller.
            fps: Rate that episodes are resampled to [1/s]; None for the old one.
            segments: Video segments by episode index; None leaves the videos out.
        """
        folder = self._folder = dataset.folder
        self.notes: list[str] = [dataset.contract_note] if dataset.contract_note else []
        self._segments = segments or {}
        self._cameras = self._choose_cameras(videos=segments is not None)
        self._image_columns = [k for k, f in folder.features.items() if f.dtype == "image"]
        pictures = self._cameras or self._image_columns
        self._recorded = recorded_statistics(folder) if pictures else {}
        self._task_index = {index: n for n, index in enumerate(sorted(folder.tasks))}
        self.tasks = self._task_texts()
        self._add_time = "time" not in dataset.columns.selections and fps is None
        self._header = recorded.RecordingHeader(
            fps=float(fps or folder.fps),
            robot_type=folder.robot_type or "unknown",
            features=self._features(),
            sidecar=self._sidecar(dataset.sidecar, units),
        )

    def _choose_cameras(self, videos: bool) -> list[str]:
        keys = video_keys(self._folder)
        if not videos:
            self.notes += [f"{key}: videos left out" for key in keys]
            return []
        there = {key for segments in self._segments.values() for key in segments}
        self.notes += [
            f"{key}: declared, but no video of it is here; left out"
            for key in keys
            if key not in there
        ]
        return [key for key in keys if key in there]

    def _task_texts(self) -> list[str]:
        tasks = [self._folder.tasks[index] for index in self._task_index]
        listed = (task for entry in self._folder.episodes for task in entry.tasks)
        tasks += [text for text in dict.fromkeys(listed) if text not in tasks]
        if not tasks:
            tasks = [_NO_TASK]
            self.notes.append(f"no task is listed: every episode shows {_NO_TASK!r} now")
        return tasks

    def _features(self) -> dict[str, dict]:
        declared = self._folder.info["features"]
        features = {}
        for key, feature in self._folder.features.items():
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
            features[recorded.TIME_KEY] = {"dtype": "float64", "shape": [1], "names": ["time"]}
        return {**features, **INDEX_FEATURES}

    def _sidecar(self, old: Sidecar, given: Mapping[str, str]) -> Sidecar:
        columns, units = dict(old.columns), {**old.units, **given}
        if self._add_time and columns:
            columns["time"] = SidecarColumn(key=recorded.TIME_KEY, names=("time",))
            units["time"] = "s"
        return replace(old, columns=columns, units=units)

    def videos_of(self, edit: EpisodeEdit) -> Segments:
        """Parts of the old videos that show the remaining frames.

        Raises:
            DatasetError: A video is missing, or the frames are not contiguous.
        """
        found, fps = self._segments.get(edit.entry.index, {}), self._folder.fps
        for key in self._cameras:
            if key not in found:
                raise edit.fault(
                    "the video of this episode is missing: leave out the videos "
                    "(videos=False), or the episode (drop_bad_episodes)",
                    key=key,
                )
        if self._cameras and (edit.resampled or (np.diff(edit.kept) != 1).any()):
            raise edit.fault(
                "its videos would have to be encoded anew, because frames were dropped in the "
                "middle or resampled: leave the videos out (videos=False), or keep the frames "
                "(drop_repeats=False, drop_bad_frames=False, fps=None)"
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

    def require_writable(self, edit: EpisodeEdit) -> None:
        """Check that every remaining frame has its images and a listed task.

        Raises:
            DatasetError: As in `videos_of`, a task is not listed, or an episode with a column
                of images was resampled.
        """
        self.videos_of(edit)
        self._tasks(edit)
        if self._image_columns and edit.resampled:
            raise edit.fault(
                "its images cannot be resampled (no fps)", key=self._image_columns[0]
            )

    def stage(self, path: Path, edit: EpisodeEdit, frames_before: int) -> None:
        """Write one episode to a file of the new dataset's staging folder."""
        tasks = self._tasks(edit)
        values = (
            edit.frames | {recorded.TIME_KEY: edit.time[:, None]}
            if self._add_time
            else edit.frames
        )
        values = values | recorded.index_columns(
            self._header.fps, recorded.episode_number(path), frames_before, tasks
        )
        features = self._header.features
        numeric = {key: values[key] for key in features if key in values}
        others = self._other_columns(edit)
        statistics = self._numeric_statistics(numeric)
        for key in (*self._cameras, *self._image_columns):
            statistics[key] = self._image_statistics(edit, key, others.get(key))
        recorded.write_episode(
            path,
            recorded.StagedEpisode(
                header=self._header,
                tasks=[self.tasks[i] for i in dict.fromkeys(tasks.tolist())],
                statistics=statistics,
                table=recorded.to_table(numeric, features, others),
            ),
        )

    def _numeric_statistics(self, numeric: Mapping[str, np.ndarray]) -> Statistics:
        """Statistics in the shape of the features."""
        statistics = episode_statistics(numeric)
        for key, figures in statistics.items():
            shape = self._header.features[key]["shape"]
            if len(shape) > 1:
                statistics[key] = {
                    name: v if name == "count" else np.reshape(v, shape).tolist()
                    for name, v in figures.items()
                }
        return statistics

    def _other_columns(self, edit: EpisodeEdit) -> dict[str, pa.ChunkedArray]:
        """Columns that hold no numbers, for the remaining frames."""
        keys = [
            key
            for key, feature in self._header.features.items()
            if feature["dtype"] != "video" and not feature["dtype"].startswith(NUMERIC)
        ]
        if not keys:
            return {}
        entry = edit.entry
        parquet = open_parquet(self._folder.root, entry.file, entry.index)
        rows = slice(entry.start, entry.start + entry.length)
        table = read_table(parquet, entry.file, keys, rows).take(pa.array(edit.kept))
        return {key: table.column(key) for key in keys}

    def _image_statistics(
        self, edit: EpisodeEdit, key: str, column: pa.ChunkedArray | None
    ) -> dict[str, list]:
        """Recorded statistics if all frames remain, else those of some images."""
        recorded = self._recorded.get(edit.entry.index, {}).get(key)
        if recorded is not None and len(edit) == edit.entry.length:
            return recorded
        chosen = np.linspace(0, len(edit) - 1, min(len(edit), _STATISTICS_IMAGES)).astype(int)
        if column is not None:
            images = [decode_image(column[int(i)].as_py()["bytes"]) for i in chosen]
        else:
            segment = self.videos_of(edit)[key]
            images = [image_at(segment, int(i), self._folder.fps) for i in chosen]
        return image_statistics(np.stack([subsampled(image) for image in images]))

    def _tasks(self, edit: EpisodeEdit) -> np.ndarray:
        """Index of the task of each frame."""
        texts = edit.entry.tasks or self.tasks[:1]
        if "task_index" not in edit.frames or not self._folder.tasks:
            return np.full(len(edit), self.tasks.index(texts[0]))
        indices = edit.frames["task_index"][:, 0]
        unknown = np.flatnonzero(~np.isin(indices, list(self._task_index)))
        if len(unknown):
            raise edit.fault(
                f"task {indices[unknown[0]]:g} is not in the list of tasks: leave the episode "
                f"out (drop_bad_episodes)",
                frame=int(unknown[0]),
                key="task_index",
            )
        return np.array([self._task_index[int(i)] for i in indices])
