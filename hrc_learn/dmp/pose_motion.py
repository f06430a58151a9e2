"""A pose over time, and the state of a pose primitive."""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp.orientation_motion import OrientationState, OrientationTrajectory
from hrc_learn.dmp.pose_columns import BODY, ERROR, POSITION
from hrc_learn.dmp.state import DMPState
from hrc_learn.dmp.trajectory import Trajectory
from hrc_learn.geometry import Pose


class PoseTrajectory:
    """A pose over time, each output computed when first asked for."""

    def __init__(self, motion: Trajectory, reference: Float[Tensor, "*batch 4"]):
        self._motion = motion
        self._rotation = OrientationTrajectory(motion, reference, first=ERROR.start)

    @property
    def time(self) -> Float[Tensor, "*batch T"]:
        """Since the start of the motion [s]."""
        return self._motion.time

    @property
    def position(self) -> Float[Tensor, "*batch T 3"]:
        """[m]."""
        return self._motion.position[..., POSITION]

    @property
    def orientation(self) -> Float[Tensor, "*batch T 4"]:
        """Unit quaternions (w, x, y, z), continuous in sign."""
        return self._rotation.orientation

    @property
    def pose(self) -> Pose:
        """Position and orientation, (*batch, T)."""
        return Pose(self.position, self.orientation)

    @property
    def velocity(self) -> Float[Tensor, "*batch T 3"]:
        """Linear [m/s]."""
        return self._motion.velocity[..., POSITION]

    @property
    def angular_velocity(self) -> Float[Tensor, "*batch T 3"]:
        """In the base frame [rad/s]."""
        return self._rotation.angular_velocity

    @cached_property
    def twist(self) -> Float[Tensor, "*batch T 6"]:
        """(linear [m/s], angular [rad/s]) in the base frame."""
        return torch.cat([self.velocity, self.angular_velocity], dim=-1)

    @property
    def acceleration(self) -> Float[Tensor, "*batch T 3"]:
        """Linear [m/s^2]."""
        return self._motion.acceleration[..., POSITION]

    @property
    def angular_acceleration(self) -> Float[Tensor, "*batch T 3"]:
        """In the base frame [rad/s^2]."""
        return self._rotation.angular_acceleration

    @property
    def body(self) -> Float[Tensor, "*batch T K"]:
        """Coordinates learned along; K = 0 without any."""
        return self._motion.position[..., BODY]

    @property
    def body_velocity(self) -> Float[Tensor, "*batch T K"]:
        """The same per second."""
        return self._motion.velocity[..., BODY]


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseState:
    """Where a pose primitive is while it is stepped."""

    motion: DMPState
    """Of position, error to the reference, and body."""
    reference: Float[Tensor, "*batch 4"]
    """The goal's orientation, unless the primitive says otherwise."""

    @property
    def pose(self) -> Pose:
        """Position [m] and orientation."""
        return Pose(self.motion.position[..., POSITION], self._rotation.orientation)

    @property
    def twist(self) -> Float[Tensor, "*batch 6"]:
        """(linear [m/s], angular [rad/s]) in the base frame."""
        linear = self.motion.velocity[..., POSITION]
        return torch.cat([linear, self._rotation.angular_velocity], dim=-1)

    @property
    def body(self) -> Float[Tensor, "*batch K"]:
        """Coordinates learned along."""
        return self.motion.position[..., BODY]

    @property
    def _rotation(self) -> OrientationState:
        columns = {
            name: getattr(self.motion, name)[..., ERROR]
            for name in ("position", "rate", "start", "goal", "way", "target", "forced")
        }
        return OrientationState(
            motion=replace(self.motion, **columns), reference=self.reference
        )


torch.export.register_dataclass(PoseState, serialized_type_name="hrc_learn.dmp.PoseState")
