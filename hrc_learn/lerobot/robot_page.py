"""The page in a browser beside a robot of LeRobot's: it shows the arm where the robot is."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING

from hrc_learn.kinematics import Arm

if TYPE_CHECKING:
    from hrc_learn.lerobot.arm_robot import ArmRobot


class RobotPage:
    """Serves a page, and shows a robot on it: a simulated one with all that is around it.

    Attributes:
        page: Served until it is closed.
    """

    def __init__(
        self, arm: Arm, host: str, port: int | None, note: str, *, guides: bool = True
    ):
        """Serve it.

        Args:
            arm: That is shown.
            host: Address to serve at.
            port: To serve at; None: the first free one from 8080 on.
            note: What the page says.
            guides: Whether the person leads the end effector too, and not the body alone.
        """
        from hrc_learn.sim import MovingBodies, World
        from hrc_learn.sim.workplace import Workplace
        from hrc_learn.teleoperation.page import Page, PageConfig, PageStatus

        self._served = ExitStack()
        self._ghost = self._shown = World(Workplace.of(arm).scene)
        self._bodies = MovingBodies(self._ghost)
        drawn = self._bodies.drawn(*(poses[None] for poses in self._bodies.poses()))
        config = PageConfig(host=host, port=port)
        page = Page(arm.chain, drawn, self._ghost.config.boxes(), config, guides=guides)
        self.page = self._served.enter_context(page)
        self.page.show(PageStatus(title="LeRobot", note=note))

    def show(self, robot: ArmRobot) -> None:
        """Show where the arm is, and in simulation everything else as well."""
        from hrc_learn.sim import MovingBodies

        world = robot.world
        if world is None:
            state = robot.arm.read()
            world = self._ghost
            world.reset(state.joint_position, gripper_width=state.gripper_width)
        if world is not self._shown:
            self._shown, self._bodies = world, MovingBodies(world)
        self.page.place(*self._bodies.poses())

    def close(self) -> None:
        """Serve it no more."""
        self._served.close()
