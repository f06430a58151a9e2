"""Metadata of a dataset: declared features, and the layout of version 3.0.

data/chunk-000/file-000.parquet            frames, one row group per episode
meta/info.json                             features, frame rate, counts
meta/stats.json                            statistics of every feature
meta/tasks.parquet                         task texts by index
meta/episodes/chunk-000/file-000.parquet   place and statistics of each episode
meta/hrc_learn.json                        sidecar (`read.contract`)
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from math import prod
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Shaped, UInt8

from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.read.dataset_files import INFO_PATH, write_parquet
from hrc_learn.demos.read.naming import names_joint_quantity, role_of_key
from hrc_learn.demos.read.quantities import INDEX_KEYS

NUMERIC = ("float", "int", "uint", "bool")
"""Prefixes of numeric dtypes."""
# Largest numbers of components and of axes of a numeric column. The force field of a wrist
# sensor has several hundred components.
_WIDEST, _MOST_AXES = 100_000, 8
_WORDS_BEFORE = re.compile(r"^(?:observations?|actions?)[./](?:states?[./])?")
SIDECAR_PATH = "meta/hrc_learn.json"


@dataclass(frozen=True, kw_only=True)
class Feature:
    """One column of the frames, as declared in `meta/info.json`."""

    key: str
    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...] | None
    """One name per component, flattened; None if the dataset gives none."""

    @property
    def width(self) -> int:
        """Number of components per frame."""
        return prod(self.shape)

    @property
    def numeric(self) -> bool:
        """True if the column holds numbers."""
        return self.dtype.startswith(NUMERIC)

    @property
    def is_picture(self) -> bool:
        """True if the column holds images, encoded as a video or one by one."""
        return self.dtype in ("video", "image")

    def component(self, index: int) -> str:
        """Name of a component, or its number if it has none."""
        return f"component {index}" if self.names is None else self.names[index]


def read_features(info: dict) -> dict[str, Feature]:
    """Declared features by key; errors as in `read_feature`."""
    return {key: read_feature(key, declared) for key, declared in info["features"].items()}


def read_feature(key: str, declared: dict) -> Feature:
    """Feature from its declaration in `meta/info.json`.

    Raises:
        DatasetError: The declaration is malformed. Names that do not fit the shape are ignored.
    """
    try:
        dtype, shape = str(declared["dtype"]), tuple(int(n) for n in declared["shape"])
        if any(n < 0 for n in shape) or len(shape) > _MOST_AXES:
            raise ValueError(f"shape {shape}")
        numeric, width = dtype.startswith(NUMERIC), prod(shape)
        if numeric and width > _WIDEST:
            raise ValueError(f"{width} numbers a frame")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        text = f"the feature's declaration is malformed: {error!r}"
        raise DatasetError(text, file=INFO_PATH, key=key) from error
    names = flatten_names(declared.get("names")) if numeric else None
    if names is not None and len(names) != width:
        names = None  # openpi's converters name the vector, not its components
    own = _WORDS_BEFORE.sub("", key)
    if numeric and names is None and width == 1 and role_of_key(key) is None:
        # A feature for each joint: observation.elbow.pos.
        names = (own,) if names_joint_quantity(own) else None
    return Feature(key=key, dtype=dtype, shape=shape, names=names)


def flatten_names(names: object) -> tuple[str, ...] | None:
    """Component names from any form in use: a flat or nested list, a dict, or None."""
    if names is None:
        return None
    if isinstance(names, dict):
        parts = {k: (k,) if isinstance(x, int) else flatten_names(x) for k, x in names.items()}
        pairs = [(key, name) for key, part in parts.items() for name in part or ()]
        alike = len({name for _, name in pairs}) < len(pairs)
        names = [f"{key}_{name}" if alike else name for key, name in pairs]
    if not isinstance(names, list | tuple):
        return (str(names),)
    return tuple(name for item in names for name in flatten_names(item) or ())


VERSION = "v3.0"
INDEX_FEATURES = {
    key: {"dtype": "float32" if key == "timestamp" else "int64", "shape": [1], "names": None}
    for key in INDEX_KEYS
}
"""Features that LeRobot adds to every dataset."""
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
# LeRobot's own defaults.
CHUNK_SIZE, FILE_SIZE_MB, VIDEO_FILE_SIZE_MB = 1000, 100, 200

# pandas uses the task texts as the index of the table only with this metadata.
_TASK_INDEX = {"pandas_type": "unicode", "numpy_type": "object", "metadata": None}
_TASK_INDEX |= {"name": "task", "field_name": "task"}
_PANDAS_INDEX = {"index_columns": ["task"], "column_indexes": [], "columns": [_TASK_INDEX]}
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}

Statistics = dict[str, dict[str, list]]
"""Feature -> statistic (min, max, mean, std, count, q01 ... q99) -> values by component."""


def place(template: str, number: int, **fields: str) -> str:
    """Path of the file with this running number; a chunk holds `CHUNK_SIZE` files."""
    chunk, file = divmod(number, CHUNK_SIZE)
    return template.format(chunk_index=chunk, file_index=file, **fields)


def data_schema(schema: pa.Schema, features: Mapping[str, dict]) -> pa.Schema:
    """The schema with metadata that states the types in Hugging Face's terms, as in LeRobot."""
    types = {}
    for name in schema.names:
        dtype, shape = features[name]["dtype"], list(features[name]["shape"])
        value = {"dtype": dtype, "_type": "Value"}
        if dtype == "image":
            types[name] = {"_type": "Image"}
        elif len(shape) > 1:
            types[name] = {"shape": shape, "dtype": dtype, "_type": f"Array{len(shape)}D"}
        elif prod(shape) == 1:
            types[name] = value
        else:
            types[name] = {"feature": value, "length": shape[0], "_type": "List"}
    return schema.with_metadata({"huggingface": json.dumps({"info": {"features": types}})})


def write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """Write the list of task texts."""
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": tasks})
    write_parquet(table.replace_schema_metadata({"pandas": json.dumps(_PANDAS_INDEX)}), path)


def info_content(
    features: Mapping[str, dict], fps: float, robot_type: str, counts: Mapping[str, int]
) -> dict:
    """Content of `meta/info.json`; `counts` holds the numbers of episodes, frames and tasks."""
    has_video = any(feature["dtype"] == "video" for feature in features.values())
    return {
        "codebase_version": VERSION,
        "fps": int(fps) if float(fps).is_integer() else fps,
        "features": dict(features),
        **{f"total_{name}": count for name, count in counts.items()},
        "chunks_size": CHUNK_SIZE,
        "data_files_size_in_mb": FILE_SIZE_MB,
        "video_files_size_in_mb": VIDEO_FILE_SIZE_MB,
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH if has_video else None,
        "robot_type": robot_type,
        "splits": {"train": f"0:{counts['episodes']}"},
    }


def dump_json(path: Path, content: object) -> None:
    """Write a JSON object the way LeRobot does."""
    text = json.dumps(content, indent=4, ensure_ascii=False, default=asdict) + "\n"
    path.write_text(text, encoding="utf-8")


def episode_statistics(features: Mapping[str, Shaped[np.ndarray, "_frames ..."]]) -> Statistics:
    """Statistics of each feature over the frames of one episode, in the feature's shape."""
    return {key: _column_statistics(np.asarray(v, float)) for key, v in features.items()}


def image_statistics(images: UInt8[np.ndarray, "_count _height _width 3"]) -> dict[str, list]:
    """Statistics of each colour channel, scaled to 0..1, in the nesting LeRobot expects."""
    colours = images.reshape(-1, 3, 1, 1) / 255
    return _column_statistics(colours) | {"count": [len(images)]}


def combined_statistics(episodes: Mapping[str, Mapping[str, np.ndarray]]) -> Statistics:
    """Statistics over all episodes.

    They are exact except for the quantiles: these are averages over the episodes, weighted by
    length, as in LeRobot.

    Args:
        episodes: Feature -> statistic -> its values, one row per episode.
    """
    return {key: _combine(stacked) for key, stacked in episodes.items()}


def _column_statistics(values: np.ndarray) -> dict[str, list]:
    quantiles = np.quantile(values, list(QUANTILES.values()), axis=0)
    found = {name: getattr(values, name)(0) for name in ("min", "max", "mean", "std")}
    found |= {"count": np.array([len(values)]), **dict(zip(QUANTILES, quantiles, strict=True))}
    return {name: row.tolist() for name, row in found.items()}


def _combine(stacked: Mapping[str, np.ndarray]) -> dict[str, list]:
    average = partial(np.average, axis=0, weights=stacked["count"].reshape(-1))
    mean = average(stacked["mean"])
    combined = {
        "min": stacked["min"].min(0),
        "max": stacked["max"].max(0),
        "mean": mean,
        "std": np.sqrt(average(stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2)),
        "count": stacked["count"].sum(0),
        **{name: average(stacked[name]) for name in QUANTILES},
    }
    return {name: values.tolist() for name, values in combined.items()}
