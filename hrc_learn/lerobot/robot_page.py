"""Browser page that shows the arm of a LeRobot robot."""

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
            arm: Arm to show.
            host: Address to serve at.
            port: Port of the page; None: the first free one from 8080 on.
            note: Text shown on the page.
            guides: True if the person also guides the end effector, and not the body only.
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
