"""LeRobot teleoperators: a scripted demonstrator, or a person at the browser page."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from lerobot.utils.decorators import check_if_not_connected
from lerobot.utils.errors import DeviceNotConnectedError

from hrc_learn.kinematics import Arm, panda
from hrc_learn.lerobot.arm_robot import ArmRobot, Device, the_robot
from hrc_learn.lerobot.arm_values import DOWN, ArmValues
from hrc_learn.lerobot.mujoco_arm import MujocoArmRobot
from hrc_learn.lerobot.person import RobotPage
from hrc_learn.protocols import ArmState, Human, HumanInput

if TYPE_CHECKING:
    from hrc_learn.teleoperation.page import Page


# Largest lead of commanded positions over the arm [rad]; it prevents windup while the arm is
# blocked.
_SLACK = 0.05


class GuidedRobot:
    """Turns the motion that a person requests into successive actions of an arm.

    Attributes:
        robot: Guided robot.
        initial_configuration: Number of the robot's initial configuration at the start.
    """

    def __init__(self, robot: ArmRobot, human: Human):
        """Start at the present pose of the arm.

        Args:
            robot: Guided robot.
            human: Person that guides it.
        """
        from hrc_learn.teleoperation.hand_guiding import HandGuidedArm, HandGuidingConfig

        self.robot, self.initial_configuration = robot, robot.initial_configurations
        state, chain = robot.read_state(), robot.values.chain
        self._velocity = np.zeros_like(state.joint_position)
        self._guided = HandGuidedArm(chain, self, human, HandGuidingConfig(dt=robot.dt))
        self._joints, self._width = state.joint_position.copy(), state.gripper_width
        self._rotation = DOWN

    def read(self) -> ArmState:
        """The arm's newest reading."""
        return self.robot.read_state()

    def command(self, joint_velocity: Float[np.ndarray, " joints"]) -> None:
        """Store the velocity for the next action [rad/s]."""
        self._velocity = joint_velocity

    def next(self) -> tuple[dict[str, float], HumanInput]:
        """Next action, and the input of the person that led to it."""
        with torch.inference_mode():
            step = self._guided.step()
        here = step.state.joint_position
        self._joints = here + np.clip(self._joints - here, -_SLACK, _SLACK)
        self._joints = self._joints + self._velocity * self.robot.dt
        if step.human_input.gripper is not None:
            self._width = step.human_input.gripper
        space, values = self.robot.space, self.robot.values
        action = values.action_of(space, self._joints, self._width, self._rotation)
        if space == "ee":
            self._rotation = np.array(list(action.values())[3:6])
        return action, step.human_input


class ArmTeleoperator(Device, Teleoperator):
    """Common part of the teleoperators of our arms."""

    _guided: GuidedRobot | None = None

    @property
    def action_features(self) -> dict[str, type]:
        names = ArmValues(panda.chain).action_names("joint")
        with suppress(DeviceNotConnectedError):  # LeRobot asks before it connects the robot
            names = tuple(the_robot().action_features)
        return dict.fromkeys(names, float)

    @property
    def feedback_features(self) -> dict[str, type]:
        return {}

    def send_feedback(self, feedback: dict[str, object]) -> None:
        """Do nothing: there is no haptic feedback."""

    def _open(self) -> None:
        """Do nothing: the guided robot is found at the first action."""

    def _close(self) -> None:
        self._guided = None

    def _guided_robot(self, robot: ArmRobot, human: Callable[[], Human]) -> GuidedRobot:
        """The guided robot, created again after each reset of the scene."""
        guided, now = self._guided, (robot, robot.initial_configurations)
        if guided is None or (guided.robot, guided.initial_configuration) != now:
            guided = self._guided = GuidedRobot(robot, human())
        return guided


@TeleoperatorConfig.register_subclass("arm_expert")
@dataclass(kw_only=True)
class ArmExpertConfig(TeleoperatorConfig):
    """Scripted demonstrator of a `mujoco_arm`; `--teleop.type=arm_expert`."""


class ArmExpert(ArmTeleoperator):
    """Demonstrates the scenario of a `mujoco_arm` from each initial configuration, then rests.

    Demonstrations of placing are those of `hrc record placing`, plus the release of the object.
    """

    config_class = ArmExpertConfig
    name = "arm_expert"

    @check_if_not_connected
    def get_action(self) -> dict[str, float]:
        robot = the_robot()
        if not isinstance(robot, MujocoArmRobot):
            raise ValueError(f"arm_expert knows scenarios of mujoco_arm, not of {robot.name}.")
        return self._guided_robot(robot, lambda: robot.run.expert).next()[0]


@TeleoperatorConfig.register_subclass("arm_page")
@dataclass(kw_only=True)
class ArmPageConfig(TeleoperatorConfig):
    """Person that guides an arm in a browser; `--teleop.type=arm_page`."""

    host: str = "127.0.0.1"
    """Address of the page. Anyone that can reach this address can move the arm."""
    port: int | None = None
    """Port of the page; None: the first free one from 8080 on."""


class ArmPage(ArmTeleoperator):
    """Browser page on which a person guides the end effector, the elbow and the gripper.

    The page shows the simulated or real arm as the robot reports it. "Home" restarts the
    scenario of a `mujoco_arm`. LeRobot controls the recording.

    Attributes:
        page: The page, while connected.
    """

    config_class = ArmPageConfig
    name = "arm_page"
    page: Page
    _shown: RobotPage
    _arm: Arm

    def __init__(self, config: ArmPageConfig):
        super().__init__(config)
        self.config = config

    def _open(self) -> None:
        arm = panda
        with suppress(DeviceNotConnectedError):  # LeRobot may connect the robot later
            arm = the_robot().work_arm
        self._serve(arm)

    def _serve(self, arm: Arm) -> None:
        note = "LeRobot records: its own keys begin and end episodes"
        self._shown = RobotPage(arm, self.config.host, self.config.port, note)
        self._arm, self.page = arm, self._shown.page

    def _close(self) -> None:
        super()._close()
        self._shown.close()

    @check_if_not_connected
    def get_action(self) -> dict[str, float]:
        robot = the_robot()
        if robot.work_arm is not self._arm:
            self._shown.close()
            self._serve(robot.work_arm)
        action, asked = self._guided_robot(robot, lambda: self.page.human).next()
        self._shown.show(robot.arm, robot.world)
        if "home" in asked.requests and isinstance(robot, MujocoArmRobot):
            robot.begin(robot.run.seed + 1)
        return action
