"""Demonstrations as plain arrays: a single demonstration, a set, and a padded batch."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import overload

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from hrc_learn.demos.issues import DatasetError

_MEASURED = ("joint_position", "joint_velocity", "joint_effort", "human_effort")
JOINT_FIELDS = (*_MEASURED, "command_position", "command_velocity")
"""Fields with one column per joint, in the order of `joint_names`."""

_WIDTHS = {"position": 3, "orientation": 4, "feature": 2}
_ARRAYS = ("time", *JOINT_FIELDS, *_WIDTHS, "gripper")


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Demonstration:
    """Recording of one demonstration of a task.

    Every array has one row per frame; quantities that were not recorded are None. Values are in
    SI units and radians. Poses describe the tool centre point in the robot's base frame. Lists
    and tensors are converted to arrays.
    """

    time: Float64[np.ndarray, " _frames"]
    """Time since the first frame [s], increasing."""
    joint_position: Float64[np.ndarray, "_frames _joints"] | None = None
    """Joint positions [rad]."""
    joint_velocity: Float64[np.ndarray, "_frames _joints"] | None = None
    """Joint velocities [rad/s]."""
    joint_effort: Float64[np.ndarray, "_frames _joints"] | None = None
    """Measured joint torques [N m]."""
    position: Float64[np.ndarray, "_frames _xyz"] | None = None
    """Position of the tool centre point [m]."""
    orientation: Float64[np.ndarray, "_frames _wxyz"] | None = None
    """Unit quaternion (w, x, y, z), its sign continuous along the demonstration."""
    gripper: Float64[np.ndarray, " _frames"] | None = None
    """Opening of the gripper [m], or 0 to 1 or an angle [rad] if the robot reports no width."""
    feature: Float64[np.ndarray, "_frames _uv"] | None = None
    """Image feature (u right, v down) [px]; undefined where `feature_visible` is False."""
    feature_visible: Bool[np.ndarray, " _frames"] | None = None
    """True where the camera saw the feature."""
    human_effort: Float64[np.ndarray, "_frames _joints"] | None = None
    """Effort of the person, as torques about the joints [N m]."""
    command_position: Float64[np.ndarray, "_frames _joints"] | None = None
    """Commanded joint positions [rad]."""
    command_velocity: Float64[np.ndarray, "_frames _joints"] | None = None
    """Commanded joint velocities [rad/s]."""
    task: str = ""
    """Task in words."""
    joint_names: tuple[str, ...] = ()
    """Joint names in the order of the columns; empty if only poses are known."""
    fps: float | int
    """Nominal frame rate [1/s]."""
    start_time: float = 0.0
    """Stamp of the first frame on the recorder's own clock [s]."""
    episode: int = 0
    """Index of the episode in its dataset."""
    extra: dict[str, Float64[np.ndarray, "_frames _components"]] = field(default_factory=dict)
    """All other numeric columns by their key in the dataset, unconverted."""

    def __post_init__(self) -> None:
        for name in (*_ARRAYS, "feature_visible"):
            if getattr(self, name) is not None:
                array = float_array(getattr(self, name))
                object.__setattr__(
                    self, name, array > 0 if name == "feature_visible" else array
                )
        extra = {key: float_array(values) for key, values in self.extra.items()}
        object.__setattr__(self, "extra", extra)
        frames, joints = len(self.time), len(self.joint_names)
        if frames == 0:
            raise ValueError("a demonstration needs at least one frame, but time is empty")
        for name in self.recorded:
            array = getattr(self, name)
            if len(array) != frames:
                raise ValueError(f"{name} has {len(array)} frames, but time has {frames}")
            width = joints if name in JOINT_FIELDS else _WIDTHS.get(name)
            if width is not None and array.shape[1:] != (width,):
                text = f"{name} has shape {array.shape}, expected ({frames}, {width})"
                named = f" for the joints {', '.join(self.joint_names)}" if joints else ""
                raise ValueError(text + named)
        for key, array in extra.items():
            if len(array) != frames:
                raise ValueError(f"{key} has {len(array)} frames, but time has {frames}")
        stalled = np.flatnonzero(~(np.diff(self.time) > 0))
        if len(stalled):
            k = int(stalled[0])
            step = f"{self.time[k]:.6g} s to {self.time[k + 1]:.6g} s at frame {k}"
            raise ValueError(f"time must increase, but goes from {step}")

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
        held = [name for name in self.recorded if name in JOINT_FIELDS]
        chosen = {name: getattr(self, name)[:, columns] for name in held}
        return replace(self, joint_names=tuple(names), **chosen)


def float_array(values: object) -> Float64[np.ndarray, "..."]:
    """Array, list or tensor (on any device, with or without gradient) as a float64 array."""
    if isinstance(values, Tensor):
        values = values.detach().cpu().numpy()
    if np.iscomplexobj(np.asarray(values)):
        raise ValueError("values must be real numbers, but are complex")
    return np.asarray(values, dtype=np.float64)


def joint_columns(available: Sequence[str], wanted: Sequence[str]) -> list[int]:
    """Columns of the wanted joints.

    Raises:
        DatasetError: A wanted joint does not exist; the message lists the existing ones.
    """
    missing = [name for name in wanted if name not in available]
    if missing:
        raise DatasetError(
            f"no joint named {', '.join(missing)}; the dataset's joints are "
            f"{', '.join(available) or 'none'}. Ask for those names (joint_names=...), or "
            f"map columns to joints yourself (mapping={{'joint_position': [...]}})."
        )
    return [list(available).index(name) for name in wanted]


@dataclass(frozen=True, kw_only=True, eq=False)
class PaddedDemonstrations:
    """Batch of demonstrations; a field is None unless all demonstrations recorded it.

    After the end of a demonstration, `mask` is False and the last row of the demonstration is
    repeated. Time continues in steps of the last interval, so that it always increases.
    """

    mask: Bool[Tensor, "demos frames"]
    """True for recorded frames."""
    length: Int[Tensor, " demos"]
    """Number of recorded frames of each demonstration."""
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


class DemonstrationSet(Sequence[Demonstration]):
    """Demonstrations of one robot, in the order they were read.

    Attributes:
        notes: Guesses and conversions of the reader, one sentence each, for the user.
        source: Folder of the dataset, "" for demonstrations made in memory.
        joint_unit: Unit of the joint positions: "rad", or "1" for fractions of a range.
    """

    def __init__(
        self,
        demonstrations: Sequence[Demonstration],
        *,
        notes: Sequence[str] = (),
        source: str = "",
        joint_unit: str = "rad",
    ):
        """
        Args:
            demonstrations: Demonstrations with the same joints.
            notes: Notes for the user.
            source: Folder of the dataset.
            joint_unit: Unit of the joint positions.

        Raises:
            ValueError: The demonstrations differ in their joints.
        """
        self._demonstrations = tuple(demonstrations)
        self.notes = tuple(notes)
        self.source = source
        self.joint_unit = joint_unit
        names = {demo.joint_names for demo in self._demonstrations}
        if len(names) > 1:
            text = f"demonstrations of one set need the same joints, but these differ: {names}"
            raise ValueError(f"{text}. select_joints(names) brings them to one order.")

    @overload
    def __getitem__(self, index: int) -> Demonstration: ...
    @overload
    def __getitem__(self, index: slice) -> "DemonstrationSet": ...
    def __getitem__(self, index):
        if isinstance(index, slice):
            return self._like(self._demonstrations[index])
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

    def _like(self, demonstrations: Sequence[Demonstration]) -> "DemonstrationSet":
        return DemonstrationSet(
            demonstrations, notes=self.notes, source=self.source, joint_unit=self.joint_unit
        )

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joint names, the same for all demonstrations."""
        return self._demonstrations[0].joint_names if self._demonstrations else ()

    @property
    def frames(self) -> int:
        """Total number of frames of all demonstrations."""
        return sum(map(len, self._demonstrations))

    def select_joints(self, names: Sequence[str]) -> "DemonstrationSet":
        """The same demonstrations with these joints only, in this order.

        Raises:
            DatasetError: A name is not among `joint_names`.
        """
        return self._like([demo.select_joints(names) for demo in self])

    def filter(self, wanted: Callable[[Demonstration], bool]) -> "DemonstrationSet":
        """Demonstrations for which `wanted` is true."""
        return self._like([demo for demo in self if wanted(demo)])

    def map(self, change: Callable[[Demonstration], Demonstration]) -> "DemonstrationSet":
        """The set with `change`, such as a step of `preprocessing`, applied to each item."""
        return self._like([change(demo) for demo in self])

    def padded(self) -> PaddedDemonstrations:
        """All demonstrations as one batch of tensors, with a mask.

        Raises:
            ValueError: The set is empty.
        """
        if not self._demonstrations:
            raise ValueError("an empty set of demonstrations has no padded form")
        lengths = np.array([len(demo) for demo in self])
        longest = int(lengths.max())
        common = set.intersection(*(set(demo.recorded) for demo in self))
        stacked: dict[str, list[np.ndarray]] = {name: [] for name in common}
        for demo in self:
            behind = longest - len(demo)
            step = demo.time[-1] - demo.time[-2] if len(demo) > 1 else 1 / demo.fps
            for name, rows in stacked.items():
                array = getattr(demo, name)
                rows.append(np.concatenate([array, np.repeat(array[-1:], behind, axis=0)]))
            stacked["time"][-1][len(demo) :] += step * np.arange(1, behind + 1)
        return PaddedDemonstrations(
            mask=torch.from_numpy(np.arange(longest) < lengths[:, None]),
            length=torch.from_numpy(lengths),
            **{name: torch.from_numpy(np.stack(rows)) for name, rows in stacked.items()},
        )
