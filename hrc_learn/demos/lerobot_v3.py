"""A LeRobot dataset of version 3.0 put together from staged episodes.

data/chunk-000/file-000.parquet            frames, one row group an episode
meta/info.json                             features, frame rate, counts
meta/stats.json                            statistics of every feature
meta/tasks.parquet                         task texts by index
meta/episodes/chunk-000/file-000.parquet   where each episode lies, its statistics
meta/hrc_learn.json                        units, frames, meaning of columns (our own)
"""

import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from .sidecar import SIDECAR_PATH
from .staging import RecordingHeader, StagedEpisode, read_episode
from .statistics import Statistics, combined_statistics
from .video import video_path

VERSION = "v3.0"
INDEX_FEATURES = {
    "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    **{
        key: {"dtype": "int64", "shape": [1], "names": None}
        for key in ("frame_index", "episode_index", "index", "task_index")
    },
}
"""Features that LeRobot adds to every dataset."""

DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
CHUNK_SIZE = 1000
FILE_SIZE_MB = 100
VIDEO_FILE_SIZE_MB = 200

# pandas reads the task texts as the table's index only when told so in its own terms.
_PANDAS_INDEX = {
    "index_columns": ["task"],
    "column_indexes": [],
    "columns": [
        {
            "name": name,
            "field_name": name,
            "pandas_type": kind,
            "numpy_type": numpy_kind,
            "metadata": None,
        }
        for name, kind, numpy_kind in (
            ("task_index", "int64", "int64"),
            ("task", "unicode", "object"),
        )
    ],
}


@dataclass(frozen=True)
class _SavedEpisode:
    """An episode whose frames are written: its place and what the metadata says of it."""

    length: int
    task: str
    statistics: Statistics
    file: int
    """Data files written before its own."""


def assemble(paths: Sequence[Path], target: Path) -> None:
    """Write the dataset of these staged episodes.

    Args:
        paths: Files of `staging.write_episode`, in order.
        target: Folder to create.
    """
    header = read_episode(paths[0]).header
    for folder in ("meta", "meta/episodes/chunk-000", "data"):
        (target / folder).mkdir(parents=True)
    saved = _write_frames(target, header, paths)
    cameras = [key for key, f in header.features.items() if f["dtype"] == "video"]
    _place_videos(paths[0].parent, target, cameras, len(saved))
    tasks = list(dict.fromkeys(episode.task for episode in saved))
    _write_tasks(target / "meta/tasks.parquet", tasks)
    _write_episodes(target / EPISODES_PATH, saved, cameras, header.fps)
    _write_json(target / "meta/info.json", _info(header, saved, tasks))
    _write_json(
        target / "meta/stats.json",
        combined_statistics([episode.statistics for episode in saved]),
    )
    _write_json(target / SIDECAR_PATH, header.sidecar)


def _write_frames(
    target: Path, header: RecordingHeader, paths: Sequence[Path]
) -> list[_SavedEpisode]:
    saved: list[_SavedEpisode] = []
    for file, group in enumerate(_by_size(paths)):
        path = target / DATA_PATH.format(
            chunk_index=file // CHUNK_SIZE, file_index=file % CHUNK_SIZE
        )
        path.parent.mkdir(exist_ok=True)
        schema = _data_schema(read_episode(group[0]).table.schema, header.features)
        with pq.ParquetWriter(path, schema) as writer:
            for staged in map(read_episode, group):
                writer.write_table(staged.table.cast(schema))
                saved.append(_saved(staged, file))
    return saved


def _saved(staged: StagedEpisode, file: int) -> _SavedEpisode:
    return _SavedEpisode(len(staged.table), staged.task, staged.statistics, file)


def _by_size(paths: Sequence[Path]) -> Iterator[list[Path]]:
    """Group episodes into files of at most `FILE_SIZE_MB`, at least one episode each."""
    group, size = [], 0
    for path in paths:
        size += path.stat().st_size
        if group and size > FILE_SIZE_MB * 2**20:
            yield group
            group, size = [], path.stat().st_size
        group.append(path)
    yield group


def _data_schema(schema: pa.Schema, features: dict[str, dict]) -> pa.Schema:
    """The schema with the types in Hugging Face's own terms, as LeRobot leaves them."""
    types = {}
    for name in schema.names:
        value = {"dtype": features[name]["dtype"], "_type": "Value"}
        width = features[name]["shape"][0]
        types[name] = (
            value if width == 1 else {"feature": value, "length": width, "_type": "List"}
        )
    return schema.with_metadata({"huggingface": json.dumps({"info": {"features": types}})})


def _write_tasks(path: Path, tasks: Sequence[str]) -> None:
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": tasks})
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(_PANDAS_INDEX)}), path)


def _place_videos(staging: Path, target: Path, cameras: Sequence[str], episodes: int) -> None:
    for camera in cameras:
        for episode in range(episodes):
            chunk, file = divmod(episode, CHUNK_SIZE)
            path = target / VIDEO_PATH.format(
                video_key=camera, chunk_index=chunk, file_index=file
            )
            path.parent.mkdir(parents=True, exist_ok=True)
            _link(video_path(staging, camera, episode), path)


def _link(source: Path, target: Path) -> None:
    """A second name for a file, not another: until the dataset stands, both must."""
    try:
        target.hardlink_to(source)
    except OSError:  # a file system without links
        shutil.copyfile(source, target)


def _write_episodes(
    path: Path, saved: Sequence[_SavedEpisode], cameras: Sequence[str], fps: float
) -> None:
    stops = [0]
    for episode in saved:
        stops.append(stops[-1] + episode.length)
    chunks, files = zip(*(divmod(episode.file, CHUNK_SIZE) for episode in saved), strict=True)
    columns = {
        "episode_index": range(len(saved)),
        "tasks": [[episode.task] for episode in saved],
        "length": [episode.length for episode in saved],
        "data/chunk_index": chunks,
        "data/file_index": files,
        "dataset_from_index": stops[:-1],
        "dataset_to_index": stops[1:],
        **{
            f"videos/{camera}/{name}": values
            for camera in cameras
            for name, values in {
                "chunk_index": [episode // CHUNK_SIZE for episode in range(len(saved))],
                "file_index": [episode % CHUNK_SIZE for episode in range(len(saved))],
                "from_timestamp": [0.0] * len(saved),
                "to_timestamp": [episode.length / fps for episode in saved],
            }.items()
        },
        **{
            f"stats/{key}/{name}": [episode.statistics[key][name] for episode in saved]
            for key, statistics in saved[0].statistics.items()
            for name in statistics
        },
        "meta/episodes/chunk_index": [0] * len(saved),
        "meta/episodes/file_index": [0] * len(saved),
    }
    pq.write_table(pa.table({name: list(values) for name, values in columns.items()}), path)


def _info(
    header: RecordingHeader, saved: Sequence[_SavedEpisode], tasks: Sequence[str]
) -> dict:
    has_video = any(feature["dtype"] == "video" for feature in header.features.values())
    return {
        "codebase_version": VERSION,
        "fps": int(header.fps) if float(header.fps).is_integer() else header.fps,
        "features": header.features,
        "total_episodes": len(saved),
        "total_frames": sum(episode.length for episode in saved),
        "total_tasks": len(tasks),
        "chunks_size": CHUNK_SIZE,
        "data_files_size_in_mb": FILE_SIZE_MB,
        "video_files_size_in_mb": VIDEO_FILE_SIZE_MB,
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH if has_video else None,
        "robot_type": header.robot_type,
        "splits": {"train": f"0:{len(saved)}"},
    }


def _write_json(path: Path, content: dict) -> None:
    path.write_text(json.dumps(content, indent=4, ensure_ascii=False) + "\n")
