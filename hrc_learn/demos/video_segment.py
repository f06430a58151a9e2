"""Parts of video files, and the places they get in a dataset."""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from .lerobot_v3 import CHUNK_SIZE, VIDEO_PATH, place


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
