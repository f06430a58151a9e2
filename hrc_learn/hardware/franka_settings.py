"""Settings of a Franka arm, for both drivers (pylibfranka and franky)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hrc_learn.controller import SafetyConfig
from hrc_learn.geometry.numerics import ArrayLike, check_settings

CYCLE = 1e-3
"""Period of Franka's control interface [s]."""
_REST, _LATER = 3.0, 1.5
"""`_REST`: shortest timeout for coming to rest [s]. `_LATER`: smallest ratio of the timeout to
the time for braking."""


@dataclass(frozen=True, kw_only=True)
class Load:
    """A load on the flange, in addition to the end effector that the arm is configured for."""

    mass: float = 0.0
    """Mass [kg]."""
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre of mass, in the flange's frame [m]."""
    inertia: tuple[tuple[float, ...], ...] = ((0.0,) * 3,) * 3
    """Inertia about the centre of mass, along the flange's axes [kg m^2]."""
    far_end: tuple[float, float, float] | None = None
    """Point of the load farthest from the flange, in the flange's frame [m]. `FrankaArm` limits
    the speed of this point like that of the tool. None: no such limit."""

    def __post_init__(self) -> None:
        check_settings(self, not_negative=["mass"])
        tensor = np.array(self.inertia)
        if tensor.shape != (3, 3) or not np.allclose(tensor, tensor.T, rtol=1e-9, atol=0):
            raise ValueError(
                f"inertia of a load must be a symmetric matrix, 3 by 3, but is {self.inertia}."
            )
        if np.linalg.eigvalsh(tensor).min() < 0:
            raise ValueError(
                f"inertia of a load must not be negative about any axis, but is {self.inertia}."
            )


@dataclass(frozen=True, kw_only=True)
class CollisionConfig:
    """Estimated external load above which the arm stops by a reflex.

    The defaults come from the maker's example for joint velocities (libfranka,
    examples/generate_joint_velocity_motion.cpp); they apply to both contacts and collisions.
    """

    torque: tuple[float, ...] = (20.0, 20.0, 18.0, 18.0, 16.0, 14.0, 12.0)
    """Threshold on each joint [N m]."""
    force: tuple[float, ...] = (20.0, 20.0, 20.0, 25.0, 25.0, 25.0)
    """Threshold at the end effector: forces along x, y, z [N], and torques about the same axes
    [N m]."""

    def __post_init__(self) -> None:
        for name, number in (("torque", 7), ("force", 6)):
            values = getattr(self, name)
            if len(values) != number or not all(0 < v < math.inf for v in values):
                raise ValueError(
                    f"{name} of a collision must be {number} positive numbers, but is {values}."
                )


class RealtimeError(RuntimeError):
    """The machine lacks real-time scheduling, which is required."""

    def __init__(self, why: str):
        """Append the remedy to the reason."""
        super().__init__(
            f"{why}: boot a kernel with PREEMPT_RT and allow the user rtprio 99 in "
            "/etc/security/limits.d. Where late commands do no harm, as with a simulator, give "
            "realtime=False; a real arm then stops whenever the machine is late."
        )


@dataclass(kw_only=True)  # not frozen: LeRobot's configuration of the arm inherits it
class FrankyConfig:
    """Settings of an arm and its gripper."""

    dynamics: float = 0.3
    """Fraction of the acceleration and jerk limits that is used, in (0, 1]."""
    timeout: float = 0.15
    """Time for which a velocity holds [s]; then the driver brings the arm to rest."""
    realtime: bool = True
    """Refuse a machine without real-time scheduling; False is for simulators."""
    grip_force: float = 20.0
    """Grasping force [N]."""
    grip_speed: float = 0.1
    """Finger speed [m/s]; the default is the highest of the Franka Hand."""
    collision: CollisionConfig = field(default_factory=CollisionConfig)
    """External load above which the arm stops by a reflex."""
    load: Load | None = None
    """Load on the flange in addition to the end effector; None keeps the arm's setting."""

    def __post_init__(self) -> None:
        positive = "timeout", "grip_force", "grip_speed"
        check_settings(self, positive=positive, fraction=["dynamics"])

    def rest_timeout(self, *limits: ArrayLike) -> float:
        """Timeout for coming to rest from the highest velocities [s].

        Args:
            limits: Limits of velocity, acceleration and jerk of the joints, before they are
                scaled by `dynamics`.
        """
        velocity, acceleration, jerk = map(np.asarray, limits)
        braking = velocity / (self.dynamics * acceleration) + acceleration / jerk
        return max(_REST, _LATER * float(braking.max()))

    def send_to(self, robot: Any) -> None:
        """Set collision thresholds and load of a connected arm.

        Args:
            robot: Robot of franky or pylibfranka; these calls are the same in both.
        """
        torque, force = list(self.collision.torque), list(self.collision.force)
        robot.set_collision_behavior(torque, torque, force, force)
        if self.load is not None:
            # The driver expects columns; for a symmetric matrix they equal the rows.
            inertia = np.ravel(self.load.inertia).tolist()
            robot.set_load(self.load.mass, list(self.load.centre), inertia)


@dataclass(kw_only=True)
class FrankaConfig(FrankyConfig):
    """Settings of an arm's 1 kHz loop.

    If an answer is late, the loop cannot know in which cycle the control box uses it. An answer
    used in the wrong cycle changes the acceleration by up to its present value. With `dynamics`
    of 0.3, this stays within the jerk limit of an FR3, 5000 rad/s^3: a change of 3 rad/s^2
    within 1 ms adds a jerk of 3000 rad/s^3 to the planned 1500 rad/s^3.

    Without real-time scheduling, some answers are late; the control box tolerates up to 20
    missing answers in a row. The loop sets real-time priority whenever it is allowed to, even
    with `realtime=False`.
    """

    grip_force: float = 40.0
    """Grasping force [N]."""
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    """Settings of the safety filter, which enforces the arm's limits, reduced by `dynamics`."""
    lockstep: bool = False
    """True for a simulator that waits for each answer, and stands still while no command comes:
    no answer is ever late, and each state is answered.
    """
    compiled: bool = True
    """True compiles the step once per machine, which takes a minute or two. An uncompiled step
    takes a whole cycle on a busy machine: use it for simulators only.
    """
    gripper: bool = True
    """True if a gripper is mounted."""
