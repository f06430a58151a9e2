"""Imperfections of a simulated work cell: arm, calibration, camera, objects.

`Imperfections` holds the sizes of the errors; `Imperfections.draw` draws the errors of one run.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from jaxtyping import Float

from hrc_learn.controller import SafetyConfig
from hrc_learn.vision import ImageNoise

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.

# Heights are always drawn for this many objects, so that later draws do not depend on the
# actual number of objects.
_MOST_OBJECTS = 8
# Constant lag of the simulated servos [s]: compensating for it reduces path errors from 1.5 to
# 0.4 mm.
_SIMULATED_SERVOS = 0.01
# `_RAMP`: time from a control step to full braking of the arm [s].
# `_BEYOND_CAPSULES`: distance by which person and arm may protrude from their capsules [m],
# including the arm's calibration error.
_RAMP, _BEYOND_CAPSULES = 0.02, 0.05
# Fields of `Imperfections` that are fractions, and their largest value.
_FRACTIONS, _LARGEST_FRACTION = ("image_loss", "person_loss", "slowness"), 0.9


@dataclass(frozen=True, kw_only=True)
class Imperfections:
    """Sizes of the errors of a run; the defaults describe an ordinary laboratory.

    docs/concepts/experiments.md gives the sources. Standard deviations belong to normal
    distributions. A range is the largest error of a uniform distribution around zero.
    """

    encoder_noise: float = 1e-4
    """Standard deviation of a joint position reading [rad]."""
    encoder_offset: float = 2e-3
    """Range of the constant error of each joint's zero [rad]."""
    command_delay: float = 0.020
    """Delay between a command and the motion of the servos [s]."""
    command_jitter: float = 0.002
    """Standard deviation of `command_delay` from one command to the next [s]."""
    servo_lag: float = 0.010
    """Time constant with which the servos follow a changed velocity [s]."""
    slowness: float = 0.3
    """Fraction of the acceleration limits that the driver leaves unused, 0 to 1: drivers such
    as franky plan with reduced limits.
    """
    joint_friction: float = 1.0
    """Dry friction of every joint [N m]."""
    gravity_error: float = 0.02
    """Range of the error of the arm's own gravity compensation, as a fraction of the weight."""
    payload: float = 0.5
    """Largest unknown mass at the hand [kg]."""
    torque_noise: float = 0.2
    """Standard deviation of an estimated external joint torque [N m]."""
    torque_lag: float = 0.010
    """Time constant of the low-pass filter of the torque estimate [s]."""
    base_error: float = 1e-3
    """Range of the base's position error along each axis [m]."""
    base_turn: float = 1e-3
    """Range of the base's rotation error about the vertical [rad]."""
    tool_error: float = 1e-3
    """Range of the tool centre point's error along each axis [m]."""
    tool_turn: float = 3e-3
    """Range of the tool's rotation error about each axis [rad]."""
    image_delay: float = 0.080
    """Delay between exposure and detected markers [s]."""
    image_loss: float = 0.20
    """Fraction of the images that never arrive."""
    image_noise: float = 2.0
    """Standard deviation of the sensor noise in grey levels of 255, in addition to
    `ImageNoise.noise`."""
    image_blur: float = 0.5
    """Standard deviation of the blur, in addition to `ImageNoise.blur` [px]."""
    table_height: float = 0.02
    """Range of the height error of the table's top [m]."""
    object_height: float = 0.005
    """Range of the height error of each object [m]."""
    object_yaw: float = math.pi
    """Range of the yaw of objects on the table [rad]."""
    teaching_error: float = 5e-4
    """Range of the error, along each axis, when a person guides the arm to a place [m]."""

    person_noise: float = 0.01
    """Standard deviation of a person's observed position along each axis [m]."""
    person_delay: float = 0.080
    """Delay between exposure and the estimated body pose of a person [s]."""
    person_loss: float = 0.20
    """Fraction of images in which a person is present but not detected."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            most = _LARGEST_FRACTION if name in _FRACTIONS else math.inf
            if not (math.isfinite(value) and 0 <= value <= most):
                raise ValueError(f"{name} must be from 0 to {most:g}, but is {value}.")

    @classmethod
    def ideal(cls) -> Imperfections:
        """No imperfections."""
        return cls().scaled(0.0)

    @classmethod
    def nominal(cls) -> Imperfections:
        """Imperfections of an ordinary laboratory: the defaults of all fields."""
        return cls()

    def scaled(self, factor: float) -> Imperfections:
        """All imperfections times a factor; fractions are limited to 0.9, the yaw to pi.

        Raises:
            ValueError: If the factor is negative.
        """
        values = {name: factor * value for name, value in vars(self).items()}
        for name in _FRACTIONS:
            values[name] = min(values[name], _LARGEST_FRACTION)
        values["object_yaw"] = min(values["object_yaw"], math.pi)
        return Imperfections(**values)

    @property
    def camera_noise(self) -> ImageNoise:
        """Blur and noise of images, the camera's own included."""
        return ImageNoise(
            blur=ImageNoise.blur + self.image_blur, noise=ImageNoise.noise + self.image_noise
        )

    def plant(self, safety: SafetyConfig) -> SafetyConfig:
        """Settings of the safety filter, adapted to the delays and limits of the arm's driver
        and to the errors of the person tracker.
        """
        # One in 700 normally distributed delays exceeds the mean by more than three deviations.
        delay = self.command_delay + 3 * self.command_jitter + self.servo_lag
        separation = replace(
            safety.separation,
            reaction_time=max(delay, _SIMULATED_SERVOS) + _RAMP,
            clearance=_BEYOND_CAPSULES + 3 * self.person_noise,
        )
        return replace(safety, braking=1 - self.slowness, delay=delay, separation=separation)

    @property
    def following_delay(self) -> float:
        """Mean delay between a command and the motion of the arm [s]."""
        return max(self.command_delay + self.servo_lag, _SIMULATED_SERVOS)

    def draw(
        self, rng: np.random.Generator, joints: int = 7, size: float = 1.0
    ) -> DrawnImperfections:
        """Draw the errors of one run.

        Args:
            rng: Random generator, also for the noise during the run.
            joints: Number of joints of the arm.
            size: Size of the hand relative to the Franka hand. Height errors of table and
                objects are proportional to it, and the unknown load to its cube.
        """

        def uniform(size: int | None = None):
            return rng.uniform(-1.0, 1.0, size)

        return DrawnImperfections(
            sizes=self,
            rng=rng,
            encoder_offset=self.encoder_offset * uniform(joints),
            gravity_error=self.gravity_error * float(uniform()),
            payload=size**3 * self.payload * float(rng.uniform()),
            base_shift=self.base_error * uniform(3),
            base_turn=self.base_turn * float(uniform()),
            tool_shift=self.tool_error * uniform(3),
            tool_turn=self.tool_turn * uniform(3),
            table_height=size * self.table_height * float(uniform()),
            object_heights=size * self.object_height * uniform(_MOST_OBJECTS),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawnImperfections:
    """The constant errors of one run, and the source of its noise."""

    sizes: Imperfections
    rng: np.random.Generator
    encoder_offset: Float[np.ndarray, " joints"]
    """Encoder offsets: reading minus true position [rad]."""
    gravity_error: float
    """Excess of the gravity compensation, as a fraction of the arm's weight."""
    payload: float
    """Unknown mass at the hand [kg]."""
    base_shift: Float[np.ndarray, "3"]
    """True minus assumed position of the base [m]."""
    base_turn: float
    """True minus assumed turn of the base about the vertical [rad]."""
    tool_shift: Float[np.ndarray, "3"]
    """True minus assumed position of the tool, in the gripper's frame [m]."""
    tool_turn: Float[np.ndarray, "3"]
    """True minus assumed turn of the tool: rotation vector in the hand's frame [rad]."""
    table_height: float
    """True minus assumed height of the table's top [m]."""
    object_heights: Float[np.ndarray, " objects"]
    """True minus assumed height of each object [m]."""

    def apply(self, spec: mujoco.MjSpec) -> None:
        """Add the errors of the arm to a scene description: calibration, friction, weights."""
        base, hand = spec.body("link0"), spec.body("hand")
        base.pos = base.pos + self.base_shift
        base.quat = _turned(base.quat, np.array([0.0, 0.0, self.base_turn]))
        # The hand is shifted along the axes of its own frame, then turned about them.
        shift = np.zeros(3)
        mujoco.mju_rotVecQuat(shift, self.tool_shift, hand.quat)
        hand.pos = hand.pos + shift
        hand.quat = _turned(hand.quat, self.tool_turn)
        if self.payload > 0:
            # The load is a small sphere at the palm: its inertia matters less than its mass.
            load = hand.add_body(name="payload", pos=(0.0, 0.0, 0.03))
            load.add_geom(
                name="payload",
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=(0.02, 0, 0),
                mass=self.payload,
                contype=0,
                conaffinity=0,
                group=5,
            )
        for joint in spec.joints:
            if joint.type != mujoco.mjtJoint.mjJNT_HINGE:  # fingers slide, objects are free
                continue
            joint.frictionloss = self.sizes.joint_friction
            # With MuJoCo's default of 0.02 s, friction would drive a joint that is braked hard.
            joint.solref_friction = (2 * spec.option.timestep, 1.0)
            joint.parent.gravcomp = 1.0 + self.gravity_error

    def encoders(
        self, joint_position: Float[np.ndarray, " joints"]
    ) -> Float[np.ndarray, " joints"]:
        """A reading of joint positions [rad]."""
        noise = self.sizes.encoder_noise * self.rng.standard_normal(joint_position.shape)
        return joint_position + self.encoder_offset + noise

    def torques(self, external: Float[np.ndarray, " joints"]) -> Float[np.ndarray, " joints"]:
        """An estimate of external joint torques [N m]."""
        return external + self.sizes.torque_noise * self.rng.standard_normal(external.shape)


class CommandChannel:
    """Delays each command to an arm by a random time, but keeps the order of the commands.

    The arm then follows with the lag of its servos and the acceleration limits of its driver.
    """

    def __init__(self, drawn: DrawnImperfections, acceleration: Float[np.ndarray, " joints"]):
        """Start at rest.

        Args:
            drawn: Delay, jitter and lag.
            acceleration: Limits of the joints [rad/s^2].
        """
        self._drawn = drawn
        self._limit = (1 - drawn.sizes.slowness) * acceleration
        self._pending: deque[tuple[float, Float[np.ndarray, " joints"]]] = deque()
        self.rest()

    def rest(self) -> None:
        """Forget all commands; the arm is at rest."""
        self._pending.clear()
        self._wanted = np.zeros_like(self._limit)
        self.velocity = np.zeros_like(self._limit)

    def send(self, time: float, joint_velocity: Float[np.ndarray, " joints"]) -> None:
        """Send joint velocities [rad/s] at a time [s]."""
        sizes = self._drawn.sizes
        jitter = sizes.command_jitter * self._drawn.rng.standard_normal()
        due = time + max(sizes.command_delay + jitter, 0.0)
        if self._pending:
            due = max(due, self._pending[-1][0])
        self._pending.append((due, np.array(joint_velocity, dtype=float)))

    def advance(self, time: float, dt: float) -> Float[np.ndarray, " joints"]:
        """Joint velocity that the servos follow from `time` to `time + dt` [rad/s]."""
        # Clocks sum rounded steps, so a command that is a nanosecond early counts as due.
        while self._pending and self._pending[0][0] <= time + 1e-9:
            self._wanted = self._pending.popleft()[1]
        lag = self._drawn.sizes.servo_lag
        fraction = 1.0 if lag == 0 else -math.expm1(-dt / lag)
        change = fraction * (self._wanted - self.velocity)
        if self._drawn.sizes.slowness > 0:
            change = np.clip(change, -self._limit * dt, self._limit * dt)
        self.velocity = self.velocity + change
        return self.velocity


def _turned(
    orientation: Float[np.ndarray, "4"], turn: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4"]:
    """A unit quaternion (wxyz) followed by a rotation vector in its own frame [rad]."""
    turned = np.array(orientation, dtype=float)
    mujoco.mju_quatIntegrate(turned, turn, 1.0)
    return turned
