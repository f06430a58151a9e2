"""Random poses of objects, camera and arm at the start of a run."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import quaternion
from hrc_learn.kinematics import panda
from hrc_learn.sim import CameraKind, ObjectConfig, World, open_camera
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.arm_motion import joint_line
from hrc_learn.skills.marker_sensor import MarkerSensor
from hrc_learn.skills.work_cell import TaskFailedError
from hrc_learn.vision import CameraModel, Marker

THREE_OBJECTS = (
    ObjectConfig(),
    ObjectConfig(
        name="carton",
        half_size=(0.027, 0.034, 0.028),
        mass=0.15,
        marker=Marker(12, 0.030),
        colour=(0.80, 0.47, 0.13, 1.0),
    ),
    ObjectConfig(
        name="tin",
        half_size=(0.019, 0.036, 0.026),
        mass=0.10,
        marker=Marker(13, 0.027),
        colour=(0.20, 0.55, 0.38, 1.0),
    ),
)
"""Three boxes of sizes that the gripper takes, none so tall that the palm meets it when the
fingers reach down beside it."""

_APART = (0.115, 0.095)
"""Distance along x or y at which the open fingers about one object clear the next [m]."""
_TURN = 0.06
"""Largest turn of an object, either way; the fingers still close on it squarely [rad]."""
_PATH_STEP = 0.05
"""Time between the samples of an approach that are checked for contacts [s]."""
_APPROACH_SPEED = 0.6
"""Joint speed of that approach [rad/s]."""


def random_object_poses(
    items: Sequence[ObjectConfig],
    middle: tuple[float, float],
    reach: tuple[float, float],
    rng: np.random.Generator,
    attempts: int = 10_000,
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Random poses of objects on the table, clear of each other.

    Args:
        items: The objects.
        middle: Of the region of the table where they lie [m].
        reach: Largest distance from its middle along x and y [m].
        rng: Source of positions and turns.
        attempts: Arrangements tried.

    Raises:
        ValueError: If they do not fit.
    """
    for _ in range(attempts):
        positions = np.array(middle) + rng.uniform(-1, 1, (len(items), 2)) * reach
        if _clear(positions):
            return {
                item.name: _pose_on_table(item, position, rng.uniform(-_TURN, _TURN))
                for item, position in zip(items, positions, strict=True)
            }
    raise ValueError(
        f"{len(items)} objects do not fit within {reach[0]:g} and {reach[1]:g} m of the "
        "middle with room for the fingers between them: fewer objects, or more reach."
    )


def _clear(positions: Float[np.ndarray, "objects 2"]) -> bool:
    first, second = np.triu_indices(len(positions), k=1)
    gaps = np.abs(positions[first] - positions[second])
    return bool((gaps >= _APART).any(axis=1).all())


def _pose_on_table(
    item: ObjectConfig, position: Float[np.ndarray, "2"], turn: float
) -> Float[np.ndarray, "4 4"]:
    c, s = np.cos(turn), np.sin(turn)
    pose = np.eye(4)
    pose[:2, :2] = [[c, -s], [s, c]]
    pose[:3, 3] = (*position, item.half_size[2])
    return pose


@dataclass(frozen=True, kw_only=True)
class GraspingSceneConfig:
    """How scenes are drawn. Lengths [m], angles [rad]."""

    camera_roll: float = 0.0
    """By which the camera is turned about its axis since the demonstrations."""
    random_camera: bool = False
    """Put the camera elsewhere, tilt it and turn it by any angle, `camera_roll` aside."""
    camera_shift: float = 0.10
    """Largest shift of a random camera along each axis."""
    camera_miss: float = 0.04
    """Largest distance from the middle of the workplace to where a random camera looks."""
    object_reach: tuple[float, float, float] = (0.10, 0.08, 0.0)
    """Largest distance of the object from the middle of the table."""
    margin: float = 0.02
    """Distance of the arm's start from its joint limits."""
    distance: float = 0.35
    """Least distance of the end effector at the start from where it will servo to."""
    height: float = 0.15
    """Least height of the end effector at the start."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GraspingScene:
    """Initial conditions of a grasp: camera, arm and object."""

    workplace: Workplace
    """With the camera of the run, which the controller is not told."""
    start: Float[np.ndarray, "7"]
    """Joint positions [rad]."""
    object_pose: Float[np.ndarray, "4 4"]

    def world(self) -> World:
        """A simulated world with this scene, at rest."""
        world = World(self.workplace.scene)
        world.reset(self.start, {self.workplace.scene.objects[0].name: self.object_pose})
        return world

    def true_target(self, world: World) -> Float[np.ndarray, "2"]:
        """Pixel of the gripper's marker with the end effector right above the object [px]."""
        above = self.workplace.hover()
        above.position[:2] = torch.from_numpy(self.object_pose[:2, 3])
        marker = above.apply(torch.from_numpy(world.hand_marker_offset()))
        return self.workplace.scene.camera.project(marker.numpy())

    @classmethod
    def draw(
        cls,
        workplace: Workplace,
        config: GraspingSceneConfig,
        rng: np.random.Generator,
        camera: CameraKind = "synthetic",
    ) -> "GraspingScene":
        """Draw a scene.

        The arm starts anywhere within its joint limits where it touches nothing, does not hide
        the object from the camera, and is not shut in: straight lines in joint space lead home.

        Args:
            workplace: With the camera of the demonstrations.
            config: How.
            rng: Source of chance.
            camera: Kind of camera that checks whether the object is hidden.
        """
        scene = workplace.scene
        pose = workplace.random_object_pose(config.object_reach, rng)
        workplace = replace(
            workplace, scene=replace(scene, camera=_camera(workplace, config, rng))
        )
        item = scene.objects[0]
        world = World(workplace.scene)
        sensor = MarkerSensor(open_camera(world, camera, rng=rng), workplace.scene.marker_ids)
        for start in _starts(workplace, config, rng):
            world.reset(start, {item.name: pose})
            if item.marker.id in sensor.detect() and _has_free_path(world, workplace, start):
                return cls(workplace=workplace, start=start, object_pose=pose)
        raise AssertionError("starts never end")


def _camera(
    workplace: Workplace, config: GraspingSceneConfig, rng: np.random.Generator
) -> CameraModel:
    """The camera of the demonstrations, moved and turned.

    It looks at a point near the middle of the workplace and is then turned about its axis.
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
) -> Iterator[Float[np.ndarray, "7"]]:
    """Joint positions within the limits, with the end effector up and away."""
    limits, hover = panda.limits, workplace.hover().position
    lower, upper = limits.lower + config.margin, limits.upper - config.margin
    while True:
        q = rng.uniform(lower, upper)
        tool = panda.forward(torch.from_numpy(q)).position
        if tool[2] > config.height and (tool - hover).norm() > config.distance:
            yield q


def _has_free_path(world: World, workplace: Workplace, start: Float[np.ndarray, "7"]) -> bool:
    """Whether straight lines in joint space lead home, directly or by way of the table."""

    def free(a: Float[Tensor, "7"], b: Float[Tensor, "7"]) -> bool:
        return not world.collisions_along(joint_line(a, b, _APPROACH_SPEED, _PATH_STEP).numpy())

    here, home = torch.from_numpy(start), workplace.home_joints()
    postures = workplace.hover_postures()
    return free(here, home) or any(free(here, q) and free(q, home) for q in postures)


_DRAWS = 100
"""Starts drawn before it is taken that there is no free one."""


def random_start(
    world: World, workplace: Workplace, noise: float, rng: np.random.Generator
) -> Float[Tensor, "7"]:
    """Joint positions about home that are within the limits and touch nothing.

    Leaves the world there, with its first object in the gripper.

    Args:
        world: Of the workplace.
        workplace: Where.
        noise: Standard deviation of each joint [rad].
        rng: Source of the noise.

    Raises:
        TaskFailedError: If no start drawn is free.
    """
    home, item = workplace.home_joints(), workplace.scene.objects[0].name
    for _ in range(_DRAWS):
        start = home + noise * torch.from_numpy(rng.standard_normal(len(home)))
        if not panda.limits.contain(start):
            continue
        world.hold(item, start.numpy())
        if not world.collisions_along(start.numpy()[None], item):
            return start
    raise TaskFailedError(f"no free start in {_DRAWS} draws with noise of {noise:g} rad")
