"""Who leads a Panda as a LeRobot teleoperator: a script, or a person in a browser."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from lerobot.utils.errors import DeviceNotConnectedError

from hrc_learn.kinematics import panda
from hrc_learn.lerobot.panda_robot import (
    DOWN,
    JOINTS,
    ActionSpace,
    Device,
    PandaRobot,
    action_names,
    action_of,
    robot_registry,
)
from hrc_learn.lerobot.robot_page import RobotPage
from hrc_learn.lerobot.robots import MujocoPanda
from hrc_learn.protocols import ArmState, Human, HumanInput

if TYPE_CHECKING:
    from hrc_learn.teleoperation.page import Page


# How far the positions may be ahead of the arm [rad]: one that is blocked is not wound up.
_SLACK = 0.05


class GuidedRobot:
    """Turns what a person asks for into positions that an arm is sent to, one after another.

    Attributes:
        robot: That is led.
        initial_configuration: Number of the robot's that it started from.
    """

    def __init__(self, robot: PandaRobot, human: Human):
        """Begin where the arm is.

        Args:
            robot: That is led.
            human: Who leads it.
        """
        from hrc_learn.teleoperation.hand_guiding import HandGuidedArm, HandGuidingConfig

        self.robot, self.initial_configuration = robot, robot.initial_configurations
        self._velocity = np.zeros(len(JOINTS))
        self._guided = HandGuidedArm(panda, self, human, HandGuidingConfig(dt=robot.dt))
        state = robot.read_state()
        self._joints, self._width = state.joint_position.copy(), state.gripper_width
        self._rotation = DOWN

    def read(self) -> ArmState:
        """The arm's newest reading."""
        return self.robot.read_state()

    def command(self, joint_velocity: Float[np.ndarray, " joints"]) -> None:
        """Keep the velocity that the arm should have [rad/s]."""
        self._velocity = joint_velocity

    def next(self) -> tuple[dict[str, float], HumanInput]:
        """The action that comes next, and what was asked for."""
        with torch.inference_mode():
            step = self._guided.step()
        here = step.state.joint_position
        self._joints = here + np.clip(self._joints - here, -_SLACK, _SLACK)
        self._joints = self._joints + self._velocity * self.robot.dt
        if step.human_input.gripper is not None:
            self._width = step.human_input.gripper
        action = action_of(self.robot.space, self._joints, self._width, self._rotation)
        if self.robot.space == "ee":
            self._rotation = np.array(list(action.values())[3:6])
        return action, step.human_input


@dataclass(kw_only=True)
class PandaTeleoperatorConfig(TeleoperatorConfig):
    """Settings of all who lead one of our Pandas."""

    robot_id: str | None = None
    """Which robot to lead, where several are connected."""


class PandaTeleoperator(Device, Teleoperator):
    """What those who lead one of our Pandas have in common."""

    def __init__(self, config: PandaTeleoperatorConfig):
        super().__init__(config)
        self._robot_id = config.robot_id
        self._guided: GuidedRobot | None = None

    @property
    def action_features(self) -> dict[str, type]:
        space: ActionSpace = "joint"
        with suppress(DeviceNotConnectedError):  # LeRobot asks before it connects the robot
            space = self._find().space
        return dict.fromkeys(action_names(space), float)

    @property
    def feedback_features(self) -> dict[str, type]:
        return {}

    def send_feedback(self, feedback: dict[str, object]) -> None:
        """Nothing is felt."""

    def _open(self) -> None:
        """Nothing is held beside what is guided."""

    def _close(self) -> None:
        self._guided = None

    def _guided_robot(self, robot: PandaRobot, human: Callable[[], Human]) -> GuidedRobot:
        """The guided robot, anew whenever everything has been put in place."""
        guided = self._guided
        if (
            guided is None
            or guided.robot is not robot
            or guided.initial_configuration != robot.initial_configurations
        ):
            guided = self._guided = GuidedRobot(robot, human())
        return guided

    def _find(self) -> PandaRobot:
        """The robot that is guided, which is connected after its teleoperator."""
        return robot_registry().find(self._robot_id)


@TeleoperatorConfig.register_subclass("panda_expert")
@dataclass(kw_only=True)
class PandaExpertConfig(PandaTeleoperatorConfig):
    """The script that shows a `mujoco_panda` its scenario; `--teleop.type=panda_expert`."""


class PandaExpert(PandaTeleoperator):
    """Shows a `mujoco_panda` its scenario from each initial configuration, then keeps still.

    The same demonstrations as `hrc record placing` records, with the release of the
    object, and grasping.
    """

    config_class = PandaExpertConfig
    name = "panda_expert"

    def get_action(self) -> dict[str, float]:
        self._need_connection()
        robot = self._find()
        if not isinstance(robot, MujocoPanda):
            raise ValueError(
                f"panda_expert knows the scenarios of a mujoco_panda only, not of {robot.name}."
            )
        return self._guided_robot(robot, lambda: robot.run.expert).next()[0]


@TeleoperatorConfig.register_subclass("panda_page")
@dataclass(kw_only=True)
class PandaPageConfig(PandaTeleoperatorConfig):
    """A person who leads a Panda in a browser; `--teleop.type=panda_page`."""

    host: str = "127.0.0.1"
    """Address to serve the page at. Whoever reaches it can move the arm."""
    port: int | None = None
    """Port to serve at; the first free one from 8080 on if None."""


class PandaPage(PandaTeleoperator):
    """A person leads the end effector, the elbow and the gripper in a browser.

    Shows the arm where the robot reports it, simulated or real. "Home" begins the scenario of a
    `mujoco_panda` anew; what concerns recording is left to LeRobot.

    Attributes:
        page: While connected.
    """

    config_class = PandaPageConfig
    name = "panda_page"
    page: Page
    _shown: RobotPage

    def __init__(self, config: PandaPageConfig):
        super().__init__(config)
        self.config = config

    def _open(self) -> None:
        note = "LeRobot records: its own keys begin and end episodes"
        self._shown = RobotPage(self.config.host, self.config.port, note)
        self.page = self._shown.page

    def _close(self) -> None:
        super()._close()
        self._shown.close()

    def get_action(self) -> dict[str, float]:
        self._need_connection()
        robot = self._find()
        action, asked = self._guided_robot(robot, lambda: self.page.human).next()
        self._shown.show(robot)
        if "home" in asked.requests and isinstance(robot, MujocoPanda):
            robot.begin(robot.run.seed + 1)
        return action
