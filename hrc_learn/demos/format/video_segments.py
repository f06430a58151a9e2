"""Where the images of a dataset lie: segments of video files, for versions 2.0, 2.1 and 3.0."""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from hrc_learn.demos.format.dataset_folder import DatasetFolder, EpisodeEntry
from hrc_learn.demos.format.lerobot_v3 import CHUNK_SIZE, VIDEO_PATH, place
from hrc_learn.demos.format.parquet import read_rows
from hrc_learn.demos.issue import DatasetError

# Parts of video files, and the places they get in a dataset.


@dataclass(frozen=True, kw_only=True)
class VideoSegment:
    """The images of one camera during one episode."""

    file: Path
    start: float
    """Where they begin in the file [s]."""
    stop: float
    """Where they end [s]."""


Segments = Mapping[str, VideoSegment]
"""Video feature -> its images during one episode."""


class VideoShelf:
    """Files of videos as they are placed in a new dataset: each once, whoever shares it."""

    def __init__(self, root: Path, taken: Mapping[str, int] | None = None):
        """
        Args:
            root: The new dataset.
            taken: Files that each camera already has there.
        """
        self._root = root
        self._count = dict(taken or {})
        self._placed: dict[tuple[str, Path], int] = {}

    def columns(self, key: str, segment: VideoSegment) -> dict[str, int | float]:
        """Place the file if it is not yet, and say where, in the terms of the episode list."""
        number = self._place(key, segment.file)
        return {
            f"videos/{key}/chunk_index": number // CHUNK_SIZE,
            f"videos/{key}/file_index": number % CHUNK_SIZE,
            f"videos/{key}/from_timestamp": segment.start,
            f"videos/{key}/to_timestamp": segment.stop,
        }

    def _place(self, key: str, file: Path) -> int:
        if (key, file) not in self._placed:
            number = self._count.get(key, 0)
            link(file, self._root / place(VIDEO_PATH, number, video_key=key))
            self._count[key], self._placed[key, file] = number + 1, number
        return self._placed[key, file]


def link(source: Path, target: Path) -> None:
    """A second name for a file, not another: until the dataset stands, both must."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        target.hardlink_to(source)
    except OSError:  # a file system without links
        shutil.copyfile(source, target)


# Where the images of a dataset lie, for its versions 2.0, 2.1 and 3.0.


def video_keys(folder: DatasetFolder) -> list[str]:
    """Features that are kept as videos."""
    return [key for key, feature in folder.features.items() if feature.dtype == "video"]


def read_segments(folder: DatasetFolder) -> dict[int, Segments]:
    """Where the images of each episode lie; without those whose file is not there."""
    keys = video_keys(folder)
    if not keys:
        return {}
    places = _places_v3(folder, keys) if folder.version.startswith("v3") else {}
    segments = {}
    for entry in folder.episodes:
        found = places.get(entry.index) or _of_own_file(folder, entry, keys)
        segments[entry.index] = {k: s for k, s in found.items() if s.file.is_file()}
    return segments


def _places_v3(folder: DatasetFolder, keys: list[str]) -> dict[int, Segments]:
    template = folder.info.get("video_path")
    places = {}
    for path in sorted((folder.root / "meta/episodes").glob("*/*.parquet")):
        for row in read_rows(folder.root, str(path.relative_to(folder.root)), ()):
            places[row["episode_index"]] = {
                key: VideoSegment(
                    file=folder.root
                    / str(template).format(
                        video_key=key,
                        chunk_index=row[f"videos/{key}/chunk_index"],
                        file_index=row[f"videos/{key}/file_index"],
                    ),
                    start=row[f"videos/{key}/from_timestamp"],
                    stop=row[f"videos/{key}/to_timestamp"],
                )
                for key in keys
                if f"videos/{key}/chunk_index" in row
            }
    return places


def _of_own_file(folder: DatasetFolder, entry: EpisodeEntry, keys: list[str]) -> Segments:
    template = str(folder.info.get("video_path"))
    chunk = entry.index // int(folder.info.get("chunks_size", 1000))
    try:
        files = {
            key: template.format(video_key=key, episode_chunk=chunk, episode_index=entry.index)
            for key in keys
        }
    except (KeyError, IndexError, ValueError) as error:
        if folder.version.startswith("v3"):
            return {}
        raise DatasetError(
            f"video_path {template!r} does not fit the dataset's version", file="meta/info.json"
        ) from error
    return {
        key: VideoSegment(file=folder.root / file, start=0.0, stop=entry.length / folder.fps)
        for key, file in files.items()
    }
