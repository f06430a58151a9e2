"""Use a robot of LeRobot, such as the SO-101 follower, as an `Arm` and a `Gripper`.

Tested with LeRobot's driver and the maker's SDK against a simulation of the servos' bus; NOT
RUN ON HARDWARE.
"""

from __future__ import annotations

import atexit
import math
import threading
import time
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from hrc_learn.geometry.numerics import check_settings
from hrc_learn.hardware.driver_process import ArmFaultError, Connected, checked_velocity
from hrc_learn.hardware.lerobot_device import (
    JointUnits,
    forget_late_replies,
    in_words,
    open_device,
)
from hrc_learn.kinematics import SerialChain
from hrc_learn.protocols import ArmState

_SLOPE = 5
"""Number of readings through which a line is fitted; its slope is the velocity. With only two
readings at 50 Hz, one step of a 12-bit encoder would appear as 0.08 rad/s."""
_STATUS = 0.5
"""Time between two readings of the servos' status [s]."""
_CONFIRMED, _LATE = 3, 0.005
"""`_CONFIRMED`: number of readings that confirm an alarm. `_LATE`: wait for late replies before
each of these readings [s]."""
_ALARMS = ("voltage", "angle sensor", "temperature", "current", "", "overload")
"""Meaning of the bits of a Feetech servo's register "Status"."""


@dataclass(frozen=True, kw_only=True)
class LeRobotConfig:
    """Settings of an arm that LeRobot drives."""

    rate: float = 50.0
    """Rate of readings and position commands [Hz]: six servos occupy the bus for 3 ms."""
    timeout: float = 0.15
    """Longest time for which a velocity holds without another command [s]."""
    silence: float = 0.4
    """Longest time without a reading [s]; LeRobot waits 50 ms for a reply, three times."""
    lag: float = 0.35
    """Largest distance of the commanded positions from the measured ones [rad]."""
    blocked: float = 1.0
    """Time at the distance `lag` after which the arm counts as blocked [s]."""
    opening: float = 0.08
    """Opening of the gripper at LeRobot's 100 % [m]."""
    unit: Literal["", "deg", "rad"] = ""
    """Unit of LeRobot's joint values. Empty: taken from the robot's calibration."""
    zeros: dict[str, float] = field(default_factory=dict)
    """Joint positions, in the arm's description, at which LeRobot's values are 0 [rad]."""
    reversed: tuple[str, ...] = ()
    """Joints whose direction in LeRobot is opposite to the direction in the description."""

    def __post_init__(self) -> None:
        numbers = "rate", "timeout", "silence", "lag", "blocked", "opening"
        check_settings(self, positive=numbers)


class LeRobotArm(Connected):
    """A position-controlled robot of LeRobot, driven by velocities.

    A thread reads the positions, integrates the velocities and sends the resulting positions.
    Without a command for the config's `timeout`, the positions sent stay constant and the
    servos hold the arm. If a servo reports a fault, or a joint lags behind, the arm stops:
    every command raises `ArmFaultError` until `recover` succeeds. Commands also raise
    `ArmFaultError` while the bus is silent.
    """

    def __init__(
        self,
        settings: Mapping[str, Any],
        chain: SerialChain,
        config: LeRobotConfig | None = None,
    ):
        """Connect. From then on, the servos hold the arm where it is.

        Args:
            settings: LeRobot's settings of the robot: type, port, id and others.
            chain: Kinematics and limits of the arm.
            config: Settings of the driver.

        Raises:
            ValueError: There is no such robot or setting, or its joints differ from the
                chain's.
            ConnectionError: The robot cannot be reached, or is not calibrated.
        """
        self.config = config = config or LeRobotConfig()
        self._robot = open_device("robot", settings)
        try:
            self.units = JointUnits.of(
                self._robot, chain.joint_names, config.unit, config.zeros, config.reversed
            )
            self._names, limits = chain.joint_names, chain.limits
            self._fastest = limits.velocity.numpy()
            zero, span = self.units.zero, self.units.span  # of the calibrated range
            self._lower = np.maximum(limits.lower.numpy(), zero - span)
            self._upper = np.minimum(limits.upper.numpy(), zero + span)
            self._readings: deque[tuple[float, np.ndarray]] = deque(maxlen=_SLOPE)
            # Locks of the bus and of the numbers below; always taken in this order.
            self._bus, self._lock = threading.Lock(), threading.Lock()
            self._ended = threading.Event()
            self._fault, self._failure = "", ""
            self._behind_since, self._status_at = math.inf, -math.inf
            self._velocity = np.zeros(len(self._names))
            self._look()
            self._goal = self._readings[-1][1].copy()
            self._moved_at = self._commanded_at = time.monotonic()
            self._share = self._width / config.opening
        except BaseException:
            self._robot.disconnect()
            raise
        self._thread = threading.Thread(target=self._keep_going, name="lerobot", daemon=True)
        self._thread.start()
        # LeRobot's setting for the torque must also apply if the program does not call `close`.
        atexit.register(self.close)

    def read(self) -> ArmState:
        """Return the newest state; `time` is this machine's monotonic clock [s].

        Raises:
            ArmFaultError: The bus has been silent for too long.
        """
        with self._lock:
            self._refuse_silence()
            times = np.array([t for t, _ in self._readings])
            positions = np.array([q for _, q in self._readings])
            velocity = np.zeros(len(self._names))
            if len(times) > 1:
                since = times - times.mean()
                velocity = since @ positions / (since @ since)
            return ArmState(
                time=float(times[-1]),
                joint_position=positions[-1].copy(),
                joint_velocity=velocity,
                gripper_width=self._width,
            )

    def command(self, joint_velocity: Float[np.ndarray, " joints"]) -> None:
        """Set the joint velocities to hold [rad/s].

        Raises:
            ValueError: The velocities are not finite, or beyond the limits of the arm's
                description.
            ArmFaultError: The arm has stopped, or its bus is silent.
        """
        velocity = checked_velocity(joint_velocity, self._names, self._fastest)
        with self._lock:
            self._refuse_silence()
            if self._fault:
                raise ArmFaultError(self._fault)
            self._advance()
            self._velocity, self._commanded_at = velocity, time.monotonic()

    def move(self, width: float) -> None:
        """Set the opening of the gripper [m], without waiting until it is reached.

        Raises:
            ValueError: The opening is NaN.
        """
        with self._lock:
            self._share = opened_fraction(width, self.config.opening)

    def stop(self) -> None:
        """Let the servos hold the arm at the present commanded positions.

        On a silent bus, the servos hold the last positions sent: no reply is needed.
        """
        with self._lock:
            self._advance()
            self._velocity = np.zeros(len(self._names))

    def recover(self) -> None:
        """Make the arm ready again after a fault, once its cause is gone.

        Raises:
            ArmFaultError: The fault remains; the message says which.
        """
        with self._bus:
            try:
                self._look()
                fault = self._alarm()
                bus = getattr(self._robot, "bus", None)
                if bus is not None and not fault:  # a servo cuts its torque on an alarm
                    bus.enable_torque()
            except Exception as error:
                fault = f"the bus does not answer ({in_words(error)}): check cable and power."
            with self._lock:
                self._fault = fault
                if fault:
                    raise ArmFaultError(fault)
                self._goal = self._readings[-1][1].copy()
                self._velocity = np.zeros(len(self._names))
                self._behind_since = math.inf

    def close(self) -> None:
        """Stop the arm and disconnect; LeRobot's settings decide whether the servos lose
        torque.
        """
        atexit.unregister(self.close)
        self._ended.set()
        self._thread.join(5.0)
        with suppress(Exception):  # the bus is gone, or a servo has an alarm
            self._robot.disconnect()

    def _keep_going(self) -> None:
        """Read and send until the arm is closed."""
        period = 1 / self.config.rate
        due = time.monotonic()
        while not self._ended.wait(max(0.0, due - time.monotonic())):
            due = max(due + period, time.monotonic())
            try:
                with self._bus:
                    self._turn()
            except Exception as error:  # a lost reply: only a long silence is a fault
                self._failure = in_words(error)
                forget_late_replies(self._robot)

    def _turn(self) -> None:
        """Read once, and send the next positions."""
        self._look()
        now, alarm = time.monotonic(), ""
        if now - self._status_at > _STATUS:
            alarm, self._status_at = self._alarm(), now
        with self._lock:
            self._advance()
            self._judge(alarm)
            goal, share, holds = self._goal.copy(), self._share, bool(self._fault)
        if not holds:
            self._robot.send_action(self.units.action(goal, share))

    def _look(self) -> None:
        """Read positions and gripper."""
        position, share = self.units.observed(self._robot.get_observation())
        with self._lock:
            self._readings.append((time.monotonic(), position))
            self._width = share * self.config.opening

    def _alarm(self) -> str:
        """Fault that a servo reports; empty if there is none."""
        alarms = self.units.alarms(self._robot)
        for _ in range(_CONFIRMED):
            if not any(alarms.values()):
                return ""
            # The SDK may have mistaken a late reply to an earlier request for the reply to this
            # one.
            time.sleep(_LATE)
            forget_late_replies(self._robot)
            again = self.units.alarms(self._robot)
            alarms = {motor: status & again[motor] for motor, status in alarms.items()}
        for motor, status in alarms.items():
            if status:
                bits = [word for i, word in enumerate(_ALARMS) if status >> i & 1 and word]
                return (
                    f"servo {motor} reports {' and '.join(bits) or f'status {status}'}: let it "
                    "cool down, check power and load, and recover or connect again."
                )
        return ""

    def _advance(self) -> None:
        """Integrate the commanded velocity into the goal, up to now or until the velocity has
        expired.
        """
        now = time.monotonic()
        until = min(now, self._commanded_at + self.config.timeout)
        elapsed = max(0.0, until - self._moved_at)
        here, lag = self._readings[-1][1], self.config.lag
        goal = self._goal + (0.0 if self._fault else elapsed) * self._velocity
        self._goal = led_goal(goal, here, lag, self._lower, self._upper)
        self._moved_at = now

    def _judge(self, alarm: str) -> None:
        """Stop the arm after an alarm, or if a joint has lagged behind for too long."""
        now, behind = time.monotonic(), np.abs(self._goal - self._readings[-1][1])
        if behind.max() < 0.99 * self.config.lag:
            self._behind_since = math.inf
        elif self._behind_since == math.inf:
            self._behind_since = now
        if not self._fault and (alarm or now - self._behind_since > self.config.blocked):
            name = self._names[int(behind.argmax())]
            self._fault = alarm or (
                f"{name} stays {behind.max():.2f} rad behind its command: it is blocked, "
                "overloaded or without power."
            )
            self._velocity = np.zeros(len(self._names))

    def _refuse_silence(self) -> None:
        silent = time.monotonic() - self._readings[-1][0]
        if silent > self.config.silence:
            why = f" ({self._failure})" if self._failure else ""
            raise ArmFaultError(
                f"no reading of the arm for {silent:.2f} s{why}: its servos hold the last "
                "positions. Check cable and power, and connect again."
            )


def led_goal(
    goal: Float[np.ndarray, " n"],
    here: Float[np.ndarray, " n"],
    lag: float,
    lower: Float[np.ndarray, " n"],
    upper: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """Limit commanded positions to a distance of `lag` from the measured ones, and to a range.

    An arm that is outside the range may move back, but not further out.
    """
    goal = np.clip(goal, here - lag, here + lag)
    return np.clip(goal, np.minimum(lower, here), np.maximum(upper, here))


def opened_fraction(width: float, opening: float) -> float:
    """Fraction of a gripper's largest opening, 0 to 1, for a requested width [m].

    Raises:
        ValueError: The width is NaN.
    """
    if math.isnan(width):
        raise ValueError("width of the gripper must be a number [m], but is nan.")
    return float(np.clip(width / opening, 0.0, 1.0))
