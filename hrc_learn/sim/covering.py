"""Somebody holds a board before the camera, so that it does not see a marker for a while."""

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..vision import CameraModel, Cover
from .scene import COVER, COVER_COLOUR, COVER_HALF_SIZE, HAND_MARKER, NOWHERE
from .world import World

_HEIGHT = 0.10
"""How far above the marker the board is held, towards the camera [m]."""


@dataclass(frozen=True, kw_only=True)
class Occlusion:
    """A spell in which a marker is hidden."""

    start: float
    """[s]"""
    duration: float
    """[s]"""
    marker: int = HAND_MARKER
    """ArUco number."""

    def __post_init__(self) -> None:
        if self.start < 0 or self.duration < 0:
            raise ValueError(
                "an occlusion's start and duration must not be negative, but are "
                f"{self.start:g} s and {self.duration:g} s."
            )


class Occluder:
    """Holds the board between the camera and a marker, wherever that moves."""

    def __init__(self, world: World, spells: Sequence[Occlusion]):
        self._world, self._spells, self._held = world, tuple(spells), False

    def update(self) -> None:
        """Move the board to where it is wanted now."""
        now = self._world.time
        for spell in self._spells:
            if spell.start <= now < spell.start + spell.duration:
                marker = self._world.marker_poses()[spell.marker][:3, 3]
                towards = self._world.config.camera.pose[:3, 3] - marker
                offset = _HEIGHT * towards / np.linalg.norm(towards)
                self._world.move_obstacle(COVER, marker + offset)
                self._held = True
                return
        if self._held:
            self._world.move_obstacle(COVER, NOWHERE)
            self._held = False


def covers_in(world: World, model: CameraModel) -> list[Cover]:
    """The board as a camera without OpenGL is to draw it, if it is in the scene."""
    centre = world.data.body(COVER).xpos
    x, y, z = COVER_HALF_SIZE
    corners = centre + np.array([[-x, -y, z], [x, -y, z], [x, y, z], [-x, y, z]])
    # Taken away it lies under the floor, which hides it from every camera.
    if np.array_equal(centre, NOWHERE) or not model.in_view(corners).any():
        return []
    return [Cover(corners=corners, colour=COVER_COLOUR[:3])]
