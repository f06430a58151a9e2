"""One collaboration in simulation: the scenario, the run, and its result."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from hrc_learn.experiments.run_measures import PullEffect, pull_effects
from hrc_learn.experiments.simulated_cell import (
    SIMULATED,
    UNOBSERVED,
    ArmAccess,
    CellRun,
    Observer,
    plan_checker,
    simulated_cell,
)
from hrc_learn.experiments.surroundings import (
    GivingPerson,
    NearWorker,
    draw_object_poses,
    draw_visit,
    near_worker,
    points_to_see,
    shown_hand_overs,
    waiting_pose,
)
from hrc_learn.sim import (
    CameraChange,
    CameraKind,
    ChangingCamera,
    Imperfections,
    OcclusionInterval,
    ScriptedOcclusion,
    WorkerConfig,
    WorkerSensor,
    WorkerVisit,
    World,
    open_camera,
    whole_arm,
)
from hrc_learn.sim.hand_over import HandOver
from hrc_learn.sim.worker import PARTS
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.grasping import INTERACT, as_load
from hrc_learn.skills.marker_sensor import feature_sensor
from hrc_learn.skills.person_watch import PersonWatch, PersonWatchConfig
from hrc_learn.skills.pick_and_place import (
    HOME,
    RECEIVE,
    RELEASE,
    PickAndPlace,
    PickAndPlaceConfig,
    PickPlaceJob,
)
from hrc_learn.skills.placing import PlacingSkill
from hrc_learn.skills.receiving import Receiving
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.skills.work_cell import WorkCell, WorkCellConfig
from hrc_learn.teleoperation import ScriptedForce, ScriptedPerturbation, random_pulls
from hrc_learn.teleoperation.page import PageConfig
from hrc_learn.vision import CameraModel

NULL_SPACE_FORCES = (
    ScriptedForce(start=0.5, duration=4.5, towards=(0.40, 0.00, 0.50), max_force=60.0),
    ScriptedForce(start=5.5, duration=4.5, towards=(-0.10, 0.25, 0.60), max_force=60.0),
)
"""Forces that push the elbow aside and back, so that a worker can reach under the arm. A force
of 60 N moves the elbow by 0.2 to 0.4 m within the 4.5 s of an interval."""

DRAGS_NEAR_WORKER = NULL_SPACE_FORCES + tuple(
    replace(force, start=force.start + 10.0) for force in NULL_SPACE_FORCES
)
"""The same forces twice. In the paper, too, a person drags joint 4 while a worker reaches under
the arm."""

# Acceleration that `PersonWatch` assumes for a person that brings an object [m/s^2]. It is
# lower than usual: the person sees the arm, and must come near enough to hand the object over.
_GIVER_ACCELERATION = 3.0


@dataclass(frozen=True, kw_only=True)
class Disturbances:
    """Disturbances of camera and images during the job."""

    occlusions: tuple[OcclusionInterval, ...] = ()
    """Intervals in which the gripper's marker is hidden."""
    camera_change: CameraChange | None = None
    """Motion of the camera between two objects; None: the camera does not move."""


@dataclass(frozen=True, kw_only=True)
class CollaborationScenario:
    """Conditions under which objects are grasped and placed near a person."""

    camera: CameraKind = "auto"
    """Kind of camera that watches the table."""
    forces: Sequence[ScriptedForce] | Literal["random"] = NULL_SPACE_FORCES
    """Forces of the person on the elbow. Their times count from the moment at which the robot
    begins to wait for them. "random": forces at random moments of the whole job."""
    disturbances: Disturbances = field(default_factory=Disturbances)
    config: PickAndPlaceConfig = field(default_factory=PickAndPlaceConfig)
    """Configuration of the job."""
    cell: WorkCellConfig = field(default_factory=WorkCellConfig)
    """Configuration of the control loop."""
    imperfections: Imperfections = field(default_factory=Imperfections.ideal)
    """Imperfections of arm, calibration, camera and objects."""
    worker: bool = False
    """A worker comes to the table unannounced and reaches under the arm."""
    handover: bool = False
    """A person hands over the last object."""
    page: PageConfig | None = None
    """Page, served in real time, on which users can also push and draw; None: no page."""


@dataclass(frozen=True, kw_only=True)
class CollaborationRun(CellRun):
    """One run of the whole job, successful or not."""

    workplace: Workplace
    picks: tuple[PickPlaceJob, ...]
    """Result for each object, in order."""
    cameras: tuple[tuple[float, CameraModel], ...]
    """True cameras, each with the time from which it was used [s]."""
    pulls: tuple[ScriptedForce, ...] = ()
    """Forces on the elbow at random moments, timed from the start of the run."""
    visit: WorkerVisit | None = None
    """True motion of the worker; None without a worker."""
    hand_over: HandOver | None = None
    """Actions of the person in a hand-over; None without one."""
    held_flat: frozenset[str] = frozenset()
    """Objects that both pads held on opposite faces, after lifting and still at the release."""

    @cached_property
    def pull_effects(self) -> list[PullEffect]:
        """Effect of each pull at a random moment."""
        if not self.pulls:
            return []
        offset = self.world.arm.encoder_offset
        return pull_effects(self.cell.log, self.pulls, self.workplace.robot.chain, offset)

    @cached_property
    def near_worker(self) -> NearWorker | None:
        """Margin over the stopping distance, and force of contacts; None without a worker."""
        if self.visit is None:
            return None
        log = self.cell.log
        return near_worker(
            log,
            self.visit,
            whole_arm(self.world.config.arm),
            self.cell.config.safety.separation,
            encoder_offset=self.world.arm.encoder_offset,
            loads={
                item.name: (as_load(item), self.motion.held(item.name)[: len(log)])
                for item in self.workplace.scene.objects
            },
            furniture=self.workplace.scene.boxes(),
        )


def simulate_collaboration(
    aiming: VisualServoSkill,
    placing: PlacingSkill,
    shelves: Sequence[str],
    scenario: CollaborationScenario | None = None,
    *,
    workplace: Workplace | None = None,
    access: ArmAccess = SIMULATED,
    seed: int = 0,
    observer: Observer = UNOBSERVED,
) -> CollaborationRun:
    """Grasp objects at random poses and put them on shelves, in MuJoCo.

    Args:
        aiming: Learned image Jacobian and visual target.
        placing: Learned placing motion.
        shelves: Shelf of each object of the scene, in turn.
        scenario: Person, camera, imperfections and configuration.
        workplace: Workplace; by default that of a Panda.
        access: Access to the arm.
        seed: Seed of object poses, imperfections, people and image noise.
        observer: Live dashboard and messages.

    Raises:
        ValueError: If the objects do not have one shelf each, a shelf is unknown or out of
            reach, or the scenario has both a worker and a hand-over.
    """
    scenario = scenario or CollaborationScenario()
    workplace = (workplace or Workplace()).approached(aiming.approach)
    if not len(shelves) == len(workplace.scene.objects) == len(set(shelves)):
        text = f"each of the {len(workplace.scene.objects)} objects needs a shelf of its own,"
        raise ValueError(f"{text} but the shelves are {', '.join(shelves)}.")
    if scenario.worker and scenario.handover:
        raise ValueError("only one person can come: give --worker or --handover, not both.")
    rng, sizes = np.random.default_rng(seed), scenario.imperfections
    # Scripted forces begin when the robot waits for them. Random forces do not depend on the
    # robot, and the robot does not wait for them.
    config, forces, begin = scenario.config, scenario.forces, None
    pulls: tuple[ScriptedForce, ...] = ()
    if forces == "random":
        # A separate generator: all other random values are the same with and without pulls.
        forces = pulls = random_pulls(np.random.default_rng([seed, 1]))
        config, begin = replace(config, interactions=0), 0.0
    person = ScriptedPerturbation(workplace.robot.chain, forces, begin)
    stage = _Stage(workplace, scenario, access, seed, rng)
    world, items = stage.world, workplace.scene.objects
    eyes = ChangingCamera(
        workplace.scene.camera,
        lambda model: open_camera(
            world, scenario.camera, model, rng=rng, noise=sizes.camera_noise
        ),
    )
    held_flat: dict[str, set[str]] = {HOME: set(), RELEASE: set()}

    def begin_phase(phase: str, time: float) -> None:
        observer.tell(f"  {time:6.2f} s  {phase}")
        if phase in held_flat:
            held_flat[phase] |= {item.name for item in items if world.holds_flat(item.name)}
        if phase == RECEIVE and stage.giving is not None:
            stage.giving.begin(time)
        if phase == INTERACT and not pulls:
            person.begin(time)

    def change_camera(number: int) -> None:
        """Move the camera before every object but the first."""
        change = scenario.disturbances.camera_change
        if change is not None and number > 0:
            model = change.applied(eyes.model, points_to_see(workplace, world), rng)
            eyes.change(world.time, model)

    with simulated_cell(
        world,
        human=person,
        sensor=feature_sensor(
            eyes, aiming.landmarks, workplace.tool_marker, [item.marker.id for item in items]
        ),
        config=scenario.cell,
        access=access,
        page=scenario.page,
        observer=observer,
        on_phase=begin_phase,
        on_step=stage.update,
        rng=rng,
        clearance=workplace.arm_clearance,
        watch=stage.watch,
    ) as (cell, motion):
        task = PickAndPlace(
            cell, workplace, aiming, placing, plan_checker(world), config, stage.receiving(cell)
        )
        picks = task.run(list(zip(items, shelves, strict=True)), change_camera)
    failures = [pick.failure for pick in picks if pick.failure]
    if left := len(items) - len(picks):
        failures.append(f"{left} objects were not started")
    return CollaborationRun(
        failure="; ".join(failures),
        workplace=workplace,
        world=world,
        cell=cell,
        motion=motion,
        picks=tuple(picks),
        cameras=tuple(eyes.history),
        pulls=pulls,
        visit=stage.visit,
        hand_over=None if stage.giving is None else stage.giving.hand_over,
        held_flat=frozenset(held_flat[HOME] & held_flat[RELEASE]),
    )


class _Stage:
    """World of a collaboration, with its objects and people.

    Attributes:
        world: World at rest, with all objects at their random poses.
        giving: Person who hands over the last object; None without a hand-over.
        watch: `PersonWatch` with the robot's tracker of people; None without a person.
    """

    def __init__(
        self,
        workplace: Workplace,
        scenario: CollaborationScenario,
        access: ArmAccess,
        seed: int,
        rng: np.random.Generator,
    ):
        self._workplace, self._sizes = workplace, scenario.imperfections
        # Separate generators: all other random values are the same with and without a person.
        person_rng = np.random.default_rng([seed, 2])
        scene, worker = workplace.scene, None
        if scenario.worker:
            self._visit = draw_visit(workplace, person_rng)
            worker = self._visit.worker.config
        elif scenario.handover:
            worker = WorkerConfig.draw(np.random.default_rng([seed, 4]))
        scene = replace(scene, worker=worker)
        robot = workplace.robot
        drawn = self._sizes.draw(rng, robot.joints, robot.hand_size)
        self.world = world = World(scene, drawn)
        poses = draw_object_poses(workplace, world, self._sizes.object_yaw, rng)
        world.reset(workplace.home_joints().numpy(), poses)
        self.giving: GivingPerson | None = None
        expected = PersonWatchConfig()
        if scenario.handover:
            self.giving = GivingPerson(
                world, scene.objects[-1], np.random.default_rng([seed, 3])
            )
            expected = PersonWatchConfig(acceleration=_GIVER_ACCELERATION)
        self.watch: PersonWatch | None = None
        if worker is not None:
            person = self.giving or self._visit
            self._tracker = WorkerSensor(
                person.ends_at,
                person.worker.radius,
                lambda: world.time,
                self._sizes,
                person_rng,
            )
            plant = access.declared(self._sizes).plant(scenario.cell.safety)
            self.watch = PersonWatch(
                self._tracker,
                whole_arm(scene.arm),
                plant.separation,
                expected,
                workplace.scene.boxes(),
            )
        self._occluder = ScriptedOcclusion(world, scenario.disturbances.occlusions)
        self.update()

    @property
    def visit(self) -> WorkerVisit | None:
        """Motion of the person that is planned so far; None without a person."""
        if self.watch is None:
            return None
        return self._visit if self.giving is None else self.giving.hand_over.visit

    def update(self) -> None:
        """Move occluder and person to their present positions."""
        self._occluder.update()
        if self.giving is not None:
            self.giving.update()
        elif self.watch is not None:
            ends = self._visit.ends_at(self.world.time)
            self.world.move_worker(ends, self._visit.item_at(self.world.time, ends))

    def receiving(self, cell: WorkCell) -> dict[str, Receiving]:
        """Skill that receives the last object, by the object's name; empty: no hand-over."""
        if self.giving is None:
            return {}
        item = self._workplace.scene.objects[-1]
        model = shown_hand_overs(self._workplace, self._sizes, item)
        place = waiting_pose(self._workplace)
        return {item.name: Receiving(cell, self._tracker, model, PARTS, place)}
