"""One episode of a recording: gathered frame by frame, put into columns, kept as a file."""

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from jaxtyping import Float64, Int64, Shaped

from hrc_learn.demos.format.metadata import SIDECAR_FORMAT, Statistics
from hrc_learn.demos.issue import DatasetError
from hrc_learn.demos.read.roles import ROLES
from hrc_learn.geometry import quaternion
from hrc_learn.store import new_file, resolved

# How recorded quantities become the columns of a LeRobot dataset.
#
# One `observation.state` as lerobot-record writes it (every quantity of the robot, told apart
# by name), so that LeRobot's own tools and viewers understand the dataset.

STATE_KEY = "observation.state"
TIME_KEY = "observation.time"


@dataclass(frozen=True, kw_only=True)
class Column:
    """One recorded quantity in its place within the dataset."""

    given: str
    """Keyword under which a frame gives it: a field of `Demonstration`, or a feature key."""
    role: str | None
    """Role under which the reader finds it; None for a feature of the user's own."""
    key: str
    """Feature of the dataset that holds it."""
    names: tuple[str, ...]
    """Names of its components within that feature."""


@dataclass(frozen=True)
class _Place:
    """Where one keyword of a frame goes; `{joint}` stands for each joint in turn."""

    given: str
    role: str
    key: str
    names: tuple[str, ...]


_PLACES = (
    _Place("joint_position", "joint_position", STATE_KEY, ("{joint}.pos",)),
    _Place("gripper", "gripper", STATE_KEY, ("gripper.pos",)),
    _Place("joint_velocity", "joint_velocity", STATE_KEY, ("{joint}.vel",)),
    _Place("joint_effort", "joint_effort", STATE_KEY, ("{joint}.torque",)),
    _Place("position", "position", STATE_KEY, ("ee.x", "ee.y", "ee.z")),
    _Place("orientation", "rotation_vector", STATE_KEY, ("ee.wx", "ee.wy", "ee.wz")),
    _Place("feature", "feature", "observation.image_feature", ("u", "v")),
    _Place("feature_visible", "feature_visible", "observation.image_feature", ("visible",)),
    _Place("human_effort", "human_effort", "observation.human_effort", ("{joint}.effort",)),
    _Place("command_position", "command_position", "action", ("{joint}.pos",)),
    _Place("command_velocity", "command_velocity", "action", ("{joint}.vel",)),
    _Place("time", "time", TIME_KEY, ("time",)),
)

FRAME_WIDTHS = {
    place.given: 4 if place.given == "orientation" else ROLES[place.role].width
    for place in _PLACES
}
"""Numbers a frame gives under each keyword; None: one a joint."""


def columns_for(
    given: Collection[str], joint_names: Sequence[str], features: Mapping[str, Sequence[str]]
) -> list[Column]:
    """Columns that hold what a frame gives, in the order of the dataset.

    Args:
        given: Keywords of the frame: fields of `Demonstration`, and keys of `features`.
        joint_names: Joints of the robot.
        features: Further features: key and the names of its components.
    """
    columns = [
        Column(
            given=place.given,
            role=place.role,
            key=place.key,
            names=_expand(place.names, joint_names),
        )
        for place in _PLACES
        if place.given in given
    ]
    own = [
        Column(given=key, role=None, key=key, names=tuple(names))
        for key, names in features.items()
    ]
    return columns + own


def lerobot_features(columns: Sequence[Column], dtype: str) -> dict[str, dict]:
    """Features as `meta/info.json` declares them, without LeRobot's index columns."""
    names: dict[str, list[str]] = {}
    for column in columns:
        names.setdefault(column.key, []).extend(column.names)
    return {
        key: {
            # A Unix stamp in float32 is good to two minutes only.
            "dtype": "float64" if key == TIME_KEY else dtype,
            "shape": [len(components)],
            "names": components,
        }
        for key, components in names.items()
    }


def sidecar_content(
    columns: Sequence[Column],
    joint_names: Sequence[str],
    frames: Mapping[str, str],
    details: Mapping[str, object],
) -> dict:
    """What the file of a dataset with these columns says."""
    known = {column.role: column for column in columns if column.role is not None}
    return {
        "format": SIDECAR_FORMAT,
        "units": {role: ROLES[role].unit for role in known},
        "columns": {
            role: {"key": column.key, "names": list(column.names)}
            for role, column in known.items()
        },
        "joint_names": list(joint_names),
        "frames": dict(frames),
        "details": dict(details),
    }


def encode(
    columns: Sequence[Column], episode: Mapping[str, Shaped[np.ndarray, "_frames ..."]]
) -> dict[str, Float64[np.ndarray, "_frames _width"]]:
    """Features of one episode from what its frames gave."""
    parts: dict[str, list[np.ndarray]] = {}
    for column in columns:
        values = np.asarray(episode[column.given], dtype=np.float64)
        if column.role == "rotation_vector":
            values = rotation_vectors(values)
        parts.setdefault(column.key, []).append(values.reshape(len(values), -1))
    return {key: np.concatenate(arrays, axis=1) for key, arrays in parts.items()}


def _expand(names: tuple[str, ...], joint_names: Sequence[str]) -> tuple[str, ...]:
    if len(names) == 1 and "{joint}" in names[0]:
        return tuple(names[0].format(joint=joint) for joint in joint_names)
    return names


def rotation_vectors(
    orientation: Float64[np.ndarray, "frames 4"],
) -> Float64[np.ndarray, "frames 3"]:
    # A gripper that points down has turned by about pi, where the shortest rotation
    # vector jumps to its opposite; the unwrapped one is what a policy can learn from.
    shortest = quaternion.log(torch.from_numpy(orientation))
    return quaternion.unwrap_log(shortest).numpy()


# The open episode of a recording: frames gathered, completed, and examined.

Episode = dict[str, Shaped[np.ndarray, "_frames ..."]]


class EpisodeBuffer:
    """Frames of one episode, each giving the same quantities."""

    def __init__(self, joint_names: Sequence[str], features: Mapping[str, Sequence[str]]):
        self._widths = {
            **{name: width or len(joint_names) for name, width in FRAME_WIDTHS.items()},
            **{key: len(names) for key, names in features.items()},
        }
        self._rows: dict[str, list[np.ndarray]] = {}

    def __len__(self) -> int:
        return len(next(iter(self._rows.values()), ()))

    def append(self, values: Mapping[str, object]) -> None:
        """Copy one frame in.

        Raises:
            ValueError: A quantity is unknown, missing, new, or of the wrong length; the
                frame is left out then.
        """
        if not len(self):
            self._rows = {name: [] for name in values}
        if values.keys() != self._rows.keys():
            difference = describe_difference(values.keys(), self._rows.keys())
            raise ValueError(f"frame {len(self)} {difference}")
        for name, row in [(name, self._row(name, value)) for name, value in values.items()]:
            self._rows[name].append(row)

    def arrays(self) -> Episode:
        """The frames so far, stacked."""
        return {name: np.stack(rows) for name, rows in self._rows.items()}

    def _row(self, name: str, value: object) -> Float64[np.ndarray, " width"]:
        if name not in self._widths:
            raise ValueError(
                f"{name!r} is no quantity of a frame; known are {', '.join(self._widths)}. "
                f"Declare others as features={{'observation.{name}': [names of components]}}."
            )
        row, width = np.array(value, dtype=np.float64), self._widths[name]
        if row.size != width or row.ndim > 1:
            raise ValueError(
                f"frame {len(self)}: {name} needs {width} numbers, got shape {row.shape}"
            )
        return row.reshape(width)


def describe_difference(given: Collection[str], expected: Collection[str]) -> str:
    """What a frame or an episode gives too little or too much, in words."""
    missing, new = sorted(set(expected) - set(given)), sorted(set(given) - set(expected))
    parts = [f"lacks {', '.join(missing)}"] * bool(missing)
    parts += [f"gives {', '.join(new)} besides"] * bool(new)
    return f"{' and '.join(parts)}: all give what the first frame gave"


def complete(episode: Episode, fps: float) -> Episode:
    """The episode with stamps and visibility filled in where its frames gave none.

    A feature that was not seen need not be finite; it is written as zero.
    """
    length = len(next(iter(episode.values())))
    episode = {"time": np.arange(length) / fps, **episode}
    if "feature" in episode:
        visible = episode.get("feature_visible", np.ones(length)).reshape(length, 1) > 0
        lost = ~visible & ~np.isfinite(episode["feature"])
        episode["feature"] = np.where(lost, 0.0, episode["feature"])
        episode["feature_visible"] = visible
    return episode


def examine(episode: Episode) -> None:
    """Refuse what no reader could use.

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
        wrong = np.abs(np.linalg.norm(episode["orientation"], axis=1) - 1) > 1e-3
        if wrong.any():
            raise ValueError(
                f"orientation must be a unit quaternion (w, x, y, z), but is not at frame "
                f"{wrong.argmax()}"
            )


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


def to_table(
    values: Mapping[str, np.ndarray],
    features: Mapping[str, Mapping],
    others: Mapping[str, pa.Array | pa.ChunkedArray] | None = None,
) -> pa.Table:
    """Arrow table of one episode: a number or a list of fixed length a frame.

    Args:
        values: Numbers by feature, (frames, components).
        features: As in `meta/info.json`, in the order of the columns.
        others: Columns that hold no numbers, such as images and texts.
    """
    others = others or {}
    arrays = {
        key: others[key]
        if key in others
        else _to_arrow(values[key], feature["dtype"], feature["shape"])
        for key, feature in features.items()
        if feature["dtype"] != "video"
    }
    return pa.table(arrays)


def _to_arrow(values: np.ndarray, dtype: str, shape: Sequence[int]) -> pa.Array:
    width = int(np.prod(shape))
    contiguous = np.ascontiguousarray(values, dtype=dtype)
    if contiguous.dtype == bool:
        flat = pa.array(contiguous.reshape(-1))  # packed to bits
        return flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)
    # Not pa.array(): it imports pandas, which would hold up the first episode for a second.
    buffers = [None, pa.py_buffer(contiguous)]
    flat = pa.Array.from_buffers(
        pa.from_numpy_dtype(contiguous.dtype), contiguous.size, buffers
    )
    if len(shape) > 1:  # lists of lists, as Hugging Face keeps arrays of several axes
        for length in reversed(shape):
            ends = np.arange(len(flat) // length + 1, dtype=np.int32) * length
            buffers = [None, pa.py_buffer(ends)]
            kind = pa.list_(flat.type)
            flat = pa.Array.from_buffers(kind, len(ends) - 1, buffers, children=[flat])
        return flat
    return flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)


def index_columns(
    fps: float, episode: int, first: int, task_index: Int64[np.ndarray, " _frames"]
) -> dict[str, np.ndarray]:
    """The columns by which LeRobot counts, of one episode.

    Args:
        fps: Frame rate [1/s].
        episode: Its index.
        first: Index of its first frame among all of the dataset.
        task_index: Task of each frame.
    """
    frame = np.arange(len(task_index))
    return {
        "timestamp": frame / fps,
        "frame_index": frame,
        "episode_index": np.full_like(frame, episode),
        "index": frame + first,
        "task_index": task_index,
    }
