"""Episodes on disk while a recording goes on: one complete file each.

Every saved episode is a file of its own beside the target (`NAME.recording/`), written
under another name and renamed when whole. A recording that is killed therefore loses the
open episode and nothing else, and what it leaves is never taken for a dataset.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hrc_learn.demos.format.lerobot_v3 import Statistics
from hrc_learn.demos.issue import DatasetError
from hrc_learn.store import new_file, resolved

_METADATA_KEY = b"hrc_learn"


@dataclass(frozen=True, kw_only=True)
class RecordingHeader:
    """What all episodes of a recording have in common; plain JSON values only."""

    fps: float
    robot_type: str
    features: dict[str, dict]
    """As in `meta/info.json`, LeRobot's index columns included."""
    sidecar: dict
    """Content of `meta/hrc_learn.json`."""


@dataclass(frozen=True, kw_only=True)
class StagedEpisode:
    """One saved episode."""

    header: RecordingHeader
    tasks: list[str]
    """Texts of the tasks it shows, at least one."""
    statistics: Statistics
    table: pa.Table


def staging_folder(root: Path) -> Path:
    """Where the recording of the dataset `root` is kept until it is whole."""
    root = resolved(root)
    return root.with_name(root.name + ".recording")


def episode_path(folder: Path, index: int) -> Path:
    return folder / f"episode_{index:06d}.parquet"


def write_episode(path: Path, episode: StagedEpisode) -> None:
    """Write one episode so that `path` exists only once it is complete and on disk."""
    metadata = {
        "header": vars(episode.header),
        "tasks": episode.tasks,
        "statistics": episode.statistics,
    }
    table = episode.table.replace_schema_metadata({_METADATA_KEY: json.dumps(metadata)})
    with new_file(path) as part:
        pq.write_table(table, part)


def read_episode(path: Path) -> StagedEpisode:
    """Read an episode that `write_episode` wrote."""
    table = pq.read_table(path)
    metadata = json.loads(table.schema.metadata[_METADATA_KEY])
    return StagedEpisode(
        header=RecordingHeader(**metadata["header"]),
        tasks=metadata["tasks"],
        statistics=metadata["statistics"],
        table=table,
    )


def staged_paths(folder: Path, first: int = 0) -> list[Path]:
    """Files of the saved episodes, in order.

    Args:
        folder: The staging folder.
        first: Index of the first one: the episodes of the dataset that is appended to.

    Raises:
        DatasetError: None was saved, or one in the middle is gone.
    """
    paths = sorted(folder.glob("episode_*.parquet"))
    if not paths:
        raise DatasetError("no episode was saved, so there is no dataset to write", file=folder)
    for index, path in enumerate(paths, start=first):
        if path != episode_path(folder, index):
            raise DatasetError(
                "this episode is missing from the recording; rename the later ones to close "
                "the gap if it is lost",
                file=episode_path(folder, index),
                episode=index,
            )
    return paths


def to_table(values: dict[str, np.ndarray], features: dict[str, dict]) -> pa.Table:
    """Arrow table of one episode: a number or a list of fixed length a frame."""
    arrays = {
        key: _to_arrow(values[key], feature["dtype"], feature["shape"][0])
        for key, feature in features.items()
        if feature["dtype"] != "video"
    }
    return pa.table(arrays)


def _to_arrow(values: np.ndarray, dtype: str, width: int) -> pa.Array:
    contiguous = np.ascontiguousarray(values, dtype=dtype)
    if contiguous.dtype == bool:
        flat = pa.array(contiguous.reshape(-1))  # packed to bits
        return flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)
    # Not pa.array(): it imports pandas, which would hold up the first episode for a second.
    buffers = [None, pa.py_buffer(contiguous)]
    flat = pa.Array.from_buffers(
        pa.from_numpy_dtype(contiguous.dtype), contiguous.size, buffers
    )
    return flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)
