"""Cartesian position region: a box that attracts the end effector."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import quaternion
from hrc_learn.pytree import pytree, static
from hrc_learn.regions.region import Region


@pytree
@dataclass(frozen=True, kw_only=True)
class PositionRegion(Region):
    """Box with smooth walls; its potential is zero inside.

    f_i = ((r_i - c_i) / h_i)^2 - 1                                      (CaFun)
    P   = sum_i k_c/2 max(0, f_i)^2                                      (CaPeFun)

    k_c has the unit of a potential: the speed it asks for, 2 k_c f (r - c)/h^2, grows as the
    box shrinks, and near a wall the excess decays at the rate 4 k_c/h^2 [1/s].
    """

    centre: Float[Tensor, "*#batch 3"]
    """Centre of the box [m]."""
    half_size: Float[Tensor, "*#batch 3"]
    """Half of its edges, all positive [m]."""
    rotation: Float[Tensor, "*#batch 4"] | None = None
    """Orientation of the box as a unit quaternion (w, x, y, z); None: along the base axes."""
    stiffness: float | tuple[float, float, float] = static(4e-3)
    """k_c, one for all or one for each axis of the box. Ten times that of Table I: there the
    excess near a wall of 0.12 m decays in 9 s, which leaves the tool outside for long."""

    def value(self, x: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*both 3"]:
        """Region function f of each pair of walls at the position x [m]."""
        scaled = self._in_box(x) / self.half_size
        return scaled * scaled - 1

    def feedback(
        self, x: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*both"], Float[Tensor, "*both 3"]]:
        """Potential and its gradient over the position, in the base frame."""
        scaled = self._in_box(x) / self.half_size
        f = (scaled * scaled - 1).clamp(min=0)
        k_c = self.stiffness
        # One for each axis of the box, or one for all.
        pull = (f.new_tensor(k_c) if isinstance(k_c, tuple) else k_c) * f
        P = 0.5 * (pull * f).sum(-1)
        gradient = 2 * pull * scaled / self.half_size
        if self.rotation is not None:
            gradient = quaternion.rotate(self.rotation, gradient)
        return P, gradient

    def _in_box(self, x: Tensor) -> Tensor:
        """Offset from the centre, along the axes of the box [m]."""
        offset = x - self.centre
        if self.rotation is None:
            return offset
        return quaternion.rotate(quaternion.conjugate(self.rotation), offset)
