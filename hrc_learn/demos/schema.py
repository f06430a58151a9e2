"""How recorded quantities become the columns of a LeRobot dataset.

One `observation.state` as lerobot-record writes it (every quantity of the robot, told
apart by name), so that LeRobot's own tools and viewers understand the dataset.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Shaped

from ..geometry import quaternion
from .roles import ROLES

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


def encode(
    columns: Sequence[Column], episode: Mapping[str, Shaped[np.ndarray, "_frames ..."]]
) -> dict[str, Float64[np.ndarray, "_frames _width"]]:
    """Features of one episode from what its frames gave."""
    parts: dict[str, list[np.ndarray]] = {}
    for column in columns:
        values = np.asarray(episode[column.given], dtype=np.float64)
        if column.role == "rotation_vector":
            values = _rotation_vectors(values)
        parts.setdefault(column.key, []).append(values.reshape(len(values), -1))
    return {key: np.concatenate(arrays, axis=1) for key, arrays in parts.items()}


def _expand(names: tuple[str, ...], joint_names: Sequence[str]) -> tuple[str, ...]:
    if len(names) == 1 and "{joint}" in names[0]:
        return tuple(names[0].format(joint=joint) for joint in joint_names)
    return names


def _rotation_vectors(
    orientation: Float64[np.ndarray, "frames 4"],
) -> Float64[np.ndarray, "frames 3"]:
    # A gripper that points down has turned by about pi, where the shortest rotation
    # vector jumps to its opposite; the unwrapped one is what a policy can learn from.
    shortest = quaternion.log(torch.from_numpy(orientation))
    return quaternion.unwrap_log(shortest).numpy()
