"""Hand guiding of an arm, passed on as positions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from lerobot.utils.errors import DeviceNotConnectedError

from hrc_learn.kinematics import panda
from hrc_learn.lerobot.panda_device import Device, robot_registry
from hrc_learn.lerobot.panda_features import DOWN, JOINTS, ActionSpace, action_names, action_of
from hrc_learn.lerobot.robots.panda_robot import PandaRobot
from hrc_learn.protocols import ArmState, Human, HumanInput


class GuidedRobot:
    """Turns what a person asks for into positions that an arm is sent to, one after another.

    Attributes:
        robot: That is led.
        beginning: Of the robot's, that it started from.
    """

    def __init__(self, robot: PandaRobot, human: Human):
        """Begin where the arm is.

        Args:
            robot: That is led.
            human: Who leads it.
        """
        from hrc_learn.teleoperation.hand_guiding import HandGuidedArm, HandGuidingConfig

        self.robot, self.beginning = robot, robot.beginnings
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
        # A blocked arm is not to be wound up.
        self._joints = here + np.clip(self._joints - here, -_SLACK, _SLACK)
        self._joints = self._joints + self._velocity * self.robot.dt
        if step.human_input.gripper is not None:
            self._width = step.human_input.gripper
        action = action_of(self.robot.space, self._joints, self._width, self._rotation)
        if self.robot.space == "ee":
            self._rotation = np.array(list(action.values())[3:6])
        return action, step.human_input


_SLACK = 0.05
"""How far the positions may be ahead of the arm [rad]."""


class PandaTeleoperator(Device, Teleoperator):
    """What those who lead one of our Pandas have in common."""

    def __init__(self, config: TeleoperatorConfig, robot_id: str | None):
        super().__init__(config)
        self._robot_id = robot_id
        self._guided: GuidedRobot | None = None

    @property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys(action_names(self._space), float)

    @property
    def _space(self) -> ActionSpace:
        try:
            return self._find().space
        except DeviceNotConnectedError:
            return "joint"

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
        if guided is None or guided.robot is not robot or guided.beginning != robot.beginnings:
            guided = self._guided = GuidedRobot(robot, human())
        return guided

    def _find(self) -> PandaRobot:
        """The robot that is guided, which is connected after its teleoperator."""
        return robot_registry().find(self._robot_id)
