"""One demonstration as plain arrays."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
from jaxtyping import Bool, Float64

from .finding import DatasetError

JOINT_FIELDS = (
    "joint_position",
    "joint_velocity",
    "joint_effort",
    "human_effort",
    "command_position",
    "command_velocity",
)
"""Fields with one column a joint, in the order of `joint_names`."""

_WIDTHS = {"position": 3, "orientation": 4, "feature": 2}


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Demonstration:
    """What was recorded while a person showed the task once.

    Every array has one row a frame; whatever was not recorded is None. SI units and
    radians; poses are of the tool centre point in the robot's base frame.
    """

    time: Float64[np.ndarray, " _frames"]
    """Time since the first frame [s], increasing."""
    joint_position: Float64[np.ndarray, "_frames _joints"] | None = None
    """[rad]"""
    joint_velocity: Float64[np.ndarray, "_frames _joints"] | None = None
    """[rad/s]"""
    joint_effort: Float64[np.ndarray, "_frames _joints"] | None = None
    """Measured joint torque [N m]."""
    position: Float64[np.ndarray, "_frames _xyz"] | None = None
    """[m]"""
    orientation: Float64[np.ndarray, "_frames _wxyz"] | None = None
    """Unit quaternion (w, x, y, z), its sign continuous along the demonstration."""
    gripper: Float64[np.ndarray, " _frames"] | None = None
    """Opening [m], or 0 to 1 where the robot knows no width."""
    feature: Float64[np.ndarray, "_frames _uv"] | None = None
    """Image feature (u right, v down) [px]; meaningless where `feature_visible` is false."""
    feature_visible: Bool[np.ndarray, " _frames"] | None = None
    """Whether the camera saw the feature."""
    human_effort: Float64[np.ndarray, "_frames _joints"] | None = None
    """The person's effort d in joint space [N m]."""
    command_position: Float64[np.ndarray, "_frames _joints"] | None = None
    """Commanded joint position [rad]."""
    command_velocity: Float64[np.ndarray, "_frames _joints"] | None = None
    """Commanded joint velocity [rad/s]."""
    task: str = ""
    """What the person was asked to show."""
    joint_names: tuple[str, ...] = ()
    """Names of the joints, in the order of the columns; empty where poses alone are known."""
    fps: float | int
    """Nominal frame rate [1/s]."""
    start_time: float = 0.0
    """Stamp of the first frame on the recorder's own clock [s]."""
    episode: int = 0
    """Index of the episode in its dataset."""
    extra: dict[str, Float64[np.ndarray, "_frames _components"]] = field(default_factory=dict)
    """Every other numeric column, by the key it has in the dataset, unconverted."""

    def __post_init__(self) -> None:
        frames, joints = len(self.time), len(self.joint_names)
        if frames == 0:
            raise ValueError("a demonstration needs at least one frame, but time is empty")
        for name in self.recorded:
            array = getattr(self, name)
            if len(array) != frames:
                raise ValueError(f"{name} has {len(array)} frames, but time has {frames}")
            width = joints if name in JOINT_FIELDS else _WIDTHS.get(name)
            if width is not None and array.shape[1:] != (width,):
                raise ValueError(
                    f"{name} has shape {array.shape}, expected ({frames}, {width})"
                    + (f" for the joints {', '.join(self.joint_names)}" if joints else "")
                )
        stalled = np.flatnonzero(np.diff(self.time) <= 0)
        if len(stalled):
            k = int(stalled[0])
            raise ValueError(
                f"time must increase, but goes from {self.time[k]:.6g} s to "
                f"{self.time[k + 1]:.6g} s at frame {k}"
            )

    def __len__(self) -> int:
        return len(self.time)

    def __repr__(self) -> str:
        return (
            f"Demonstration(episode {self.episode}, {self.task!r}: {len(self)} frames, "
            f"{self.duration:.3g} s; {', '.join(self.recorded)})"
        )

    @property
    def duration(self) -> float:
        """Time from the first frame to the last [s]."""
        return float(self.time[-1] - self.time[0])

    @property
    def recorded(self) -> tuple[str, ...]:
        """Names of the array fields that hold data, `time` first."""
        return tuple(
            f.name for f in fields(self) if isinstance(getattr(self, f.name), np.ndarray)
        )

    def select_joints(self, names: Sequence[str]) -> "Demonstration":
        """The same demonstration with these joints only, in this order.

        Raises:
            DatasetError: A name is not among `joint_names`.
        """
        if tuple(names) == self.joint_names:
            return self
        columns = joint_columns(self.joint_names, names)
        chosen = {
            name: getattr(self, name)[:, columns]
            for name in self.recorded
            if name in JOINT_FIELDS
        }
        return replace(self, joint_names=tuple(names), **chosen)


def joint_columns(available: Sequence[str], wanted: Sequence[str]) -> list[int]:
    """Columns of the wanted joints.

    Raises:
        DatasetError: A wanted joint does not exist; the message lists those that do.
    """
    missing = [name for name in wanted if name not in available]
    if missing:
        raise DatasetError(
            f"no joint named {', '.join(missing)}; the dataset's joints are "
            f"{', '.join(available) or 'none'}. Ask for those names (joint_names=...), or "
            f"map columns to joints yourself (mapping={{'joint_position': [...]}})."
        )
    return [list(available).index(name) for name in wanted]
