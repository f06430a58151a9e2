"""What a task asks of an arm, a gripper, a camera and a person.

Tasks know these protocols only; MuJoCo, a recording or real hardware stands behind them.
Arrays are NumPy float64: that is what drivers and simulators speak.
"""

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

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
class HumanInput:
    """What a person asks for at one instant."""

    effort: Float[np.ndarray, " joints"] = field(default_factory=lambda: np.zeros(7))
    """Null-space effort d on the joints (paper, eq. globalControl)."""
    twist: Float[np.ndarray, " 6"] = field(default_factory=lambda: np.zeros(6))
    """End-effector motion, linear [m/s] and angular [rad/s], in the base frame."""


@runtime_checkable
class Human(Protocol):
    """A person beside the arm: scripted, at a gamepad, or in a browser."""

    def read(self, state: ArmState) -> HumanInput:
        """Return what the person asks for, now that the arm is in `state`."""
        ...
