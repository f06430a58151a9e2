"""Vision region: an ellipse in the image that attracts the feature to the target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.pytree import pytree, static
from hrc_learn.regions.region import Region

# Normalised distance at which the pull of the saturated form levels off.
_SATURATION = 0.5


@pytree
@dataclass(frozen=True, kw_only=True)
class VisionRegion(Region):
    """Ellipse round the target; its potential is least at the target.

    f = ((u - u_d) / b_1)^2 + ((v - v_d) / b_2)^2 - 1                    (eq_vision_re_func)
    P = k_v/2 (1 - min(0, f)^2)                                          (eq_vision_p)

    That pull is zero at the target and again at the edge of the ellipse, and so weak near
    both. `formulation="saturated"` has the same pull close to the target but keeps pulling
    with constant strength further out, wherever the feature is seen:

    P = 2 k_v s^2 (sqrt(1 + rho^2/s^2) - 1),   rho^2 = f + 1,   s = 1/2

    A feature of several points, such as the corners of a marker, has an ellipse round each of
    them, and the mean of their potentials.
    """

    target: Float[Tensor, "*#batch rows"]
    """Desired feature position (u, v) [px], or u and v of several points in turn."""
    half_size: Float[Tensor, "*#batch rows"]
    """Half axes b_1, b_2 of the ellipse, positive [px]. It should lie inside the image."""
    stiffness: float = static(0.3)
    """k_v."""
    formulation: Literal["paper", "saturated"] = static("paper")

    @classmethod
    def inside_image(
        cls,
        target: Float[Tensor, "*batch rows"],
        image_size: tuple[int, int],
        border: float = 0.0,
        **options: Any,
    ) -> VisionRegion:
        """Largest ellipse round the target that stays inside the image.

        Args:
            target: Desired feature position (u, v) [px].
            image_size: Width and height of the image [px].
            border: Distance the ellipse keeps from the edge of the image [px].
            options: The remaining fields.

        Raises:
            ValueError: The target is not inside the image by more than the border.
        """
        # Pixels count from 0, so the last one is at the size less one.
        far_edge = target.new_tensor(image_size).repeat(target.shape[-1] // 2) - 1
        half_size = torch.minimum(target, far_edge - target) - border
        if not bool((half_size > 0).all()):
            raise ValueError(
                f"the vision target must lie more than {border} px inside the image of "
                f"{image_size[0]} x {image_size[1]} px, but is {target.tolist()}; "
                "move the target or lower `border`"
            )
        return cls(target=target, half_size=half_size, **options)

    def value(self, x: Float[Tensor, "*batch rows"]) -> Float[Tensor, "*both"]:
        """Region function f at the feature position x [px]; of several points, the largest."""
        scaled = (x - self.target) / self.half_size
        square = scaled * scaled
        if square.shape[-1] > 2:
            return square.unflatten(-1, (-1, 2)).sum(-1).amax(-1) - 1
        return square.sum(-1) - 1

    def feedback(
        self, x: Float[Tensor, "*batch rows"]
    ) -> tuple[Float[Tensor, "*both"], Float[Tensor, "*both rows"]]:
        """Potential and its gradient over the feature position [1/px]; means over points."""
        scaled = (x - self.target) / self.half_size
        if scaled.shape[-1] > 2:
            P, gradient = self._steer(scaled.unflatten(-1, (-1, 2)))
            points = P.shape[-1]
            return P.mean(-1), gradient.flatten(-2) / (points * self.half_size)
        P, gradient = self._steer(scaled)
        return P, gradient / self.half_size

    def _steer(self, scaled: Tensor) -> tuple[Tensor, Tensor]:
        """Potential of a point and its gradient, at its normalised offset."""
        square = (scaled * scaled).sum(-1, keepdim=True)
        steer = self._saturated if self.formulation == "saturated" else self._paper
        P, slope = steer(square)
        return P.squeeze(-1), slope * scaled

    def _paper(self, square: Tensor) -> tuple[Tensor, Tensor]:
        f = (square - 1).clamp(max=0)
        return (0.5 * self.stiffness) * (1 - f * f), (-2 * self.stiffness) * f

    def _saturated(self, square: Tensor) -> tuple[Tensor, Tensor]:
        root = torch.sqrt(1 + square / _SATURATION**2)
        return (2 * self.stiffness * _SATURATION**2) * (root - 1), 2 * self.stiffness / root
