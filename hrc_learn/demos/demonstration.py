"""Demonstrations as plain arrays: one, several of one robot, and several padded to one
length.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import overload

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from hrc_learn.demos.issue import DatasetError

# One demonstration as plain arrays.

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


# Demonstrations of different lengths as tensors of one length.


@dataclass(frozen=True, kw_only=True, eq=False)
class PaddedDemonstrations:
    """Demonstrations stacked along a leading axis; a field is None unless all recorded it.

    Behind the end of a demonstration its last row is held and time goes on in steps of the
    last interval, so that time increases everywhere; `mask` is false there.
    """

    mask: Bool[Tensor, "demos frames"]
    """True where a frame was recorded."""
    length: Int[Tensor, " demos"]
    """Recorded frames of each demonstration."""
    time: Float[Tensor, "demos frames"]
    joint_position: Float[Tensor, "demos frames joints"] | None = None
    joint_velocity: Float[Tensor, "demos frames joints"] | None = None
    joint_effort: Float[Tensor, "demos frames joints"] | None = None
    position: Float[Tensor, "demos frames 3"] | None = None
    orientation: Float[Tensor, "demos frames 4"] | None = None
    gripper: Float[Tensor, "demos frames"] | None = None
    feature: Float[Tensor, "demos frames 2"] | None = None
    feature_visible: Bool[Tensor, "demos frames"] | None = None
    human_effort: Float[Tensor, "demos frames joints"] | None = None
    command_position: Float[Tensor, "demos frames joints"] | None = None
    command_velocity: Float[Tensor, "demos frames joints"] | None = None

    def to(
        self, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> "PaddedDemonstrations":
        """Move every field; a dtype changes those that hold real numbers."""
        moved = {
            f.name: tensor.to(device, dtype if tensor.is_floating_point() else None)
            for f in fields(self)
            if (tensor := getattr(self, f.name)) is not None
        }
        return PaddedDemonstrations(**moved)


def pad(demonstrations: Sequence[Demonstration]) -> PaddedDemonstrations:
    """Stack demonstrations, holding the last row of the shorter ones (float64)."""
    lengths = np.array([len(demo) for demo in demonstrations])
    longest = int(lengths.max())
    shared = set.intersection(*(set(demo.recorded) for demo in demonstrations)) - {"time"}
    stacked = {
        name: np.stack([_hold(getattr(demo, name), longest) for demo in demonstrations])
        for name in shared
    }
    time = np.stack([_go_on(demo.time, longest, demo.fps) for demo in demonstrations])
    return PaddedDemonstrations(
        mask=torch.from_numpy(np.arange(longest) < lengths[:, None]),
        length=torch.from_numpy(lengths),
        time=torch.from_numpy(time),
        **{name: torch.from_numpy(array) for name, array in stacked.items()},
    )


def _hold(array: np.ndarray, length: int) -> np.ndarray:
    return np.concatenate([array, np.repeat(array[-1:], length - len(array), axis=0)])


def _go_on(time: np.ndarray, length: int, fps: float | int) -> np.ndarray:
    step = time[-1] - time[-2] if len(time) > 1 else 1 / fps
    return np.concatenate([time, time[-1] + step * np.arange(1, length - len(time) + 1)])


# Several demonstrations of one robot.


class DemonstrationSet(Sequence[Demonstration]):
    """Demonstrations of one robot, in the order they were read.

    Attributes:
        notes: What the reader guessed or converted, one sentence each; show it to the user.
        source: The dataset's folder, "" for demonstrations made in memory.
    """

    def __init__(
        self,
        demonstrations: Sequence[Demonstration],
        *,
        notes: Sequence[str] = (),
        source: str = "",
    ):
        self._demonstrations = tuple(demonstrations)
        self.notes = tuple(notes)
        self.source = source
        names = {demo.joint_names for demo in self._demonstrations}
        if len(names) > 1:
            raise ValueError(
                f"demonstrations of one set share their joints, but these differ: {names}. "
                f"select_joints(names) brings them to one order."
            )

    @overload
    def __getitem__(self, index: int) -> Demonstration: ...
    @overload
    def __getitem__(self, index: slice) -> "DemonstrationSet": ...
    def __getitem__(self, index):
        if isinstance(index, slice):
            return DemonstrationSet(
                self._demonstrations[index], notes=self.notes, source=self.source
            )
        return self._demonstrations[index]

    def __len__(self) -> int:
        return len(self._demonstrations)

    def __iter__(self) -> Iterator[Demonstration]:
        return iter(self._demonstrations)

    def __repr__(self) -> str:
        return (
            f"DemonstrationSet({len(self)} demonstrations, {self.frames} frames, "
            f"joints: {', '.join(self.joint_names) or 'none'})"
        )

    @property
    def joint_names(self) -> tuple[str, ...]:
        return self._demonstrations[0].joint_names if self._demonstrations else ()

    @property
    def frames(self) -> int:
        """Frames of all demonstrations together."""
        return sum(map(len, self._demonstrations))

    def select_joints(self, names: Sequence[str]) -> "DemonstrationSet":
        """The same demonstrations with these joints only, in this order.

        Raises:
            DatasetError: A name is not among `joint_names`.
        """
        return DemonstrationSet(
            [demo.select_joints(names) for demo in self], notes=self.notes, source=self.source
        )

    def filter(self, wanted: Callable[[Demonstration], bool]) -> "DemonstrationSet":
        """Only the demonstrations for which `wanted` is true."""
        chosen = [demo for demo in self if wanted(demo)]
        return DemonstrationSet(chosen, notes=self.notes, source=self.source)

    def map(self, change: Callable[[Demonstration], Demonstration]) -> "DemonstrationSet":
        """What `change` makes of each demonstration, such as a step of `preprocessing`."""
        changed = [change(demo) for demo in self]
        return DemonstrationSet(changed, notes=self.notes, source=self.source)

    def padded(self) -> PaddedDemonstrations:
        """All demonstrations as tensors of one length, with a mask.

        Raises:
            ValueError: The set is empty.
        """
        if not self._demonstrations:
            raise ValueError("an empty set of demonstrations has no padded form")
        return pad(self._demonstrations)
