"""The columns and videos of a repaired dataset, as LeRobot wants them."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from hrc_learn.demos.format.dataset_folder import DatasetFolder, EpisodeEntry
from hrc_learn.demos.format.features import Sidecar, sidecar_copy
from hrc_learn.demos.format.lerobot_v3 import INDEX_FEATURES, episode_statistics
from hrc_learn.demos.format.video_segments import Segments, VideoSegment, video_keys
from hrc_learn.demos.issue import DatasetError
from hrc_learn.demos.read.component_names import INDEX_KEYS
from hrc_learn.demos.repair.episode_edit import Draft, Meaning, RepairOptions
from hrc_learn.demos.write.schema import TIME_KEY
from hrc_learn.demos.write.staging import (
    RecordingHeader,
    StagedEpisode,
    to_table,
    write_episode,
)

# The columns of a repaired dataset, as LeRobot wants them.


class Recast:
    """How episodes of one dataset are written into another of version 3.0.

    Attributes:
        tasks: Task texts by index.
        notes: What is changed in all episodes.
    """

    def __init__(
        self,
        folder: DatasetFolder,
        sidecar: Sidecar,
        meaning: Meaning,
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
        self._add_time = "time" not in meaning.matching.selections and options.fps is None
        self._header = RecordingHeader(
            fps=float(options.fps or folder.fps),
            robot_type=folder.robot_type or "unknown",
            features=self._features(),
            sidecar=self._sidecar(sidecar, units),
        )

    def videos_of(self, entry: EpisodeEntry) -> Segments:
        """Where the images of the cameras that are kept lie.

        Raises:
            DatasetError: Some of them are not there.
        """
        found = self._segments.get(entry.index, {})
        missing = [key for key in self._cameras if key not in found]
        if missing:
            raise DatasetError(
                "the video of this episode is missing: leave out the videos (videos=False), or "
                "the episode (drop_bad_episodes)",
                episode=entry.index,
                key=missing[0],
            )
        return {key: found[key] for key in self._cameras}

    def stage(self, path: Path, draft: Draft, frames_before: int) -> None:
        """Write one episode beside the new dataset."""
        number = int(path.stem.rpartition("_")[2])
        count = np.arange(len(draft))
        tasks = self._tasks(draft)
        values = {k: v for k, v in draft.frames.items() if k in self._header.features}
        if self._add_time:
            values[TIME_KEY] = draft.time[:, None]
        values |= {
            "timestamp": count / self._header.fps,
            "frame_index": count,
            "episode_index": np.full_like(count, number),
            "index": count + frames_before,
            "task_index": tasks,
        }
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

    def _tasks(self, draft: Draft) -> np.ndarray:
        if "task_index" in draft.frames:
            return np.array(
                [self._task_index[int(i)] for i in draft.frames["task_index"][:, 0]]
            )
        texts = draft.entry.tasks or self.tasks[:1]
        return np.full(len(draft), self.tasks.index(texts[0]))


# Images of repaired episodes: the parts of the old videos that show what is left.


def cut_segments(draft: Draft, segments: Segments, fps: float) -> Segments:
    """The images of those frames that are left.

    Raises:
        DatasetError: They are not in one piece.
    """
    if not segments:
        return {}
    if draft.kept is None or (np.diff(draft.kept) != 1).any():
        raise draft.bad(
            "its videos would have to be encoded anew, because frames were dropped in the "
            "middle or resampled: leave the videos out (videos=False), or the frames as they "
            "are (drop_repeats=False, drop_bad_frames=False, fps=None)"
        )
    first, count = int(draft.kept[0]), len(draft.kept)
    return {
        key: VideoSegment(
            file=segment.file,
            start=segment.start + first / fps,
            stop=segment.start + (first + count) / fps,
        )
        for key, segment in segments.items()
    }
