"""The simulated work cell of all three experiments, and the access to its arm.

access = access_by("franky", panda)
with simulated_cell(world, human=person, sensor=sensor, access=access) as (cell, _):
    PickAndPlace(cell, ...).run(jobs)
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, nullcontext
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch

from hrc_learn.controller.null_space_motion import Clearance
from hrc_learn.hardware import FrankaArm, FrankaConfig, FrankyArm, FrankyConfig
from hrc_learn.hardware.protocol_server import ArmServer, ServedArm, serve_world
from hrc_learn.kinematics import Arm
from hrc_learn.log import LoggedSteps
from hrc_learn.protocols import Human, OpenedArm
from hrc_learn.sim import Imperfections, MotionLog, World
from hrc_learn.skills.marker_sensor import FeatureSensor, LatencyConfig
from hrc_learn.skills.person_watch import PersonWatch
from hrc_learn.skills.placing import Plan, check_plan
from hrc_learn.skills.work_cell import WorkCell, WorkCellConfig
from hrc_learn.teleoperation import CombinedInput
from hrc_learn.teleoperation.page import PageConfig
from hrc_learn.teleoperation.page_session import TaskPage

type Serve = Callable[[World], AbstractContextManager[ArmServer]]
"""Function that serves the arm of a world over its network protocol, such as `serve_world`."""
ArmDriver = Literal["sim", "franky", "franka"]
"""Driver of a simulated arm: the simulator itself, or a driver of the real arm."""

PROTOCOL_DELAY = 0.003
"""Delay from a command to a driver until the servos receive it [s]: two cycles of the protocol,
and a third because the state that was read is one cycle old. Measured with commands every 10
ms.
"""


@dataclass(frozen=True, kw_only=True)
class ArmAccess:
    """Connection to the arm of a world, with the delay and dynamics of its driver.

    With a driver, the same task uses all software that a real arm needs: the driver package,
    its sockets, and the 1 ms cycles of the protocol. The simulated world responds to these
    cycles.
    """

    open: Callable[[World], AbstractContextManager[OpenedArm]]
    """Connects to the arm of a world at rest; the connection lasts until the run ends."""
    delay: float = 0.0
    """Delay from a command until the servos of the arm receive it [s]."""
    dynamics: float = 1.0
    """Fraction of the arm's acceleration limits that the driver uses."""

    def declared(self, sizes: Imperfections) -> Imperfections:
        """Imperfections that a controller must allow for: those of arm and driver."""
        return replace(
            sizes,
            command_delay=sizes.command_delay + self.delay,
            slowness=max(sizes.slowness, 1 - self.dynamics),
        )


SIMULATED = ArmAccess(open=lambda world: nullcontext(world.opened_arm))
"""Direct access to the simulated arm."""


def access_by(
    driver: ArmDriver,
    robot: Arm,
    *,
    dynamics: float = FrankyConfig.dynamics,
    serve: Serve = serve_world,
) -> ArmAccess:
    """Access to the arm of a world through a named driver.

    Args:
        driver: Name of the driver.
        robot: Arm of the world.
        dynamics: Fraction of the arm's acceleration limits that a real driver uses.
        serve: Serves the arm over its network protocol.

    Raises:
        ValueError: If the driver does not support the arm.
    """
    if driver == "sim":
        return SIMULATED
    if not robot.is_franka:
        text = f"--arm {driver} drives Franka arms only, not the {robot.name}: leave it out to"
        raise ValueError(f"{text} simulate without a driver.")

    def connected(address: str) -> Any:
        # No real-time check: the simulated server waits for each answer.
        if driver == "franky":
            # The grip force of the simulated gripper.
            config = FrankyConfig(realtime=False, grip_force=40.0, dynamics=dynamics)
            return FrankyArm(address, config)
        return FrankaArm(
            address, robot, FrankaConfig(realtime=False, lockstep=True, dynamics=dynamics)
        )

    @contextmanager
    def open_arm(world: World) -> Iterator[OpenedArm]:
        with serve(world) as server:
            with server.running():
                opened = connected(server.address)
            with closing(ServedArm(opened, server)) as arm:
                yield OpenedArm(arm=arm, gripper=arm, advance=server.advance)

    return ArmAccess(open=open_arm, delay=PROTOCOL_DELAY, dynamics=dynamics)


type LiveView = Callable[[WorkCell, World, MotionLog], AbstractContextManager[None]]
"""Context entered when a cell is ready to start and left when the run is over."""


@dataclass(frozen=True, kw_only=True)
class Observer:
    """Outputs during a run; by default none."""

    view: LiveView = lambda *_: nullcontext()
    """Live dashboard."""
    tell: Callable[[str], None] = lambda text: None
    """Shows a line about the next step."""


UNOBSERVED = Observer()


@dataclass(frozen=True, kw_only=True, eq=False)
class CellRun:
    """One run of a work cell, successful or not."""

    world: World
    """World at the end of the run."""
    cell: WorkCell
    motion: MotionLog
    """Poses of everything that moved."""
    failure: str = ""
    """Reason why the robot gave up; empty if it did not. Metrics are evaluated separately."""

    @property
    def log(self) -> LoggedSteps:
        """All columns of the control loop."""
        return self.cell.log


@contextmanager
def simulated_cell(
    world: World,
    *,
    human: Human,
    sensor: FeatureSensor | None = None,
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
) -> Iterator[tuple[WorkCell, MotionLog]]:
    """Connect a work cell to a world, without gradients, until the block ends.

    Yields the cell, and the poses of everything that moves in the world.

    Args:
        world: World with arm, camera and objects, at rest.
        human: Scripted person.
        sensor: Camera that finds tool and objects; None for tasks without a camera.
        config: Configuration of the loop; its delays, losses and braking are adapted to those
            of the world and of the driver.
        access: Access to the arm.
        page: Page, served in real time, on which users can also push and draw; None: no page.
        title: Title of that page.
        observer: Live dashboard and messages.
        on_phase: Called with name and start time [s] of each phase.
        on_step: Called after each step of the world.
        rng: Random generator that decides which images are lost.
        clearance: Returns the arm's distance from itself and its surroundings; a pushed arm
            keeps a margin.
        watch: Watches for people near the arm.
    """
    config, plant = config or WorkCellConfig(), access.declared(world.imperfections.sizes)
    latency = LatencyConfig(
        delay=max(config.latency.delay, plant.image_delay),
        frame_loss=max(config.latency.frame_loss, plant.image_loss),
    )
    config = replace(
        config,
        latency=latency,
        safety=plant.plant(config.safety),
        command_delay=plant.following_delay,
    )
    with torch.inference_mode(), ExitStack() as stack:
        opened = stack.enter_context(access.open(world))
        motion = MotionLog(world, opened.advance)

        task = None
        if page is not None:
            task = stack.enter_context(TaskPage(world, config.dt, page, title))
            observer.tell(f"Page at {task.url}")
            human = CombinedInput(human, task.human)

        def advance(duration: float) -> None:
            motion.advance(duration)
            on_step()
            if task is not None:
                task.tick()

        cell = WorkCell(
            chain=world.arm.robot.chain,
            arm=opened.arm,
            gripper=opened.gripper,
            sensor=sensor,
            human=human,
            advance=advance,
            config=config,
            on_phase=on_phase,
            rng=rng,
            clearance=clearance,
            watch=watch,
        )
        if task is not None:
            task.cell = cell
        stack.enter_context(observer.view(cell, world, motion))
        yield cell, motion


def plan_checker(world: World) -> Callable[[Plan], None]:
    """Function that raises `BlockedPathError` if a plan with the held object collides."""

    def check(plan: Plan) -> None:
        check_plan(plan, world, next(iter(world.held()), None))

    return check
