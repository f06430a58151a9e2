"""Image features of a dataset in a folder beside it: one file an episode.

    NAME.features/CAMERA.FEATURE/episode_000000.parquet    u, v, visible: one row a frame

The dataset itself is never touched. Each file is whole or not there, and says of which video
it was made, so that an extraction goes on where it was broken off and notices new recordings.
"""

import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Float64

from ..finding import DatasetError
from ..parquet import open_parquet, read_table, to_numpy
from ..video_segment import VideoSegment

_SOURCE = b"hrc_learn.video"


@dataclass(frozen=True, kw_only=True, eq=False)
class FeatureTrack:
    """An image feature along one episode."""

    pixels: Float64[np.ndarray, "_frames 2"]
    """(u right, v down) [px], 0 where it was not seen."""
    visible: Bool[np.ndarray, " _frames"]


def features_folder(root: Path) -> Path:
    """Where the features found in the videos of the dataset `root` are kept."""
    return root.with_name(root.name + ".features")


def feature_names(root: Path) -> list[str]:
    """Features that were extracted, whole or in part."""
    return sorted(path.name for path in features_folder(root).glob("*") if path.is_dir())


class FeatureCache:
    """The files of one feature of one dataset."""

    def __init__(self, root: Path, name: str):
        self.name = name
        self._folder = features_folder(root) / name

    def path(self, episode: int) -> Path:
        return self._folder / f"episode_{episode:06d}.parquet"

    def is_current(self, episode: int, segment: VideoSegment) -> bool:
        """Whether the episode's file is there and was made of this very video."""
        path = self.path(episode)
        if not path.is_file():
            return False
        metadata = pq.read_schema(path).metadata or {}
        return metadata.get(_SOURCE) == _fingerprint(segment)

    def write(self, episode: int, segment: VideoSegment, track: FeatureTrack) -> None:
        """Keep what was found in an episode; its file is whole or not there."""
        path = self.path(episode)
        path.parent.mkdir(parents=True, exist_ok=True)
        table = pa.table(
            {
                "u": pa.array(track.pixels[:, 0]),
                "v": pa.array(track.pixels[:, 1]),
                "visible": pa.array(track.visible),
            }
        )
        unfinished = path.with_suffix(f".unfinished.{os.getpid()}")
        pq.write_table(
            table.replace_schema_metadata({_SOURCE: _fingerprint(segment)}), unfinished
        )
        unfinished.replace(path)

    def read(self, episode: int, frames: int) -> FeatureTrack:
        """What was found in an episode.

        Raises:
            DatasetError: It was not extracted, or is of another recording.
        """
        file = str(self.path(episode))
        if not self.path(episode).is_file():
            raise DatasetError(
                f"{self.name} was not extracted from this episode: run extract_features.py, "
                f"which goes on where it was broken off",
                file=file,
                episode=episode,
            )
        table = read_table(open_parquet(Path(), file, episode), file)
        u, v, visible = (to_numpy(table.column(name))[:, 0] for name in ("u", "v", "visible"))
        if len(u) != frames:
            raise DatasetError(
                f"{self.name} has {len(u)} frames, the episode {frames}: run "
                f"extract_features.py again",
                file=file,
                episode=episode,
            )
        return FeatureTrack(pixels=np.stack([u, v], axis=1), visible=visible.astype(bool))


def _fingerprint(segment: VideoSegment) -> bytes:
    state = segment.file.stat()
    content = [segment.file.name, state.st_size, state.st_mtime_ns, segment.start, segment.stop]
    return json.dumps(content).encode()
