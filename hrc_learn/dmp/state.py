"""State of a primitive in closed loop."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class DMPState:
    """Where a primitive is while it is stepped; every step makes a new one.

    A pytree: goes through `torch.func` and `torch.export` as it is.

    To follow a robot that was pushed, replace the position by the measured one.
    """

    position: Float[Tensor, "*batch D"]
    rate: Float[Tensor, "*batch D"]
    """dy/ds, the velocity times the duration."""
    start: Float[Tensor, "*batch D"]
    goal: Float[Tensor, "*batch D"]
    """What attracts the motion now."""
    way: Float[Tensor, "*batch D"]
    """Goal minus start, as the motion began."""
    target: Float[Tensor, "*batch D"]
    """Where the goal was last told to be; a filtered goal takes a while to get there."""
    duration: Float[Tensor, "*batch"]
    """[s] that the motion takes when nothing slows it."""
    pace: Float[Tensor, "*batch"]
    """Speed of the last step: 1 undisturbed, towards 0 the more it was slowed."""
    s: Float[Tensor, "*batch"]
    """Normalised time, 1 at the end of the motion. Float64: a thousand additions show."""
    forced: Float[Tensor, "*batch 2 D"]
    """(y, dy/ds) that the unscaled forcing term alone has caused by `s`."""

    @property
    def velocity(self) -> Float[Tensor, "*batch D"]:
        """Per second."""
        return self.rate * (self.pace / self.duration)[..., None]


torch.export.register_dataclass(DMPState, serialized_type_name="hrc_learn.dmp.DMPState")
