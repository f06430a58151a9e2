"""One grasp in simulation, from a random scene: camera, start of the arm, object."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.experiments.simulated_cell import (
    SIMULATED,
    UNOBSERVED,
    ArmAccess,
    CellRun,
    Observer,
    plan_checker,
    simulated_cell,
)
from hrc_learn.geometry import quaternion
from hrc_learn.protocols import Human
from hrc_learn.sim import CameraKind, Imperfections, ObjectConfig, World, open_camera
from hrc_learn.sim.imperfections import DrawnImperfections
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.arm_motion import joint_line
from hrc_learn.skills.grasping import Grasping, GraspingConfig, GraspJob
from hrc_learn.skills.marker_sensor import MarkerSensor, feature_sensor
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.skills.work_cell import TaskFailedError
from hrc_learn.teleoperation import ScriptedPerturbation
from hrc_learn.teleoperation.page import PageConfig
from hrc_learn.vision import CameraModel

# Joint speed [rad/s] and time between samples [s] of the approach that is checked for contacts.
_APPROACH_SPEED, _PATH_STEP = 0.6, 0.05
# Largest yaw of objects in a scene without imperfections, either way [rad]: people lay objects
# roughly parallel to the table's edges.
_ALONG_EDGES = 0.06
CAMERA_SHIFT = 0.10
"""Largest shift of a random camera along each axis [m]."""
# Largest distance along each axis between the middle of the workplace and the point that a
# random camera looks at [m].
_CAMERA_MISS = 0.04
# Largest distance of the object from the middle of the table along each axis [m].
_OBJECT_REACH = (0.10, 0.08, 0.0)
# Distance of the start from the joint limits [rad], and smallest height of the end effector at
# the start [m], for an arm whose `hand_size` is 1.
_LIMIT_MARGIN, _START_HEIGHT = 0.02, 0.15
_MOST_STARTS = 200
"""Largest number of random joint positions that are tried as a start."""
START_DISTANCE = 0.35
"""Smallest distance of the end effector at the start from its goal [m], at `hand_size` 1."""


@dataclass(frozen=True, kw_only=True)
class GraspingSceneConfig:
    """Distribution of random scenes."""

    camera_roll: float = 0.0
    """Rotation of the camera about its axis since the demonstrations [rad]."""
    random_camera: bool = False
    """Shift and tilt the camera, and rotate it by a random angle instead of `camera_roll`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GraspingScene:
    """Initial conditions of a grasp: camera, arm and object."""

    workplace: Workplace
    """Workplace with the camera of the run, which the controller does not know."""
    start: Float[np.ndarray, " joints"]
    """Joint positions at the start [rad]."""
    object_pose: Float[np.ndarray, "4 4"]
    imperfections: DrawnImperfections | None = None
    """Imperfections of arm, calibration, camera and object; None: no imperfections."""

    def world(self) -> World:
        """World with this scene, at rest."""
        world = World(self.workplace.scene, self.imperfections)
        world.reset(self.start, {self.workplace.scene.objects[0].name: self.object_pose})
        return world

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

        The arm starts anywhere within its joint limits, joints of more than one turn within
        half a turn of home. It touches nothing there, does not hide the object from the camera,
        and can move home on straight lines in joint space.

        Args:
            workplace: Workplace with the camera of the demonstrations.
            config: Distribution of the scenes.
            rng: Random generator.
            camera: Kind of camera that checks if the object is hidden.
            imperfections: Imperfections of arm, calibration, camera and object; None: no
                imperfections.

        Raises:
            ValueError: Every drawn start hides the object or has no free path home.
        """
        scene, sizes = workplace.scene, imperfections or Imperfections.ideal()
        # A separate generator, so that the scenes do not depend on the imperfections.
        drawn = sizes.draw(rng.spawn(1)[0], workplace.robot.joints, workplace.robot.hand_size)
        yaw = max(_ALONG_EDGES, sizes.object_yaw)
        pose = workplace.random_object_pose(workplace.scaled(_OBJECT_REACH), rng, yaw)
        camera_model = _draw_camera(workplace, config, rng)
        workplace = replace(workplace, scene=replace(scene, camera=camera_model))
        item = scene.objects[0]
        world = World(workplace.scene, drawn)
        pose[2, 3] = world.table_top + world.config.objects[0].half_size[2]
        eye = open_camera(world, camera, rng=rng, noise=sizes.camera_noise)
        sensor = MarkerSensor(eye, workplace.scene.marker_ids)
        for start in _starts(workplace, rng):
            world.reset(start, {item.name: pose})
            if item.marker.id in sensor.detect() and _has_free_path(world, workplace, start):
                return cls(
                    workplace=workplace, start=start, object_pose=pose, imperfections=drawn
                )
        raise ValueError(
            f"none of {_MOST_STARTS} random starts has a free path home and leaves the object "
            "in the camera's view: turn the camera to the table (scene.random_camera=false "
            "keeps it in place), or move table and cabinet away from the arm"
        )


@dataclass(frozen=True, kw_only=True)
class GraspingRun(CellRun):
    """One grasp, successful or not."""

    scene: GraspingScene
    item: ObjectConfig
    result: GraspJob | None
    """Record of the task; None if the task failed."""


def simulate_grasp(
    aiming: VisualServoSkill,
    scene: GraspingScene,
    *,
    camera: CameraKind = "auto",
    config: GraspingConfig | None = None,
    rng: np.random.Generator,
    access: ArmAccess = SIMULATED,
    human: Human | None = None,
    page: PageConfig | None = None,
    observer: Observer = UNOBSERVED,
) -> GraspingRun:
    """Grasp an object and carry it home, in MuJoCo.

    Args:
        aiming: Learned image Jacobian and visual target.
        scene: Initial conditions.
        camera: Kind of camera that watches the table.
        config: Configuration of the grasp.
        rng: Source of image noise and of lost images.
        access: Access to the arm.
        human: Person near the arm; None: no person.
        page: Browser page that shows the run in real time, where users can draw goals and pull
            the arm; None: no page.
        observer: Live dashboard and messages.
    """
    workplace = scene.workplace.approached(aiming.approach)
    scene = replace(scene, workplace=workplace)
    world = scene.world()
    item, sizes = workplace.scene.objects[0], world.imperfections.sizes
    eye = open_camera(world, camera, rng=rng, noise=sizes.camera_noise)
    job, failure = GraspJob(item=item), ""
    with simulated_cell(
        world,
        human=human or ScriptedPerturbation(workplace.robot.chain, ()),
        sensor=feature_sensor(
            eye,
            aiming.landmarks,
            workplace.tool_marker,
            [thing.marker.id for thing in workplace.scene.objects],
        ),
        access=access,
        page=page,
        title="Grasping",
        observer=observer,
        rng=rng,
    ) as (cell, motion):
        task = Grasping(cell, workplace, aiming, config, check=plan_checker(world))
        try:
            task.grasp(job)
            task.go_home()
        except TaskFailedError as error:
            failure = str(error)
    return GraspingRun(
        scene=scene,
        world=world,
        cell=cell,
        motion=motion,
        item=item,
        result=None if failure else job,
        failure=failure,
    )


def _draw_camera(
    workplace: Workplace, config: GraspingSceneConfig, rng: np.random.Generator
) -> CameraModel:
    """Camera of the demonstrations, moved and rotated.

    A random camera looks at a point near the middle of the workplace, and is then rotated about
    its axis.
    """
    camera = workplace.scene.camera
    rotation, position = camera.pose[:3, :3], camera.pose[:3, 3]
    roll = config.camera_roll
    if config.random_camera:
        position = position + CAMERA_SHIFT * rng.uniform(-1, 1, 3)
        middle = workplace.hover().position.numpy()
        sight = middle + _CAMERA_MISS * rng.uniform(-1, 1, 3) - position
        # Rotation axis times the sine of the angle: nearly the rotation vector for small tilts.
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
    workplace: Workplace, rng: np.random.Generator
) -> Iterator[Float[np.ndarray, " joints"]]:
    """Joint positions [rad] with the end effector high enough, and far enough from its goal."""
    limits, home = workplace.robot.chain.limits, workplace.home_joints()
    hover, size = workplace.hover().position, workplace.robot.hand_size
    # Joints of more than one turn start within half a turn of home: cables must not wind up.
    half = torch.where(limits.upper - limits.lower > 2 * torch.pi, torch.pi, torch.inf)
    lower = torch.maximum(limits.lower + _LIMIT_MARGIN, home - half)
    upper = torch.minimum(limits.upper - _LIMIT_MARGIN, home + half)
    for _ in range(_MOST_STARTS):
        q = rng.uniform(lower, upper)
        tool = workplace.robot.chain.forward(torch.from_numpy(q)).position
        if tool[2] > size * _START_HEIGHT and (tool - hover).norm() > size * START_DISTANCE:
            yield q


def _has_free_path(
    world: World, workplace: Workplace, start: Float[np.ndarray, " joints"]
) -> bool:
    """True if straight joint-space lines lead home, directly or via a hover posture."""

    def free(a: Float[Tensor, " joints"], b: Float[Tensor, " joints"]) -> bool:
        return not world.collisions_along(joint_line(a, b, _APPROACH_SPEED, _PATH_STEP).numpy())

    here, home = torch.from_numpy(start), workplace.home_joints()
    postures = workplace.hover_postures()
    return free(here, home) or any(free(here, q) and free(q, home) for q in postures)
