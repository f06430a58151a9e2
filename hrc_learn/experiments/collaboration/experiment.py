"""The collaboration in simulation: everything put together, run once, kept for evaluation."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.experiments.pose_randomization import scatter
from hrc_learn.experiments.run_recording import Watch, unwatched
from hrc_learn.kinematics import panda
from hrc_learn.sim import (
    CameraChange,
    CameraKind,
    ChangingCamera,
    MotionLog,
    ObjectConfig,
    OcclusionInterval,
    ScriptedOcclusion,
    World,
    open_camera,
)
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.marker_sensor import MarkerSensor
from hrc_learn.skills.pick_and_place import (
    INTERACT,
    PickAndPlace,
    PickAndPlaceConfig,
    PickPlaceJob,
)
from hrc_learn.skills.placing import PlacingSkill, Plan, check_plan
from hrc_learn.skills.visual_servoing import VisualServoSkill
from hrc_learn.skills.work_cell import WorkCell, WorkCellConfig
from hrc_learn.teleoperation import ScriptedForce, ScriptedPerturbation
from hrc_learn.teleoperation.page import PageConfig
from hrc_learn.teleoperation.page_session import task_page
from hrc_learn.vision import CameraModel

PULLS = (
    ScriptedForce(start=0.5, duration=4.5, towards=(0.40, 0.00, 0.50), max_force=60.0),
    ScriptedForce(start=5.5, duration=4.5, towards=(-0.10, 0.25, 0.60), max_force=60.0),
)
"""A worker reaches under the arm: the elbow is drawn aside, and let back."""

OBJECT_REACH = (0.10, 0.08, 0.0)
"""How far from the middle of the table a single object lies [m]."""
OBJECTS_REACH = (0.12, 0.10)
"""The same of several."""


@dataclass(frozen=True, kw_only=True)
class Disturbances:
    """What happens to camera and images beside the job."""

    occlusions: tuple[OcclusionInterval, ...] = ()
    """Spells in which the hand's marker is hidden."""
    camera_change: CameraChange | None = None
    """How the camera is changed between two objects; None: it stays."""


@dataclass(frozen=True, kw_only=True)
class SimulatedJob:
    """One run, successful or not."""

    workplace: Workplace
    world: World
    """As it was left."""
    cell: WorkCell
    motion: MotionLog
    picks: tuple[PickPlaceJob, ...]
    """What became of each object, in turn."""
    cameras: tuple[tuple[float, CameraModel], ...]
    """The true cameras, and from when on each watched [s]."""
    disturbances: Disturbances = field(default_factory=Disturbances)

    @property
    def failure(self) -> str:
        """Why objects were not delivered, as the robot sees it; empty if all were."""
        failures = [pick.failure for pick in self.picks if pick.failure]
        if left := len(self.workplace.scene.objects) - len(self.picks):
            failures.append(f"{left} objects were not begun with")
        return "; ".join(failures)


def simulate_collaboration(
    aiming: VisualServoSkill,
    placing: PlacingSkill,
    shelves: Sequence[str],
    *,
    workplace: Workplace | None = None,
    camera: CameraKind = "auto",
    pulls: Sequence[ScriptedForce] = PULLS,
    disturbances: Disturbances | None = None,
    config: PickAndPlaceConfig | None = None,
    cell_config: WorkCellConfig | None = None,
    seed: int = 0,
    page: PageConfig | None = None,
    watch: Watch = unwatched,
    on_start: Callable[[World, WorkCell], None] = lambda world, cell: None,
    on_phase: Callable[[str, float], None] = lambda phase, time: None,
    on_page: Callable[[str], None] = lambda address: None,
) -> SimulatedJob:
    """Grasp objects that lie at random and put them on shelves, in MuJoCo.

    Args:
        aiming: Learned image Jacobian and visual target.
        placing: Learned placing motion.
        shelves: Where to put each of the scene's objects, in turn.
        workplace: Where.
        camera: Which kind of camera watches.
        pulls: At the body, in time since the robot gives the person time.
        disturbances: What happens to camera and images meanwhile.
        config: How the job is done.
        cell_config: How the loop runs; images may be late or lost.
        seed: Of where the objects lie, and of image noise.
        page: Serve a page from which people pull at the body too, and let the world go on in
            real time; None: no page.
        watch: Watches from the side, such as `serving` a dashboard.
        on_start: Shown world and work cell before the job begins.
        on_phase: Told the name of each phase of the task, and when it begins [s].
        on_page: Told the address of the page.

    Raises:
        ValueError: If shelves and objects do not go together, there is no such shelf, or the
            arm cannot reach it.
    """
    workplace = (workplace or Workplace()).approached(aiming.approach)
    rng = np.random.default_rng(seed)
    disturbances = disturbances or Disturbances()
    cell_config = cell_config or WorkCellConfig()
    items = workplace.scene.objects
    _check_shelves(workplace, shelves)
    world = World(workplace.scene)
    world.reset(workplace.home_joints().numpy(), _places(workplace, rng))
    person, motion = ScriptedPerturbation(panda, pulls, begin=None), MotionLog(world)
    occluder = ScriptedOcclusion(world, disturbances.occlusions)
    eyes = ChangingCamera(
        workplace.scene.camera, lambda model: open_camera(world, camera, model, rng=rng)
    )

    def advance(duration: float) -> None:
        motion.advance(duration)
        occluder.update()

    def enter(phase: str, time: float) -> None:
        on_phase(phase, time)
        if phase == INTERACT:
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
        human, passing, beside = person, advance, None
        if page is not None:
            opened = task_page(world, cell_config.dt, page, on_page)
            beside = stack.enter_context(opened)
            human, passing = beside.joined(person, advance)
        cell = WorkCell(
            chain=panda,
            arm=world.arm,
            gripper=world.arm,
            sensor=MarkerSensor(eyes, workplace.scene.marker_ids),
            human=human,
            advance=passing,
            config=cell_config,
            on_phase=enter,
            rng=rng,
        )
        if beside is not None:
            beside.follow(cell)
        stack.enter_context(watch(cell, world, motion))
        on_start(world, cell)
        task = PickAndPlace(cell, workplace, aiming, placing, check, config)
        picks = task.run(list(zip(items, shelves, strict=True)), before)
    return SimulatedJob(
        workplace=workplace,
        world=world,
        cell=cell,
        motion=motion,
        picks=tuple(picks),
        cameras=tuple(eyes.history),
        disturbances=disturbances,
    )


def with_objects(workplace: Workplace, items: Sequence[ObjectConfig]) -> Workplace:
    """The workplace with these objects on its table."""
    return replace(workplace, scene=replace(workplace.scene, objects=tuple(items)))


def _check_shelves(workplace: Workplace, shelves: Sequence[str]) -> None:
    items = workplace.scene.objects
    for name in shelves:
        workplace.shelf(name)
    if len(shelves) != len(items) or len(set(shelves)) != len(shelves):
        raise ValueError(
            f"each of the {len(items)} objects needs a shelf of its own, but the shelves are "
            f"{', '.join(shelves)}."
        )


def _places(
    workplace: Workplace, rng: np.random.Generator
) -> dict[str, Float[np.ndarray, "4 4"]]:
    items = workplace.scene.objects
    if len(items) == 1:
        return {items[0].name: workplace.random_object_pose(OBJECT_REACH, rng)}
    return scatter(items, workplace.table_centre, OBJECTS_REACH, rng)


def _watched(workplace: Workplace, world: World) -> Float[np.ndarray, "points 3"]:
    """What a camera has to see: where objects lie, and the hand's marker when above them."""
    reach = np.array([*OBJECTS_REACH, 0.0])
    signs = np.array([[a, b, 0.0] for a in (-1, 1) for b in (-1, 1)])
    hover = workplace.hover()
    marker = hover.apply(torch.from_numpy(world.hand_marker_offset())).numpy()
    on_table = np.array([*workplace.table_centre, workplace.scene.objects[0].half_size[2]])
    # Markers and their plates reach as far as this about their centres, and a margin more.
    return np.concatenate([middle + signs * (reach + 0.05) for middle in (on_table, marker)])
