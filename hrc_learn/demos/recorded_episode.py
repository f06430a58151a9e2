"""One recorded episode: its frames, its columns as LeRobot keeps them, and its file."""

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Float64, Int64, Shaped

from hrc_learn.demos.demonstration import float_array
from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.read.contract import Sidecar
from hrc_learn.demos.read.dataset_files import open_parquet, read_table, write_parquet
from hrc_learn.demos.read.metadata import Statistics, episode_statistics
from hrc_learn.demos.read.quantities import RECORDED, ROLES
from hrc_learn.geometry import quaternion
from hrc_learn.store import new_file, parse_json

TIME_KEY = "time"
"""Feature that holds the true stamps, measured at recording, whereas LeRobot's `timestamp` is
frame / fps. It is not called `observation.time`: policies would take such a feature as an
input, which no robot provides."""
_METADATA_KEY = b"hrc_learn"

Episode = dict[str, Shaped[np.ndarray, "_frames ..."]]
"""Quantity -> values of one episode."""


@dataclass(frozen=True, kw_only=True)
class RecordedColumn:
    """One recorded quantity and its place in the dataset."""

    given: str
    """Keyword of the quantity in a frame: a field of `Demonstration`, or a feature key."""
    role: str | None
    """Role under which readers find the quantity; None for a user-defined feature."""
    key: str
    """Feature of the dataset that holds the quantity."""
    names: tuple[str, ...]
    """Component names within that feature; in `_COLUMNS`, `{joint}` stands for each joint."""


_COLUMNS = tuple(
    RecordedColumn(given=given, role=role or given, key=key, names=tuple(names))
    for given, (role, key, *names) in RECORDED.items()
)
FRAME_WIDTHS = {
    column.given: 4 if column.given == "orientation" else ROLES[str(column.role)].width
    for column in _COLUMNS
}
"""Keyword of a frame -> number of values; None for one per joint."""


def columns_for(
    given: Collection[str], joint_names: Sequence[str], features: Mapping[str, Sequence[str]]
) -> list[RecordedColumn]:
    """Columns for the content of a frame, in the order of the dataset.

    Args:
        given: Keywords of the frame: fields of `Demonstration`, and keys of `features`.
        joint_names: Joints of the robot.
        features: User-defined features: key -> component names.
    """
    columns = []
    for column in (column for column in _COLUMNS if column.given in given):
        if "{joint}" in column.names[0]:
            names = tuple(column.names[0].format(joint=joint) for joint in joint_names)
            column = replace(column, names=names)
        columns.append(column)
    return columns + [
        RecordedColumn(given=key, role=None, key=key, names=tuple(names))
        for key, names in features.items()
    ]


def lerobot_features(columns: Sequence[RecordedColumn]) -> dict[str, dict]:
    """Features as declared in `meta/info.json`, without LeRobot's index columns."""
    names: dict[str, list[str]] = {}
    for column in columns:
        names.setdefault(column.key, []).extend(column.names)
    # Policies expect float32, in which a Unix stamp has a resolution of two minutes.
    types = {key: "float64" if key == TIME_KEY else "float32" for key in names}
    return {k: {"dtype": types[k], "shape": [len(n)], "names": n} for k, n in names.items()}


def encode(
    columns: Sequence[RecordedColumn], episode: Episode
) -> dict[str, Float64[np.ndarray, "_frames _width"]]:
    """Features of one episode from its quantities."""
    parts: dict[str, list[np.ndarray]] = {}
    for column in columns:
        values = np.asarray(episode[column.given], dtype=np.float64)
        if column.role == "rotation_vector":
            values = rotation_vectors(values)
        parts.setdefault(column.key, []).append(values.reshape(len(values), -1))
    return {key: np.concatenate(arrays, axis=1) for key, arrays in parts.items()}


def rotation_vectors(
    orientation: Float64[np.ndarray, "frames 4"],
) -> Float64[np.ndarray, "frames 3"]:
    """Rotation vectors [rad] without jumps.

    A gripper that points down is rotated by about pi, where the shortest rotation vector jumps
    to its negative. A policy can learn from unwrapped rotation vectors.
    """
    shortest = quaternion.log(torch.from_numpy(orientation))
    return quaternion.unwrap_log(shortest).numpy()


def frame_row(
    values: Mapping[str, object], widths: Mapping[str, int], earlier: Sequence[Episode]
) -> Episode:
    """Copy of the quantities of one frame.

    Args:
        values: Quantity -> numbers.
        widths: Known quantity -> its number of components.
        earlier: Earlier frames of the episode, with the same quantities.

    Raises:
        ValueError: A quantity is unknown, missing, of the wrong length, or not in `earlier`.
    """
    number = len(earlier)
    if earlier and values.keys() != earlier[0].keys():
        difference = describe_difference(values.keys(), earlier[0].keys())
        raise ValueError(f"frame {number} {difference}")
    row = {}
    for name, value in values.items():
        if name not in widths:
            text = f"{name!r} is no quantity of a frame; known are {', '.join(widths)}. Declare"
            more = f"features={{'observation.{name}': [names of components]}}"
            raise ValueError(f"{text} others as {more}.")
        numbers, width = float_array(value).copy(), widths[name]
        if numbers.size != width or numbers.ndim > 1:
            text = f"frame {number}: {name} needs {width} numbers, got shape {numbers.shape}"
            raise ValueError(text)
        row[name] = numbers.reshape(width)
    return row


def stacked(frames: Sequence[Episode]) -> Episode:
    """The episode that consists of these frames; {} if there are none."""
    names = frames[0] if frames else ()
    return {name: np.stack([frame[name] for frame in frames]) for name in names}


def describe_difference(given: Collection[str], expected: Collection[str]) -> str:
    """Missing and surplus quantities of a frame or an episode, in words."""
    missing, new = sorted(set(expected) - set(given)), sorted(set(given) - set(expected))
    parts = [f"lacks {', '.join(missing)}"] * bool(missing)
    parts += [f"adds {', '.join(new)}"] * bool(new)
    return f"{' and '.join(parts)}: all frames need the quantities of the first"


def complete(episode: Episode, fps: float) -> Episode:
    """The episode with default stamps and visibility if its frames gave none.

    An image feature need not be finite while it is not visible; values that are not finite
    then become zero.
    """
    length = len(next(iter(episode.values())))
    episode = {"time": np.arange(length) / fps, **episode}
    if "feature" in episode:
        visible = episode.get("feature_visible", np.ones(length)).reshape(length, 1) > 0
        lost = ~visible & ~np.isfinite(episode["feature"])
        episode["feature"] = np.where(lost, 0.0, episode["feature"])
        episode["feature_visible"] = visible
    return episode


def require_valid(episode: Episode) -> None:
    """Check that readers can use an episode.

    Raises:
        ValueError: A value is not finite, time does not increase, or an orientation is no
            unit quaternion.
    """
    for name, values in episode.items():
        bad = np.argwhere(~np.isfinite(values.reshape(len(values), -1)))
        if len(bad):
            raise ValueError(f"{name} is not finite at frame {bad[0, 0]}")
    stalled = np.flatnonzero(np.diff(episode["time"].reshape(-1)) <= 0)
    if len(stalled):
        raise ValueError(f"time must increase, but does not after frame {stalled[0]}")
    if "orientation" in episode:
        # The tolerance allows for float32.
        wrong = np.abs(np.linalg.norm(episode["orientation"], axis=1) - 1) > 1e-3
        if wrong.any():
            text = "orientation must be a unit quaternion (w, x, y, z), but is not at frame"
            raise ValueError(f"{text} {wrong.argmax()}")


@dataclass(frozen=True, kw_only=True)
class RecordingHeader:
    """Properties common to all episodes of a recording, as JSON values."""

    fps: float
    robot_type: str
    features: dict[str, dict]
    """Features as in `meta/info.json`, with LeRobot's index columns."""
    sidecar: Sidecar


@dataclass(frozen=True, kw_only=True)
class EpisodeDescription:
    """Properties of one saved episode, kept in the metadata of its file."""

    header: RecordingHeader
    tasks: list[str]
    """Texts of the episode's tasks, at least one."""
    statistics: Statistics
    provenance: str = ""
    """Origin of an episode that was made from others, as JSON."""


def episode_path(folder: Path, index: int) -> Path:
    """File of a saved episode in the folder of a recording."""
    return folder / f"episode_{index:06d}.parquet"


def episode_number(path: Path) -> int:
    """Index of the episode in a file."""
    return int(path.stem.rpartition("_")[2])


def write_episode(
    path: Path,
    header: RecordingHeader,
    values: Mapping[str, np.ndarray],
    tasks: tuple[Sequence[str], Int64[np.ndarray, " _frames"]],
    frames_before: int,
    *,
    others: Mapping[str, pa.ChunkedArray] | None = None,
    statistics: Statistics | None = None,
    provenance: str = "",
) -> None:
    """Write one episode; `path` exists only once the file is complete and on disk.

    Args:
        path: File, as in `episode_path`.
        header: Properties of the recording.
        values: Feature -> numbers (frames, components), without LeRobot's index columns.
        tasks: Texts of the episode's tasks, and the dataset's task index for each frame.
        frames_before: Total number of frames of all earlier episodes.
        others: Columns that hold no numbers, such as images and texts.
        statistics: Statistics of the episode's images.
        provenance: Origin of an episode that was made from others, as JSON.
    """
    texts, indices = tasks
    number, features = episode_number(path), header.features
    frame = np.arange(len(indices))
    found = {**values, "timestamp": frame / header.fps, "frame_index": frame}
    found |= {"episode_index": np.full_like(frame, number), "task_index": indices}
    found["index"] = frame + frames_before
    shapes = {key: features[key]["shape"] for key in features if key in found}
    own = episode_statistics({k: found[k].reshape(-1, *shape) for k, shape in shapes.items()})
    described = EpisodeDescription(
        header=header,
        tasks=[*texts],
        statistics=own | (statistics or {}),
        provenance=provenance,
    )
    table = to_table(found, features, others)
    metadata = {_METADATA_KEY: json.dumps(described, default=asdict)}
    with new_file(path) as part:
        write_parquet(table.replace_schema_metadata(metadata), part)


def read_episode(path: Path) -> tuple[EpisodeDescription, pa.Table]:
    """Read an episode written by `write_episode`.

    Raises:
        DatasetError: The file is damaged.
    """
    table = read_table(open_parquet(path.parent, path.name), path.name)
    described = (table.schema.metadata or {}).get(_METADATA_KEY, b"")
    try:
        return parse_json(described, EpisodeDescription), table
    except ValueError as error:
        raise DatasetError(f"no episode of a recording ({error})", file=path) from error


def staged_paths(folder: Path, first: int = 0) -> list[Path]:
    """Files of the saved episodes, in order.

    Args:
        folder: Folder of the recording.
        first: Index of the first episode: number of episodes of the extended dataset, or 0.

    Raises:
        DatasetError: No episode was saved, or an episode before the last is missing.
    """
    paths = sorted(folder.glob("episode_*.parquet"))
    if not paths:
        raise DatasetError("no episode was saved, so there is no dataset to write", file=folder)
    for index, path in enumerate(paths, start=first):
        expected = episode_path(folder, index)
        if path != expected:
            text = "is missing from the recording; rename the later files if it is lost"
            raise DatasetError(text, file=expected, episode=index)
    return paths


def to_table(
    values: Mapping[str, np.ndarray],
    features: Mapping[str, Mapping],
    others: Mapping[str, pa.Array | pa.ChunkedArray] | None = None,
) -> pa.Table:
    """Arrow table of one episode, with one row per frame.

    Args:
        values: Feature -> numbers (frames, components).
        features: Features as in `meta/info.json`, in the order of the columns.
        others: Columns that hold no numbers, such as images and texts.
    """
    arrays: dict[str, pa.Array | pa.ChunkedArray] = {**(others or {})}
    for key, feature in features.items():
        if key in values:
            arrays[key] = _to_arrow(values[key], feature["dtype"], feature["shape"])
    return pa.table({key: arrays[key] for key in features if key in arrays})


def _to_arrow(values: np.ndarray, dtype: str, shape: Sequence[int]) -> pa.Array:
    width = int(np.prod(shape))
    contiguous = np.ascontiguousarray(values, dtype=dtype)
    if contiguous.dtype == bool:
        flat = pa.array(contiguous.reshape(-1))  # packed to bits
    else:
        # pa.array() would import pandas and delay the first episode by a second.
        buffers = [None, pa.py_buffer(contiguous)]
        kind = pa.from_numpy_dtype(contiguous.dtype)
        flat = pa.Array.from_buffers(kind, contiguous.size, buffers)
        if len(shape) > 1:
            # Lists of lists, as Hugging Face keeps arrays of several axes.
            for length in reversed(shape):
                ends = range(0, len(flat) + 1, length)
                flat = pa.ListArray.from_arrays(pa.array(ends, pa.int32()), flat)
            return flat
    return flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)
