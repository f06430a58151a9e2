"""The Panda as LeRobot sees it: names and units of its values, and what all its robots share.

Radians, metres and pixels; poses in the base frame as position and rotation vector. Names end
in `.pos` or `.vel` because lerobot-rollout hands on no others.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from lerobot.robots import Robot, RobotConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from torch import Tensor

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import gripper_down, panda, panda_capsules
from hrc_learn.lerobot.loop_watch import LoopWatch
from hrc_learn.lerobot.person import Person, PersonConfig
from hrc_learn.protocols import Arm, ArmState
from hrc_learn.teleoperation.recording_quality import pressed

if TYPE_CHECKING:
    from hrc_learn.sim import World
    from hrc_learn.skills.arm_motion import PositionServo
    from hrc_learn.skills.complementary_motion import ComplementaryMotion

JOINTS = tuple(f"{name}.pos" for name in panda.joint_names)
VELOCITIES = tuple(f"{name}.vel" for name in panda.joint_names)
HAND = tuple(f"ee.{axis}.pos" for axis in ("x", "y", "z", "wx", "wy", "wz"))
GRIPPER = "gripper.pos"
PIXELS = ("object.u.pos", "object.v.pos")
MARKER = ("marker.u.pos", "marker.v.pos", "marker.seen.pos")

ActionSpace = Literal["joint", "ee"]
"""Positions of the joints, or of the end effector; the gripper's opening in either case."""


def action_names(space: ActionSpace) -> tuple[str, ...]:
    """Names of an action's values, in order."""
    return (*(JOINTS if space == "joint" else HAND), GRIPPER)


DOWN = quaternion.log(gripper_down()).numpy()
"""Rotation vector of a gripper that points down, by which those of others are told [rad]."""


def action_of(
    space: ActionSpace,
    joints: Float[np.ndarray, "7"],
    width: float,
    near: Float[np.ndarray, "3"] = DOWN,
) -> dict[str, float]:
    """The action that sends the joints somewhere, and the gripper to an opening.

    Args:
        space: Of the action.
        joints: Positions [rad].
        width: Opening [m].
        near: Rotation vector before, which this one goes on from [rad].
    """
    values = joints if space == "joint" else hand_vector(joints, near)
    return dict(zip(action_names(space), (*map(float, values), float(width)), strict=True))


def hand_vector(
    joints: Float[np.ndarray, "7"], near: Float[np.ndarray, "3"] = DOWN
) -> Float[np.ndarray, "6"]:
    """Position [m] and rotation vector [rad] of the end effector.

    A gripper that points down is half a turn from the base, where the shortest rotation vector
    jumps from one side to the other; `near` picks the side.
    """
    pose = panda.forward(torch.from_numpy(np.asarray(joints, dtype=float)))
    vector = pose.vector()
    pair = torch.stack([torch.from_numpy(np.array(near, dtype=float)), vector[3:]])
    return torch.cat([vector[:3], quaternion.unwrap_log(pair)[1]]).numpy()


def target_of(action: Mapping[str, Any]) -> tuple[Float[np.ndarray, "7"] | Pose, float]:
    """Read an action of either space; names it does not know are passed over.

    Returns:
        Positions of the joints [rad] or pose of the end effector, and opening of the gripper
        [m], NaN where none is given.

    Raises:
        ValueError: Names are missing.
    """
    width = float(action.get(GRIPPER, np.nan))
    if all(name in action for name in HAND):
        vector = torch.tensor([float(action[name]) for name in HAND], dtype=torch.float64)
        return Pose.from_vector(vector), width
    missing = [name for name in JOINTS if name not in action]
    if missing:
        raise ValueError(
            f"an action for a Panda needs {', '.join(JOINTS)} or {', '.join(HAND)}, but lacks "
            f"{', '.join(missing)}."
        )
    return np.array([float(action[name]) for name in JOINTS]), width


def observed(
    state: ArmState, names: Sequence[str], near: Float[np.ndarray, "3"] = DOWN
) -> dict[str, float]:
    """Values of an arm's state by name.

    Args:
        state: Of the arm.
        names: Wanted, of those of this module but `PIXELS` and `MARKER`.
        near: Rotation vector of the end effector before [rad].
    """
    values = dict(zip(JOINTS, state.joint_position.tolist(), strict=True))
    values |= zip(VELOCITIES, state.joint_velocity.tolist(), strict=True)
    values[GRIPPER] = state.gripper_width
    if not {*HAND}.isdisjoint(names):
        values |= zip(HAND, hand_vector(state.joint_position, near).tolist(), strict=True)
    return {name: float(values[name]) for name in names}


class Device:
    """A device that has nothing to calibrate; to derive from before LeRobot's own class."""

    _connected = False

    @property
    def is_connected(self) -> bool:
        return self._connected

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    def connect(self, calibrate: bool = True) -> None:
        """Take hold of the device.

        Raises:
            DeviceAlreadyConnectedError: It is held already.
        """
        if self._connected:
            raise DeviceAlreadyConnectedError(f"{self} is connected already.")
        self._open()
        self._connected = True

    def disconnect(self) -> None:
        """Let it go.

        Raises:
            DeviceNotConnectedError: It is not held.
        """
        self._need_connection()
        self._connected = False
        self._close()

    def _need_connection(self) -> None:
        if not self._connected:
            raise DeviceNotConnectedError(f"{self} is not connected: call connect() first.")

    @abstractmethod
    def _open(self) -> None:
        """Take hold of it."""

    @abstractmethod
    def _close(self) -> None:
        """Let it go."""


class RobotRegistry:
    """The connected robots among which a teleoperator finds the one that it guides.

    LeRobot gives a teleoperator no reference to the robot. One that guides the end effector,
    rather than copying joints of its own, needs to know where the arm is.
    """

    def __init__(self) -> None:
        self._robots: list[PandaRobot] = []

    def __iter__(self) -> Iterator[PandaRobot]:
        """In the order in which they were connected."""
        return iter(tuple(self._robots))

    def add(self, robot: PandaRobot) -> None:
        """Note a robot that has been connected."""
        self._robots.append(robot)

    def remove(self, robot: PandaRobot) -> None:
        """Forget a robot that has been disconnected."""
        self._robots.remove(robot)

    def find(self, id: str | None) -> PandaRobot:
        """The robot with a name, or the only one.

        Raises:
            DeviceNotConnectedError: There is none, or several and no name is given.
        """
        found = [robot for robot in self._robots if id in (None, robot.id)]
        if len(found) == 1:
            return found[0]
        names = ", ".join(repr(robot.id) for robot in self._robots) or "none"
        wanted = "a robot of hrc_learn" if id is None else f"one robot with id {id!r}"
        raise DeviceNotConnectedError(
            f"this teleoperator guides {wanted} (mujoco_panda or franka_panda); connected: "
            f"{names}. Give --teleop.robot_id where there are several."
        )


@cache
def robot_registry() -> RobotRegistry:
    """The registry of this process, which robots and teleoperators share."""
    return RobotRegistry()


@dataclass(kw_only=True)
class PandaRobotConfig(RobotConfig):
    """Settings that the simulated and the real Panda share."""

    fps: float = 50.0
    """Actions a second: the rate of the dataset, or of the rollout."""
    action_space: ActionSpace = "joint"
    """What actions give: positions of the joints, or of the end effector ("ee")."""
    velocity: bool = False
    """Whether joint velocities are observed."""
    hand: bool = False
    """Whether the pose of the end effector is observed; it is where actions give it."""
    person: PersonConfig = field(default_factory=PersonConfig)
    """Who leads the body while actions lead the end effector."""


class PandaRobot(Device, Robot):
    """A Panda led by positions of its joints, or of its end effector.

    Actions of either space are obeyed, and values they do not name are left alone, so that
    lerobot-rollout's way back to the first position works as well. What an action asks for is
    done within the limits of the joints only; `send_action` returns what was done.

    With a person beside it (`PandaRobotConfig.person`) actions lead the end effector only, and
    the person the body, at the same time (`ComplementaryMotion`).

    Attributes:
        space: Of the actions that it declares.
        dt: Time between actions [s].
        initial_configurations: How often everything has been put in place, which only a
            simulation can.
        complement: Lets a person lead the body, while connected; None: there is none.
        judged: Whether what it does may be recorded, so that doubts are told.
    """

    complement: ComplementaryMotion | None = None

    def __init__(self, config: PandaRobotConfig):
        super().__init__(config)
        self.space: ActionSpace = config.action_space
        self.dt = 1.0 / config.fps
        self.cameras: dict[str, Any] = {}
        self.initial_configurations = 0
        self._names = (
            *JOINTS,
            *(VELOCITIES if config.velocity else ()),
            *(HAND if config.hand or self.space == "ee" else ()),
            GRIPPER,
        )
        self._rotation = DOWN
        self._person_config = config.person
        self._loop = LoopWatch(
            str(self), config.fps, chain=panda, in_real_time=self.in_real_time
        )
        self._state: ArmState | None = None
        self.judged = True

    @property
    def observation_features(self) -> dict[str, Any]:
        return dict.fromkeys((*self._names, *self.person_names), float)

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(action_names(self.space), float)

    @property
    def person_names(self) -> tuple[str, ...]:
        """Names of what is observed of the person."""
        return self._person_config.names

    def connect(self, calibrate: bool = True) -> None:
        super().connect(calibrate)
        if self._person_config.kind != "none":
            self._invite(self._person_config)
        robot_registry().add(self)

    def disconnect(self) -> None:
        self._need_connection()
        self._loop.end()
        robot_registry().remove(self)
        if self.complement is not None:
            self.complement = None
            self._person.close()
        super().disconnect()

    def get_observation(self) -> dict[str, Any]:
        self._need_connection()
        state, names = self.arm.read(), self._names
        self._state = state
        values = observed(state, names, self._rotation)
        if HAND[0] in values:
            self._rotation = np.array([values[name] for name in HAND[3:]])
        if self.complement is not None:
            seen = self._seen(state)
            joints = [name for name in names if name not in HAND]
            values |= observed(seen, joints)
            told = (*self.complement.nullspace_input, *self.complement.offset)
            if self.person_names:
                values |= zip(self.person_names, map(float, told), strict=True)
        return values

    def send_action(self, action: dict[str, Any]) -> dict[str, float]:
        self._need_connection()
        self._judge()
        where, width = target_of(action)
        joints = self._joints_at(where) if isinstance(where, Pose) else where
        if self.complement is not None:
            joints, width = self._beside_person(self.complement, where, joints, width)
        sent = self._command(joints, width)
        return action_of(self.space, sent, width, self._rotation)

    def _judge(self) -> None:
        """Tell the watch what is recorded with this action."""
        if not self.judged:
            return
        state, self._state = self._state, None
        if state is None:
            self._loop.tick()
        else:
            self._loop.tick(state, (*self._touching(), *pressed(panda, state)))

    def _touching(self) -> tuple[str, ...]:
        """What the arm has met since the last action that it should not, in words."""
        return ()

    @property
    @abstractmethod
    def arm(self) -> Arm:
        """The arm, to be read."""

    @abstractmethod
    def _joints_at(self, pose: Pose) -> Float[np.ndarray, "7"]:
        """Joint positions that bring the end effector to a pose [rad]."""

    @abstractmethod
    def _command(self, joints: Float[np.ndarray, "7"], width: float) -> Float[np.ndarray, "7"]:
        """Send joints [rad] and gripper [m]; where the joints are really sent [rad]."""

    @property
    @abstractmethod
    def servo(self) -> PositionServo:
        """Which leads the arm by positions."""

    @property
    def in_real_time(self) -> bool:
        """Whether the arm goes on moving while the loop is late."""
        return True

    @property
    def world(self) -> World | None:
        """The simulated world that it is in; None for a real one."""
        return None

    def read_state(self) -> ArmState:
        """The newest reading of the arm, for whoever leads it."""
        self._need_connection()
        return self._seen(self.arm.read())

    def clearance(self, joint_position: Float[Tensor, "*batch 7"]) -> Float[Tensor, "*batch"]:
        """Distance of the arm from what it must not meet, as far as that is known [m].

        A real arm knows of itself only.
        """
        return panda_capsules.self_distance(joint_position)

    def _invite(self, config: PersonConfig) -> None:
        """Let a person lead the body."""
        from hrc_learn.skills.complementary_motion import ComplementaryMotion
        from hrc_learn.skills.null_space_yielding import YieldingConfig

        self._person = Person(config)
        self.complement = ComplementaryMotion(
            panda,
            self._person,
            self.dt,
            self.servo.limits,
            YieldingConfig(after_push=config.after_push),
            self.clearance,
        )

    def _beside_person(
        self,
        complement: ComplementaryMotion,
        where: Float[np.ndarray, "7"] | Pose,
        joints: Float[np.ndarray, "7"],
        width: float,
    ) -> tuple[Float[np.ndarray, "7"], float]:
        """Joints and gripper, with the body where the person wants it."""
        from hrc_learn.skills.arm_motion import joints_near

        with torch.inference_mode():
            if isinstance(where, Pose) and complement.posture is not None:
                joints = joints_near(panda, where, complement.posture).numpy()
            joints, width = complement.next(self.arm.read(), joints, width)
        self._person.show(self)
        return joints, width

    def _seen(self, state: ArmState) -> ArmState:
        """What is told of a reading: the policy's own posture, if that is what it observes."""
        if self.complement is None or self._person_config.observed == "joints":
            return state
        return replace(
            state,
            joint_position=state.joint_position - self.complement.offset,
            joint_velocity=state.joint_velocity - self.complement.offset_velocity.numpy(),
        )
