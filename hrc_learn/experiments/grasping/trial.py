"""One grasp in simulation: a random scene, and a choice of image-Jacobian estimators."""

import copy
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.experiments.arm_access import SIMULATED, ArmAccess
from hrc_learn.experiments.run_recording import LiveView, no_live_view
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import (
    CompositeEstimator,
    FixedEstimator,
    ImageJacobianEstimator,
    PaperEstimator,
    RBFImageJacobian,
)
from hrc_learn.sim import (
    CameraKind,
    Imperfections,
    MotionLog,
    ObjectConfig,
    World,
    open_camera,
)
from hrc_learn.sim.imperfections import DrawnImperfections
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.arm_motion import joint_line
from hrc_learn.skills.failures import TaskFailedError
from hrc_learn.skills.grasping import Grasping, GraspingConfig, GraspResult
from hrc_learn.skills.marker_sensor import LatencyConfig, MarkerSensor
from hrc_learn.skills.placing import Plan, check_plan
from hrc_learn.skills.visual_skill import VisualServoSkill, from_learned, guessed_network
from hrc_learn.skills.work_cell import WorkCell, WorkCellConfig
from hrc_learn.teleoperation import DrawnInterval, ScriptedDrawing
from hrc_learn.teleoperation.page import PageConfig
from hrc_learn.teleoperation.page_session import task_page
from hrc_learn.vision import CameraModel

# Of the approach that is checked for contacts: joint speed [rad/s], time between samples [s].
_APPROACH_SPEED, _PATH_STEP = 0.6, 0.05
# Yaw of objects in a scene without imperfections, either way [rad]: as people lay them down.
_ALONG_EDGES = 0.06


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
    imperfections: DrawnImperfections | None = None
    """Of arm, calibration, camera and object; None: none."""

    def world(self) -> World:
        """A simulated world with this scene, at rest."""
        world = World(self.workplace.scene, self.imperfections)
        world.reset(self.start, {self.workplace.scene.objects[0].name: self.object_pose})
        return world

    def above(self) -> Pose:
        """The end effector right above the object, turned to grasp it."""
        hover, (least, _) = self.workplace.hover(), self.workplace.hover_turns
        yaw = math.atan2(self.object_pose[1, 0], self.object_pose[0, 0])
        # Half a turn looks the same to a parallel gripper.
        turn = least + (yaw - least) % math.pi
        about = quaternion.exp(torch.tensor([0.0, 0.0, turn], dtype=torch.float64))
        position = hover.position.clone()
        position[:2] = torch.from_numpy(self.object_pose[:2, 3])
        return Pose(position, quaternion.multiply(about, hover.orientation))

    def true_target(self, world: World, tool: Pose | None = None) -> Float[np.ndarray, "2"]:
        """True pixel of the gripper's marker with the end effector right above the object.

        Args:
            world: Knows where the marker is on the gripper.
            tool: Its height and orientation are taken; None: those of `above`.
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
        the object from the camera, and is not shut in: straight lines in joint space lead home.

        Args:
            workplace: With the camera of the demonstrations.
            config: How.
            rng: Source of chance.
            camera: Kind of camera that checks whether the object is hidden.
            imperfections: Of arm, calibration, camera and object; None: none.
        """
        scene, sizes = workplace.scene, imperfections or Imperfections.ideal()
        # A stream of its own: the same scenes whatever the imperfections.
        drawn = sizes.draw(rng.spawn(1)[0], workplace.robot.joints)
        yaw = max(_ALONG_EDGES, sizes.object_yaw)
        pose = workplace.random_object_pose(config.object_reach, rng, yaw)
        workplace = replace(
            workplace, scene=replace(scene, camera=_camera(workplace, config, rng))
        )
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
    limits, hover = workplace.robot.chain.limits, workplace.hover().position
    lower, upper = limits.lower + config.margin, limits.upper - config.margin
    while True:
        q = rng.uniform(lower, upper)
        tool = workplace.robot.chain.forward(torch.from_numpy(q)).position
        if tool[2] > config.height and (tool - hover).norm() > config.distance:
            yield q


def _has_free_path(world: World, workplace: Workplace, start: Float[np.ndarray, "7"]) -> bool:
    """Whether straight lines in joint space lead home, directly or by way of the table."""

    def free(a: Float[Tensor, "7"], b: Float[Tensor, "7"]) -> bool:
        return not world.collisions_along(joint_line(a, b, _APPROACH_SPEED, _PATH_STEP).numpy())

    here, home = torch.from_numpy(start), workplace.home_joints()
    postures = workplace.hover_postures()
    return free(here, home) or any(free(here, q) and free(q, home) for q in postures)


@dataclass(frozen=True)
class Variant:
    """An initial image Jacobian, and a law that adapts it."""

    label: str
    estimator: Callable[[RBFImageJacobian], ImageJacobianEstimator]
    """From the learned image Jacobian."""
    claim: str = ""
    """What the paper says about it."""


def _from_guess(
    law: type[ImageJacobianEstimator],
) -> Callable[[RBFImageJacobian], ImageJacobianEstimator]:
    """The law from the paper's initial image Jacobian, whatever was learned."""
    return lambda _: law(guessed_network())


DEFAULT = "learned"

VARIANTS: Mapping[str, Variant] = {
    DEFAULT: Variant("Kalman filter from the learned Jacobian", from_learned),
    "kalman": Variant(
        "Kalman filter from the paper's guess", lambda _: from_learned(guessed_network())
    ),
    "composite": Variant(
        "composite law from the paper's guess", _from_guess(CompositeEstimator)
    ),
    "paper": Variant(
        "the paper's law from its guess",
        _from_guess(PaperEstimator),
        claim="reaches the target, faster than without adaptation (Experiment 2)",
    ),
    "fixed": Variant(
        "the paper's guess, not adapted",
        _from_guess(FixedEstimator),
        claim="reaches the target, slower (Experiment 2)",
    ),
    "unadapted": Variant(
        "the learned Jacobian, not adapted",
        # Estimators work in double precision, and the skill keeps its own network.
        lambda learned: FixedEstimator(copy.deepcopy(learned).double()),
    ),
}
"""What can be compared, the default first."""


@dataclass(frozen=True, kw_only=True)
class SimulatedGrasp:
    """One grasp, successful or not."""

    scene: GraspingScene
    world: World
    """As the run left it."""
    cell: WorkCell
    motion: MotionLog
    item: ObjectConfig
    result: GraspResult | None
    """What the task reports; None if it failed."""
    failure: str = ""
    """Why it failed."""


def simulate_grasp(
    aiming: VisualServoSkill,
    scene: GraspingScene,
    *,
    estimator: ImageJacobianEstimator | None = None,
    told_target: bool = False,
    camera: CameraKind = "auto",
    config: GraspingConfig | None = None,
    rng: np.random.Generator,
    access: ArmAccess = SIMULATED,
    drawings: Sequence[DrawnInterval] = (),
    page: PageConfig | None = None,
    view: LiveView = no_live_view,
    on_page: Callable[[str], None] = lambda address: None,
) -> SimulatedGrasp:
    """Grasp an object and carry it home, in MuJoCo.

    Args:
        aiming: Learned image Jacobian and visual target.
        scene: Initial conditions.
        estimator: Of the image Jacobian; None: that of `Grasping`.
        told_target: Tell the controller the target pixel, which no real one can know:
            estimators are then compared on nothing but how they get there.
        camera: Which kind of camera watches.
        config: How objects are grasped.
        rng: Source of image noise, and of which images are lost.
        access: How the arm is led.
        drawings: What a scripted person draws, in the time of the run.
        page: Serve a page from which people draw and pull the arm too, and let the world go
            on in real time; None: no page.
        view: Dashboard of the run while it goes on.
        on_page: Told the address of the page.
    """
    workplace = scene.workplace.approached(aiming.approach)
    scene = replace(scene, workplace=workplace)
    world = scene.world()
    item, sizes = workplace.scene.objects[0], world.imperfections.sizes
    plant = access.told(sizes)
    eye = open_camera(world, camera, rng=rng, noise=sizes.camera_noise)
    latency = LatencyConfig(delay=sizes.image_delay, frame_loss=sizes.image_loss)
    config = config or GraspingConfig()
    law = replace(config.controller, safety=plant.plant(config.controller.safety))
    config = replace(config, controller=law)

    def check(plan: Plan) -> None:
        check_plan(plan, world, item.name if world.holds(item.name) else None)

    result, failure = None, ""
    dt = WorkCellConfig().dt
    with torch.inference_mode(), ExitStack() as stack:
        driven = stack.enter_context(access.open(world))
        motion = MotionLog(world, driven.advance)
        human, passing, beside = ScriptedDrawing(drawings), motion.advance, None
        if page is not None:
            opened = task_page(world, dt, page, on_page, title="Grasping")
            beside = stack.enter_context(opened)
            human, passing = beside.joined(human, motion.advance)
        cell = WorkCell(
            chain=workplace.robot.chain,
            arm=driven.arm,
            gripper=driven.gripper,
            sensor=MarkerSensor(eye, workplace.scene.marker_ids),
            human=human,
            advance=passing,
            config=WorkCellConfig(
                dt=dt,
                latency=latency,
                safety=plant.plant(WorkCellConfig().safety),
                command_delay=plant.following_delay,
            ),
            rng=rng,
        )
        if beside is not None:
            beside.follow(cell)
        above = scene.above()

        def told(
            pixel, jacobian, orientation: Float[Tensor, "4"], further: Float[np.ndarray, "3"]
        ) -> Float[np.ndarray, "2"]:
            target = scene.true_target(world, Pose(above.position, orientation))
            return target + jacobian[:, :3] @ further

        task = Grasping(
            cell,
            workplace,
            aiming,
            config,
            estimator=estimator,
            target=told if told_target else None,
            check=check,
        )
        try:
            with view(cell, world, motion):
                result = task.grasp(item)
                task.go_home()
        except TaskFailedError as error:
            failure = str(error)
    return SimulatedGrasp(
        scene=scene,
        world=world,
        cell=cell,
        motion=motion,
        item=item,
        result=result,
        failure=failure,
    )


@dataclass(frozen=True, kw_only=True)
class GraspingRun:
    """Grasps of the same object from the same start, seen by the same camera."""

    grasp: SimulatedGrasp
    """By the default, told nothing: this is what has to succeed."""
    compared: Mapping[str, SimulatedGrasp]
    """By variant, each told the target pixel."""
