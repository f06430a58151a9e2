"""Channels of a demonstration to learn: joints, position, orientation, or pose."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.demos import DemonstrationSet, PaddedDemonstrations
from hrc_learn.dmp import JointDMP, OrientationDMP, PoseDMP
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import arm_angle, panda

type Channel = Literal["joint", "position", "orientation", "pose"]
type Primitive = JointDMP | OrientationDMP | PoseDMP

CHANNELS: dict[str, tuple[str, ...]] = {
    "joint": ("joint_position",),
    "position": ("position",),
    "orientation": ("orientation",),
    "pose": ("position", "orientation"),
}
"""Every channel, with the columns that it is learned from."""
CLASSES = {
    "joint": JointDMP,
    "position": JointDMP,
    "orientation": OrientationDMP,
    "pose": PoseDMP,
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Motions:
    """Demonstrations of one motion, ready for a primitive of any channel."""

    demos: PaddedDemonstrations
    joint_names: tuple[str, ...]
    source: str

    @classmethod
    def of(cls, demos: DemonstrationSet) -> "Motions":
        """Pad them; of a Panda, the pose of the end effector follows from the joints."""
        padded = demos.padded()
        joints = padded.joint_position if demos.joint_names == panda.joint_names else None
        if joints is not None and (padded.position is None or padded.orientation is None):
            hand = panda.forward(joints)
            pose = {"position": hand.position, "orientation": hand.orientation}
            padded = PaddedDemonstrations(**(vars(padded) | pose))
        return cls(demos=padded, joint_names=demos.joint_names, source=demos.source)

    def available(self) -> tuple[str, ...]:
        """Kinds that can be learned."""
        return tuple(
            channel
            for channel, columns in CHANNELS.items()
            if all(getattr(self.demos, column) is not None for column in columns)
        )

    def column(self, name: str) -> Tensor:
        """A column that is there."""
        values = getattr(self.demos, name)
        assert values is not None, name
        return values

    def position(self, channel: str) -> Float[Tensor, "demos frames D"]:
        """What a primitive of a channel with linear coordinates is fitted to."""
        return self.column(CHANNELS[channel][0])

    def naming(self, channel: str) -> dict[str, Any]:
        """Names and unit of the coordinates of a linear channel."""
        if channel == "joint":
            return {"joint_names": self.joint_names or None, "units": "rad"}
        return {"joint_names": ("x", "y", "z"), "units": "m"}

    def fit(self, channel: str, n_basis: int, **options: Any) -> Primitive:
        """One primitive for each demonstration.

        Args:
            channel: One of `available()`.
            n_basis: Number of basis functions.
            options: See `FitOptions`.

        Raises:
            ValueError: The demonstrations lack what the channel needs.
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
        """Raise ValueError unless a channel can be learned."""
        missing = [name for name in CHANNELS[channel] if getattr(self.demos, name) is None]
        if missing:
            raise ValueError(
                f"{self.source}: the demonstrations hold no {' and no '.join(missing)}, which "
                f"a primitive of channel {channel!r} is learned from. Look with "
                f"datasets/check_dataset.py."
            )

    def adapted(self, channel: str, primitive: Primitive) -> "Reproduction":
        """A primitive with the start, goal and duration of each demonstration."""
        last = (self.demos.length - 1)[:, None, None]

        def ends(name: str) -> tuple[Tensor, Tensor]:
            values = self.column(name)
            return values[:, 0], values.take_along_dim(last, dim=1)[:, 0]

        time, duration = self.demos.time, self.demos.time.take_along_dim(last[..., 0], dim=1)
        timing = {"duration": duration[:, 0]}
        if isinstance(primitive, JointDMP):
            start, goal = ends(CHANNELS[channel][0])
            return Reproduction(primitive.rollout(time, start, goal, **timing).position)
        turn_start, turn_goal = ends("orientation")
        if isinstance(primitive, OrientationDMP):
            motion = primitive.rollout(time, turn_start, turn_goal, **timing)
            return Reproduction(orientation=motion.orientation)
        start, goal = ends("position")
        motion = primitive.rollout(
            time, Pose(start, turn_start), Pose(goal, turn_goal), **timing
        )
        return Reproduction(motion.position, motion.orientation)

    def own(self, primitive: Primitive) -> "Reproduction":
        """What each demonstration's own primitive makes of it."""
        if isinstance(primitive, OrientationDMP):
            return Reproduction(orientation=primitive.rollout().orientation)
        if isinstance(primitive, JointDMP):
            return Reproduction(primitive.rollout().position)
        motion = primitive.rollout()
        return Reproduction(motion.position, motion.orientation)

    def _body_shape(self) -> Tensor | None:
        """Arm angle of a Panda, continuous, and alike in turns at the start [rad]."""
        if self.demos.joint_position is None or self.joint_names != panda.joint_names:
            return None
        angle = np.unwrap(arm_angle(panda, self.demos.joint_position).numpy(), axis=1)
        start = np.unwrap(angle[:, :1], axis=0) - angle[:, :1]
        return torch.from_numpy(angle + start)[..., None]


@dataclass(frozen=True, eq=False)
class Reproduction:
    """Motions at the stamps of demonstrations; None where a channel says nothing about it."""

    position: Float[Tensor, "demos frames D"] | None = None
    """Joints [rad] or position [m]."""
    orientation: Float[Tensor, "demos frames 4"] | None = None

    def __post_init__(self):
        for name, values in vars(self).items():
            if values is not None:
                object.__setattr__(self, name, values.detach())


def load_primitive(folder: Path, channel: str) -> Primitive:
    """A saved primitive of that channel.

    Raises:
        FileNotFoundError: No saved primitive there.
        ValueError: It is a model of another channel.
    """
    return CLASSES[channel].load(folder)


def select_channels(motions: Motions, wanted: Sequence[str]) -> tuple[str, ...]:
    """Kinds to learn: those wanted, or, if none is named, joints and pose or what there is.

    Raises:
        ValueError: The demonstrations lack what a channel needs, or hold no motion at all.
    """
    for channel in wanted:
        motions.require(channel)
    if wanted:
        return tuple(wanted)
    available = motions.available()
    if not available:
        raise ValueError(
            f"{motions.source}: the demonstrations hold neither joint positions nor "
            "end-effector poses, so there is no motion to learn. Look with "
            "hrc check."
        )
    whole = [channel for channel in ("joint", "pose") if channel in available]
    parts = [channel for channel in ("position", "orientation") if channel in available]
    return tuple(whole if "pose" in whole else whole + parts)
