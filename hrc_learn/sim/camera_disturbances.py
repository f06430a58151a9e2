"""Disturbances of a camera in use: it is moved, refocused, or a marker is occluded."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, UInt8

from hrc_learn.protocols import Camera
from hrc_learn.sim.scene import (
    HAND_MARKER,
    NOWHERE,
    OCCLUDER,
    OCCLUDER_COLOUR,
    OCCLUDER_HALF_SIZE,
)
from hrc_learn.sim.world import World
from hrc_learn.vision import CameraModel, OccludingBoard

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.

# How far above the marker the board is held, towards the camera: clear of the gripper [m].
_BOARD_HEIGHT = 0.10


@dataclass(frozen=True, kw_only=True)
class CameraChange:
    """How much a camera is changed at a time."""

    distance: float = 0.10
    """By which it is moved, in any direction [m]."""
    angle: float = np.deg2rad(10.0)
    """By which it is turned, about any axis [rad]."""
    focus: float = 1.0
    """Factor on its focal length."""

    def __post_init__(self) -> None:
        if self.distance < 0 or self.angle < 0 or not self.focus > 0:
            raise ValueError(
                "a camera's change needs distance and angle that are not negative and a "
                f"positive focus, but they are {self.distance:g} m, {self.angle:g} rad and "
                f"{self.focus:g}."
            )

    def applied(
        self,
        model: CameraModel,
        watched: Float[np.ndarray, "points 3"],
        rng: np.random.Generator,
        attempts: int = 10_000,
    ) -> CameraModel:
        """A changed camera that still sees what it is there for.

        Args:
            model: The camera as it is.
            watched: Points that stay in its view [m].
            rng: Source of the directions.
            attempts: Directions tried.

        Raises:
            ValueError: If the points are out of view whatever the direction.
        """
        (fx, fy), s = model.focal, self.focus
        for _ in range(attempts):
            pose = model.pose.copy()
            pose[:3, 3] += self.distance * _direction(rng)
            pose[:3, :3] = _rotation(self.angle * _direction(rng)) @ pose[:3, :3]
            changed = replace(model, pose=pose, focal=(s * fx, s * fy))
            if changed.in_view(watched).all():
                return changed
        raise ValueError(
            f"a camera moved by {self.distance:g} m, turned by {np.rad2deg(self.angle):.0f} "
            f"degrees and refocused by {s:g} does not see the workplace: change it less."
        )


class ChangingCamera:
    """Implements the `Camera` protocol by one camera after the other.

    Attributes:
        history: When each of them came to be the one, and its true model.
    """

    def __init__(self, model: CameraModel, opened: Callable[[CameraModel], Camera]):
        """Begin with a camera.

        Args:
            model: Of the first.
            opened: Opens a camera.
        """
        self._open = opened
        self._camera = opened(model)
        self.history: list[tuple[float, CameraModel]] = [(-np.inf, model)]

    @property
    def model(self) -> CameraModel:
        """The true camera now."""
        return self.history[-1][1]

    def change(self, time: float, model: CameraModel) -> None:
        """See through another camera from a time on [s]."""
        self._camera = self._open(model)
        self.history.append((time, model))

    def read(self) -> UInt8[np.ndarray, "height width 3"]:
        """The image now, RGB."""
        return self._camera.read()


def _direction(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


def _rotation(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Rodrigues' formula; the identity for no rotation."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K


@dataclass(frozen=True, kw_only=True)
class OcclusionInterval:
    """An interval in which a marker is occluded."""

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


class ScriptedOcclusion:
    """Holds a board between the camera and a marker, wherever that moves."""

    def __init__(self, world: World, intervals: Sequence[OcclusionInterval]):
        self._world, self._intervals, self._held = world, tuple(intervals), False

    def update(self) -> None:
        """Move the board to where it belongs now."""
        now = self._world.time
        for interval in self._intervals:
            if interval.start <= now < interval.start + interval.duration:
                marker = self._world.marker_poses()[interval.marker][:3, 3]
                towards = self._world.config.camera.pose[:3, 3] - marker
                offset = _BOARD_HEIGHT * towards / np.linalg.norm(towards)
                self._world.move_obstacle(OCCLUDER, marker + offset)
                self._held = True
                return
        if self._held:
            self._world.move_obstacle(OCCLUDER, NOWHERE)
            self._held = False


def occluding_boards(world: World, model: CameraModel) -> list[OccludingBoard]:
    """The board as a camera without OpenGL is to draw it, if it is in the scene."""
    centre = world.data.body(OCCLUDER).xpos
    x, y, z = OCCLUDER_HALF_SIZE
    corners = centre + np.array([[-x, -y, z], [x, -y, z], [x, y, z], [-x, y, z]])
    # Taken away it lies under the floor, which hides it from every camera.
    if np.array_equal(centre, NOWHERE) or not model.in_view(corners).any():
        return []
    return [OccludingBoard(corners=corners, colour=OCCLUDER_COLOUR[:3])]
