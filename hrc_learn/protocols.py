"""Protocols of an arm, a gripper, a camera and a person, as skills use them.

Skills know these protocols only; MuJoCo, a recording or real hardware implements them. Arrays
are NumPy float64, as in drivers and simulators.
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
    """Estimated external torques on the joints [N m]; None if the arm gives no estimate."""


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
        """Set the opening of the fingers [m]; an object between the fingers is squeezed."""
        ...


@dataclass(frozen=True, kw_only=True)
class OpenedArm:
    """An arm ready for commands."""

    arm: Arm
    gripper: Gripper
    advance: Callable[[float], None]
    """Function that waits for a duration [s], or advances a simulation by this duration."""


@dataclass(frozen=True, kw_only=True)
class Touch:
    """Two objects in contact, from `start` until `end`."""

    first: str
    """Collision geometry (MuJoCo's geom) of the moving side: arm, hand or carried object."""
    second: str
    """Geom that the moving side touched."""
    start: float
    """Time of the first step in contact [s]."""
    end: float
    """Time of the last step in contact [s]."""
    depth: float
    """Deepest penetration [m]."""

    def __str__(self) -> str:
        depth_mm = 1e3 * self.depth
        return f"{self.first} met {self.second} at {self.start:.2f} s, {depth_mm:.1f} mm deep"


@runtime_checkable
class Camera(Protocol):
    """An uncalibrated camera."""

    def read(self) -> UInt8[np.ndarray, "height width 3"]:
        """Return the newest image, RGB."""
        ...


@runtime_checkable
class TimedCamera(Camera, Protocol):
    """A camera with image time stamps; images of other cameras count as just taken."""

    @property
    def age(self) -> float:
        """Time between the exposure of the newest image and its reading [s]."""
        ...


@dataclass(frozen=True, kw_only=True)
class DrawnRegion:
    """An axis-aligned box in the base frame, drawn by a person for the end effector."""

    centre: tuple[float, float, float]
    """Centre [m]."""
    half_size: tuple[float, float, float]
    """Half the edge lengths [m]."""

    def __post_init__(self) -> None:
        if not np.isfinite(self.centre).all():
            raise ValueError(f"a region's centre must be finite, but is {self.centre}.")
        if not all(0 < x < np.inf for x in self.half_size):
            raise ValueError(f"half_size must be positive and finite, but is {self.half_size}.")


Request = Literal["start", "stop", "save", "discard", "home", "finish"]
"""One-off request of a person: "start", "stop", "save" and "discard" concern a demonstration,
"home" moves the arm back to where it started, and "finish" ends the session.
"""


@dataclass(frozen=True, kw_only=True)
class HumanInput:
    """A person's input at one instant."""

    nullspace_input: Float[np.ndarray, " joints"] | None = None
    """Null-space effort d on the joints [N m] (paper, eq. globalControl); None: no effort."""
    twist: Float[np.ndarray, " 6"] = field(default_factory=lambda: np.zeros(6))
    """End-effector motion, linear [m/s] and angular [rad/s], in the base frame."""
    gripper: float | None = None
    """Requested opening of the gripper [m]; None: no request."""
    region: DrawnRegion | None = None
    """Region to keep the end effector in; None: no region."""
    target: tuple[float, float, float] | None = None
    """Target point of the end effector, in the base frame [m]; None: no target."""
    turn: tuple[float, float, float] | None = None
    """Rotation added to the end-effector orientation that the task requests, as a rotation
    vector in the base frame [rad]; None: no rotation."""
    requests: tuple[Request, ...] = ()
    """Requests since the last reading, in order."""
    pause: bool = False
    """True while the task should pause where it is."""
    stop: str = ""
    """Reason to stop the arm and abort the task; empty: go on."""

    def effort(self, joints: int) -> Float[np.ndarray, " joints"]:
        """Null-space effort d on the joints of an arm [N m]; zeros if none is requested.

        Args:
            joints: Number of joints of the arm.

        Raises:
            ValueError: The requested effort is for an arm with another number of joints.
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
"""Reason why an arm does not follow a person's guidance.

"joint_limit": a joint is near its limit. "singularity": a singularity lies ahead. "obstacle":
an obstacle lies ahead. "speed": the requested motion exceeds the speed limit of hand guiding.
"task": the requested motion would move the end effector away from its task. "narrow_path": the
path allows no null-space motion. "too_far": the arm could not return from the requested
posture. "task_waits": the task waits until the arm has returned. "person": a person is near the
arm. "stopped": the safety filter brakes.
"""
HINDRANCES: tuple[Hindrance, ...] = get_args(Hindrance)
"""All hindrances, in the order of the log's column "hindered"."""


@dataclass(frozen=True, kw_only=True)
class Reason:
    """Reason why an arm does not follow a person's guidance, or follows it only in part."""

    hindrance: Hindrance
    text: str
    """Text for the person, such as "joint 4 is at its limit"."""
    kept: float = 1.0
    """Fraction of the motion that this reason leaves, 0 to 1; 1 for a mere remark."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Feedback:
    """Feedback of an arm to the person who guides it."""

    pushed: bool = False
    """True while the person requests a motion."""
    followed: float = 1.0
    """Fraction of the requested motion that the arm follows, 0 to 1; 1 while no motion is
    requested. For a push, the requested motion is a null-space motion. An arm that is still
    accelerating does not lower the fraction.
    """
    reasons: tuple[Reason, ...] = ()
    """Reasons why `followed` is below 1, the strongest first; empty while no motion is
    requested."""
    contact_force: Float[np.ndarray, "3"] | None = None
    """Force at the end effector equivalent to the external torques, in the base frame [N]; None
    if the arm gives no estimate."""
    near_limits: tuple[str, ...] = ()
    """Names of the joints that are near their limits."""
    person_distance: float | None = None
    """Distance of the nearest person [m], NaN while unknown; None: no person tracking."""
    pace: float = 1.0
    """Speed scale of the task due to nearby people, 0 to 1."""
    slip: float = 0.0
    """Change of the gripper's opening since the object was grasped [m]."""
    contact_expected: bool = False
    """True while or shortly after the task probes for contact: contacts at the end effector are
    then expected.
    """


@runtime_checkable
class Human(Protocol):
    """A person near the arm: scripted, at a gamepad, or in a browser."""

    def read(self, state: ArmState) -> HumanInput:
        """Return the person's input for the arm in `state`."""
        ...

    def tell(self, feedback: Feedback) -> None:
        """Notify the person of contacts and of how far the arm follows.

        The control loop calls this at each step: slow devices must defer their work. Devices
        without feedback ignore the call, which is the default here.
        """


@dataclass(frozen=True, kw_only=True)
class PersonObservation:
    """Observed body of a person, as capsules: all points within a radius of a line segment."""

    time: float
    """Time of exposure, not of arrival [s]."""
    ends: Float[np.ndarray, "parts 2 3"]
    """Ends of the segments, in the base frame [m]."""
    radius: Float[np.ndarray, " parts"]
    """Radii of the capsules [m]."""
    velocity: Float[np.ndarray, "parts 2 3"]
    """Velocities of the ends [m/s]; zero in the first observation."""
    regions: tuple[str, ...] = ()
    """Body region of each capsule (`hrc_learn.controller.BODY_REGIONS`); empty: the regions are
    unknown, and the arm may touch none of them."""


@runtime_checkable
class PersonTracker(Protocol):
    """Tracks the people near an arm."""

    def read(self) -> PersonObservation | None:
        """Return the newest observation that has arrived; None if there is no observation, for
        any reason. An observation without capsules means that no person is near the arm.

        Callers must allow for the largest motion of a person since the time of exposure.
        """
        ...
