"""Where a grasp begins: a camera nobody calibrated, an arm far off, an object at random."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import quaternion
from ..kinematics import panda
from ..sim import CameraKind, World, open_camera
from ..vision import CameraModel
from .eye import Eye
from .motion import joint_line
from .workplace import Workplace

_PATH_STEP = 0.05
"""Time between the samples of an approach that are checked for contacts [s]."""


@dataclass(frozen=True, kw_only=True)
class GraspingSettingConfig:
    """How settings are drawn. Lengths [m], angles [rad]."""

    camera_roll: float = 0.0
    """By which the camera is turned about its axis since the demonstrations."""
    random_camera: bool = False
    """Put the camera elsewhere, tilt it and turn it by any angle, `camera_roll` aside."""
    camera_shift: float = 0.10
    """How far a random camera is moved at most, along each axis."""
    camera_miss: float = 0.04
    """How far off the middle of the workplace a random camera looks at most."""
    object_reach: tuple[float, float, float] = (0.10, 0.08, 0.0)
    """How far from the middle of the table the object lies at most."""
    margin: float = 0.02
    """Distance of the arm's start from its joint limits."""
    distance: float = 0.35
    """Least distance of the hand at the start from where it will aim."""
    height: float = 0.15
    """Least height of the hand at the start."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GraspingSetting:
    """One of them."""

    workplace: Workplace
    """With the camera that watches."""
    start: Float[np.ndarray, "7"]
    """Joint positions [rad]."""
    object_pose: Float[np.ndarray, "4 4"]

    def world(self) -> World:
        """A simulated world in this setting, at rest."""
        world = World(self.workplace.scene)
        world.reset(self.start, {self.workplace.scene.objects[0].name: self.object_pose})
        return world

    def true_target(self, world: World) -> Float[np.ndarray, "2"]:
        """Pixel of the hand's marker with the hand right above the object [px]."""
        above = self.workplace.hover()
        above.position[:2] = torch.from_numpy(self.object_pose[:2, 3])
        marker = above.apply(torch.from_numpy(world.hand_marker_offset()))
        return self.workplace.scene.camera.project(marker.numpy())

    @classmethod
    def draw(
        cls,
        workplace: Workplace,
        config: GraspingSettingConfig,
        rng: np.random.Generator,
        camera: CameraKind = "synthetic",
    ) -> "GraspingSetting":
        """Draw a setting.

        The arm starts anywhere within its joint limits where it touches nothing, does not hide
        the object from the camera, and is not shut in: straight lines in joint space lead home.

        Args:
            workplace: With the camera as it stood in the demonstrations.
            config: How.
            rng: Source of chance.
            camera: What looks whether the object is hidden.
        """
        scene = workplace.scene
        pose = workplace.random_object_pose(config.object_reach, rng)
        workplace = replace(
            workplace, scene=replace(scene, camera=_camera(workplace, config, rng))
        )
        item = scene.objects[0]
        world = World(workplace.scene)
        eye = Eye.on(open_camera(world, camera, rng=rng), workplace.scene)
        for start in _starts(workplace, config, rng):
            world.reset(start, {item.name: pose})
            if item.marker.id in eye.look() and _has_a_way(world, workplace, start):
                return cls(workplace=workplace, start=start, object_pose=pose)
        raise AssertionError("starts never end")


def _camera(
    workplace: Workplace, config: GraspingSettingConfig, rng: np.random.Generator
) -> CameraModel:
    """The camera of the demonstrations, moved and turned."""
    camera = workplace.scene.camera
    shown, eye, roll = camera.pose[:3, :3], camera.pose[:3, 3], config.camera_roll
    look = shown
    if config.random_camera:
        eye = eye + config.camera_shift * rng.uniform(-1, 1, 3)
        middle = workplace.hover().position.numpy()
        sight = middle + config.camera_miss * rng.uniform(-1, 1, 3) - eye
        axis = shown[:, 2]
        turn = np.cross(axis, sight / np.linalg.norm(sight))
        look = _rotation(turn) @ shown
        roll = rng.uniform(-np.pi, np.pi)
    pose = np.eye(4)
    pose[:3, :3] = look @ _rotation(np.array([0.0, 0.0, roll]))
    pose[:3, 3] = eye
    return replace(camera, pose=pose)


def _rotation(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    return quaternion.to_matrix(quaternion.exp(torch.from_numpy(vector))).numpy()


def _starts(
    workplace: Workplace, config: GraspingSettingConfig, rng: np.random.Generator
) -> Iterator[Float[np.ndarray, "7"]]:
    """Joint positions within the limits, with the hand up and away."""
    limits, hover = panda.limits, workplace.hover().position
    lower, upper = limits.lower + config.margin, limits.upper - config.margin
    while True:
        q = rng.uniform(lower, upper)
        hand = panda.forward(torch.from_numpy(q)).position
        if hand[2] > config.height and (hand - hover).norm() > config.distance:
            yield q


def _has_a_way(world: World, workplace: Workplace, start: Float[np.ndarray, "7"]) -> bool:
    """Whether straight lines in joint space lead home, at once or by way of the table."""

    def free(a: Float[Tensor, "7"], b: Float[Tensor, "7"]) -> bool:
        return not world.collisions_along(joint_line(a, b, 0.6, _PATH_STEP).numpy())

    here, home = torch.from_numpy(start), workplace.home_joints()
    postures = workplace.hover_postures()
    return free(here, home) or any(free(here, q) and free(q, home) for q in postures)
