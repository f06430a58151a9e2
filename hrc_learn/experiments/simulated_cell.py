"""The simulated work cell in which the trials of all three experiments run.

with simulated_cell(world, human=person, sensor=sensor) as simulated:
PickAndPlace(simulated.cell, ...).run(jobs)
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch

from hrc_learn.experiments.arm_access import SIMULATED, ArmAccess
from hrc_learn.experiments.elbow_pulls import Clearance
from hrc_learn.protocols import Human
from hrc_learn.sim import Imperfections, MotionLog, World
from hrc_learn.skills.grasping import GraspingConfig
from hrc_learn.skills.marker_sensor import LatencyConfig, MarkerSensor
from hrc_learn.skills.person_watch import PersonWatch
from hrc_learn.skills.placing import Plan, check_plan
from hrc_learn.skills.work_cell import WorkCell, WorkCellConfig
from hrc_learn.teleoperation.page import PageConfig
from hrc_learn.teleoperation.page_session import task_page

type LiveView = Callable[[WorkCell, World, MotionLog], AbstractContextManager[None]]
"""Context entered when a cell is ready to start and left when the run is over."""


def no_live_view(*_: object) -> AbstractContextManager[None]:
    """Live view that shows nothing."""
    return nullcontext()


@dataclass(frozen=True, kw_only=True)
class Observer:
    """Outputs of a run while it goes on; by default none."""

    view: LiveView = no_live_view
    """Live dashboard."""
    tell: Callable[[str], None] = lambda text: None
    """Shows a line about the next step."""

    def tell_phase(self, phase: str, time: float) -> None:
        """Show the name and start time [s] of a phase."""
        self.tell(f"  {time:6.2f} s  {phase}")


UNOBSERVED = Observer()


@dataclass(frozen=True, kw_only=True)
class SimulatedCell:
    """A work cell in simulation."""

    cell: WorkCell
    motion: MotionLog
    """Poses of everything that moves."""


@contextmanager
def simulated_cell(
    world: World,
    *,
    human: Human,
    sensor: MarkerSensor | None = None,
    config: WorkCellConfig | None = None,
    access: ArmAccess = SIMULATED,
    page: PageConfig | None = None,
    title: str = "Pick and place",
    observer: Observer = UNOBSERVED,
    on_phase: Callable[[str, float], None] = lambda phase, time: None,
    on_step: Callable[[], None] = lambda: None,
    rng: np.random.Generator | None = None,
    clearance: Clearance | None = None,
    watch: PersonWatch | None = None,
) -> Iterator[SimulatedCell]:
    """Connect a work cell to a world, without gradients, until the block ends.

    Args:
        world: World with arm, camera and objects, at rest.
        human: Scripted person.
        sensor: Camera with its marker detector; None for tasks without a camera.
        config: Configuration of the loop; the imperfections of the world and of the driver are
            added to it (`allow_for`).
        access: Access to the arm.
        page: Serves a page on which people push and draw too, in real time; None: no page.
        title: Title of that page.
        observer: Live dashboard and messages.
        on_phase: Called with name and start time [s] of each phase.
        on_step: Called after each step of the world.
        rng: Decides which images are lost.
        clearance: Distance between the arm and its surroundings, kept when it is pushed.
        watch: Watches for people near the arm.
    """
    config = allow_for(config or WorkCellConfig(), access.declared(world.imperfections.sizes))
    with torch.inference_mode(), ExitStack() as stack:
        opened = stack.enter_context(access.open(world))
        motion = MotionLog(world, opened.advance)

        def advance(duration: float) -> None:
            motion.advance(duration)
            on_step()

        people, advance_all, task = human, advance, None
        if page is not None:
            announce = partial(_tell_address, observer)
            task = stack.enter_context(task_page(world, config.dt, page, announce, title))
            people, advance_all = task.joined(human, advance)
        cell = WorkCell(
            chain=world.arm.robot.chain,
            arm=opened.arm,
            gripper=opened.gripper,
            sensor=sensor,
            human=people,
            advance=advance_all,
            config=config,
            on_phase=on_phase,
            rng=rng,
            clearance=clearance,
            watch=watch,
        )
        if task is not None:
            task.follow(cell)
        stack.enter_context(observer.view(cell, world, motion))
        yield SimulatedCell(cell=cell, motion=motion)


def _tell_address(observer: Observer, address: str) -> None:
    observer.tell(f"Page at {address}")


def allow_for(config: WorkCellConfig, sizes: Imperfections) -> WorkCellConfig:
    """Configuration of a loop that allows for the delays, losses and braking of its plant."""
    latency = LatencyConfig(
        delay=max(config.latency.delay, sizes.image_delay),
        frame_loss=max(config.latency.frame_loss, sizes.image_loss),
    )
    return replace(
        config,
        latency=latency,
        safety=sizes.plant(config.safety),
        command_delay=sizes.following_delay,
    )


def grasping_allows_for(config: GraspingConfig, sizes: Imperfections) -> GraspingConfig:
    """Grasping whose controller allows for the plant in its own safety filter."""
    safety = sizes.plant(config.controller.safety)
    return replace(config, controller=replace(config.controller, safety=safety))


def plan_checker(world: World) -> Callable[[Plan], None]:
    """Function that raises `BlockedPathError` if a plan with the held object collides."""

    def check(plan: Plan) -> None:
        held = (item.name for item in world.config.objects if world.holds(item.name))
        check_plan(plan, world, next(held, None))

    return check
