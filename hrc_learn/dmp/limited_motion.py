"""A motion between joint limits over time, and its state in closed loop."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp.soft_limits import SoftLimits
from hrc_learn.dmp.state import DMPState
from hrc_learn.dmp.trajectory import Trajectory


class LimitedTrajectory:
    """A motion between limits, each output computed when first asked for."""

    def __init__(self, free: Trajectory, limits: SoftLimits):
        """Constrain a motion without bounds."""
        self._free = free
        self._limits = limits

    @property
    def time(self) -> Float[Tensor, "*batch T"]:
        """Since the start of the motion [s]."""
        return self._free.time

    @cached_property
    def position(self) -> Float[Tensor, "*batch T D"]:
        """In the units of the demonstration."""
        return self._limits.constrain(self._free.position)

    @cached_property
    def velocity(self) -> Float[Tensor, "*batch T D"]:
        """The same per second."""
        return self._velocity(self._free.position, self._free.velocity)

    @cached_property
    def acceleration(self) -> Float[Tensor, "*batch T D"]:
        """The same per second squared."""
        x, rate, curvature = self._free.position, self._free.velocity, self._free.acceleration
        return torch.func.jvp(self._velocity, (x, rate), (rate, curvature))[1]

    def _velocity(self, x: Tensor, rate: Tensor) -> Tensor:
        return torch.func.jvp(self._limits.constrain, (x,), (rate,))[1]


@dataclass(frozen=True, kw_only=True, eq=False)
class LimitedState:
    """Where a primitive between limits is while it is stepped; a pytree."""

    motion: DMPState
    """Of the coordinates without bounds."""
    limits: SoftLimits

    @property
    def position(self) -> Float[Tensor, "*batch D"]:
        """In the units of the demonstration, always between the limits."""
        return self.limits.constrain(self.motion.position)

    @property
    def velocity(self) -> Float[Tensor, "*batch D"]:
        """Per second."""
        motion = self.motion
        rate = motion.velocity
        return torch.func.jvp(self.limits.constrain, (motion.position,), (rate,))[1]


torch.export.register_dataclass(LimitedState, serialized_type_name="hrc_learn.dmp.LimitedState")
