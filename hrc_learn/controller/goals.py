"""Where the arm is to go: the regions that a task or a person may move at any step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.pytree import pytree
from hrc_learn.regions import OrientationRegion, PositionRegion, PostureRegion, VisionRegion

HALF_SIZE = (0.12, 0.12, 0.08)
"""Half edges of the box that proved large enough to find the marker in view [m]."""
IMAGE_SIZE = (1440, 1080)
"""Width and height of the paper's camera [px]."""


@pytree
@dataclass(frozen=True, kw_only=True)
class Goals:
    """The attracting regions and whether the camera takes part.

    Tensors all through, so a task changes them between two steps without rebuilding or
    recompiling the controller.
    """

    position: PositionRegion
    orientation: OrientationRegion
    vision: VisionRegion
    vision_enabled: Bool[Tensor, "*#batch"]
    """False: steer by the Cartesian regions alone, whatever the camera sees."""
    posture: PostureRegion | None = None
    """Where to go in joint space before task-space feedback takes over; None: it leads from
    the start."""

    @classmethod
    def at(
        cls,
        centre: Float[Tensor, "*#batch 3"],
        orientation: Float[Tensor, "*#batch 4"],
        target: Float[Tensor, "*#batch rows"] | None = None,
        *,
        half_size: Sequence[float] = HALF_SIZE,
        image_size: tuple[int, int] = IMAGE_SIZE,
    ) -> Goals:
        """Goals with the recommended gains.

        Args:
            centre: Of the box for the tool centre point [m].
            orientation: Of the tool, a unit quaternion.
            target: Of the feature in the image [px], u and v of each of its points; None
                switches the camera off.
            half_size: Of the box [m].
            image_size: Width and height of the image [px].

        Raises:
            ValueError: The target lies outside the image.
        """
        enabled = target is not None
        if target is None:
            target = centre.new_tensor(image_size) / 2
        return cls(
            position=PositionRegion(centre=centre, half_size=centre.new_tensor(half_size)),
            orientation=OrientationRegion(goal=orientation),
            vision=VisionRegion.inside_image(target, image_size),
            vision_enabled=torch.tensor(enabled, device=centre.device),
        )

    def moved_to(
        self,
        centre: Float[Tensor, "*#batch 3"],
        half_size: Float[Tensor, "*#batch 3"] | None = None,
    ) -> Goals:
        """The same goals with the box elsewhere and, if told, of another size [m]."""
        if half_size is None:
            half_size = self.position.half_size
        return replace(
            self, position=replace(self.position, centre=centre, half_size=half_size)
        )

    def turned_to(self, orientation: Float[Tensor, "*#batch 4"]) -> Goals:
        """The same goals with another tool orientation."""
        return replace(self, orientation=replace(self.orientation, goal=orientation))

    def aimed_at(self, target: Float[Tensor, "*#batch rows"]) -> Goals:
        """The same goals with another target in the image [px]."""
        return replace(self, vision=replace(self.vision, target=target))

    def approached_by(self, posture: Float[Tensor, "*#batch n"] | None) -> Goals:
        """The same goals, first approached in joint space towards a posture [rad].

        Take an inverse-kinematics solution of the box centre that is near the arm.
        """
        region = None if posture is None else PostureRegion(goal=posture)
        return replace(self, posture=region)

    def with_vision(self, enabled: bool) -> Goals:
        """The same goals with the camera taking part or not."""
        return replace(self, vision_enabled=torch.full_like(self.vision_enabled, enabled))
