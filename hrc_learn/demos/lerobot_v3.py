"""What stands where in a LeRobot dataset of version 3.0.

data/chunk-000/file-000.parquet            frames, one row group an episode
meta/info.json                             features, frame rate, counts
meta/stats.json                            statistics of every feature
meta/tasks.parquet                         task texts by index
meta/episodes/chunk-000/file-000.parquet   where each episode lies, its statistics
meta/hrc_learn.json                        units, frames, meaning of columns (our own)
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

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


def place(template: str, number: int, **fields: str) -> str:
    """Path of the file of that number; a chunk holds `CHUNK_SIZE` of them."""
    chunk, file = divmod(number, CHUNK_SIZE)
    return template.format(chunk_index=chunk, file_index=file, **fields)


def data_schema(schema: pa.Schema, features: Mapping[str, dict]) -> pa.Schema:
    """The schema with the types in Hugging Face's own terms, as LeRobot leaves them."""
    types = {}
    for name in schema.names:
        value = {"dtype": features[name]["dtype"], "_type": "Value"}
        width = features[name]["shape"][0]
        types[name] = (
            value if width == 1 else {"feature": value, "length": width, "_type": "List"}
        )
    return schema.with_metadata({"huggingface": json.dumps({"info": {"features": types}})})


def write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """The list of task texts, each at its index."""
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": tasks})
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(_PANDAS_INDEX)}), path)


def info(
    features: Mapping[str, dict],
    fps: float,
    robot_type: str,
    *,
    episodes: int,
    frames: int,
    tasks: int,
) -> dict:
    """Content of `meta/info.json`."""
    has_video = any(feature["dtype"] == "video" for feature in features.values())
    return {
        "codebase_version": VERSION,
        "fps": int(fps) if float(fps).is_integer() else fps,
        "features": dict(features),
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": tasks,
        "chunks_size": CHUNK_SIZE,
        "data_files_size_in_mb": FILE_SIZE_MB,
        "video_files_size_in_mb": VIDEO_FILE_SIZE_MB,
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH if has_video else None,
        "robot_type": robot_type,
        "splits": {"train": f"0:{episodes}"},
    }


def write_json(path: Path, content: Mapping) -> None:
    path.write_text(json.dumps(content, indent=4, ensure_ascii=False) + "\n")
