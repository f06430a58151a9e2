"""What a skill asks of an arm, a gripper, a camera and a person.

Skills know these protocols only; MuJoCo, a recording or real hardware stands behind them.
Arrays are NumPy float64: that is what drivers and simulators speak.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Protocol, get_args, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8


@dataclass(frozen=True, kw_only=True)
class ArmState:
    """One reading of an arm."""

    time: float
    """Clock of the arm [s]."""
    joint_position: Float[np.ndarray, " joints"]
    """Joint positions [rad]."""
    joint_velocity: Float[np.ndarray, " joints"]
    """Joint velocities [rad/s]."""
    gripper_width: float
    """Opening between the finger pads [m]."""
    external_torque: Float[np.ndarray, " joints"] | None = None
    """Estimate of what the surroundings exert on the joints [N m]; None: the arm has none."""


@runtime_checkable
class Arm(Protocol):
    """A velocity-controlled arm."""

    def read(self) -> ArmState:
        """Return the newest state."""
        ...

    def command(self, joint_velocity: Float[np.ndarray, " joints"]) -> None:
        """Set the joint velocities [rad/s] to hold until the next command."""
        ...


@runtime_checkable
class Gripper(Protocol):
    """A parallel gripper."""

    def move(self, width: float) -> None:
        """Set the opening to reach or to squeeze towards [m]."""
        ...


@dataclass(frozen=True, kw_only=True)
class OpenedArm:
    """An arm that is ready to be led."""

    arm: Arm
    gripper: Gripper
    advance: Callable[[float], None]
    """Lets a time pass in its world [s]."""


@runtime_checkable
class Camera(Protocol):
    """A camera whose intrinsics and pose nobody needs to know."""

    def read(self) -> UInt8[np.ndarray, "height width 3"]:
        """Return the newest image, RGB."""
        ...


@runtime_checkable
class TimedCamera(Camera, Protocol):
    """A camera that tells when its images were taken; those of others count as just taken."""

    @property
    def age(self) -> float:
        """From the newest image that was read being taken until it was read [s]."""
        ...


@dataclass(frozen=True, kw_only=True)
class DrawnRegion:
    """A box that a person has drawn for the end effector, along the axes of the base frame."""

    centre: tuple[float, float, float]
    """[m]"""
    half_size: tuple[float, float, float]
    """[m]"""

    def __post_init__(self) -> None:
        if min(self.half_size) <= 0:
            raise ValueError(f"a region's half_size must be positive, but is {self.half_size}.")


Request = Literal["start", "stop", "save", "discard", "home", "finish"]
"""What a person asks for once: of the demonstration being recorded, then of the arm (back to
where it started) and of the session."""


@dataclass(frozen=True, kw_only=True)
class HumanInput:
    """What a person asks for at one instant."""

    nullspace_input: Float[np.ndarray, " joints"] | None = None
    """Null-space effort d on the joints [N m] (paper, eq. globalControl); None: no effort."""
    twist: Float[np.ndarray, " 6"] = field(default_factory=lambda: np.zeros(6))
    """End-effector motion, linear [m/s] and angular [rad/s], in the base frame."""
    gripper: float | None = None
    """Opening the gripper should have [m]; None: nothing is asked."""
    region: DrawnRegion | None = None
    """Where the end effector should be; None: anywhere."""
    target: tuple[float, float, float] | None = None
    """Point marked for the end effector, in the base frame [m]; None: none is."""
    turn: tuple[float, float, float] | None = None
    """Rotation added to the orientation that a rule or a task has for the end effector, as a
    rotation vector in the base frame [rad]; None: none is."""
    requests: tuple[Request, ...] = ()
    """Asked for since the last reading, in this order."""
    pause: bool = False
    """Whether the task waits where it is, as long as this is asked for."""
    stop: str = ""
    """Why the arm comes to rest and the task is given up; empty: it goes on."""

    def effort(self, joints: int) -> Float[np.ndarray, " joints"]:
        """Null-space effort d on the joints of an arm [N m]; zeros if none is requested.

        Args:
            joints: Number of joints of the arm.

        Raises:
            ValueError: The requested effort is for another number of joints.
        """
        if self.nullspace_input is None:
            return np.zeros(joints)
        if len(self.nullspace_input) != joints:
            raise ValueError(
                f"nullspace_input has {len(self.nullspace_input)} entries, but the arm has "
                f"{joints} joints: give one effort [N m] per joint, or None for no effort."
            )
        return self.nullspace_input


Hindrance = Literal[
    "joint_limit",
    "singularity",
    "obstacle",
    "speed",
    "task",
    "narrow_path",
    "too_far",
    "task_waits",
    "person",
    "stopped",
]
"""What keeps an arm from following the person who leads it: a joint near its limit; a
singularity ahead; something it would meet; the speed that people may lead it with; the task,
whose end effector would have to move; a path that nobody can push it off; a posture that it
would not come back from; a task that waits until it is back; somebody near it; the safety
filter, which brakes it."""
HINDRANCES: tuple[Hindrance, ...] = get_args(Hindrance)
"""All of them, in the order of the log's column "hindered"."""


@dataclass(frozen=True, kw_only=True)
class Reason:
    """Why an arm does not follow, or only in part."""

    hindrance: Hindrance
    text: str
    """In words, such as "joint 4 is at its limit"."""
    kept: float = 1.0
    """Share of the motion that it leaves, 0 to 1; 1 of what only goes along with the push."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Feedback:
    """What an arm tells the person who leads it."""

    pushed: bool = False
    """Whether the person asks for a motion now."""
    followed: float = 1.0
    """Share of what is asked that the arm follows, 0 to 1; 1 while nothing is. Of a push that
    is of the motion that it would have in the null space. The time that an arm needs to get
    under way takes nothing from it."""
    reasons: tuple[Reason, ...] = ()
    """Why that is less, what takes the most first; none while nothing is asked."""
    contact_force: Float[np.ndarray, "3"] | None = None
    """Force that the external torques amount to at the end effector, in the base frame [N];
    None: the arm tells none."""
    near_limits: tuple[str, ...] = ()
    """Names of the joints that are near their limits."""
    person_distance: float | None = None
    """Of the nearest person [m], NaN while it is not known; None: nobody watches for them."""
    pace: float = 1.0
    """Share of its speed that people near it leave the task, 0 to 1."""
    slip: float = 0.0
    """By how much the gripper's opening has changed since it holds its object [m]."""
    contact_expected: bool = False
    """Whether the task feels its way or has just done so: what is met at the end effector is
    part of it."""


@runtime_checkable
class Human(Protocol):
    """A person beside the arm: scripted, at a gamepad, or in a browser."""

    def read(self, state: ArmState) -> HumanInput:
        """Return what the person asks for, now that the arm is in `state`."""
        ...

    def tell(self, feedback: Feedback) -> None:
        """Tell the person what the arm feels, and how far it follows.

        Called at each step, by the control loop: devices that take their time do so elsewhere.
        One by which nothing is felt ignores it, as this does for all that derive from it.
        """


@dataclass(frozen=True, kw_only=True)
class PersonObservation:
    """Where a person's body was, as capsules: all points within a radius of a segment."""

    time: float
    """When they were there: of the image, not of its arrival [s]."""
    ends: Float[np.ndarray, "parts 2 3"]
    """Of the segments, in the base frame [m]."""
    radius: Float[np.ndarray, " parts"]
    """[m]"""
    velocity: Float[np.ndarray, "parts 2 3"]
    """Of the ends; zero as long as only one image is known [m/s]."""


@runtime_checkable
class PersonTracker(Protocol):
    """Sees where the people beside an arm are."""

    def read(self) -> PersonObservation | None:
        """Return the newest observation that has arrived; None: none has, for whatever reason.

        Who relies on it allows for what a person can do since its time.
        """
        ...
