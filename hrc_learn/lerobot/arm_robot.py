"""Base class of arms as LeRobot robots, and warnings about poor recordings of an arm."""

from __future__ import annotations

import logging
import time
from abc import abstractmethod
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from lerobot.robots import Robot, RobotConfig
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected
from lerobot.utils.errors import DeviceNotConnectedError
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.kinematics import Arm as ArmModel
from hrc_learn.kinematics import SerialChain
from hrc_learn.lerobot.arm_values import DOWN, GRIPPER, HAND, ActionSpace, ArmValues
from hrc_learn.lerobot.person import PersonConfig, RobotPage, open_device
from hrc_learn.protocols import Arm, ArmState
from hrc_learn.teleoperation.demonstration_recorder import RecordingQuality, pressed

if TYPE_CHECKING:
    from hrc_learn.sim import World
    from hrc_learn.skills.arm_motion import PositionServo
    from hrc_learn.skills.complementary_motion import ComplementaryMotion

logger = logging.getLogger(__name__)

LATE = 1.5
"""Action periods after which an action counts as late: from then on, its time is nearer to the
next frame."""
PAUSE = 2.0
"""Time without an action [s] after which there is a pause, for example between two episodes,
and not just a late action."""
TOLERATED = 0.02
"""Largest fraction of late actions that causes no warning."""
EPISODE = 1.0
"""Shortest sequence of actions that is long enough for an episode, and is therefore checked for
motion [s]."""


class Device:
    """Mix-in for devices without calibration; list this base before LeRobot's base class."""

    _connected, is_calibrated = False, True

    @property
    def is_connected(self) -> bool:
        return self._connected

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Open the device.

        Raises:
            DeviceAlreadyConnectedError: The device is open already.
        """
        self._open()
        self._connected = True

    @check_if_not_connected
    def disconnect(self) -> None:
        """Close the device.

        Raises:
            DeviceNotConnectedError: The device is not open.
        """
        self._connected = False
        self._close()

    @abstractmethod
    def _open(self) -> None:
        """Open the device."""

    @abstractmethod
    def _close(self) -> None:
        """Close the device."""


class LoopWatch:
    """Checks recordings of an arm, and warns at the end of each sequence of actions.

    LeRobot stamps each frame with its number divided by the rate, not with the time of the
    recording: if actions came late, the arm seems to have moved faster than it did. LeRobot
    does not report when it records, nor when an episode ends. Therefore a sequence of actions
    is assumed to end with a pause, with the next reset of the scene, or when the robot is
    disconnected.
    """

    def __init__(
        self,
        name: str,
        fps: float,
        clock: Callable[[], float] = time.perf_counter,
        chain: SerialChain | None = None,
        *,
        in_real_time: bool = True,
    ):
        """Start without actions.

        Args:
            name: Name of the robot, for the warning.
            fps: Nominal actions a second.
            clock: Function that returns the time [s].
            chain: Kinematics of the arm, for checking joint limits; None skips this check.
            in_real_time: True if the arm keeps moving while the loop is late.
        """
        self._name, self._clock, self._in_real_time = name, clock, in_real_time
        self._fps, self._quality = fps, RecordingQuality(fps, chain)

    def tick(self, state: ArmState | None = None, touching: Collection[str] = ()) -> None:
        """Count an action.

        Args:
            state: Last reading of the arm; None: it was not read.
            touching: Unexpected contacts of the arm, as text.
        """
        now = self._clock()
        arrivals = self._quality.arrivals
        if self._in_real_time and arrivals and now - arrivals[-1] > PAUSE:
            self.end()
        if state is None:
            self._quality.arrivals.append(now)
        else:
            q, width = state.joint_position, state.gripper_width
            self._quality.add(now, state.time, q, width, touching)

    def end(self) -> None:
        """Warn of problems with the actions since the last call."""
        late, actions = self._quality.late(LATE), len(self._quality.arrivals)
        if self._in_real_time and len(late) > TOLERATED * actions:
            logger.warning(
                "%s: %d of %d actions came late, by %.0f ms at most: the recording lacks "
                "about %d frames, and moves faster there than the arm did. Record again with "
                "fewer or smaller images, a lower --dataset.fps, or no other load",
                self._name,
                len(late),
                actions,
                1e3 * (late.max() - 1 / self._fps),
                (np.rint(late * self._fps) - 1).sum(),
            )
        doubts = self._quality.met()
        if len(self._quality.states) >= EPISODE * self._fps:
            doubts.insert(0, self._quality.worthless())
        for doubt in filter(None, doubts):
            logger.warning("%s: in the recording, %s", self._name, doubt)
        self._quality.clear()


connected_robots: list[ArmRobot] = []
"""Connected robots of this process, in the order in which they were connected."""


def the_robot() -> ArmRobot:
    """The only connected robot, for its teleoperator.

    LeRobot gives a teleoperator no reference to the robot. But a teleoperator that guides the
    end effector needs the state of the arm.

    Raises:
        DeviceNotConnectedError: No robot or several robots are connected.
    """
    if len(connected_robots) != 1:
        names = ", ".join(map(str, connected_robots)) or "none"
        raise DeviceNotConnectedError(
            "this teleoperator needs exactly one connected robot of hrc_learn (such as "
            f"mujoco_arm or franka_panda); connected: {names}."
        )
    return connected_robots[0]


@dataclass(kw_only=True)
class ValuesConfig:
    """Commanded and observed values of an arm."""

    action_space: ActionSpace = "joint"
    """Space of actions: joint positions ("joint"), or the pose of the end effector ("ee")."""
    velocity: bool = False
    """Observe joint velocities."""
    hand: bool = False
    """Observe the pose of the end effector; always observed if actions command it."""


@dataclass(kw_only=True)
class ArmRobotConfig(ValuesConfig, RobotConfig):
    """Settings common to simulated and real arms."""

    fps: float = 50.0
    """Actions a second: the rate of the dataset, or of the rollout."""
    person: PersonConfig = field(default_factory=PersonConfig)
    """Person that guides the body while actions command the end effector."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_settings(self, positive=["fps"])


class ArmRobot(Device, Robot):
    """Arm commanded by joint positions or by the pose of its end effector.

    Actions of both spaces are accepted, and the gripper's opening may be omitted. This lets
    lerobot-rollout return the arm to its first position. Motions keep the limits of the joints
    and of the tool speed, but do not avoid obstacles. `send_action` returns the commanded
    values.

    With a person (`ArmRobotConfig.person`), actions command only the end effector, and the
    person guides the body (`ComplementaryMotion`).

    Attributes:
        work_arm: The arm with its gripper.
        values: Observed and commanded values, by name.
        space: Declared action space.
        dt: Time between actions [s].
        initial_configurations: Number of resets of the scene; only a simulation can be reset.
        complement: Combination with the person's input, while connected; None: there is no
            person.
        judged: True if the arm's motion may be recorded. Poor recordings then cause warnings.
    """

    in_real_time = True
    """True if the arm keeps moving while the loop is late."""
    complement: ComplementaryMotion | None = None
    _page: RobotPage | None = None

    def __init__(self, config: ArmRobotConfig, work_arm: ArmModel):
        super().__init__(config)
        if config.person.kind != "none" and work_arm.null_space == "none":
            raise ValueError(
                f"person.kind: a {work_arm.name} has no null space to guide: a full pose of "
                f'its end effector fixes the {work_arm.joints} joints. Choose "none".'
            )
        self.work_arm, self.values = work_arm, ArmValues(work_arm.chain)
        self.space: ActionSpace = config.action_space
        self.dt = 1.0 / config.fps
        self.cameras: dict[str, Any] = {}
        self.initial_configurations = 0
        self._names = (
            *self.values.joints,
            *(self.values.velocities if config.velocity else ()),
            *(HAND if config.hand or self.space == "ee" else ()),
            GRIPPER,
        )
        self._rotation = DOWN
        self._person_config = config.person
        self._loop = LoopWatch(
            str(self), config.fps, chain=work_arm.chain, in_real_time=self.in_real_time
        )
        self._state: ArmState | None = None
        self.judged = True

    @property
    def observation_features(self) -> dict[str, Any]:
        return dict.fromkeys((*self._names, *self.person_names), float)

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(self.values.action_names(self.space), float)

    @property
    def person_names(self) -> tuple[str, ...]:
        """Names of the observed values of the person's input."""
        return self._person_config.names(self.work_arm.chain)

    def connect(self, calibrate: bool = True) -> None:
        super().connect(calibrate)
        connected_robots.append(self)
        try:
            if self._person_config.kind != "none":
                self._invite(self._person_config)
        except BaseException:
            self.disconnect()
            raise

    @check_if_not_connected
    def disconnect(self) -> None:
        self._loop.end()
        connected_robots.remove(self)
        self.complement, page, self._page = None, self._page, None
        try:
            super().disconnect()
        finally:  # a page that failed raises its error
            if page is not None:
                page.close()

    @check_if_not_connected
    def get_observation(self) -> dict[str, Any]:
        state, names = self.arm.read(), self._names
        self._state = state
        values = self.values.observed(state, names, self._rotation)
        if HAND[0] in values:
            self._rotation = np.array([values[name] for name in HAND[3:]])
        if self.complement is not None:
            seen = self._seen(state)
            joints = [name for name in names if name not in HAND]
            values |= self.values.observed(seen, joints)
            values_of_person = (*self.complement.nullspace_input, *self.complement.offset)
            if self.person_names:
                values |= zip(self.person_names, map(float, values_of_person), strict=True)
        return values

    @check_if_not_connected
    def send_action(self, action: dict[str, Any]) -> dict[str, float]:
        self._judge()
        where, width = self.values.target_of(action)
        joints = self.servo.joints_at(where) if isinstance(where, Pose) else where
        if self.complement is not None:
            joints, width = self._with_person(self.complement, where, joints, width)
        sent = self._command(joints, width)
        return self.values.action_of(self.space, sent, width, self._rotation)

    def _judge(self) -> None:
        """Pass the reading of the arm that is recorded with this action to the loop watch."""
        if not self.judged:
            return
        state, self._state = self._state, None
        if state is None:
            self._loop.tick()
        else:
            self._loop.tick(state, (*self._touching(), *pressed(self.work_arm.chain, state)))

    def _touching(self) -> tuple[str, ...]:
        """Unexpected contacts of the arm since the last action, as text."""
        return ()

    @property
    @abstractmethod
    def arm(self) -> Arm:
        """Driver of the arm, for reading it."""

    @abstractmethod
    def _command(
        self, joints: Float[np.ndarray, " joints"], width: float
    ) -> Float[np.ndarray, " joints"]:
        """Send joints [rad] and gripper [m]; returns the joints that were sent [rad]."""

    @property
    @abstractmethod
    def servo(self) -> PositionServo:
        """Position servo of the arm."""

    @property
    def world(self) -> World | None:
        """Simulated world of the arm; None for a real arm."""
        return None

    @check_if_not_connected
    def read_state(self) -> ArmState:
        """Latest reading of the arm, for teleoperators."""
        return self._seen(self.arm.read())

    def clearance(
        self, joint_position: Float[Tensor, "*batch joints"]
    ) -> Float[Tensor, "*batch"]:
        """Distance of the arm from known obstacles [m]; for a real arm, only from itself."""
        return self.work_arm.whole.self_distance(joint_position)

    def _invite(self, config: PersonConfig) -> None:
        """Connect the input device of the person that guides the body."""
        from hrc_learn.controller.null_space_motion import YieldingConfig, guided_elbow_speed
        from hrc_learn.skills.complementary_motion import ComplementaryMotion

        human, self._page = open_device(config, self.work_arm)
        elbow_speed = guided_elbow_speed(self.servo.config.safety.tcp_speed)
        self.complement = ComplementaryMotion(
            self.work_arm.chain,
            human,
            self.dt,
            self.servo.limits,
            YieldingConfig(after_push=config.after_push, elbow_speed=elbow_speed),
            self.clearance,
        )

    def _with_person(
        self,
        complement: ComplementaryMotion,
        where: Float[np.ndarray, " joints"] | Pose,
        joints: Float[np.ndarray, " joints"],
        width: float,
    ) -> tuple[Float[np.ndarray, " joints"], float]:
        """Joint positions and gripper opening, with the person's motion of the body added."""
        from hrc_learn.skills.arm_motion import joints_near

        with torch.inference_mode():
            if isinstance(where, Pose) and complement.posture is not None:
                joints = joints_near(self.work_arm.chain, where, complement.posture).numpy()
            joints, width = complement.next(self.arm.read(), joints, width)
        if self._page is not None:
            self._page.show(self.arm, self.world)
        return joints, width

    def _seen(self, state: ArmState) -> ArmState:
        """The reading as observed: with the policy's own posture if `observed` is "posture"."""
        if self.complement is None or self._person_config.observed == "joints":
            return state
        return replace(
            state,
            joint_position=state.joint_position - self.complement.offset,
            joint_velocity=state.joint_velocity - self.complement.offset_velocity.numpy(),
        )
