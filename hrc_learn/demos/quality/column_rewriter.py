"""Columns of a repaired dataset: features, statistics, tasks and videos in version 3.0."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Int64

from hrc_learn.demos import recorded_episode as recorded
from hrc_learn.demos.quality.episode_edits import EpisodeEdit
from hrc_learn.demos.read.dataset_files import open_parquet, read_table
from hrc_learn.demos.read.dataset_folder import recorded_statistics
from hrc_learn.demos.read.metadata import (
    INDEX_FEATURES,
    NUMERIC,
    Sidecar,
    SidecarColumn,
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
        header: Properties of the new dataset.
    """

    def __init__(
        self,
        dataset: OpenedDataset,
        units: Mapping[str, str],
        *,
        fps: float | int | None,
        segments: Mapping[int, Segments] | None,
        add_time: bool = False,
    ):
        """
        Args:
            dataset: The old dataset.
            units: Units from the caller.
            fps: Rate that episodes are resampled to [1/s]; None for the old one.
            segments: Video segments by episode index; None leaves the videos out.
            add_time: Add the old stamps as `time`.
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
        self._unlisted = self.tasks[:1]
        self._add_time = add_time
        self.header = recorded.RecordingHeader(
            fps=float(fps or folder.fps),
            robot_type=folder.robot_type or "unknown",
            features=self._features(),
            sidecar=self._sidecar(dataset.sidecar, units),
        )

    def _choose_cameras(self, videos: bool) -> list[str]:
        there = {key for segments in self._segments.values() for key in segments}
        reason = (
            "declared, but no video of it is here; left out" if videos else "videos left out"
        )
        keys = video_keys(self._folder)
        self.notes += [f"{key}: {reason}" for key in keys if key not in there]
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

    def join(self, header: recorded.RecordingHeader, tasks: list[str]) -> None:
        """Write the episodes as those of a dataset with this header and these tasks."""
        self._task_index = {n: tasks.index(text) for n, text in self._folder.tasks.items()}
        self.tasks, self.header = tasks, header
        self._cameras = [key for key in self._cameras if key in header.features]
        self._image_columns = [key for key in self._image_columns if key in header.features]

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
        if self._image_columns and edit.resampled:
            text = "its images cannot be resampled (no fps)"
            raise edit.fault(text, key=self._image_columns[0])
        begin = int(edit.kept[0]) / fps
        end = begin + len(edit) / fps
        return {
            key: replace(old, start=old.start + begin, stop=old.start + end)
            for key, old in found.items()
            if key in self._cameras
        }

    def stage(
        self,
        path: Path,
        edit: EpisodeEdit,
        videos: Segments,
        tasks: Int64[np.ndarray, " frames"],
        frames_before: int,
    ) -> None:
        """Write one episode, with `videos_of` and `tasks_of` it, to a staged file."""
        values = edit.frames | (
            {recorded.TIME_KEY: edit.time[:, None]} if self._add_time else {}
        )
        number, features = recorded.episode_number(path), self.header.features
        values |= recorded.index_columns(self.header.fps, number, frames_before, tasks)
        numeric = {key: values[key] for key in features if key in values}
        others = self._other_columns(edit)
        statistics = episode_statistics(
            {key: v.reshape(-1, *features[key]["shape"]) for key, v in numeric.items()}
        )
        for key in (*self._cameras, *self._image_columns):
            images = others.get(key, videos.get(key))
            statistics[key] = self._image_statistics(edit, key, images)
        staged = recorded.StagedEpisode(
            header=self.header,
            tasks=[self.tasks[i] for i in dict.fromkeys(tasks.tolist())],
            statistics=statistics,
            table=recorded.to_table(numeric, features, others),
        )
        recorded.write_episode(path, staged)

    def _other_columns(self, edit: EpisodeEdit) -> dict[str, pa.ChunkedArray]:
        """Columns that hold no numbers, for the remaining frames."""
        types = {key: feature["dtype"] for key, feature in self.header.features.items()}
        keys = [key for key, kind in types.items() if not kind.startswith(("video", *NUMERIC))]
        if not keys:
            return {}
        entry = edit.entry
        parquet = open_parquet(self._folder.root, entry.file, entry.index)
        rows = slice(entry.start, entry.start + entry.length)
        table = read_table(parquet, entry.file, keys, rows).take(pa.array(edit.kept))
        return {key: table.column(key) for key in keys}

    def _image_statistics(
        self, edit: EpisodeEdit, key: str, images: pa.ChunkedArray | VideoSegment | None
    ) -> dict[str, list]:
        """Recorded statistics if all frames remain, else those of some images."""
        known = self._recorded.get(edit.entry.index, {}).get(key)
        if known is not None and len(edit) == edit.entry.length:
            return known
        chosen = np.linspace(0, len(edit) - 1, min(len(edit), _STATISTICS_IMAGES)).astype(int)
        if isinstance(images, VideoSegment):
            some = [image_at(images, int(i), self._folder.fps) for i in chosen]
        else:
            assert images is not None
            some = [decode_image(images[int(i)].as_py()["bytes"]) for i in chosen]
        return image_statistics(np.stack([subsampled(image) for image in some]))

    def tasks_of(self, edit: EpisodeEdit) -> Int64[np.ndarray, " frames"]:
        """Index of the task of each frame.

        Raises:
            DatasetError: A task is not in the list of tasks.
        """
        texts = edit.entry.tasks or self._unlisted
        if "task_index" not in edit.frames or not self._folder.tasks:
            return np.full(len(edit), self.tasks.index(texts[0]))
        indices = edit.frames["task_index"][:, 0]
        unknown = np.flatnonzero(~np.isin(indices, list(self._task_index)))
        if len(unknown):
            text = (
                f"task {indices[unknown[0]]:g} is not in the list of tasks: leave the episode "
                f"out (drop_bad_episodes)"
            )
            raise edit.fault(text, frame=int(unknown[0]), key="task_index")
        return np.array([self._task_index[int(i)] for i in indices])
