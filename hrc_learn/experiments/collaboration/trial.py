"""One collaboration in simulation: scenario, run, and what is kept of it."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.experiments.arm_access import SIMULATED, ArmAccess
from hrc_learn.experiments.collaboration.hand_over import (
    GivingPerson,
    giver,
    shown_hand_overs,
    waiting,
)
from hrc_learn.experiments.collaboration.pulls import PullEffect, pull_effects
from hrc_learn.experiments.collaboration.reach_space import (
    ReachSpace,
    reach_spaces,
    space_over_bench,
)
from hrc_learn.experiments.collaboration.worker import (
    draw_visit,
    move_worker,
    separation_margin,
)
from hrc_learn.experiments.run_recording import LiveView, no_live_view
from hrc_learn.geometry import quaternion
from hrc_learn.kinematics import Arm
from hrc_learn.sim import (
    CameraChange,
    CameraKind,
    ChangingCamera,
    MotionLog,
    ObjectConfig,
    OcclusionInterval,
    ScriptedOcclusion,
    WorkerSensor,
    WorkerVisit,
    World,
    open_camera,
    whole_arm,
)
from hrc_learn.sim.hand_over import HandOver
from hrc_learn.sim.imperfections import Imperfections
from hrc_learn.sim.worker import PARTS
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.grasping import as_load
from hrc_learn.skills.marker_sensor import LatencyConfig, MarkerSensor
from hrc_learn.skills.person_watch import PersonWatch, PersonWatchConfig
from hrc_learn.skills.pick_and_place import (
    HOME,
    INTERACT,
    RECEIVE,
    RELEASE,
    PickAndPlace,
    PickAndPlaceConfig,
    PickPlaceJob,
)
from hrc_learn.skills.placing import PlacingSkill, Plan, check_plan
from hrc_learn.skills.receiving import Receiving
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.skills.work_cell import WorkCell, WorkCellConfig
from hrc_learn.teleoperation import (
    CombinedInput,
    DrawnInterval,
    ForceMapping,
    InteractionForceConfig,
    ScriptedDrawing,
    ScriptedForce,
    ScriptedPerturbation,
    random_pulls,
)
from hrc_learn.teleoperation.hand_guiding import DEFAULT_MAPPING
from hrc_learn.teleoperation.page import PageConfig
from hrc_learn.teleoperation.page_session import task_page
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
"""Three boxes of sizes that the gripper takes."""

_APART = 0.118
"""Distance at which the open fingers about one object clear the next, however both lie [m]:
0.06 m to the outside of a finger, 0.046 m to the corner of the largest object."""

# At which a hand that brings something to the robot may get faster than it was seen to be
# [m/s^2]: who hands over watches the arm, and it has to come near enough to be given anything.
_BRINGS = 3.0

NULL_SPACE_FORCES = (
    ScriptedForce(start=0.5, duration=4.5, towards=(0.40, 0.00, 0.50), max_force=60.0),
    ScriptedForce(start=5.5, duration=4.5, towards=(-0.10, 0.25, 0.60), max_force=60.0),
)
"""A worker reaches under the arm: the elbow is pushed aside and back. A force of 60 N moves it
by 0.2 to 0.4 m within the 4.5 s of an interval."""

DRAGS_BESIDE_WORKER = NULL_SPACE_FORCES + tuple(
    replace(force, start=force.start + 10.0) for force in NULL_SPACE_FORCES
)
"""Forward and back twice, as the paper's expert drags joint 4 while a worker reaches."""

Pulls = Literal["scripted", "random", "none"]
"""When a scripted person pulls the elbow: while the robot waits for them above the first
object, at random moments of the whole job, or never."""

OBJECT_REACH = (0.10, 0.08, 0.0)
"""Largest distance of a single object from the middle of the table [m]."""
OBJECTS_REACH = (0.12, 0.10)
"""The same of several objects, along x and y [m]."""


@dataclass(frozen=True, kw_only=True)
class Disturbances:
    """What happens to camera and images during the job."""

    occlusions: tuple[OcclusionInterval, ...] = ()
    """Intervals in which the gripper's marker is hidden."""
    camera_change: CameraChange | None = None
    """How the camera is moved between two objects; None: it stays."""


@dataclass(frozen=True, kw_only=True)
class CollaborationRun:
    """One run of the whole job, successful or not."""

    workplace: Workplace
    world: World
    """As the run left it."""
    cell: WorkCell
    motion: MotionLog
    picks: tuple[PickPlaceJob, ...]
    """The result for each object, in order."""
    cameras: tuple[tuple[float, CameraModel], ...]
    """The true cameras, and from when on each watched [s]."""
    disturbances: Disturbances = field(default_factory=Disturbances)
    pulls: tuple[ScriptedForce, ...] = ()
    """Of the person on the elbow, in the time of the run, where they do not wait to be let."""
    visit: WorkerVisit | None = None
    """Where the worker truly was; None: nobody was there."""
    hand_over: HandOver | None = None
    """What he did who handed an object over; None: nobody did."""
    held_flat: frozenset[str] = frozenset()
    """Objects that both pads held on opposite faces, when lifted and still at the release."""

    @cached_property
    def pull_effects(self) -> list[PullEffect]:
        """What each pull at a random moment did in each phase that it reached into."""
        if not self.pulls:
            return []
        offset = self.world.arm.encoder_offset
        return pull_effects(
            self.cell.log,
            self.pulls,
            self.workplace.robot.chain,
            encoder_offset=offset,
            clearance=self.workplace.arm_clearance,
        )

    @cached_property
    def separation_margin(self) -> Float[np.ndarray, " steps"] | None:
        """Of the worker, at each step (`separation_margin`) [m]; None: nobody was there."""
        if self.visit is None:
            return None
        log = self.cell.log
        return separation_margin(
            log,
            self.visit,
            whole_arm(self.world.config.arm),
            self.cell.config.safety.separation,
            encoder_offset=self.world.arm.encoder_offset,
            loads={
                item.name: (as_load(item), self.motion.held(item.name)[: len(log)])
                for item in self.workplace.scene.objects
            },
        )

    @cached_property
    def reach_spaces(self) -> list[ReachSpace]:
        """What room the arm left the worker at each marker; empty if nobody was there."""
        if self.visit is None or not len(self.visit.markers):
            return []
        x, y, _ = self.visit.markers.mean(axis=0).tolist()
        return reach_spaces(
            self.cell.log,
            self.visit,
            whole_arm(self.world.config.arm),
            space_over_bench((x, y), self.world.table_top),
            self.world.arm.encoder_offset,
        )

    @property
    def failure(self) -> str:
        """Why objects were not delivered, as the robot sees it; empty if all were."""
        failures = [pick.failure for pick in self.picks if pick.failure]
        if left := len(self.workplace.scene.objects) - len(self.picks):
            failures.append(f"{left} objects were not started")
        return "; ".join(failures)


def simulate_collaboration(
    aiming: VisualServoSkill,
    placing: PlacingSkill,
    shelves: Sequence[str],
    *,
    workplace: Workplace | None = None,
    camera: CameraKind = "auto",
    forces: Sequence[ScriptedForce] | Literal["random"] = NULL_SPACE_FORCES,
    disturbances: Disturbances | None = None,
    config: PickAndPlaceConfig | None = None,
    cell_config: WorkCellConfig | None = None,
    imperfections: Imperfections | None = None,
    worker: bool = False,
    handover: bool = False,
    access: ArmAccess = SIMULATED,
    mapping: ForceMapping = DEFAULT_MAPPING,
    drawings: Sequence[DrawnInterval] = (),
    seed: int = 0,
    page: PageConfig | None = None,
    view: LiveView = no_live_view,
    on_start: Callable[[World, WorkCell], None] = lambda world, cell: None,
    on_phase: Callable[[str, float], None] = lambda phase, time: None,
    on_page: Callable[[str], None] = lambda address: None,
) -> CollaborationRun:
    """Grasp objects that lie at random and put them on shelves, in MuJoCo.

    Args:
        aiming: Learned image Jacobian and visual target.
        placing: Learned placing motion.
        shelves: Where to put each of the scene's objects, in turn.
        workplace: Where.
        camera: Which kind of camera watches.
        forces: Of the person on the elbow, in time since the robot waits for them; or at
            random moments from the beginning on, whatever the robot does.
        disturbances: What happens to camera and images during the job.
        config: How the job is done.
        cell_config: How the loop runs; images may be late or lost.
        imperfections: Of arm, calibration, camera and objects; None: none.
        worker: Whether a worker comes to the table, whom nobody expects.
        handover: Whether the last object is in a person's hand, who hands it over.
        access: How the arm is led.
        mapping: How these forces act.
        drawings: What a scripted person draws, in the time of the run.
        seed: Of the objects' poses and of image noise.
        page: Serve a page from which people push the elbow and draw too, and let the world
            go on in real time; None: no page.
        view: Dashboard of the run while it goes on.
        on_start: Given world and cell before the job begins.
        on_phase: Told the name of each phase of the task, and when it begins [s].
        on_page: Told the address of the page.

    Raises:
        ValueError: If there is not one shelf for each object, there is no such shelf, or the
            arm cannot reach it.
    """
    workplace = (workplace or Workplace()).approached(aiming.approach)
    rng = np.random.default_rng(seed)
    disturbances = disturbances or Disturbances()
    cell_config = cell_config or WorkCellConfig()
    sizes = imperfections or Imperfections.ideal()
    latency = LatencyConfig(
        delay=max(cell_config.latency.delay, sizes.image_delay),
        frame_loss=max(cell_config.latency.frame_loss, sizes.image_loss),
    )
    plant = access.told(sizes)
    safety = plant.plant(cell_config.safety)
    cell_config = replace(
        cell_config, latency=latency, safety=safety, command_delay=plant.following_delay
    )
    config = _on_plant(config or PickAndPlaceConfig(), plant)
    items, chain = workplace.scene.objects, workplace.robot.chain
    _check_shelves(workplace, shelves)
    if worker and handover:
        raise ValueError("one person comes: give --worker or --handover")
    # Drawn apart, so that runs with and without the worker are alike but for him.
    chance = np.random.default_rng([seed, 2])
    visit = draw_visit(workplace, chance, beside_elbow=True) if worker else None
    scene = replace(workplace.scene, worker=None if visit is None else visit.worker.config)
    if handover:
        scene = replace(scene, worker=giver(seed).config)
    world = World(scene, sizes.draw(rng, workplace.robot.joints))
    world.reset(
        workplace.home_joints().numpy(), _object_poses(workplace, world, sizes.object_yaw, rng)
    )
    pulls: tuple[ScriptedForce, ...] = ()
    interaction = InteractionForceConfig(mapping=mapping)
    if forces == "random":
        # Drawn apart, so that runs with and without pulls are alike but for them.
        pulls = random_pulls(np.random.default_rng([seed, 1]))
        config = replace(config, interactions=0)
        person = ScriptedPerturbation(chain, pulls, 0.0, interaction)
    else:
        person = ScriptedPerturbation(chain, forces, None, interaction)
    watch = None
    giving = None
    if handover:
        giving = GivingPerson(world, items[-1], np.random.default_rng([seed, 3]))
    tracker = None
    somebody = giving or visit
    if somebody is not None:
        tracker = WorkerSensor(somebody, lambda: world.time, sizes, chance)
        expected = PersonWatchConfig(acceleration=_BRINGS) if handover else None
        watch = PersonWatch(tracker, whole_arm(scene.arm), safety.separation, expected)
    if visit is not None:
        move_worker(world, visit)
    occluder = ScriptedOcclusion(world, disturbances.occlusions)
    eyes = ChangingCamera(
        workplace.scene.camera,
        lambda model: open_camera(world, camera, model, rng=rng, noise=sizes.camera_noise),
    )

    flat: dict[str, set[str]] = {HOME: set(), RELEASE: set()}

    def enter(phase: str, time: float) -> None:
        on_phase(phase, time)
        if phase in flat:
            flat[phase] |= {item.name for item in items if world.holds_flat(item.name)}
        if phase == RECEIVE and giving is not None:
            giving.begin(time)
        if phase == INTERACT and not pulls:
            person.begin(time)

    def check(plan: Plan) -> None:
        held = (item.name for item in items if world.holds(item.name))
        check_plan(plan, world, next(held, None))

    def before(number: int) -> None:
        change = disturbances.camera_change
        if change is not None and number > 0:
            model = change.applied(eyes.model, _watched(workplace, world), rng)
            eyes.change(world.time, model)

    with torch.inference_mode(), ExitStack() as stack:
        driven = stack.enter_context(access.open(world))
        motion = MotionLog(world, driven.advance)

        def advance(duration: float) -> None:
            motion.advance(duration)
            occluder.update()
            if visit is not None:
                move_worker(world, visit)
            if giving is not None:
                giving.update()

        human, passing, beside = person, advance, None
        if drawings:
            human = CombinedInput(person, ScriptedDrawing(drawings))
        if page is not None:
            opened = task_page(world, cell_config.dt, page, on_page)
            beside = stack.enter_context(opened)
            human, passing = beside.joined(human, advance)
        cell = WorkCell(
            chain=chain,
            arm=driven.arm,
            gripper=driven.gripper,
            sensor=MarkerSensor(eyes, workplace.scene.marker_ids),
            human=human,
            advance=passing,
            config=cell_config,
            on_phase=enter,
            rng=rng,
            clearance=workplace.arm_clearance,
            watch=watch,
        )
        if beside is not None:
            beside.follow(cell)
        stack.enter_context(view(cell, world, motion))
        on_start(world, cell)
        receiving = {}
        if giving is not None and tracker is not None:
            model = shown_hand_overs(workplace, sizes, items[-1])
            receiving[items[-1].name] = Receiving(
                cell, tracker, model, PARTS, waiting(workplace)
            )
        task = PickAndPlace(cell, workplace, aiming, placing, check, config, receiving)
        picks = task.run(list(zip(items, shelves, strict=True)), before)
    return CollaborationRun(
        workplace=workplace,
        world=world,
        cell=cell,
        motion=motion,
        picks=tuple(picks),
        cameras=tuple(eyes.history),
        disturbances=disturbances,
        pulls=pulls,
        visit=visit if giving is None else giving.hand_over.visit,
        hand_over=None if giving is None else giving.hand_over,
        held_flat=frozenset(flat[HOME] & flat[RELEASE]),
    )


def _on_plant(config: PickAndPlaceConfig, sizes: Imperfections) -> PickAndPlaceConfig:
    """The controller's safety filter is told what the arm can do, too."""
    law = config.grasping.controller
    law = replace(law, safety=sizes.plant(law.safety))
    return replace(config, grasping=replace(config.grasping, controller=law))


def with_objects(workplace: Workplace, items: Sequence[ObjectConfig]) -> Workplace:
    """The workplace with these objects on its table."""
    return replace(workplace, scene=replace(workplace.scene, objects=tuple(items)))


def workplace_for(
    shelves: Sequence[str],
    robot: Arm,
    shelf_x: float | None = None,
    shelf_depth: float | None = None,
) -> Workplace:
    """A workplace with an object for each shelf.

    Args:
        shelves: Their names.
        robot: The arm.
        shelf_x: Where along the boards objects are put [m]; None: as the cell is laid out.
        shelf_depth: How far behind the boards' front edge [m]; likewise.

    Raises:
        ValueError: If there are more shelves named than objects known, or none.
    """
    if not 1 <= len(shelves) <= len(THREE_OBJECTS):
        raise ValueError(
            f"there are 1 to {len(THREE_OBJECTS)} objects to put on shelves, but "
            f"{len(shelves)} shelves are named."
        )
    given = {"shelf_x": shelf_x, "shelf_depth": shelf_depth}
    options = {name: value for name, value in given.items() if value is not None}
    workplace = Workplace.of(robot, **options)
    return with_objects(workplace, THREE_OBJECTS[: len(shelves)])


def _check_shelves(workplace: Workplace, shelves: Sequence[str]) -> None:
    items = workplace.scene.objects
    for name in shelves:
        workplace.shelf(name)
    if len(shelves) != len(items) or len(set(shelves)) != len(shelves):
        raise ValueError(
            f"each of the {len(items)} objects needs a shelf of its own, but the shelves are "
            f"{', '.join(shelves)}."
        )


def _object_poses(
    workplace: Workplace, world: World, yaw: float, rng: np.random.Generator
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Poses on the table as it is, of objects as tall as they are."""
    items = world.config.objects
    reach = OBJECT_REACH[:2] if len(items) == 1 else OBJECTS_REACH
    return random_object_poses(
        items, workplace.table_centre, reach, rng, yaw=yaw, table_top=world.table_top
    )


def random_object_poses(
    items: Sequence[ObjectConfig],
    middle: tuple[float, float],
    reach: tuple[float, float],
    rng: np.random.Generator,
    *,
    yaw: float = np.pi,
    table_top: float = 0.0,
    attempts: int = 10_000,
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Random poses of objects on the table, clear of each other.

    Args:
        items: The objects.
        middle: Of the region of the table where they lie [m].
        reach: Largest distance from its middle along x and y [m].
        rng: Source of positions and turns.
        yaw: Largest turn, either way [rad].
        table_top: Height of the table [m].
        attempts: Arrangements tried.

    Raises:
        ValueError: If they do not fit.
    """
    for _ in range(attempts):
        positions = np.array(middle) + rng.uniform(-1, 1, (len(items), 2)) * reach
        if _clear(positions):
            return {
                item.name: _pose_on_table(item, position, rng.uniform(-yaw, yaw), table_top)
                for item, position in zip(items, positions, strict=True)
            }
    raise ValueError(
        f"{len(items)} objects do not fit within {reach[0]:g} and {reach[1]:g} m of the "
        "middle with room for the fingers between them: fewer objects, or more reach."
    )


def _clear(positions: Float[np.ndarray, "objects 2"]) -> bool:
    first, second = np.triu_indices(len(positions), k=1)
    gaps = np.linalg.norm(positions[first] - positions[second], axis=1)
    return bool((gaps >= _APART).all())


def _pose_on_table(
    item: ObjectConfig, position: Float[np.ndarray, "2"], turn: float, table_top: float
) -> Float[np.ndarray, "4 4"]:
    c, s = np.cos(turn), np.sin(turn)
    pose = np.eye(4)
    pose[:2, :2] = [[c, -s], [s, c]]
    pose[:3, 3] = (*position, table_top + item.half_size[2])
    return pose


def _watched(workplace: Workplace, world: World) -> Float[np.ndarray, "points 3"]:
    """What a camera has to see: where objects lie, and the marker of a gripper above them."""
    reach = np.array([*OBJECTS_REACH, 0.0])
    corners = np.array([[a, b, 0.0] for a in (-1, 1) for b in (-1, 1)])
    hover, offset = workplace.hover(), torch.from_numpy(world.hand_marker_offset())
    turns = torch.linspace(*workplace.hover_turns, 7, dtype=torch.float64)
    about = torch.stack([0 * turns, 0 * turns, turns], dim=-1)
    turned = quaternion.multiply(quaternion.exp(about), hover.orientation)
    markers = (hover.position + quaternion.rotate(turned, offset)).numpy()
    on_table = np.array([*workplace.table_centre, workplace.scene.objects[0].half_size[2]])
    # A marker's plate reaches 3 cm from its centre; the rest is margin.
    return np.concatenate(
        [middle + corners * (reach + 0.05) for middle in (on_table, *markers)]
    )
