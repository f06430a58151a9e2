"""A Panda behind the `Arm` and `Gripper` protocols, by the driver package `franky`.

Written against the published interface of franky 2.0 (PyPI: franky-control), tested with a fake
that speaks it. NOT RUN ON HARDWARE.
"""

from __future__ import annotations

import importlib
import time
from typing import Any

import numpy as np
from jaxtyping import Float

from hrc_learn.protocols import ArmState

_NARROW = 0.005
"""Openings below this are a wish to squeeze [m]."""


class FrankyArm:
    """The arm and its gripper.

    A velocity holds for `timeout` at most: the driver itself then brings the arm to rest, also
    if this process has died.
    """

    def __init__(
        self,
        ip: str,
        *,
        dynamics: float,
        timeout: float,
        grip_force: float,
        grip_speed: float,
    ):
        """Connect.

        Args:
            ip: Address of the control box.
            dynamics: Fraction of the driver's own limits.
            timeout: How long a velocity holds [s].
            grip_force: With which the gripper squeezes [N].
            grip_speed: Of the fingers [m/s].

        Raises:
            ImportError: The driver is not installed.
        """
        self._franky = franky = _import_franky()
        self._robot = franky.Robot(ip)
        self._robot.recover_from_errors()
        self._robot.relative_dynamics_factor = dynamics
        self._gripper = franky.Gripper(ip)
        self._hold = franky.Duration(round(1e3 * timeout))
        self._force, self._speed = grip_force, grip_speed
        self._width: float | None = None

    def read(self) -> ArmState:
        """Return the newest state."""
        joints = self._robot.current_joint_state
        return ArmState(
            time=time.monotonic(),
            joint_position=np.array(joints.position, dtype=float),
            joint_velocity=np.array(joints.velocity, dtype=float),
            gripper_width=float(self._gripper.width),
        )

    def command(self, joint_velocity: Float[np.ndarray, "7"]) -> None:
        """Set the joint velocities to hold [rad/s]."""
        if not np.isfinite(joint_velocity).all():
            raise ValueError(f"joint_velocity must be finite, but is {joint_velocity}.")
        motion = self._franky.JointVelocityMotion(joint_velocity.tolist(), duration=self._hold)
        self._robot.move(motion, asynchronous=True)

    def stop(self) -> None:
        """Bring the arm to rest."""
        self._robot.move(self._franky.JointVelocityStopMotion(), asynchronous=True)

    def move(self, width: float) -> None:
        """Open the gripper to a width, or squeeze what is between its fingers [m].

        Sent once for each new width: the gripper takes its time, and no stream of commands.
        """
        if self._width is not None and abs(width - self._width) < _NARROW:
            return
        self._width = width
        if width < _NARROW:
            self._gripper.grasp_async(0.0, self._speed, self._force, epsilon_outer=1.0)
        else:
            self._gripper.move_async(width, self._speed)


def _import_franky() -> Any:
    try:
        return importlib.import_module("franky")
    except ImportError as error:
        raise ImportError(
            "a real Panda needs the driver package franky: pip install franky-control, in the "
            "build for the server version of its control box, on a machine with a real-time "
            "kernel."
        ) from error
