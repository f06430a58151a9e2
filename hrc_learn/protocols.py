"""What a skill asks of an arm, a gripper, a camera and a person.

Skills know these protocols only; MuJoCo, a recording or real hardware stands behind them.
Arrays are NumPy float64: that is what drivers and simulators speak.
"""

from dataclasses import dataclass, field
from typing import Literal, Protocol, runtime_checkable

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


@runtime_checkable
class Camera(Protocol):
    """A camera whose intrinsics and pose nobody needs to know."""

    def read(self) -> UInt8[np.ndarray, "height width 3"]:
        """Return the newest image, RGB."""
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

    nullspace_input: Float[np.ndarray, " joints"] = field(default_factory=lambda: np.zeros(7))
    """Null-space effort d on the joints (paper, eq. globalControl)."""
    twist: Float[np.ndarray, " 6"] = field(default_factory=lambda: np.zeros(6))
    """End-effector motion, linear [m/s] and angular [rad/s], in the base frame."""
    gripper: float | None = None
    """Opening the gripper should have [m]; None: nothing is asked."""
    region: DrawnRegion | None = None
    """Where the end effector should be; None: anywhere."""
    target: tuple[float, float, float] | None = None
    """Point marked for the end effector, in the base frame [m]; None: none is."""
    requests: tuple[Request, ...] = ()
    """Asked for since the last reading, in this order."""


@runtime_checkable
class Human(Protocol):
    """A person beside the arm: scripted, at a gamepad, or in a browser."""

    def read(self, state: ArmState) -> HumanInput:
        """Return what the person asks for, now that the arm is in `state`."""
        ...


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
