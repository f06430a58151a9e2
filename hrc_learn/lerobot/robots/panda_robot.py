"""What the simulated and the real Panda have in common as LeRobot robots."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
from jaxtyping import Float
from lerobot.robots import Robot, RobotConfig

from hrc_learn.geometry import Pose
from hrc_learn.lerobot.panda_device import Device, robot_registry
from hrc_learn.lerobot.panda_features import (
    DOWN,
    GRIPPER,
    HAND,
    JOINTS,
    VELOCITIES,
    ActionSpace,
    action_names,
    action_of,
    observed,
    target_of,
)
from hrc_learn.protocols import Arm, ArmState


class PandaRobot(Device, Robot):
    """A Panda led by positions of its joints, or of its hand.

    Actions of either space are obeyed, and values they do not name are left alone, so that
    lerobot-rollout's way back to the first position works as well. What an action asks for is
    done within the limits of the joints only; `send_action` returns what was done.

    Attributes:
        space: Of the actions that it declares.
        dt: Time between actions [s].
        beginnings: How often everything has been put in place, which only a simulation can.
    """

    dt: float

    def __init__(self, config: RobotConfig, space: ActionSpace, *, velocity: bool, hand: bool):
        super().__init__(config)
        self.space: ActionSpace = space
        self.cameras: dict[str, Any] = {}
        self.beginnings = 0
        hand = hand or space == "ee"
        self._names = (
            *JOINTS,
            *(VELOCITIES if velocity else ()),
            *(HAND if hand else ()),
            GRIPPER,
        )
        self._rotation = DOWN

    @property
    def observation_features(self) -> dict[str, Any]:
        return dict.fromkeys(self._names, float)

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(action_names(self.space), float)

    def connect(self, calibrate: bool = True) -> None:
        super().connect(calibrate)
        robot_registry().add(self)

    def disconnect(self) -> None:
        self._need_connection()
        robot_registry().remove(self)
        super().disconnect()

    def get_observation(self) -> dict[str, Any]:
        self._need_connection()
        values = observed(self.arm.read(), self._names, self._rotation)
        if HAND[0] in values:
            self._rotation = np.array([values[name] for name in HAND[3:]])
        return values | self._further_values()

    def send_action(self, action: dict[str, Any]) -> dict[str, float]:
        self._need_connection()
        where, width = target_of(action)
        joints = self._joints_at(where) if isinstance(where, Pose) else where
        sent = self._command(joints, width)
        return action_of(self.space, sent, width, self._rotation)

    @property
    @abstractmethod
    def arm(self) -> Arm:
        """The arm, to be read."""

    @abstractmethod
    def _joints_at(self, pose: Pose) -> Float[np.ndarray, "7"]:
        """Joint positions that bring the hand to a pose [rad]."""

    @abstractmethod
    def _command(self, joints: Float[np.ndarray, "7"], width: float) -> Float[np.ndarray, "7"]:
        """Send joints [rad] and gripper [m]; where the joints are really sent [rad]."""

    def read_state(self) -> ArmState:
        """The newest reading of the arm, for whoever leads it."""
        self._need_connection()
        return self.arm.read()

    def _further_values(self) -> dict[str, float]:
        """Observed beside the arm's own."""
        return {}
