"""Copies of a dataset with edited frames: features, statistics, tasks and videos."""

import shutil
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from hrc_learn.demos import recorded_episode as recorded
from hrc_learn.demos.dataset_assembly import assemble
from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.quality.episode_edits import EpisodeEdit
from hrc_learn.demos.read import metadata
from hrc_learn.demos.read.contract import (
    SidecarColumn,
    fingerprint,
    keep_contract,
    read_sidecar,
)
from hrc_learn.demos.read.dataset_files import open_parquet, read_table
from hrc_learn.demos.read.dataset_folder import DatasetFolder, open_folder, recorded_statistics
from hrc_learn.demos.read.quantities import INDEX_KEYS
from hrc_learn.demos.read.source import OpenedDataset
from hrc_learn.demos.videos import Segments, VideoSegment, decode_image, image_at, subsampled
from hrc_learn.store import DATASET, replacing

NO_TASK = "unnamed task"
_IN_TABLES = ("video", *metadata.NUMERIC)
_STATISTICS_IMAGES = 20
"""Largest number of images of an episode that enter its statistics, as in LeRobot for short
episodes."""
_LARGEST_NOTE = 2**20
"""Largest card, licence or foreign metadata file that is copied [bytes]."""


@dataclass(frozen=True, kw_only=True)
class Rewritten:
    """One episode of the new dataset: its frames, its videos, and the task of each frame."""

    writer: "ColumnRewriter"
    edit: EpisodeEdit
    videos: Segments
    tasks: list[str]


def write_copy(
    out: Path, episodes: Iterable[Rewritten], tasks: Sequence[str], notes_of: Path | None = None
) -> None:
    """Write rewritten episodes into a new dataset.

    Args:
        out: Folder of the new dataset, which must not exist.
        episodes: The episodes, all with the same header.
        tasks: Task texts in order of their indices.
        notes_of: Dataset from which the card, the licence and the metadata of other programs
            are copied.

    Raises:
        DatasetError: There are no episodes.
        FileExistsError: `out` exists.
    """
    with replacing(out, DATASET) as target:
        staging = target / "episodes"
        staging.mkdir(parents=True)
        paths: list[Path] = []
        videos: list[Segments] = []
        numbers, frames = {text: n for n, text in enumerate(tasks)}, 0
        for episode in episodes:
            paths.append(recorded.episode_path(staging, len(videos)))
            episode.writer.stage(paths[-1], episode, numbers, frames)
            videos.append(episode.videos)
            frames += len(episode.edit)
        if not paths:
            raise DatasetError("no episode could be repaired", file=notes_of)
        assemble(paths, target, videos=videos, tasks=tasks)
        if notes_of is not None:
            _copy_notes(notes_of, target)
        contract = read_sidecar(target).contract
        if contract.components:
            renewed = fingerprint(open_folder(target))
            keep_contract(target, replace(contract, fingerprint=renewed))
        shutil.rmtree(staging)


def _copy_notes(source: Path, target: Path) -> None:
    """Copy the card, the licence and metadata of other programs."""
    for path in (*source.glob("*.md"), *source.glob("LICENSE*"), *source.glob("meta/*.json")):
        there = target / path.relative_to(source)
        ordinary = path.is_file() and not path.is_symlink()
        if ordinary and not there.exists() and path.stat().st_size < _LARGEST_NOTE:
            shutil.copyfile(path, there)


def listed_tasks(folder: DatasetFolder) -> list[str]:
    """Task texts of a dataset: listed tasks by index, then tasks that only episodes name."""
    listed = [folder.tasks[index] for index in sorted(folder.tasks)]
    listed += [task for entry in folder.episodes for task in entry.tasks]
    return [*dict.fromkeys(listed)] or [NO_TASK]


def new_header(
    dataset: OpenedDataset,
    units: Mapping[str, str],
    cameras: Collection[str],
    *,
    fps: float | int | None = None,
    add_time: bool = False,
) -> recorded.RecordingHeader:
    """Header of a copy of a dataset.

    Args:
        dataset: The old dataset.
        units: Role -> unit from the caller, which also replaces the unit in the contract.
        cameras: Features whose videos are copied.
        fps: Rate to which episodes are resampled [1/s]; None for the old rate.
        add_time: Add the old stamps as `time`.
    """
    folder, old, features = dataset.folder, dataset.sidecar, {}
    for key, feature in folder.features.items():
        declared = folder.info["features"][key]
        if key in INDEX_KEYS or (feature.dtype == "video" and key not in cameras):
            continue
        if feature.numeric:
            names = list(feature.names) if feature.names else None
            declared = declared | {"shape": list(feature.shape) or [1], "names": names}
        features[key] = declared
    columns, declared_units = dict(old.columns), {**old.units, **units}
    if add_time:
        features[recorded.TIME_KEY] = {"dtype": "float64", "shape": [1], "names": ["time"]}
        if columns:
            columns["time"] = SidecarColumn(key=recorded.TIME_KEY, names=("time",))
            declared_units["time"] = "s"
    given = {
        column: unit
        for role, unit in units.items()
        if role in dataset.columns.selections
        for column in dataset.columns.selections[role].columns
    }
    parts = [replace(p, unit=given.get(p.column, p.unit)) for p in old.contract.components]
    contract = replace(old.contract, components=tuple(parts))
    return recorded.RecordingHeader(
        fps=float(fps or folder.fps),
        robot_type=folder.robot_type or "unknown",
        features={**features, **metadata.INDEX_FEATURES},
        sidecar=replace(old, columns=columns, units=declared_units, contract=contract),
    )


class ColumnRewriter:
    """Writer of the episodes of one dataset into a new dataset."""

    def __init__(
        self,
        folder: DatasetFolder,
        header: recorded.RecordingHeader,
        segments: Mapping[int, Segments],
    ):
        """
        Args:
            folder: The old dataset.
            header: Properties of the new dataset.
            segments: Video segments by episode index.
        """
        self._folder, self._header, self._segments = folder, header, segments
        types = {key: feature["dtype"] for key, feature in header.features.items()}
        self.cameras = [key for key, dtype in types.items() if dtype == "video"]
        self._image_columns = [key for key, dtype in types.items() if dtype == "image"]
        self._others = [k for k, dtype in types.items() if not dtype.startswith(_IN_TABLES)]
        pictures = self.cameras or self._image_columns
        self._recorded = recorded_statistics(folder) if pictures else {}

    def rewritten(self, edit: EpisodeEdit) -> Rewritten:
        """An edited episode with its tasks and its parts of the old videos.

        Raises:
            DatasetError: A video is missing or would have to be re-encoded, or a task is not
                listed.
        """
        videos, tasks = self._videos_of(edit), self._tasks_of(edit)
        return Rewritten(writer=self, edit=edit, videos=videos, tasks=tasks)

    def _videos_of(self, edit: EpisodeEdit) -> Segments:
        """Parts of the old videos that show the remaining frames."""
        found, fps = self._segments.get(edit.entry.index, {}), self._folder.fps
        for key in self.cameras:
            if key not in found:
                text = "the video of this episode is missing: copy it, or leave out the videos"
                text += " (--no-videos) or the episode (--drop bad-episodes)"
                raise edit.fault(text, key=key)
        if self.cameras and (edit.resampled or (np.diff(edit.kept) != 1).any()):
            raise edit.fault(
                "its videos would have to be encoded anew, because frames were dropped in the "
                "middle or resampled: leave the videos out (videos=False), or keep the frames "
                "(drop_repeats=False, drop_bad_frames=False, fps=None)"
            )
        if self._image_columns and edit.resampled:
            text = "its images cannot be resampled: give no fps"
            raise edit.fault(text, key=self._image_columns[0])
        begin = int(edit.kept[0]) / fps
        end = begin + len(edit) / fps
        shown = {key: found[key] for key in self.cameras}
        return {
            k: replace(s, start=s.start + begin, stop=s.start + end) for k, s in shown.items()
        }

    def _tasks_of(self, edit: EpisodeEdit) -> list[str]:
        """Task of each frame."""
        listed = self._folder.tasks
        if "task_index" not in edit.frames or not listed:
            first = (*edit.entry.tasks, *listed_tasks(self._folder))[0]
            return [first] * len(edit)
        indices = edit.frames["task_index"][:, 0].tolist()
        for frame, index in enumerate(indices):
            if index not in listed:
                text = f"task {index:g} is not in the list of tasks: leave the episode out"
                raise edit.fault(f"{text} (--drop bad-episodes)", frame, "task_index")
        return [listed[index] for index in indices]

    def stage(
        self, path: Path, episode: Rewritten, numbers: Mapping[str, int], frames_before: int
    ) -> None:
        """Write one episode to a file from which the new dataset is assembled.

        Args:
            path: The file.
            episode: Result of `rewritten`.
            numbers: Index of each task text.
            frames_before: Number of frames of all earlier episodes.
        """
        edit, others = episode.edit, self._other_columns(episode.edit)
        pictures = {**episode.videos, **others}
        statistics = {
            key: self._image_statistics(edit, key, pictures[key])
            for key in (*self.cameras, *self._image_columns)
        }
        indices = np.array([numbers[text] for text in episode.tasks])
        recorded.write_episode(
            path,
            self._header,
            {recorded.TIME_KEY: edit.time[:, None]} | edit.frames,
            ([*dict.fromkeys(episode.tasks)], indices),
            frames_before,
            others=others,
            statistics=statistics,
        )

    def _other_columns(self, edit: EpisodeEdit) -> dict[str, pa.ChunkedArray]:
        """Columns that hold no numbers, for the remaining frames."""
        if not self._others:
            return {}
        entry = edit.entry
        parquet = open_parquet(self._folder.root, entry.file, entry.index)
        rows = slice(entry.start, entry.start + entry.length)
        table = read_table(parquet, entry.file, self._others, rows).take(pa.array(edit.kept))
        return {key: table.column(key) for key in self._others}

    def _image_statistics(
        self, edit: EpisodeEdit, key: str, images: pa.ChunkedArray | VideoSegment
    ) -> dict[str, list]:
        """Recorded image statistics if all frames remain, else statistics of some images."""
        known = self._recorded.get(edit.entry.index, {}).get(key)
        if known is not None and len(edit) == edit.entry.length:
            return known
        chosen = np.linspace(0, len(edit) - 1, min(len(edit), _STATISTICS_IMAGES)).astype(int)
        if isinstance(images, VideoSegment):
            some = [image_at(images, int(i), self._folder.fps) for i in chosen]
        else:
            some = [decode_image(images[int(i)].as_py()["bytes"]) for i in chosen]
        return metadata.image_statistics(np.stack([subsampled(image) for image in some]))
