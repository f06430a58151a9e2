"""The page in a browser as a LeRobot teleoperator."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING

from hrc_learn.lerobot.robots import MujocoPanda
from hrc_learn.lerobot.robots.panda_robot import PandaRobot
from hrc_learn.lerobot.teleoperators.config_panda_page import PandaPageConfig
from hrc_learn.lerobot.teleoperators.panda_teleoperator import PandaTeleoperator

if TYPE_CHECKING:
    from hrc_learn.sim import MovingBodies, World
    from hrc_learn.teleoperation.page import Page

_NOTE = "LeRobot records: its own keys begin and end episodes"


class PandaPage(PandaTeleoperator):
    """A person leads the hand, the body and the gripper in a browser.

    Shows the arm where the robot reports it, simulated or real. "Home" begins the scenario of a
    `mujoco_panda` anew; what concerns recording is left to LeRobot.

    Attributes:
        page: While connected.
    """

    config_class = PandaPageConfig
    name = "panda_page"
    page: Page
    _bodies: MovingBodies
    _ghost: World
    _shown: World

    def __init__(self, config: PandaPageConfig):
        super().__init__(config, config.robot_id)
        self.config = config
        self._served = ExitStack()

    def _open(self) -> None:
        from hrc_learn.kinematics import panda
        from hrc_learn.sim import MovingBodies, World
        from hrc_learn.teleoperation.page import Page, PageConfig, PageStatus

        self._ghost = self._shown = World()
        self._bodies = MovingBodies(self._ghost)
        drawn = self._bodies.drawn(*(poses[None] for poses in self._bodies.poses()))
        config = PageConfig(host=self.config.host, port=self.config.port)
        page = Page(panda, drawn, self._ghost.config.boxes(), config)
        self.page = self._served.enter_context(page)
        self.page.show(PageStatus(title="LeRobot", note=_NOTE))

    def _close(self) -> None:
        super()._close()
        self._served.close()

    def get_action(self) -> dict[str, float]:
        self._need_connection()
        robot = self._find()
        action, asked = self._guided_robot(robot, lambda: self.page.human).next()
        self._show(robot)
        if "home" in asked.requests and isinstance(robot, MujocoPanda):
            robot.begin(robot.run.seed + 1)
        return action

    def _show(self, robot: PandaRobot) -> None:
        """Show where the arm is, and in simulation everything else as well."""
        from hrc_learn.sim import MovingBodies

        world = robot.run.world if isinstance(robot, MujocoPanda) else self._ghost
        if world is self._ghost:
            state = robot.read_state()
            self._ghost.reset(state.joint_position, gripper_width=state.gripper_width)
        if world is not self._shown:
            self._shown, self._bodies = world, MovingBodies(world)
        self.page.place(*self._bodies.poses())
