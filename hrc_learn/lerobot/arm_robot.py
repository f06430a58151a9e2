"""Arms as LeRobot robots: names and units of their values, and the base class of all robots.

Units are radians, metres and pixels; poses are in the base frame, as position and rotation
vector. Names end in `.pos` or `.vel` because lerobot-rollout passes on no others.
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
from hrc_learn.kinematics import Arm as ArmModel
from hrc_learn.kinematics import SerialChain, gripper_down
from hrc_learn.lerobot.loop_watch import LoopWatch
from hrc_learn.lerobot.person import Person, PersonConfig
from hrc_learn.protocols import Arm, ArmState
from hrc_learn.teleoperation.recording_quality import pressed

if TYPE_CHECKING:
    from hrc_learn.sim import World
    from hrc_learn.skills.arm_motion import PositionServo
    from hrc_learn.skills.complementary_motion import ComplementaryMotion

HAND = tuple(f"ee.{axis}.pos" for axis in ("x", "y", "z", "wx", "wy", "wz"))
GRIPPER = "gripper.pos"
PIXELS = ("object.u.pos", "object.v.pos")
MARKER = ("marker.u.pos", "marker.v.pos", "marker.seen.pos")

ActionSpace = Literal["joint", "ee"]
"""Positions of the joints, or of the end effector; the gripper's opening in either case."""

DOWN = quaternion.log(gripper_down()).numpy()
"""Rotation vector of a gripper that points down, the reference for choosing the signs of others
[rad].
"""


class ArmValues:
    """The values of an arm by their names: those of its joints are called as the joints are.

    Attributes:
        chain: Kinematics of the arm.
        joints: Names of the joints' positions [rad].
        velocities: Names of their velocities [rad/s].
    """

    def __init__(self, chain: SerialChain):
        """Name them."""
        self.chain = chain
        self.joints = tuple(f"{name}.pos" for name in chain.joint_names)
        self.velocities = tuple(f"{name}.vel" for name in chain.joint_names)

    def action_names(self, space: ActionSpace) -> tuple[str, ...]:
        """Names of an action's values, in order."""
        return (*(self.joints if space == "joint" else HAND), GRIPPER)

    def action_of(
        self,
        space: ActionSpace,
        joints: Float[np.ndarray, " joints"],
        width: float,
        near: Float[np.ndarray, "3"] = DOWN,
    ) -> dict[str, float]:
        """The action that sends the joints somewhere, and the gripper to an opening.

        Args:
            space: Action space.
            joints: Positions [rad].
            width: Opening [m].
            near: Rotation vector before, which this one goes on from [rad].
        """
        values = joints if space == "joint" else self.hand_vector(joints, near)
        names = self.action_names(space)
        return dict(zip(names, (*map(float, values), float(width)), strict=True))

    def hand_vector(
        self, joints: Float[np.ndarray, " joints"], near: Float[np.ndarray, "3"] = DOWN
    ) -> Float[np.ndarray, "6"]:
        """Position [m] and rotation vector [rad] of the end effector.

        A gripper that points down is half a turn from the base, where the shortest rotation
        vector jumps from one side to the other; `near` picks the side.
        """
        pose = self.chain.forward(torch.from_numpy(np.asarray(joints, dtype=float)))
        vector = pose.vector()
        pair = torch.stack([torch.from_numpy(np.array(near, dtype=float)), vector[3:]])
        return torch.cat([vector[:3], quaternion.unwrap_log(pair)[1]]).numpy()

    def target_of(
        self, action: Mapping[str, Any]
    ) -> tuple[Float[np.ndarray, " joints"] | Pose, float]:
        """Read an action of either space; names it does not know are passed over.

        Returns:
            Positions of the joints [rad] or pose of the end effector, and opening of the
            gripper [m], NaN where none is given.

        Raises:
            ValueError: Names are missing.
        """
        width = float(action.get(GRIPPER, np.nan))
        if all(name in action for name in HAND):
            vector = torch.tensor([float(action[name]) for name in HAND], dtype=torch.float64)
            return Pose.from_vector(vector), width
        missing = [name for name in self.joints if name not in action]
        if missing:
            raise ValueError(
                f"an action for this arm needs {', '.join(self.joints)} or {', '.join(HAND)}, "
                f"but lacks {', '.join(missing)}."
            )
        return np.array([float(action[name]) for name in self.joints]), width

    def observed(
        self, state: ArmState, names: Sequence[str], near: Float[np.ndarray, "3"] = DOWN
    ) -> dict[str, float]:
        """Values of the arm's state by name.

        Args:
            state: State of the arm.
            names: Wanted, of those of this class, `HAND` and `GRIPPER`.
            near: Rotation vector of the end effector before [rad].
        """
        q = state.joint_position
        values = dict(zip(self.joints, q.tolist(), strict=True))
        values |= zip(self.velocities, state.joint_velocity.tolist(), strict=True)
        values[GRIPPER] = state.gripper_width
        if not {*HAND}.isdisjoint(names):
            values |= zip(HAND, self.hand_vector(q, near).tolist(), strict=True)
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
        self._robots: list[ArmRobot] = []

    def __iter__(self) -> Iterator[ArmRobot]:
        """In the order in which they were connected."""
        return iter(tuple(self._robots))

    def add(self, robot: ArmRobot) -> None:
        """Note a robot that has been connected."""
        self._robots.append(robot)

    def remove(self, robot: ArmRobot) -> None:
        """Forget a robot that has been disconnected."""
        self._robots.remove(robot)

    def find(self, id: str | None) -> ArmRobot:
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
            f"this teleoperator guides {wanted} (mujoco_arm or franka_panda); connected: "
            f"{names}. Give --teleop.robot_id where there are several."
        )


@cache
def robot_registry() -> RobotRegistry:
    """Registry of connected robots in this process, used by robots and teleoperators."""
    return RobotRegistry()


@dataclass(kw_only=True)
class ArmRobotConfig(RobotConfig):
    """Settings common to simulated and real arms."""

    fps: float = 50.0
    """Actions a second: the rate of the dataset, or of the rollout."""
    action_space: ActionSpace = "joint"
    """Space of actions: joint positions ("joint"), or the pose of the end effector ("ee")."""
    velocity: bool = False
    """Observe joint velocities."""
    hand: bool = False
    """Observe the pose of the end effector; always observed if actions command it."""
    person: PersonConfig = field(default_factory=PersonConfig)
    """Person that guides the body while actions command the end effector."""


class ArmRobot(Device, Robot):
    """Arm commanded by joint positions or by the pose of its end effector.

    Actions of either space are accepted, and values that an action omits are kept, so that
    lerobot-rollout can also return the arm to its first position. Motions respect the joint
    limits only; `send_action` returns what was commanded.

    With a person (`ArmRobotConfig.person`) actions command the end effector only, while the
    person guides the body (`ComplementaryMotion`).

    Attributes:
        work_arm: The arm with its gripper.
        values: Observed and commanded values, by name.
        space: Declared action space.
        dt: Time between actions [s].
        initial_configurations: Number of resets of the scene; only a simulation can be reset.
        complement: Combination with the person's input, while connected; None: there is no
            person.
        judged: True if its motion may be recorded, so that quality warnings are given.
    """

    complement: ComplementaryMotion | None = None

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
        """Names of what is observed of the person."""
        return self._person_config.names(self.work_arm.chain)

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

    def send_action(self, action: dict[str, Any]) -> dict[str, float]:
        self._need_connection()
        self._judge()
        where, width = self.values.target_of(action)
        joints = self._joints_at(where) if isinstance(where, Pose) else where
        if self.complement is not None:
            joints, width = self._with_person(self.complement, where, joints, width)
        sent = self._command(joints, width)
        return self.values.action_of(self.space, sent, width, self._rotation)

    def _judge(self) -> None:
        """Tell the watch what is recorded with this action."""
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
        """The arm, to be read."""

    @abstractmethod
    def _joints_at(self, pose: Pose) -> Float[np.ndarray, " joints"]:
        """Joint positions that bring the end effector to a pose [rad]."""

    @abstractmethod
    def _command(
        self, joints: Float[np.ndarray, " joints"], width: float
    ) -> Float[np.ndarray, " joints"]:
        """Send joints [rad] and gripper [m]; where the joints are really sent [rad]."""

    @property
    @abstractmethod
    def servo(self) -> PositionServo:
        """Position servo of the arm."""

    @property
    def in_real_time(self) -> bool:
        """True if the arm keeps moving while the loop is late."""
        return True

    @property
    def world(self) -> World | None:
        """The simulated world that it is in; None for a real one."""
        return None

    def read_state(self) -> ArmState:
        """Latest reading of the arm, for teleoperators."""
        self._need_connection()
        return self._seen(self.arm.read())

    def clearance(
        self, joint_position: Float[Tensor, "*batch joints"]
    ) -> Float[Tensor, "*batch"]:
        """Distance of the arm from what it must not meet, as far as that is known [m].

        A real arm knows of itself only.
        """
        return self.work_arm.whole.self_distance(joint_position)

    def _invite(self, config: PersonConfig) -> None:
        """Connect the person that guides the body."""
        from hrc_learn.controller.null_space_motion import YieldingConfig
        from hrc_learn.skills.complementary_motion import ComplementaryMotion

        self._person = Person(config, self.work_arm)
        self.complement = ComplementaryMotion(
            self.work_arm.chain,
            self._person,
            self.dt,
            self.servo.limits,
            YieldingConfig(after_push=config.after_push),
            self.clearance,
        )

    def _with_person(
        self,
        complement: ComplementaryMotion,
        where: Float[np.ndarray, " joints"] | Pose,
        joints: Float[np.ndarray, " joints"],
        width: float,
    ) -> tuple[Float[np.ndarray, " joints"], float]:
        """Joints and gripper, with the body where the person wants it."""
        from hrc_learn.skills.arm_motion import joints_near

        with torch.inference_mode():
            if isinstance(where, Pose) and complement.posture is not None:
                joints = joints_near(self.work_arm.chain, where, complement.posture).numpy()
            joints, width = complement.next(self.arm.read(), joints, width)
        self._person.show(self.arm, self.world)
        return joints, width

    def _seen(self, state: ArmState) -> ArmState:
        """Observed part of a reading; the policy's own posture if that is configured."""
        if self.complement is None or self._person_config.observed == "joints":
            return state
        return replace(
            state,
            joint_position=state.joint_position - self.complement.offset,
            joint_velocity=state.joint_velocity - self.complement.offset_velocity.numpy(),
        )
