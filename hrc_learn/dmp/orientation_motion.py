"""An orientation over time, and the state of an orientation primitive."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp.rotation import error as error_space
from hrc_learn.dmp.rotation.formulation import ErrorMotion
from hrc_learn.dmp.state import DMPState


class OrientationTrajectory:
    """An orientation over time, each output computed when first asked for."""

    def __init__(
        self, errors: ErrorMotion, reference: Float[Tensor, "*batch 4"], first: int = 0
    ):
        """Read the motion of an error, found in columns `first` to `first` + 3 of `errors`."""
        self._errors = errors
        self._reference = reference
        self._columns = slice(first, first + 3)

    @property
    def time(self) -> Float[Tensor, "*batch T"]:
        """Since the start of the motion [s]."""
        return self._errors.time

    @cached_property
    def orientation(self) -> Float[Tensor, "*batch T 4"]:
        """Unit quaternions (w, x, y, z), continuous in sign."""
        return error_space.to_orientations(self._error, self._reference)

    @cached_property
    def angular_velocity(self) -> Float[Tensor, "*batch T 3"]:
        """In the base frame [rad/s]."""
        return error_space.angular_velocity(self._error, self._rate)

    @cached_property
    def angular_acceleration(self) -> Float[Tensor, "*batch T 3"]:
        """In the base frame [rad/s^2]."""
        curvature = self._errors.acceleration[..., self._columns]
        return error_space.angular_acceleration(self._error, self._rate, curvature)

    @property
    def _error(self) -> Tensor:
        return self._errors.position[..., self._columns]

    @property
    def _rate(self) -> Tensor:
        return self._errors.velocity[..., self._columns]


@dataclass(frozen=True, kw_only=True, eq=False)
class OrientationState:
    """Where an orientation primitive is while it is stepped."""

    motion: DMPState
    """Of the error to the reference."""
    reference: Float[Tensor, "*batch 4"]
    """The goal, unless the primitive says otherwise."""

    @property
    def orientation(self) -> Float[Tensor, "*batch 4"]:
        """Unit quaternion (w, x, y, z)."""
        return error_space.to_orientation(self.motion.position, self.reference)

    @property
    def angular_velocity(self) -> Float[Tensor, "*batch 3"]:
        """In the base frame [rad/s]."""
        return error_space.angular_velocity(self.motion.position, self.motion.velocity)


torch.export.register_dataclass(
    OrientationState, serialized_type_name="hrc_learn.dmp.OrientationState"
)
