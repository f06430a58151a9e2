"""A work cell under one clock: arm, gripper, camera and person, stepped and logged."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from hrc_learn.controller import INTERVENTIONS, Command, SafetyFilter
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import SerialChain
from hrc_learn.protocols import Arm, ArmState, Gripper, Human, HumanInput
from hrc_learn.skills.cartesian_motion import path_velocity, resolved_rate, straight_line
from hrc_learn.skills.marker_sensor import Eye, Sight, Transport, TransportConfig
from hrc_learn.viz import StepLog

# A workplace under one clock: arm, gripper, camera and person, stepped and logged together.
#
# Tasks know the protocols only. What passes time is handed in: a simulator's physics, or a
# clock that waits for real hardware.


@dataclass(frozen=True, kw_only=True)
class StationConfig:
    """How the loop runs."""

    dt: float = 0.01
    """Control step [s]."""
    look_every: int = 4
    """Control steps from one image to the next, while the task watches the camera."""
    keep_every: int = 40
    """Control steps from one image kept for the recording to the next; 0: none is kept."""
    transport: TransportConfig = field(default_factory=TransportConfig)
    """What happens to images on their way from the camera."""
    damping: float = 3.0
    """c_d: effort that moves the body by one unit of joint speed (paper, Table I)."""
    pose_gain: float = 4.0
    """How fast an error of pose is corrected on given motions [1/s]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class KeptImage:
    """An image kept for the recording."""

    time: float
    """[s]"""
    image: UInt8[np.ndarray, "height width 3"]


class Station:
    """Runs the loop: look, listen to the person, command, wait, log.

    Attributes:
        chain: Kinematics of the arm.
        gripper: Its gripper's driver.
        state: Newest reading of the arm.
        sight: Newest detection of markers that has arrived.
        asked: What the person asks for now.
        watching: Markers looked for in an image every `look_every` steps; none: no image.
        log: Columns of every step so far, and the phases of the task.
        images: Images kept for the recording.
    """

    def __init__(
        self,
        *,
        chain: SerialChain,
        arm: Arm,
        gripper: Gripper,
        eye: Eye | None = None,
        human: Human,
        advance: Callable[[float], None],
        config: StationConfig | None = None,
        on_phase: Callable[[str, float], None] = lambda phase, time: None,
        rng: np.random.Generator | None = None,
    ):
        """Take hold of the parts.

        Args:
            chain: Kinematics of the arm.
            arm: Its driver.
            gripper: Its gripper's driver.
            eye: The fixed camera and what finds markers in its images; None where a task
                needs none.
            human: The person beside the arm.
            advance: Lets a given time pass [s].
            config: How the loop runs.
            on_phase: Told the name of each phase of the task, and when it begins [s].
            rng: Decides which images are lost.
        """
        self.config = config or StationConfig()
        self.chain = chain
        self.gripper = gripper
        self.watching: Collection[int] = ()
        self.log = StepLog()
        self.images: list[KeptImage] = []
        self._arm, self._eye, self._human = arm, eye, human
        self._advance, self._on_phase = advance, on_phase
        self._safety = SafetyFilter(chain.limits)
        self._ticks = 0
        self.state: ArmState = arm.read()
        self.asked: HumanInput = human.read(self.state)
        self.sight = Sight()
        self._transport = Transport(self.config.transport, rng or np.random.default_rng(0))
        self._guard = self._safety.initial_state(self.joints)

    @property
    def joints(self) -> Float[Tensor, " joints"]:
        """Measured joint positions [rad]."""
        return torch.from_numpy(self.state.joint_position)

    @property
    def pose(self) -> Pose:
        """Pose of the hand, from the measured joints."""
        return self.chain.forward(self.joints)

    @property
    def time(self) -> float:
        """Clock of the arm [s]."""
        return self.state.time

    def enter(self, phase: str) -> None:
        """Begin another phase of the task."""
        self.log.event(self.time, phase)
        self._on_phase(phase, self.time)

    def look(self, ids: Collection[int] | None = None) -> None:
        """Take an image and find markers in it, all unless told; it may be late, or lost."""
        pixels = {} if self._eye is None else self._eye.look(ids)
        self._transport.send(Sight(time=self.time, joints=self.joints, pixels=pixels))
        self._receive()

    def see(self, ids: Collection[int] | None = None) -> Sight:
        """The scene as it is now: holds still until an image taken from now on has arrived."""
        now = self.time
        self.look(ids)
        while self.sight.time < now:
            self.stay(self.config.look_every * self.config.dt)
            self.look(ids)
        return self.sight

    def step(self, joint_velocity: Float[Tensor, " joints"]) -> None:
        """Send a command through the safety filter, and let one step pass [rad/s]."""
        joints = self.joints
        safe, self._guard, report = self._safety.step(
            self._guard,
            joints,
            joint_velocity,
            self.config.dt,
            jacobian=self.chain.jacobian(joints),
        )
        self._send(safe, safety=report.flags.numpy(), **_NOTHING_SEEN)

    def obey(
        self,
        command: Command,
        target: Float[np.ndarray, "2"],
        feature: np.ndarray,
        approach: float = 0.0,
    ) -> None:
        """Carry out one step of the adaptive controller, which has its own safety filter.

        Args:
            command: Of the controller.
            target: Where the feature should be [px].
            feature: Where it is; NaN if it is not seen [px].
            approach: Share of a joint-space approach in the command.
        """
        self._guard = self._safety.initial_state(self.joints, command.joint_velocity)
        self._send(
            command.joint_velocity,
            safety=command.safety.flags.numpy(),
            feature=feature,
            target=target,
            image_jacobian=command.image_jacobian.numpy(),
            weight_norm=float(command.weight_norm),
            potential=float(command.potential),
            potential_rate=float(command.potential_rate),
            vision_activation=float(command.vision_level),
            approach=approach,
        )

    def follow(self, goal: Pose, twist: Float[Tensor, "6"]) -> None:
        """One step of keeping the hand on a moving goal while the person may push the body."""
        pose, J = self.chain.forward_and_jacobian(self.joints)
        correction = self.config.pose_gain * pose.twist_to(goal)
        effort = torch.from_numpy(self.asked.effort) / self.config.damping
        self.step(resolved_rate(J, twist + correction, effort))

    def stay(self, duration: float) -> None:
        """Keep the hand where it is for a while [s], yielding to the person."""
        goal, still = self.pose, torch.zeros(6, dtype=torch.float64)
        for _ in range(round(duration / self.config.dt)):
            self.follow(goal, still)

    def move_straight(self, goal: Pose, speed: float = 0.15, settle: float = 0.4) -> None:
        """Move the hand to a pose on a straight line, and let it come to rest.

        Args:
            goal: Where to.
            speed: Mean speed [m/s].
            settle: Time at the end [s].
        """
        for pose, twist in straight_line(self.pose, goal, speed, self.config.dt):
            self.follow(pose, twist)
        still = torch.zeros(6, dtype=torch.float64)
        for _ in range(round(settle / self.config.dt)):
            self.follow(goal, still)

    def play(
        self,
        path: Float[np.ndarray, "steps joints"],
        until: Callable[[], bool] = lambda: False,
    ) -> int:
        """Move the joints along a path sampled at the control step.

        The person's effort is not followed meanwhile: a planned path avoids obstacles only as
        it was planned.

        Args:
            path: Joint positions [rad].
            until: Asked before each step whether to leave it at that.

        Returns:
            Samples of the path that were gone to.
        """
        for k, q in enumerate(path):
            if until():
                return k
            error = torch.from_numpy(q) - self.joints
            velocity = torch.from_numpy(path_velocity(path, k, self.config.dt))
            self.step(velocity + self.config.pose_gain * error)
        return len(path)

    def _send(self, velocity: Float[Tensor, " joints"], **columns) -> None:
        self.log.append(
            time=self.time,
            joint_position=self.state.joint_position,
            joint_velocity=self.state.joint_velocity,
            command_velocity=velocity.numpy(),
            human_effort=self.asked.effort,
            gripper=self.state.gripper_width,
            **columns,
        )
        self._arm.command(velocity.numpy())
        self._advance(self.config.dt)
        self._ticks += 1
        self.state = self._arm.read()
        self.asked = self._human.read(self.state)
        self._receive()
        if self.watching and self._ticks % self.config.look_every == 0:
            self.look(self.watching)
        every = self.config.keep_every
        if self._eye is not None and every and self._ticks % every == 0:
            self.images.append(KeptImage(time=self.time, image=self._eye.read()))

    def _receive(self) -> None:
        self.sight = self._transport.newest(self.time) or self.sight


_NAN = float("nan")
_NOTHING_SEEN = {
    "feature": np.full(2, _NAN),
    "target": np.full(2, _NAN),
    "image_jacobian": np.full((2, 6), _NAN),
    "weight_norm": _NAN,
    "potential": _NAN,
    "potential_rate": _NAN,
    "vision_activation": _NAN,
    "approach": _NAN,
}

SAFETY_COLUMNS = INTERVENTIONS
"""Names of the components of the log's column "safety"."""

# How tasks fail: the work could not be done, though nothing was wrong with the request.


class TaskFailedError(RuntimeError):
    """A task could not be carried out; says at which phase and why."""


class MissedGraspError(TaskFailedError):
    """A grasp came to nothing; another attempt may do."""


class BlockedPathError(TaskFailedError):
    """A planned motion would hit something or leave the limits of the arm."""
