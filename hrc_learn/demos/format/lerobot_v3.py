"""What stands where in a LeRobot dataset of version 3.0, and the statistics it keeps."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Shaped, UInt8

# What stands where in a LeRobot dataset of version 3.0.
#
# data/chunk-000/file-000.parquet            frames, one row group an episode
# meta/info.json                             features, frame rate, counts
# meta/stats.json                            statistics of every feature
# meta/tasks.parquet                         task texts by index
# meta/episodes/chunk-000/file-000.parquet   where each episode lies, its statistics
# meta/hrc_learn.json                        units, frames, meaning of columns (our own)

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
    text = json.dumps(content, indent=4, ensure_ascii=False) + "\n"
    path.write_text(text, encoding="utf-8")


# Statistics of features, as LeRobot keeps them for every episode and for the whole.

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}

Statistics = dict[str, dict[str, list]]
"""Feature -> statistic (min, max, mean, std, count, q01 ... q99) -> one number a component."""


def episode_statistics(features: Mapping[str, Shaped[np.ndarray, "_frames ..."]]) -> Statistics:
    """Statistics of each feature over the frames of one episode."""
    return {key: _of_columns(np.asarray(values, float)) for key, values in features.items()}


def image_statistics(images: UInt8[np.ndarray, "_count _height _width 3"]) -> dict[str, list]:
    """Statistics of each colour channel, scaled to 0..1, in the nesting LeRobot expects."""
    flat = _of_columns(images.reshape(-1, 3) / 255)
    nested = {name: [[[value]] for value in values] for name, values in flat.items()}
    return nested | {"count": [len(images)]}


def combined_statistics(episodes: Sequence[Statistics]) -> Statistics:
    """Statistics over all episodes.

    Exact but for the quantiles, which are the means of the episodes' weighted by length:
    that is how LeRobot itself combines them.
    """
    return {key: _combine([episode[key] for episode in episodes]) for key in episodes[0]}


def _of_columns(values: np.ndarray) -> dict[str, list]:
    values = values.reshape(len(values), -1)
    quantiles = np.quantile(values, list(QUANTILES.values()), axis=0)
    return {
        "min": values.min(0).tolist(),
        "max": values.max(0).tolist(),
        "mean": values.mean(0).tolist(),
        "std": values.std(0).tolist(),
        "count": [len(values)],
        **{name: row.tolist() for name, row in zip(QUANTILES, quantiles, strict=True)},
    }


def _combine(episodes: Sequence[dict[str, list]]) -> dict[str, list]:
    stacked = {name: np.array([episode[name] for episode in episodes]) for name in episodes[0]}
    weights = (stacked["count"] / stacked["count"].sum()).reshape(
        -1, *[1] * (stacked["mean"].ndim - 1)
    )
    mean = (weights * stacked["mean"]).sum(0)
    variance = (weights * (stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2)).sum(0)
    combined = {
        "min": stacked["min"].min(0),
        "max": stacked["max"].max(0),
        "mean": mean,
        "std": np.sqrt(variance),
        "count": stacked["count"].sum(0),
        **{name: (weights * stacked[name]).sum(0) for name in QUANTILES},
    }
    return {name: values.tolist() for name, values in combined.items()}
