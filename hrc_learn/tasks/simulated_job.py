"""The collaboration in simulation: everything put together, run once, kept for evaluation."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
import torch

from ..human import BothHands, PullSpell, ScriptedPuller
from ..human.page import PageConfig
from ..kinematics import panda
from ..protocols import Human
from ..sim import CameraKind, MotionLog, ObjectConfig, World, open_camera
from .collaboration import INTERACT, Collaboration, CollaborationConfig, CollaborationResult
from .eye import Eye
from .failure import TaskFailedError
from .fit_aiming import AimingSkill
from .page_beside import page_beside
from .placing import PlacingSkill, Plan, check_plan
from .station import Station, StationConfig
from .watching import Watch, unwatched
from .workplace import Workplace

PULLS = (
    PullSpell(start=0.5, duration=4.5, towards=(0.40, 0.00, 0.50), strongest=60.0),
    PullSpell(start=5.5, duration=4.5, towards=(-0.10, 0.25, 0.60), strongest=60.0),
)
"""A worker reaches under the arm: the elbow is drawn aside, and let back."""

OBJECT_REACH = (0.10, 0.08, 0.0)
"""How far from the middle of the table objects lie [m]."""


@dataclass(frozen=True, kw_only=True)
class SimulatedJob:
    """One run, successful or not."""

    workplace: Workplace
    world: World
    """As it was left."""
    station: Station
    motion: MotionLog
    item: ObjectConfig
    shelf: str
    result: CollaborationResult | None
    """What the task reports; None if it failed."""
    failure: str = ""
    """Why it failed."""


def simulate_collaboration(
    aiming: AimingSkill,
    placing: PlacingSkill,
    shelf: str,
    *,
    workplace: Workplace | None = None,
    camera: CameraKind = "auto",
    pulls: Sequence[PullSpell] = PULLS,
    config: CollaborationConfig | None = None,
    seed: int = 0,
    page: PageConfig | None = None,
    watch: Watch = unwatched,
    on_phase: Callable[[str, float], None] = lambda phase, time: None,
    on_page: Callable[[str], None] = lambda address: None,
) -> SimulatedJob:
    """Grasp an object that lies at random and put it on a shelf, in MuJoCo.

    Args:
        aiming: Learned image Jacobian and visual target.
        placing: Learned placing motion.
        shelf: Where to put the object.
        workplace: Where.
        camera: Which kind of camera watches.
        pulls: At the body, in time since the robot gives the person time.
        config: How the job is done.
        seed: Of where the object lies, and of image noise.
        page: Serve a page from which people pull at the body too, and let the world go on in
            real time; None: no page.
        watch: Watches from the side, such as `serving` a dashboard.
        on_phase: Told the name of each phase of the task, and when it begins [s].
        on_page: Told the address of the page.

    Raises:
        ValueError: If there is no such shelf, or the arm cannot reach it.
    """
    workplace, rng = workplace or Workplace(), np.random.default_rng(seed)
    workplace.shelf(shelf)
    item = workplace.scene.objects[0]
    world = World(workplace.scene)
    pose = workplace.random_object_pose(OBJECT_REACH, rng)
    world.reset(workplace.home_joints().numpy(), {item.name: pose})
    person = ScriptedPuller(panda, pulls, begin=None)
    motion = MotionLog(world)

    def enter(phase: str, time: float) -> None:
        on_phase(phase, time)
        if phase == INTERACT:
            person.begin(time)

    def check(plan: Plan) -> None:
        check_plan(plan, world, item.name if world.holds(item.name) else None)

    result, failure = None, ""
    with torch.inference_mode(), ExitStack() as stack:
        human, advance = person, motion.advance
        if page is not None:
            opened = page_beside(world, StationConfig().dt, page, on_page)
            human, advance = _joined(person, motion.advance, *stack.enter_context(opened))
        station = Station(
            chain=panda,
            arm=world.arm,
            gripper=world.arm,
            eye=Eye.on(open_camera(world, camera, rng=rng), workplace.scene),
            human=human,
            advance=advance,
            on_phase=enter,
        )
        stack.enter_context(watch(station, world, motion))
        task = Collaboration(station, workplace, aiming, placing, check, config)
        try:
            result = task.run(item, shelf)
        except TaskFailedError as error:
            failure = str(error)
    return SimulatedJob(
        workplace=workplace,
        world=world,
        station=station,
        motion=motion,
        item=item,
        shelf=shelf,
        result=result,
        failure=failure,
    )


def _joined(
    person: Human, advance: Callable[[float], None], at_page: Human, tick: Callable[[], None]
) -> tuple[Human, Callable[[float], None]]:
    """The person of the script with those at the page, and time that passes for both."""

    def advance_and_show(duration: float) -> None:
        advance(duration)
        tick()

    return BothHands(person, at_page), advance_and_show
