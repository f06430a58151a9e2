"""Random scenes of the grasping experiment: camera, start of the arm, pose of the object."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.sim import CameraKind, Imperfections, World, open_camera
from hrc_learn.sim.imperfections import DrawnImperfections
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.arm_motion import joint_line
from hrc_learn.skills.marker_sensor import MarkerSensor
from hrc_learn.vision import CameraModel

# Joint speed [rad/s] and time between samples [s] of the approach checked for contacts.
_APPROACH_SPEED, _PATH_STEP = 0.6, 0.05
# Largest yaw of objects in a scene without imperfections, either way [rad]: as laid by hand.
_ALONG_EDGES = 0.06


@dataclass(frozen=True, kw_only=True)
class GraspingSceneConfig:
    """Distribution of random scenes. Lengths [m], angles [rad]."""

    camera_roll: float = 0.0
    """Rotation of the camera about its axis since the demonstrations."""
    random_camera: bool = False
    """Shift and tilt the camera, and rotate it by any angle in place of `camera_roll`."""
    camera_shift: float = 0.10
    """Largest shift of a random camera along each axis."""
    camera_miss: float = 0.04
    """Largest distance between the middle of the workplace and the point that a random camera
    looks at, along each axis."""
    object_reach: tuple[float, float, float] = (0.10, 0.08, 0.0)
    """Largest distance of the object from the middle of the table, along each axis."""
    margin: float = 0.02
    """Distance of the start from the joint limits."""
    distance: float = 0.35
    """Smallest distance of the end effector at the start from its goal."""
    height: float = 0.15
    """Smallest height of the end effector at the start."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GraspingScene:
    """Initial conditions of a grasp: camera, arm and object."""

    workplace: Workplace
    """Workplace with the camera of the run, which the controller does not know."""
    start: Float[np.ndarray, " joints"]
    """Joint positions at the start [rad]."""
    object_pose: Float[np.ndarray, "4 4"]
    imperfections: DrawnImperfections | None = None
    """Imperfections of arm, calibration, camera and object; None: none."""

    def world(self) -> World:
        """World with this scene, at rest."""
        world = World(self.workplace.scene, self.imperfections)
        world.reset(self.start, {self.workplace.scene.objects[0].name: self.object_pose})
        return world

    def above(self) -> Pose:
        """Pose of the end effector above the object, rotated to grasp it."""
        hover, (least, _) = self.workplace.hover(), self.workplace.hover_turns
        yaw = math.atan2(self.object_pose[1, 0], self.object_pose[0, 0])
        # Half a turn makes no difference to a parallel gripper.
        turn = least + (yaw - least) % math.pi
        about_z = quaternion.exp(torch.tensor([0.0, 0.0, turn], dtype=torch.float64))
        position = hover.position.clone()
        position[:2] = torch.from_numpy(self.object_pose[:2, 3])
        return Pose(position, quaternion.multiply(about_z, hover.orientation))

    def true_target(self, world: World, tool: Pose | None = None) -> Float[np.ndarray, "2"]:
        """True pixel of the gripper's marker with the end effector above the object [px].

        Args:
            world: World with the true place of the marker on the gripper.
            tool: Pose of the end effector whose height and orientation are used; by default
                that of `above`.
        """
        above = self.above()
        if tool is not None:
            position = torch.cat([above.position[:2], tool.position[2:]])
            above = Pose(position, tool.orientation)
        marker = above.apply(torch.from_numpy(world.hand_marker_offset()))
        return self.workplace.scene.camera.project(marker.numpy())

    @classmethod
    def draw(
        cls,
        workplace: Workplace,
        config: GraspingSceneConfig,
        rng: np.random.Generator,
        camera: CameraKind = "synthetic",
        imperfections: Imperfections | None = None,
    ) -> "GraspingScene":
        """Draw a scene.

        The arm starts anywhere within its joint limits where it touches nothing, does not hide
        the object from the camera, and can move home on straight lines in joint space.

        Args:
            workplace: Workplace with the camera of the demonstrations.
            config: Distribution of the scenes.
            rng: Random generator.
            camera: Kind of camera that checks if the object is hidden.
            imperfections: Imperfections of arm, calibration, camera and object; None: none.
        """
        scene, sizes = workplace.scene, imperfections or Imperfections.ideal()
        # A generator of its own: the scenes are the same with any imperfections.
        drawn = sizes.draw(rng.spawn(1)[0], workplace.robot.joints)
        yaw = max(_ALONG_EDGES, sizes.object_yaw)
        pose = workplace.random_object_pose(config.object_reach, rng, yaw)
        camera_model = _draw_camera(workplace, config, rng)
        workplace = replace(workplace, scene=replace(scene, camera=camera_model))
        item = scene.objects[0]
        world = World(workplace.scene, drawn)
        pose[2, 3] = world.table_top + world.config.objects[0].half_size[2]
        eye = open_camera(world, camera, rng=rng, noise=sizes.camera_noise)
        sensor = MarkerSensor(eye, workplace.scene.marker_ids)
        for start in _starts(workplace, config, rng):
            world.reset(start, {item.name: pose})
            if item.marker.id in sensor.detect() and _has_free_path(world, workplace, start):
                return cls(
                    workplace=workplace, start=start, object_pose=pose, imperfections=drawn
                )
        raise AssertionError("the sequence of starts is endless")


def _draw_camera(
    workplace: Workplace, config: GraspingSceneConfig, rng: np.random.Generator
) -> CameraModel:
    """Camera of the demonstrations, moved and rotated.

    It looks at a point near the middle of the workplace and is then rotated about its axis.
    """
    camera = workplace.scene.camera
    rotation, position = camera.pose[:3, :3], camera.pose[:3, 3]
    roll = config.camera_roll
    if config.random_camera:
        position = position + config.camera_shift * rng.uniform(-1, 1, 3)
        middle = workplace.hover().position.numpy()
        sight = middle + config.camera_miss * rng.uniform(-1, 1, 3) - position
        # Sine of the angle times its axis: close to the rotation vector for these small tilts.
        tilt = np.cross(rotation[:, 2], sight / np.linalg.norm(sight))
        rotation = _rotation(tilt) @ rotation
        roll = rng.uniform(-np.pi, np.pi)
    pose = np.eye(4)
    pose[:3, :3] = rotation @ _rotation(np.array([0.0, 0.0, roll]))
    pose[:3, 3] = position
    return replace(camera, pose=pose)


def _rotation(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    return quaternion.to_matrix(quaternion.exp(torch.from_numpy(vector))).numpy()


def _starts(
    workplace: Workplace, config: GraspingSceneConfig, rng: np.random.Generator
) -> Iterator[Float[np.ndarray, " joints"]]:
    """Joint positions within the limits, with the end effector high and far enough [rad]."""
    limits, hover = workplace.robot.chain.limits, workplace.hover().position
    lower, upper = limits.lower + config.margin, limits.upper - config.margin
    while True:
        q = rng.uniform(lower, upper)
        tool = workplace.robot.chain.forward(torch.from_numpy(q)).position
        if tool[2] > config.height and (tool - hover).norm() > config.distance:
            yield q


def _has_free_path(
    world: World, workplace: Workplace, start: Float[np.ndarray, " joints"]
) -> bool:
    """True if straight lines in joint space lead home, directly or by way of the table."""

    def free(a: Float[Tensor, " joints"], b: Float[Tensor, " joints"]) -> bool:
        return not world.collisions_along(joint_line(a, b, _APPROACH_SPEED, _PATH_STEP).numpy())

    here, home = torch.from_numpy(start), workplace.home_joints()
    postures = workplace.hover_postures()
    return free(here, home) or any(free(here, q) and free(q, home) for q in postures)
