"""One grasp in simulation: where it begins, the run, and what came of it."""

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.experiments.collaboration.metrics import limit_violations
from hrc_learn.experiments.run_recording import Watch, span, unwatched
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import ImageJacobianEstimator
from hrc_learn.kinematics import panda
from hrc_learn.sim import CameraKind, MotionLog, ObjectConfig, World, open_camera
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.cartesian_motion import joint_line
from hrc_learn.skills.grasping import Grasping, GraspingConfig, GraspResult
from hrc_learn.skills.marker_sensor import MarkerSensor
from hrc_learn.skills.placing import Plan, check_plan
from hrc_learn.skills.visual_servoing import VisualServoSkill
from hrc_learn.skills.work_cell import TaskFailedError, WorkCell
from hrc_learn.teleoperation import ScriptedPerturbation
from hrc_learn.vision import CameraModel

# Where a grasp begins: a camera nobody calibrated, an arm far off, an object at random.

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
        sensor = MarkerSensor(open_camera(world, camera, rng=rng), workplace.scene.marker_ids)
        for start in _starts(workplace, config, rng):
            world.reset(start, {item.name: pose})
            if item.marker.id in sensor.detect() and _has_a_way(world, workplace, start):
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


# A grasp in simulation: everything put together, run once, kept for evaluation.


@dataclass(frozen=True, kw_only=True)
class SimulatedGrasp:
    """One run, successful or not."""

    setting: GraspingSetting
    world: World
    """As it was left."""
    cell: WorkCell
    motion: MotionLog
    item: ObjectConfig
    result: GraspResult | None
    """What the task reports; None if it failed."""
    failure: str = ""
    """Why it failed."""


def simulate_grasp(
    aiming: VisualServoSkill,
    setting: GraspingSetting,
    *,
    estimator: ImageJacobianEstimator | None = None,
    told_target: bool = False,
    camera: CameraKind = "auto",
    config: GraspingConfig | None = None,
    rng: np.random.Generator,
    watch: Watch = unwatched,
    on_phase: Callable[[str, float], None] = lambda phase, time: None,
) -> SimulatedGrasp:
    """Grasp an object and carry it home, in MuJoCo.

    Args:
        aiming: Learned image Jacobian and visual target.
        setting: Where it begins.
        estimator: Of the image Jacobian; None: that of `Grasping`.
        told_target: Tell the controller the pixel to aim at, which no real one can know:
            estimators are then compared on nothing but how they get there.
        camera: Which kind of camera watches.
        config: How objects are grasped.
        rng: Source of image noise.
        watch: Watches from the side, such as `serving` a dashboard.
        on_phase: Told the name of each phase of the task, and when it begins [s].
    """
    workplace = setting.workplace.approached(aiming.approach)
    setting = replace(setting, workplace=workplace)
    world = setting.world()
    item, motion = workplace.scene.objects[0], MotionLog(world)

    def check(plan: Plan) -> None:
        check_plan(plan, world, item.name if world.holds(item.name) else None)

    result, failure = None, ""
    with torch.inference_mode():
        cell = WorkCell(
            chain=panda,
            arm=world.arm,
            gripper=world.arm,
            sensor=MarkerSensor(
                open_camera(world, camera, rng=rng), workplace.scene.marker_ids
            ),
            human=ScriptedPerturbation(panda, (), begin=None),
            advance=motion.advance,
            on_phase=on_phase,
        )
        target = setting.true_target(world)
        task = Grasping(
            cell,
            workplace,
            aiming,
            config,
            estimator=estimator,
            target=(lambda pixel, jacobian: target) if told_target else None,
            check=check,
        )
        try:
            with watch(cell, world, motion):
                result = task.grasp(item)
                task.go_home()
        except TaskFailedError as error:
            failure = str(error)
    return SimulatedGrasp(
        setting=setting,
        world=world,
        cell=cell,
        motion=motion,
        item=item,
        result=result,
        failure=failure,
    )


# What came of a grasp, as MuJoCo's contacts and poses tell it, whatever the task believes.

LIFTED = 0.10
"""Height above the table at which an object counts as lifted [m]."""


@dataclass(frozen=True, kw_only=True)
class GraspOutcome:
    """Measured after the arm went home with the object. Lengths [m], angles [rad], times [s].

    What was never reached is NaN.
    """

    held: bool
    """Whether the object is between both fingers."""
    height: float
    """Of the object above where it lay."""
    violations: int
    """Steps in which a joint was outside its range of position or velocity."""
    touches: int
    """Of the arm with table, cabinet and itself."""
    attempts: int
    """Grasps tried."""
    duration: float
    """From the start until home."""
    aim_time: float
    """Of the last attempt, from remote until above the object."""
    vision_time: float
    """Of that, since the camera took over for the first time."""
    pixel_error: float
    """From the hand's marker to its target as the hand goes down [px]."""
    target_error: float
    """From that target to where the marker should truly have been [px]."""
    place_error: float
    """From the hand to right above the object as the hand goes down, horizontally."""
    angle_error: float
    """Of the hand from pointing straight down, then."""
    failure: str
    """Why it is no success; empty if it is."""

    @classmethod
    def of(cls, run: SimulatedGrasp) -> "GraspOutcome":
        """Measure."""
        world, log, result = run.world, run.cell.log, run.result
        touches = [
            touch
            for monitor in (world.table_contacts, world.cabinet_contacts, world.self_contacts)
            for touch in monitor.touches
        ]
        held = world.holds(run.item.name)
        height = float(world.object_pose(run.item.name)[2, 3] - run.setting.object_pose[2, 3])
        violations = limit_violations(run.cell) if len(log) else 0
        failure = run.failure
        if not failure and not (held and height > LIFTED):
            failure = f"the object is not held {1e3 * LIFTED:.0f} mm above the table"
        if not failure and violations:
            failure = f"joint limits were left in {violations} steps"
        if not failure and touches:
            failure = str(touches[0])
        return cls(
            held=held,
            height=height,
            violations=violations,
            touches=len(touches),
            attempts=0 if result is None else result.attempts,
            duration=run.cell.time,
            aim_time=math.nan if result is None else result.servo_time,
            pixel_error=math.nan if result is None else result.pixel_error,
            failure=failure,
            **_at_descent(run),
        )

    def values(self) -> dict[str, float]:
        """All but the failure, as numbers."""
        return {k: float(v) for k, v in asdict(self).items() if k != "failure"}


def _at_descent(run: SimulatedGrasp) -> dict[str, float]:
    """What the last descent began with."""
    log = run.cell.log
    descents = [event.time for event in log.events if event.text == "grasp"]
    unknown = ("vision_time", "target_error", "place_error", "angle_error")
    if not descents:
        return dict.fromkeys(unknown, math.nan)
    aiming = span(log, "servo")
    time = log["time"]
    last = int(np.searchsorted(time, descents[-1])) - 1
    hand = panda.forward(torch.from_numpy(log["joint_position"][last]))
    above = Pose(hand.position, run.setting.workplace.hover().orientation)
    off = hand.position[:2].numpy() - run.setting.object_pose[:2, 3]
    seen = (time >= aiming[0]) & (log["vision_activation"] > 0)
    taken_over = time[seen][0] if seen.any() else math.nan
    target = log["target"][last] - run.setting.true_target(run.world)
    return {
        "vision_time": min(aiming[1], descents[-1]) - taken_over,
        "target_error": float(np.linalg.norm(target)),
        "place_error": float(np.linalg.norm(off)),
        "angle_error": float(hand.twist_to(above)[3:].norm()),
    }
