"""A workplace under one clock: arm, gripper, camera and person, stepped and logged together.

Tasks know the protocols only. What passes time is handed in: a simulator's physics, or a
clock that waits for real hardware.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ..controller import SafetyFilter
from ..geometry import Pose
from ..kinematics import SerialChain
from ..protocols import Arm, ArmState, Camera, Gripper, Human, HumanInput
from ..vision import MarkerDetector, centre
from ..viz import StepLog
from .motion import path_velocity, resolved_rate, straight_line


@dataclass(frozen=True, kw_only=True)
class StationConfig:
    """How the loop runs."""

    dt: float = 0.01
    """Control step [s]."""
    camera_every: int = 4
    """Control steps from one image to the next."""
    keep_image_every: int = 25
    """Control steps from one image kept in the recording to the next."""
    damping: float = 3.0
    """c_d: effort that moves the body at one unit of joint speed (paper, Table I) [N m s/rad]."""
    pose_gain: float = 4.0
    """How fast an error of pose is corrected on given motions [1/s]."""
    marker_ids: tuple[int, ...] = ()
    """ArUco numbers to look for."""


@dataclass(frozen=True, kw_only=True)
class Sight:
    """What the camera saw last."""

    time: float = -np.inf
    """When the image was taken [s]."""
    pixels: Mapping[int, Float[np.ndarray, "2"]] = field(default_factory=dict)
    """Centre of each marker in it, by number (u, v) [px]."""


@dataclass(frozen=True, kw_only=True)
class KeptImage:
    """An image kept for the recording."""

    time: float
    image: UInt8[np.ndarray, "height width 3"]


class Station:
    """Runs the loop: look, listen to the person, command, wait, log.

    Attributes:
        state: Newest reading of the arm.
        sight: Newest detection of markers.
        asked: What the person asks for now.
        log: Columns of every step so far.
        images: Images kept for the recording.
        phase: Name of what the task is doing, for the log.
    """

    def __init__(
        self,
        *,
        chain: SerialChain,
        arm: Arm,
        gripper: Gripper,
        camera: Camera | None,
        human: Human,
        advance: Callable[[float], None],
        config: StationConfig | None = None,
    ):
        """Take hold of the parts and look once.

        Args:
            chain: Kinematics of the arm.
            arm: Its driver.
            gripper: Its gripper's driver.
            camera: The fixed camera; None where the task needs none.
            human: The person beside it.
            advance: Lets a given time pass [s].
            config: How the loop runs.
        """
        self.config = config or StationConfig()
        self.chain = chain
        self.gripper = gripper
        self.human = human
        self.log = StepLog()
        self.images: list[KeptImage] = []
        self.phase = ""
        self.sight = Sight()
        self._arm, self._camera, self._advance = arm, camera, advance
        self._detector = MarkerDetector(list(self.config.marker_ids))
        self._safety = SafetyFilter(chain.limits)
        self._ticks = 0
        self._observe()
        self._guard = self._safety.initial_state(self.joints)

    @property
    def joints(self) -> Float[Tensor, " joints"]:
        """Measured joint positions [rad]."""
        return torch.from_numpy(self.state.joint_position)

    @property
    def pose(self) -> Pose:
        """Pose of the hand from the measured joints."""
        return self.chain.forward(self.joints)

    @property
    def time(self) -> float:
        """Clock of the arm [s]."""
        return self.state.time

    def enter(self, phase: str) -> None:
        """Note in the log that another phase of the task begins."""
        self.phase = phase
        self.log.event(self.time, phase)

    def step(self, joint_velocity: Float[Tensor, " joints"], **columns) -> None:
        """Send one command through the safety filter, and let one step pass.

        Args:
            joint_velocity: Wanted [rad/s].
            columns: Further values to log with this step.
        """
        safe, self._guard, report = self._safety.step(
            self._guard, self.joints, joint_velocity, self.config.dt
        )
        columns["safety"] = report.flags
        self.command(safe, **columns)

    def command(self, joint_velocity: Float[Tensor, " joints"], **columns) -> None:
        """Send a command that has passed a safety filter, and let one step pass."""
        velocity = joint_velocity.numpy()
        pose = self.pose
        self.log.append(
            time=self.time,
            joint_position=self.state.joint_position,
            joint_velocity=velocity,
            position=pose.position.numpy(),
            orientation=pose.orientation.numpy(),
            human_effort=self.asked.effort,
            gripper=self.state.gripper_width,
            **columns,
        )
        self._arm.command(velocity)
        self._advance(self.config.dt)
        self._ticks += 1
        self._observe()

    def wait(self, duration: float) -> None:
        """Stand still, yielding to the person."""
        for _ in range(round(duration / self.config.dt)):
            self.follow(self.pose, torch.zeros(6, dtype=torch.float64))

    def follow(self, goal: Pose, twist: Float[Tensor, "6"]) -> None:
        """One step of keeping the hand on a moving goal while the person may push the body."""
        correction = self.config.pose_gain * self.pose.twist_to(goal)
        effort = torch.from_numpy(self.asked.effort) / self.config.damping
        self.step(resolved_rate(self.chain.jacobian(self.joints), twist + correction, effort))

    def move_straight(self, goal: Pose, speed: float = 0.15) -> None:
        """Move the hand to a pose on a straight line [m/s]."""
        for pose, twist in straight_line(self.pose, goal, speed, self.config.dt):
            self.follow(pose, twist)
        for _ in range(round(0.5 / self.config.dt)):
            self.follow(goal, torch.zeros(6, dtype=torch.float64))

    def play(self, path: Float[np.ndarray, "steps joints"]) -> None:
        """Move the joints along a path sampled at the station's step.

        The person's effort is not followed meanwhile: a planned path is free of obstacles
        only as planned.
        """
        for k, q in enumerate(path):
            error = torch.from_numpy(q) - self.joints
            velocity = torch.from_numpy(path_velocity(path, k, self.config.dt))
            self.step(velocity + self.config.pose_gain * error)

    def _observe(self) -> None:
        self.state: ArmState = self._arm.read()
        self.asked: HumanInput = self.human.read(self.state)
        if self._camera is None or self._ticks % self.config.camera_every:
            return
        image = self._camera.read()
        found = self._detector.detect(image)
        pixels = {id: centre(corners) for id, corners in found.items()}
        self.sight = Sight(time=self.time, pixels=pixels)
        if self._ticks % self.config.keep_image_every < self.config.camera_every:
            self.images.append(KeptImage(time=self.time, image=image))
