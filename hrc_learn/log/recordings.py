"""Log the steps of control loops and record runs, in NumPy, for drawing by `hrc_learn.viz`.

A log has columns of equal length, one row per step, and is cheap to append to. Times of a
recording are in seconds from its start. If a field of a recording is None or empty, the panel
or figure that would show this field is left out.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from hrc_learn.geometry import Body, Box
from hrc_learn.store import new_file
from hrc_learn.vision import CameraModel


class Event(NamedTuple):
    """Event with a line of text, such as the start of a phase of the task."""

    time: float
    """Time of the event [s]."""
    text: str


class LoggedSteps:
    """Columns of the quantities that a loop measured, one row per step.

    Attributes:
        events: Events in order of time.
    """

    def __init__(self, blocks: Sequence[np.ndarray], length: int, events: Sequence[Event]):
        """Store blocks of rows; all blocks but the last are full.

        Args:
            blocks: Structured arrays of one type and length.
            length: Number of rows in use.
            events: Events of the run.
        """
        self._blocks, self._length = list(blocks), length
        self.events = list(events)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns, in the order of the first row."""
        return (self._blocks[0].dtype.names or ()) if self._blocks else ()

    def __len__(self) -> int:
        return self._length

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def __getitem__(self, name: str) -> np.ndarray:
        """Copy of one column, (steps, ...)."""
        if name not in self:
            raise KeyError(f"{name!r} is not logged; the columns are {list(self.names)}.")
        return np.concatenate([block[name] for block in self.blocks()])

    def blocks(self, start: int = 0) -> Iterator[np.ndarray]:
        """Rows from `start` on, as structured arrays that are views of the log.

        Another thread may read while the loop appends.
        """
        length, before = self._length, 0
        for block in tuple(self._blocks):
            rows = block[max(start - before, 0) : max(length - before, 0)]
            before += len(block)
            if before > start:
                yield rows

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write columns and events as one .npz file, which appears only when complete.

        Its arrays are `column/NAME`, `event/time` [s] and `event/text`.
        """
        arrays: dict[str, Any] = {f"column/{name}": self[name] for name in self.names}
        arrays["event/time"] = np.array([event.time for event in self.events], dtype=float)
        arrays["event/text"] = np.array([event.text for event in self.events], dtype=str)
        with new_file(Path(path)) as part, part.open("wb") as file:
            np.savez(file, **arrays)


Value = np.ndarray | np.generic | float | int | bool
"""A measurement of one step: an array of any shape, or a number."""


class StepLog(LoggedSteps):
    """Columns of the quantities that a loop measures, one row per step.

    The first row determines the columns and their shapes, which every later row must have, too.
    Numbers become float64, even if the first value is an integer (`time=0`); booleans stay
    boolean. Memory is allocated in blocks and never moved, so that no step has to copy the log.

        log = StepLog()
        log.append(time=t, joint_position=q, feature=x, pushed=True)
        log["joint_position"]      # (steps, 7)
    """

    def __init__(self, block: int = 8192):
        """Make an empty log.

        Args:
            block: Number of rows allocated at a time.
        """
        if block < 1:
            raise ValueError(f"block must be at least one row, but is {block}.")
        # `_length` is increased last, so that another thread sees complete rows only.
        super().__init__(blocks=(), length=0, events=())
        self._block = block
        self._dtype: np.dtype | None = None
        # Name, shape of a value, and values of each column of the last block.
        self._columns: list[tuple[str, tuple[int, ...], np.ndarray]] = []

    def snapshot(self, rows: int | None = None) -> LoggedSteps:
        """View of the present rows, which does not grow.

        Another thread may take a snapshot while the loop appends.

        Args:
            rows: Number of rows; None: all.
        """
        length = len(self) if rows is None else min(rows, len(self))
        return LoggedSteps(self._blocks, length, self.events)

    def append(self, **values: Value) -> None:
        """Add a row.

        Raises:
            ValueError: The row lacks a column, has a new column, or has a value of another
                shape.
        """
        if self._dtype is None:
            self._open(values)
        i = self._length - self._first
        if i == self._block:
            self._extend()
            i = 0
        if len(values) != len(self._columns):
            raise self._mismatch(values)
        for name, shape, column in self._columns:
            value = values.get(name)
            # NumPy would repeat a single number over the whole column.
            if value is None or shape != (() if type(value) is float else np.shape(value)):
                raise self._mismatch(values)
            column[i] = value
        self._length += 1

    def event(self, time: float, text: str) -> None:
        """Log an event at a time [s]."""
        self.events.append(Event(float(time), text))

    def _open(self, values: Mapping[str, Value]) -> None:
        kinds = {name: np.asarray(value).dtype == bool for name, value in values.items()}
        self._dtype = np.dtype(
            [(name, bool if kinds[name] else float, np.shape(v)) for name, v in values.items()]
        )
        self._extend()

    def _mismatch(self, values: Mapping[str, Value]) -> ValueError:
        assert self._dtype is not None
        expected = {name: self._dtype[name].shape for name in self.names}
        given = {name: np.shape(value) for name, value in values.items()}
        differing = [
            f"{name} is {given.get(name, 'missing')}, not {expected.get(name, 'a column')}"
            for name in sorted(expected.keys() | given.keys())
            if given.get(name) != expected.get(name)
        ]
        return ValueError(
            f"row {len(self)} does not fit the columns of the first row: "
            + "; ".join(differing)
            + ". Log every quantity at every step, with NaN where it has no value."
        )

    def _extend(self) -> None:
        assert self._dtype is not None
        rows = np.zeros(self._block, dtype=self._dtype)
        self._blocks.append(rows)
        self._columns = [(name, rows[name].shape[1:], rows[name]) for name in self.names]
        self._first = (len(self._blocks) - 1) * self._block  # rows before the last block


@dataclass(frozen=True, kw_only=True, eq=False)
class JointRanges:
    """Ranges of the joints, drawn together with the joint positions."""

    lower: Float[np.ndarray, " joints"]
    """Lower position limits [rad]."""
    upper: Float[np.ndarray, " joints"]
    """Upper position limits [rad]."""
    velocity: Float[np.ndarray, " joints"] | None = None
    """Largest speeds [rad/s]."""

    @classmethod
    def of(cls, limits: Any) -> "JointRanges":
        """Ranges and speeds of an arm's limits (`kinematics.JointLimits`)."""
        names = ("lower", "upper", "velocity")
        return cls(**{name: getattr(limits, name).numpy() for name in names})


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraRecording:
    """Images of a camera, and the feature detected in them."""

    model: CameraModel
    """True camera, known in simulation only; drawn as a frustum."""
    feature: Float[np.ndarray, "time 2"]
    """Measured feature [px]; NaN while it was not visible."""
    target: Float[np.ndarray, "time 2"]
    """Target of the feature [px]; NaN without a target."""
    image_time: Float[np.ndarray, " images"] = field(default_factory=lambda: np.empty(0))
    """Times of the images [s]."""
    images: tuple[UInt8[np.ndarray, "h w 3"], ...] = ()
    """RGB images, a few per second."""

    def __post_init__(self) -> None:
        if len(self.image_time) != len(self.images):
            raise ValueError(
                f"image_time has {len(self.image_time)} entries for {len(self.images)} images."
            )

    @property
    def error(self) -> Float[np.ndarray, " time"]:
        """Distance from feature to target [px]."""
        return np.linalg.norm(self.feature - self.target, axis=-1)


@dataclass(frozen=True, kw_only=True, eq=False)
class RunRecording:
    """One run of a task, sampled at every control step.

    Raises:
        ValueError: The number of samples of a field differs from the length of `time`.
    """

    title: str
    time: Float[np.ndarray, " time"]
    """Times of the samples [s], increasing."""

    joint_names: tuple[str, ...]
    joint_position: Float[np.ndarray, "time joints"]
    """Joint positions [rad]."""
    joint_velocity: Float[np.ndarray, "time joints"] | None = None
    """Joint velocities [rad/s]."""
    joint_limits: JointRanges | None = None
    demo_joint_position: Float[np.ndarray, "time joints"] | None = None
    """Demonstrated joint positions at the same fraction of the motion [rad]; NaN at steps
    outside the motion."""

    position: Float[np.ndarray, "time 3"]
    """Tool centre point in the base frame [m]."""
    demo_path: Float[np.ndarray, "samples 3"] | None = None
    """Tool centre point of the demonstration [m]."""
    plan_path: Float[np.ndarray, "plan_samples 3"] | None = None
    """Planned path of the learned motion [m]."""

    bodies: tuple[Body, ...] = ()
    """Links of the arm, gripper, carried objects."""
    boxes: tuple[Box, ...] = ()
    """Static objects, in the base frame."""
    region: Box | None = None
    """Cartesian region in which visual servoing takes over."""
    active_region: Float[np.ndarray, "time 6"] | None = None
    """Centre and half edge lengths of the controller's position region at each step [m]; NaN
    without a controller in the loop."""
    drawn: Bool[np.ndarray, " time"] | None = None
    """True while a region drawn by a person is in use."""

    camera: CameraRecording | None = None
    image_jacobian: Float[np.ndarray, "time 2 6"] | None = None
    """Image Jacobian estimated by the learned model [px/m, px/rad]; NaN without an estimate."""
    true_image_jacobian: Float[np.ndarray, "time 2 6"] | None = None
    """Image Jacobian of the true camera, in simulation only [px/m, px/rad]."""
    weight_norm: Float[np.ndarray, " time"] | None = None
    """Frobenius norm of the image Jacobian's weights."""
    potentials: Mapping[str, Float[np.ndarray, " time"]] = field(default_factory=dict)
    """Potential of each region, or a Lyapunov function, by name."""

    potential_rate: Float[np.ndarray, " time"] | None = None
    """Rate of the sum of the potentials, predicted by the estimated image Jacobian [1/s]."""

    nullspace_input: Float[np.ndarray, "time joints"] | None = None
    """Null-space input d of the person on each joint [N m]."""
    push: Float[np.ndarray, "time 2 3"] | None = None
    """Point of the arm that the person pushes, and a second point in the direction of the push
    [m]; NaN without a push."""
    followed: Float[np.ndarray, " time"] | None = None
    """Fraction of the push that the arm follows, 0 to 1; NaN without a push."""
    hindered: Mapping[str, Bool[np.ndarray, " time"]] = field(default_factory=dict)
    """For each hindrance, by name: true while it keeps the arm from following the push."""
    elbow_motion: Float[np.ndarray, " time"] | None = None
    """Distance of the elbow from its undisturbed position [m]."""
    position_deviation: Float[np.ndarray, " time"] | None = None
    """Distance of the end effector from its undisturbed position [m]."""
    rotation_deviation: Float[np.ndarray, " time"] | None = None
    """Angle of the end effector from its undisturbed orientation [rad]."""

    worker_distance: Mapping[str, Float[np.ndarray, " time"]] = field(default_factory=dict)
    """Distances between a worker and the robot with its load, by name [m]: the true smallest
    distance, the smallest distance seen by the robot, and the protective distance; NaN while
    unknown."""
    worker_nearest: Float[np.ndarray, "time 2 3"] | None = None
    """Nearest points of robot and worker [m]."""

    safety: Mapping[str, Float[np.ndarray, " time"] | Bool[np.ndarray, " time"]] = field(
        default_factory=dict
    )
    """Interventions of the safety filter, by name of their kind: a flag or a strength."""
    phases: tuple[Event, ...] = ()
    """Start of each phase of the task."""
    remarks: tuple[Event, ...] = ()
    """Messages to the person near the arm."""

    def __post_init__(self) -> None:
        series: dict[str, np.ndarray] = {}
        for field_name, value in vars(self).items():
            if isinstance(value, Mapping):
                series |= {f"{field_name}[{name!r}]": one for name, one in value.items()}
            elif isinstance(value, np.ndarray) and field_name not in _PATHS:
                series[field_name] = value
        for body in self.bodies:
            series[f"bodies: {body.name}.position"] = body.position
            series[f"bodies: {body.name}.orientation"] = body.orientation
        if self.camera is not None:
            series["camera.feature"] = self.camera.feature
            series["camera.target"] = self.camera.target
        wrong = {n: len(v) for n, v in series.items() if len(v) != len(self.time)}
        if wrong:
            raise ValueError(
                f"time has {len(self.time)} samples, but "
                + ", ".join(f"{name} has {n}" for name, n in wrong.items())
                + ". Log every field at every control step, with NaN where it has no value."
            )


_PATHS = ("demo_path", "plan_path")
"""Arrays without a sample for each control step."""
