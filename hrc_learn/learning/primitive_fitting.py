"""Fit movement primitives to demonstrations: one to each demonstration, and their mean.

The primitives are fitted by channel: joints, position, orientation or pose of the end effector.
A dataset too large for memory is sampled, or streamed into one common primitive.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.demos import (
    Demonstration,
    DemonstrationSet,
    DemonstrationSource,
    PaddedDemonstrations,
)
from hrc_learn.distributed import LazyMap
from hrc_learn.dmp import (
    BasisSelection,
    JointDMP,
    OrientationDMP,
    PoseDMP,
    fit_shared,
    mean_primitive,
    select_basis_count,
)
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import arm_angle, fr3, panda
from hrc_learn.learning.reproduction_error import ReproductionError, reproduction_error

type Primitive = JointDMP | OrientationDMP | PoseDMP

CHANNELS: dict[str, tuple[str, ...]] = {
    "joint": ("joint_position",),
    "position": ("position",),
    "orientation": ("orientation",),
    "pose": ("position", "orientation"),
}
"""Columns from which each channel is learned."""
CLASSES = {
    "joint": JointDMP,
    "position": JointDMP,
    "orientation": OrientationDMP,
    "pose": PoseDMP,
}
EACH = "each"
"""Subfolder of a model for the primitives of single demonstrations."""
_APPROACH = 0.6
"""Fraction of a motion that adapts to a new goal; the rest, such as an insertion, keeps its
shape."""
_LEAST_MOTION = 1e-4
"""Smallest motion above the noise of encoders and trackers [rad, m, quaternion components]."""
HELD_AT_ONCE = 700_000
"""Largest number of values of a channel in memory. This is the number of demonstrations, times
the frames of the longest demonstration, times the columns (number of joints, but at least the 7
of a pose). Fitting so many values and comparing models takes up to 300 MB."""
LONGEST = 5_000
"""Largest number of frames of a demonstration in a sample; enough for 100 basis functions."""


def require_motion(demo: Demonstration, source: str) -> None:
    """Refuse a demonstration without motion, since its relative errors are not defined.

    Raises:
        ValueError: Neither joints nor pose move, or values are not finite.
    """
    columns = (demo.joint_position, demo.position, demo.orientation)
    shown = [column for column in columns if column is not None and column.size]
    place = f"{source}, episode {demo.episode}"
    if any(not np.isfinite(column).all() for column in shown):
        raise ValueError(f"{place}: values are not finite; `hrc check` names them")
    if shown and max(float(np.ptp(column, axis=0).max()) for column in shown) < _LEAST_MOTION:
        raise ValueError(f"{place}: nothing moves; leave it out (--episodes lists the others)")


@dataclass(frozen=True, kw_only=True, eq=False)
class Motions:
    """Demonstrations of one motion, padded to one batch."""

    demos: PaddedDemonstrations
    joint_names: tuple[str, ...]
    source: str
    joint_unit: str = "rad"
    """Unit of the joint positions; "1": fractions of the joints' ranges."""

    @classmethod
    def of(cls, demos: DemonstrationSet) -> "Motions":
        """Pad demonstrations to one batch.

        A Panda's end-effector pose is computed from its joints, unless a position or an
        orientation was recorded: the recorded values may refer to another frame.

        Raises:
            ValueError: A demonstration has no motion, or values that are not finite.
        """
        for demo in demos:
            require_motion(demo, demos.source)
        padded = demos.padded()
        is_panda = (demos.joint_names, demos.joint_unit) == (panda.joint_names, "rad")
        joints = padded.joint_position if is_panda else None
        if joints is not None and padded.position is None and padded.orientation is None:
            tool = panda.forward(joints)
            pose = {"position": tool.position, "orientation": tool.orientation}
            padded = PaddedDemonstrations(**(vars(padded) | pose))
        return cls(
            demos=padded,
            joint_names=demos.joint_names,
            source=demos.source,
            joint_unit=demos.joint_unit,
        )

    def missing(self, channel: str) -> list[str]:
        """Columns of a channel that were not recorded."""
        return [name for name in CHANNELS[channel] if getattr(self.demos, name) is None]

    def column(self, name: str) -> Tensor:
        """Column of all demonstrations, (demos, frames, components)."""
        values = getattr(self.demos, name)
        assert values is not None, name
        return values

    def position(self, channel: str) -> Float[Tensor, "demos frames D"]:
        """Linear coordinates of a channel: joint positions [rad] or position [m]."""
        return self.column(CHANNELS[channel][0])

    def fit(self, channel: str, n_basis: int, **options: Any) -> Primitive:
        """Fit one primitive to each demonstration.

        Args:
            channel: Channel whose columns were recorded.
            n_basis: Number of basis functions.
            options: Fields of `FitOptions`.
        """
        time, mask = self.demos.time, self.demos.mask
        if channel == "orientation":
            turn = self.column("orientation")
            return OrientationDMP.fit(time, turn, n_basis, mask=mask, **options)
        position = self.position(channel)
        if channel == "pose":
            turn, body = self.column("orientation"), self._body_shape()
            return PoseDMP.fit(time, position, turn, n_basis, body=body, mask=mask, **options)
        named = _naming(channel, self.joint_names, self.joint_unit)
        return JointDMP.fit(time, position, n_basis, mask=mask, **named, **options)

    def require(self, channel: str) -> None:
        """Raise ValueError unless the columns of a channel were recorded."""
        if missing := self.missing(channel):
            raise ValueError(
                f"{self.source}: the demonstrations have no {' and no '.join(missing)}, which "
                f"channel {channel!r} needs. hrc check lists the columns."
            )

    @torch.no_grad()
    def adapted(self, channel: str, primitive: Primitive) -> Any:
        """Motions of a common primitive, adapted to each demonstration.

        Each motion has the start, goal and duration of its demonstration, and the same time
        stamps.
        """
        last = (self.demos.length - 1)[:, None]
        columns = [self.column(name) for name in CHANNELS[channel]]
        starts = [x[:, 0] for x in columns]
        goals = [x.take_along_dim(last[..., None], dim=1)[:, 0] for x in columns]
        start, goal = (Pose(*x) if channel == "pose" else x[0] for x in (starts, goals))
        time = self.demos.time
        lasting = time.take_along_dim(last, dim=1)[:, 0]
        return cast(Any, primitive).rollout(time, start, goal, lasting)

    def error(self, channel: str, made: Any) -> ReproductionError:
        """Errors of reproduced motions `made`, sampled at the demonstrations' time stamps."""
        return reproduction_error(self.demos, CHANNELS[channel][0], made)

    def _body_shape(self) -> Tensor | None:
        """Arm angle of a Franka arm [rad], (demos, frames, 1); None for other arms.

        The angle is continuous over time, and its first value is continuous from each
        demonstration to the next.
        """
        chain = {arm.joint_names: arm for arm in (panda, fr3)}.get(self.joint_names)
        if chain is None or self.demos.joint_position is None or self.joint_unit != "rad":
            return None
        angle = np.unwrap(arm_angle(chain, self.demos.joint_position).numpy(), axis=1)
        start = np.unwrap(angle[:, :1], axis=0) - angle[:, :1]
        return torch.from_numpy(angle + start)[..., None]


def _naming(channel: str, joint_names: tuple[str, ...], joint_unit: str) -> dict[str, Any]:
    """Arguments of `JointDMP.fit` that name the coordinates of a channel and their unit."""
    if channel == "joint":
        return {"joint_names": joint_names or None, "units": joint_unit}
    return {"joint_names": ("x", "y", "z"), "units": "m"}


def load_primitive(folder: str | Path, channel: str) -> Primitive:
    """Load the primitive of a channel.

    Raises:
        FileNotFoundError: The folder holds no saved primitive.
        ValueError: The primitive belongs to another channel.
    """
    return CLASSES[channel].load(folder)


def select_channels(motions: Motions, wanted: Sequence[str]) -> tuple[str, ...]:
    """Channels to learn: the wanted ones, or else joints and pose, if they were recorded.

    Raises:
        ValueError: The demonstrations lack a column of a channel, or hold no motion at all.
    """
    for channel in wanted:
        motions.require(channel)
    if wanted:
        return tuple(wanted)
    available = [channel for channel in CHANNELS if not motions.missing(channel)]
    if not available:
        raise ValueError(
            f"{motions.source}: the demonstrations hold neither joint positions nor "
            "end-effector poses. hrc check lists the columns."
        )
    whole = [channel for channel in ("joint", "pose") if channel in available]
    parts = [channel for channel in ("position", "orientation") if channel in available]
    return tuple(whole if "pose" in whole else whole + parts)


@dataclass(frozen=True, kw_only=True)
class FittedPrimitives:
    """Primitives of one motion: one for each demonstration, and their mean."""

    motions: Motions
    each: Mapping[str, Primitive]
    """Primitives of all demonstrations as a batch, by channel."""
    common: Mapping[str, Primitive]
    """Mean primitive without batch dimensions, by channel."""
    n_basis: int
    """Number of basis functions."""
    selection: BasisSelection | None = None
    """Selection of the number of basis functions; None if the number was given."""

    def save(self, folder: str | Path, each: bool = False) -> None:
        """Write the mean primitives to `folder/CHANNEL`.

        Args:
            folder: Folder of the model.
            each: Also write the primitives of single demonstrations, from which
                `ProbabilisticDMP` is fitted, to `folder/each/CHANNEL`.
        """
        for channel, primitive in self.common.items():
            primitive.save(Path(folder, channel))
        for channel, primitives in self.each.items() if each else ():
            primitives.save(Path(folder, EACH, channel))

    def metrics(self) -> dict[str, float]:
        """Errors of the primitives, by name.

        Names with `mean_` are for the mean primitive, adapted to each demonstration's start,
        goal and duration.
        """
        count = float(len(self.motions.demos.length))
        values = {"demonstrations": count, "basis_functions": float(self.n_basis)}
        for channel, primitives in self.each.items():
            own = primitives.rollout()
            mean = self.motions.adapted(channel, self.common[channel])
            for name, made in ((channel, own), (f"mean_{channel}", mean)):
                values |= self.motions.error(channel, made).summary(name)
        return values


def fit_primitives(
    demos: DemonstrationSet,
    n_basis: int | None = 60,
    method: str = "trajectory",
    *,
    channels: Sequence[str] = (),
    candidates: Sequence[int] = (10, 15, 20, 30, 40, 60, 80, 100),
    **options: Any,
) -> FittedPrimitives:
    """Fit one primitive to each demonstration, and their mean.

    Args:
        demos: Demonstrations of one motion.
        n_basis: Number of basis functions. None: the smallest candidate that predicts held-out
            samples as well as the best one (see `select_basis_count`).
        method: See `JointDMP.fit`.
        channels: Channels to learn. Default: joints and pose, if they were recorded. A
            Panda's pose is computed from its joints, and its arm angle is learned too.
        candidates: Numbers of basis functions to choose from.
        options: Further fields of `FitOptions`, and `scaling`. `smooth` is True by default.

    Raises:
        ValueError: The demonstrations hold no motion, or lack a column of a channel.
    """
    motions = Motions.of(demos)
    channels = select_channels(motions, channels)
    # Without smoothing the fit would follow the noise of encoders and trackers.
    options = {"method": method, "smooth": True, **options}
    if "scaling" not in options:
        options.setdefault("approach", _APPROACH)
    selection = None
    if n_basis is None:
        selection = _select(motions, channels[0], candidates, options)
        n_basis = selection.count
    each = {channel: motions.fit(channel, n_basis, **options) for channel in channels}
    return FittedPrimitives(
        motions=motions,
        each=each,
        common={channel: mean_primitive(cast(Any, each[channel])) for channel in channels},
        n_basis=n_basis,
        selection=selection,
    )


def _select(
    motions: Motions, channel: str, candidates: Sequence[int], options: Mapping[str, Any]
) -> BasisSelection:
    """Select the number of basis functions from the linear coordinates of a channel."""
    if channel == "orientation":
        raise ValueError(
            "the number of basis functions is chosen by joints or positions: give n_basis for "
            "orientations alone."
        )
    shortest = int(motions.demos.length.min())
    possible = [count for count in candidates if 2 * count <= shortest]
    if not possible:
        raise ValueError(
            f"the shortest demonstration has {shortest} samples, too few to choose the number "
            f"of basis functions from {', '.join(map(str, candidates))}: give n_basis."
        )
    return select_basis_count(
        motions.demos.time,
        motions.position(channel),
        possible,
        mask=motions.demos.mask,
        **options,
    )


def sampled(source: DemonstrationSource) -> DemonstrationSet:
    """All demonstrations, or an evenly spread sample of them if the dataset is too large.

    In a sample, demonstrations longer than twice the median length, or than `LONGEST` frames,
    are thinned. A note of the result describes the sample.

    Args:
        source: Demonstrations on disk.
    """
    lengths = source.lengths
    if len(lengths) * max(lengths) * _width(source) <= HELD_AT_ONCE:
        return source.load()
    longest = min(LONGEST, 2 * int(np.median(lengths)), max(lengths))
    count = min(len(lengths), max(1, HELD_AT_ONCE // (longest * _width(source))))
    demos = [_thinned(demo, longest) for demo in source.spread(count)]
    note = f"{count} of {len(lengths)} demonstrations, evenly spread, are used"
    if max(lengths) > longest:
        note += f"; longer ones are thinned to {longest} frames"
    note += "; --several streamed uses all"
    notes, unit = (*source.notes, note), source.joint_unit
    return DemonstrationSet(demos, notes=notes, source=source.source, joint_unit=unit)


def _width(source: DemonstrationSource) -> int:
    """Number of columns of the widest channel."""
    return max(7, len(source.joint_names))


def _thinned(demo: Demonstration, longest: int) -> Demonstration:
    """Demonstration with at most `longest` frames, including the first and the last."""
    if len(demo) <= longest:
        return demo
    kept = np.linspace(0, len(demo) - 1, longest).round().astype(int)
    return replace(
        demo,
        **{name: getattr(demo, name)[kept] for name in demo.recorded},
        fps=demo.fps * (longest - 1) / (len(demo) - 1),
        extra={key: values[kept] for key, values in demo.extra.items()},
    )


def fit_streamed(
    demos: DemonstrationSource, n_basis: int, *, channels: Sequence[str] = ()
) -> tuple[dict[str, JointDMP], dict[str, float]]:
    """Fit one primitive to all demonstrations in a single pass, reading them one by one.

    Args:
        demos: Demonstrations on disk.
        n_basis: Number of basis functions.
        channels: "joint", "position" or both. Default: joint.

    Returns:
        Primitives by channel, and measured values by name.

    Raises:
        ValueError: A channel is pose or orientation: coordinates of orientations depend on the
            goal of each demonstration, so they have no common primitive.
    """
    fits, metrics = {}, {"demonstrations": float(len(demos)), "frames": float(demos.frames)}
    for channel in channels or ("joint",):
        if channel not in ("joint", "position"):
            raise ValueError(f"channel {channel!r} cannot be streamed, only joint and position")
        column = partial(_stamped_column, name=CHANNELS[channel][0], source=demos.source)
        named = _naming(channel, demos.joint_names, demos.joint_unit)
        fits[channel], rmse = fit_shared(LazyMap(demos, column), n_basis, **named)
        metrics[f"mean_{channel}_rmse"] = float(rmse.square().mean().sqrt())
    return fits, metrics


def _stamped_column(
    demo: Demonstration, name: str, source: str
) -> tuple[Float[np.ndarray, " T"], Float[np.ndarray, "T D"]]:
    """Time stamps [s] and one column of a demonstration."""
    require_motion(demo, source)
    values = getattr(demo, name)
    if values is None:
        raise ValueError(f"{source}, episode {demo.episode}: no {name}.")
    return demo.time, values
