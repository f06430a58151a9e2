"""Channels of demonstrations (joints, position, orientation, pose) and reproduction errors."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.demos import Demonstration, DemonstrationSet, PaddedDemonstrations
from hrc_learn.dmp import JointDMP, OrientationDMP, PoseDMP
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import arm_angle, fr3, panda

type Channel = Literal["joint", "position", "orientation", "pose"]
type Primitive = JointDMP | OrientationDMP | PoseDMP

CHANNELS: dict[str, tuple[str, ...]] = {
    "joint": ("joint_position",),
    "position": ("position",),
    "orientation": ("orientation",),
    "pose": ("position", "orientation"),
}
"""Columns that each channel is learned from."""
CLASSES = {
    "joint": JointDMP,
    "position": JointDMP,
    "orientation": OrientationDMP,
    "pose": PoseDMP,
}


class LazyMap[S, T](Sequence[T]):
    """Lazy map of a sequence: an item is computed when it is accessed."""

    def __init__(self, items: Sequence[S], function: Callable[[S], T]):
        self._items, self._function = items, function

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return LazyMap(self._items[index], self._function)
        return self._function(self._items[index])

    def __len__(self) -> int:
        return len(self._items)

    def __iter__(self) -> Iterator[T]:
        return map(self._function, self._items)


_LEAST_MOTION = 1e-4
"""Smallest motion above the noise of encoders and trackers [rad, m, quaternion components]."""


def require_motion(demo: Demonstration, source: str) -> None:
    """Refuse a demonstration without motion, as its relative errors are not defined.

    Raises:
        ValueError: Neither joints nor pose move, or values are not finite.
    """
    columns = (demo.joint_position, demo.position, demo.orientation)
    shown = [column for column in columns if column is not None and column.size]
    place = f"{source}, episode {demo.episode}"
    if any(not np.isfinite(column).all() for column in shown):
        raise ValueError(f"{place}: values are not finite; `hrc check` names them")
    if shown and max(float(np.ptp(column, axis=0).max()) for column in shown) < _LEAST_MOTION:
        raise ValueError(f"{place}: nothing moves; leave it out (--episodes names the others)")


@dataclass(frozen=True, kw_only=True, eq=False)
class Motions:
    """Demonstrations of one motion, padded to one batch."""

    demos: PaddedDemonstrations
    joint_names: tuple[str, ...]
    source: str

    @classmethod
    def of(cls, demos: DemonstrationSet) -> "Motions":
        """Pad demonstrations to one batch.

        A Panda's end-effector pose is computed from its joints, unless a position or an
        orientation was recorded, which may refer to another frame.

        Raises:
            ValueError: A demonstration has no motion, or values that are not finite.
        """
        for demo in demos:
            require_motion(demo, demos.source)
        padded = demos.padded()
        joints = padded.joint_position if demos.joint_names == panda.joint_names else None
        if joints is not None and padded.position is None and padded.orientation is None:
            tool = panda.forward(joints)
            pose = {"position": tool.position, "orientation": tool.orientation}
            padded = PaddedDemonstrations(**(vars(padded) | pose))
        return cls(demos=padded, joint_names=demos.joint_names, source=demos.source)

    def available(self) -> tuple[str, ...]:
        """Channels whose columns were recorded."""
        return tuple(
            channel
            for channel, columns in CHANNELS.items()
            if all(getattr(self.demos, column) is not None for column in columns)
        )

    def column(self, name: str) -> Tensor:
        """Column of all demonstrations, (demos, frames, components)."""
        values = getattr(self.demos, name)
        assert values is not None, name
        return values

    def position(self, channel: str) -> Float[Tensor, "demos frames D"]:
        """Linear coordinates of a channel: joint positions [rad] or position [m]."""
        return self.column(CHANNELS[channel][0])

    def naming(self, channel: str) -> dict[str, Any]:
        """Arguments of `JointDMP.fit` that name the coordinates and their unit."""
        if channel == "joint":
            return {"joint_names": self.joint_names or None, "units": "rad"}
        return {"joint_names": ("x", "y", "z"), "units": "m"}

    def fit(self, channel: str, n_basis: int, **options: Any) -> Primitive:
        """Fit one primitive to each demonstration.

        Args:
            channel: One of `available()`.
            n_basis: Number of basis functions.
            options: Fields of `FitOptions`.

        Raises:
            ValueError: The demonstrations lack a column of the channel.
        """
        self.require(channel)
        time, mask = self.demos.time, self.demos.mask
        if channel == "orientation":
            turn = self.column("orientation")
            return OrientationDMP.fit(time, turn, n_basis, mask=mask, **options)
        position = self.position(channel)
        if channel == "pose":
            turn, body = self.column("orientation"), self._body_shape()
            return PoseDMP.fit(time, position, turn, n_basis, body=body, mask=mask, **options)
        return JointDMP.fit(
            time, position, n_basis, mask=mask, **self.naming(channel), **options
        )

    def require(self, channel: str) -> None:
        """Raise ValueError unless the columns of a channel were recorded."""
        missing = [name for name in CHANNELS[channel] if getattr(self.demos, name) is None]
        if missing:
            raise ValueError(
                f"{self.source}: the demonstrations have no {' and no '.join(missing)}, which "
                f"channel {channel!r} needs. hrc check lists the columns."
            )

    @torch.no_grad()
    def adapted(self, channel: str, primitive: Primitive) -> "Reproduction":
        """Motion of a common primitive with start, goal and duration of each demonstration."""
        last = (self.demos.length - 1)[:, None]
        columns = [self.column(name) for name in CHANNELS[channel]]
        starts = [x[:, 0] for x in columns]
        goals = [x.take_along_dim(last[..., None], dim=1)[:, 0] for x in columns]
        start, goal = (Pose(*x) if channel == "pose" else x[0] for x in (starts, goals))
        time = self.demos.time
        lasting = time.take_along_dim(last, dim=1)[:, 0]
        return Reproduction.of(cast(Any, primitive).rollout(time, start, goal, lasting))

    @torch.no_grad()
    def own(self, primitive: Primitive) -> "Reproduction":
        """Motion of each demonstration's own primitive."""
        return Reproduction.of(primitive.rollout())

    def _body_shape(self) -> Tensor | None:
        """Arm angle of a Franka arm [rad], continuous, in the same turn at the start."""
        franka = {arm.joint_names: arm for arm in (panda, fr3)}
        if self.demos.joint_position is None or self.joint_names not in franka:
            return None
        chain = franka[self.joint_names]
        angle = np.unwrap(arm_angle(chain, self.demos.joint_position).numpy(), axis=1)
        start = np.unwrap(angle[:, :1], axis=0) - angle[:, :1]
        return torch.from_numpy(angle + start)[..., None]


@dataclass(frozen=True, eq=False)
class Reproduction:
    """Motions at the time stamps of demonstrations."""

    position: Float[Tensor, "demos frames D"] | None = None
    """Joint positions [rad] or position [m]; None for orientations."""
    orientation: Float[Tensor, "demos frames 4"] | None = None
    """Unit quaternions; None for joints and positions."""

    @classmethod
    def of(cls, motion: Any) -> "Reproduction":
        """Position and orientation of a trajectory, as far as it has them."""
        return cls(getattr(motion, "position", None), getattr(motion, "orientation", None))


def load_primitive(folder: Path, channel: str) -> Primitive:
    """Load the primitive of a channel.

    Raises:
        FileNotFoundError: The folder holds no saved primitive.
        ValueError: The primitive belongs to another channel.
    """
    return CLASSES[channel].load(folder)


def select_channels(motions: Motions, wanted: Sequence[str]) -> tuple[str, ...]:
    """Channels to learn: those given, or else joints and pose as far as they were recorded.

    Raises:
        ValueError: The demonstrations lack a column of a channel, or hold no motion at all.
    """
    for channel in wanted:
        motions.require(channel)
    if wanted:
        return tuple(wanted)
    available = motions.available()
    if not available:
        raise ValueError(
            f"{motions.source}: the demonstrations hold neither joint positions nor "
            "end-effector poses. hrc check lists the columns."
        )
    whole = [channel for channel in ("joint", "pose") if channel in available]
    parts = [channel for channel in ("position", "orientation") if channel in available]
    return tuple(whole if "pose" in whole else whole + parts)


@dataclass(frozen=True, kw_only=True, eq=False)
class ReproductionError:
    """Errors of each demonstration; None if a measure does not apply to the channel."""

    nrmse: Float[Tensor, " demos"] | None = None
    """Root mean square error divided by the largest range of any coordinate."""
    largest: Float[Tensor, " demos"] | None = None
    """Largest error of any coordinate [rad] or [m]."""
    goal_error: Float[Tensor, " demos"] | None = None
    """Distance of the last samples [rad] or [m]."""
    jerk: Float[Tensor, " demos"] | None = None
    """Ratio of the dimensionless jerk to that of the demonstration. Below 1: smoother."""
    turn_rmse: Float[Tensor, " demos"] | None = None
    """Root mean square angle between orientations [deg]."""
    turn_at_goal: Float[Tensor, " demos"] | None = None
    """Angle between the last orientations [deg]."""

    def columns(self) -> dict[str, Float[Tensor, " demos"]]:
        """Measures that apply, by name."""
        return {name: values for name, values in vars(self).items() if values is not None}

    def summary(self, prefix: str) -> dict[str, float]:
        """Median and maximum of each measure, by name."""
        figures = {}
        for name, values in self.columns().items():
            figures[f"{prefix}_{name}_median"] = float(values.quantile(0.5))
            figures[f"{prefix}_{name}_max"] = float(values.max())
        return figures


def reproduction_error(channel: str, motions: Motions, made: Reproduction) -> ReproductionError:
    """Errors of reproductions.

    Args:
        channel: Channel of the motions.
        motions: Demonstrations.
        made: Reproductions at their time stamps.
    """
    measures: dict[str, Tensor] = {}
    mask, last = motions.demos.mask, (motions.demos.length - 1)[:, None]
    if made.position is not None:
        measures |= _linear(motions, motions.column(CHANNELS[channel][0]), made.position)
    if made.orientation is not None:
        shown = motions.column("orientation")
        angle = quaternion.angle(made.orientation, shown).rad2deg()
        square = torch.where(mask, angle, 0.0).square().sum(dim=-1)
        measures["turn_rmse"] = (square / mask.sum(dim=-1)).sqrt()
        measures["turn_at_goal"] = angle.take_along_dim(last, dim=1)[:, 0]
    return ReproductionError(**measures)


def _linear(motions: Motions, shown: Tensor, made: Tensor) -> dict[str, Tensor]:
    mask, length = motions.demos.mask, motions.demos.length
    error = torch.where(mask[..., None], made - shown, 0.0)
    samples = mask.sum(dim=-1) * shown.shape[-1]
    low = torch.where(mask[..., None], shown, torch.inf).amin(dim=-2)
    high = torch.where(mask[..., None], shown, -torch.inf).amax(dim=-2)
    rmse = (error.square().sum(dim=(-2, -1)) / samples).sqrt()
    time = motions.demos.time
    jerk = [
        dimensionless_jerk(time[i, :n], made[i, :n])
        / dimensionless_jerk(time[i, :n], shown[i, :n])
        for i, n in enumerate(length.tolist())
    ]
    return {
        "nrmse": rmse / (high - low).amax(dim=-1).clamp_min(1e-12),
        "largest": error.abs().amax(dim=(-2, -1)),
        "goal_error": error.take_along_dim((length - 1)[:, None, None], dim=1)[:, 0].norm(
            dim=-1
        ),
        "jerk": torch.stack(jerk),
    }


def dimensionless_jerk(
    time: Float[Tensor, "T"], position: Float[Tensor, "T D"]
) -> Float[Tensor, ""]:
    """Integral of the squared jerk times duration^5 / (path length)^2, without unit.

    Invariant to units, speed and size (Hogan and Sternad 2009, "Sensitivity of smoothness
    measures to movement duration, amplitude, and arrests"). Computed from differences of
    samples, so that noise counts.
    """
    values = position
    for _ in range(3):
        values = torch.gradient(values, spacing=(time,), dim=0)[0]
    duration = time[-1] - time[0]
    length = position.diff(dim=0).norm(dim=-1).sum().clamp_min(1e-12)
    square = torch.trapezoid(values.square().sum(dim=-1), time)
    return square * duration**5 / length**2
