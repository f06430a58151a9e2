"""LeRobot robot wrapper: a smooth path through the actions at the rate of the motors."""

from __future__ import annotations

import logging
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event, Lock, Thread
from typing import Any, Literal

import draccus
import numpy as np
from lerobot.robots import Robot, RobotConfig, make_robot_from_config
from lerobot.utils.errors import DeviceNotConnectedError

from .action_limits import ActionLimits
from .upsampling import ActionUpsampler

logger = logging.getLogger(__name__)

SMOOTH_ROBOT = "smooth"
_LATE = 2.0
"""Periods of the motors after which a setpoint counts as late."""
_WAIT = 0.5
"""Actions for which the next one is waited for before the motion comes to rest."""
_FOLLOW = 0.1
"""Fraction of an action's lateness by which the times of later actions move; it suppresses
jitter of the loop, but follows its drift.
"""


@dataclass(kw_only=True)
class SmoothRobotConfig(RobotConfig):
    """`--robot.type=smooth --robot.of=so101_follower --robot.options='{port: /dev/ttyACM0}'`"""

    of: str = ""
    """Type of the wrapped robot, as in --robot.type."""
    options: dict[str, Any] = field(default_factory=dict)
    """Its settings, as YAML: what else would be given as --robot.NAME=VALUE."""
    limits: Path | None = None
    """File of limits, as `lerobot-smooth limits` and `hrc smooth --limits` write it."""
    rate: float = 250.0
    """Setpoints a second that the robot is sent."""
    degree: int = 3
    """Degree of the curve through the actions: 0 holds each, 1 is LeRobot's interpolation, 2
    and 3 have continuous velocity and acceleration.
    """
    latency: float | None = None
    """Latency of the curve, in actions; at most (degree + 1)/2, the default."""
    clock: Literal["wall", "actions"] = "wall"
    """"wall": a thread sends setpoints in real time. "actions": all setpoints of an action are
    sent at once, for a simulated robot whose time advances with them.
    """


class SmoothRobot(Robot):
    """Moves another robot from action to action on a smooth path within limits.

    It has that robot's observations and actions, so that every program of LeRobot, with every
    way of inference, uses it as that robot. Setpoints are what is sent to the motors; an action
    is where they are about `latency` later. Where actions stop coming the motion comes to rest
    at the last one. The path begins, at `connect` and after each `begin`, where the robot is.

    Attributes:
        inner: The wrapped robot.
        upsampler: Upsampler of the actions.
        late: Setpoints that were sent more than a period late, as when a camera held the robot.
        sent: Setpoints in all.
    """

    config_class = SmoothRobotConfig
    name = SMOOTH_ROBOT

    def __init__(self, config: SmoothRobotConfig):
        """Make both robots.

        Raises:
            ValueError: There is no such robot, or its actions are not those of the limits.
        """
        super().__init__(config)
        if config.of not in RobotConfig.get_known_choices() or config.of == SMOOTH_ROBOT:
            known = ", ".join(sorted(RobotConfig.get_known_choices().keys() - {SMOOTH_ROBOT}))
            raise ValueError(f"--robot.of must be one of {known}; got {config.of!r}")
        if config.limits is None:
            raise ValueError(
                "--robot.limits is needed: `lerobot-smooth limits --dataset FOLDER --out FILE` "
                "writes such a file."
            )
        limits = ActionLimits.load(config.limits)
        settings = {"id": config.id, "calibration_dir": config.calibration_dir}
        given = {k: v for k, v in settings.items() if v is not None} | config.options
        inner = draccus.decode(RobotConfig, {"type": config.of, **given})
        self.inner = make_robot_from_config(inner)
        # Datasets and calibrations are those of the wrapped robot.
        self.name = self.robot_type = self.inner.name  # pyright: ignore[reportAttributeAccessIssue]
        if set(limits.names) != set(self.inner.action_features):
            raise ValueError(
                f"{config.limits} has limits for {', '.join(limits.names)}, but actions of "
                f"{config.of} are {', '.join(self.inner.action_features)}"
            )
        self.config = config
        self.upsampler = ActionUpsampler(
            limits, config.rate, degree=config.degree, latency=config.latency
        )
        self.late = self.sent = 0
        self._names = limits.names
        self._bus, self._actions = Lock(), deque[np.ndarray]()
        self._stop, self._thread = Event(), None
        self._error: Exception | None = None
        self._started: float | None = None

    @property
    def observation_features(self) -> dict[str, Any]:
        return self.inner.observation_features

    @property
    def action_features(self) -> dict[str, Any]:
        return self.inner.action_features

    @property
    def cameras(self) -> Any:
        """Configuration of the wrapped robot."""
        return getattr(self.inner, "cameras", {})

    @property
    def is_connected(self) -> bool:
        return self.inner.is_connected

    @property
    def is_calibrated(self) -> bool:
        return self.inner.is_calibrated

    def calibrate(self) -> None:
        """Calibrate the wrapped robot."""
        self.inner.calibrate()

    def configure(self) -> None:
        """Configure the wrapped robot."""
        self.inner.configure()

    def connect(self, calibrate: bool = True) -> None:
        self.inner.connect(calibrate)
        self.begin()
        if self.config.clock == "wall":
            self._stop.clear()
            self._thread = Thread(target=self._lead, daemon=True, name="smooth motion")
            self._thread.start()

    def begin(self) -> None:
        """Restart the path at rest at the robot's position, as after moving it by hand.

        Raises:
            ValueError: The robot does not report where a value of its actions is.
        """
        with self._bus:
            seen = self.inner.get_observation()
            here = np.array([float(seen.get(name, np.nan)) for name in self._names])
            if unknown := [n for n, x in zip(self._names, here, strict=True) if x != x]:
                raise ValueError(
                    f"{self.inner} does not report {', '.join(unknown)}, so it is not known "
                    "where its motion begins: check the sensor"
                )
            self._actions.clear()
            self._started = None
            self.upsampler.reset(here)

    def get_observation(self) -> dict[str, Any]:
        self._complain()
        with self._bus:
            return self.inner.get_observation()

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Go on to an action.

        Args:
            action: Values that it does not name stay where they were sent.

        Returns:
            The setpoint sent last.

        Raises:
            DeviceNotConnectedError: The robot is not connected, or stopped taking setpoints.
        """
        self._complain()
        if not self.is_connected:
            raise DeviceNotConnectedError(f"{self} is not connected: call connect() first.")
        with self._bus:
            # NaN is taken for the value before.
            values = np.array([float(action.get(name, np.nan)) for name in self._names])
            if self.config.clock == "wall":
                self._actions.append(values)
            else:
                for setpoint in self.upsampler.frame(values):
                    self._send(setpoint)
            return self._named(self.upsampler.position)

    def disconnect(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self.inner.disconnect()
        if self.sent:
            logger.info("smooth motion: %d setpoints, %d of them late", self.sent, self.late)

    def _complain(self) -> None:
        if self._error is not None:
            raise DeviceNotConnectedError(
                f"{self.inner} took no more setpoints: {self._error}"
            ) from self._error

    def _named(self, values: np.ndarray) -> dict[str, float]:
        return dict(zip(self._names, values.tolist(), strict=True))

    def _send(self, setpoint: np.ndarray) -> None:
        self.inner.send_action(self._named(setpoint))
        self.sent += 1

    def _lead(self) -> None:
        """Send setpoints in real time until stopped."""
        period = 1 / self.config.rate
        due = time.perf_counter()
        while not self._stop.wait(max(0.0, due - time.perf_counter())):
            try:
                with self._bus:
                    now = time.perf_counter()
                    if self._started is not None or self._actions:
                        self._send(self.upsampler.setpoint(self._phase(now)))
            except Exception as error:  # any error of a driver is raised to the caller
                self._error = error
                logger.error("smooth motion stopped: %s", error)
                return
            if now - due > (_LATE - 1) * period:
                self.late += 1
                due = now  # what was missed is not sent in a burst
            due += period

    def _phase(self, now: float) -> float:
        """Time since the newest action of the path, in actions, which it takes when it is due.

        The first is due when it comes, the next ones an action's time later each.
        """
        fps = self.upsampler.limits.fps
        if self._started is None:
            self._started = now
            self.upsampler.push(self._actions.popleft())
        while (phase := (now - self._started) * fps) >= 1:
            if self._actions:
                self.upsampler.push(self._actions.popleft())
                late = max(0.0, phase - 1)
            elif phase >= 1 + _WAIT:
                self.upsampler.repeat()
                late = 0.0
            else:
                break
            self._started += (1 + _FOLLOW * late) / fps
        return (now - self._started) * fps


if SMOOTH_ROBOT not in RobotConfig.get_known_choices():
    # It may be installed as a distribution of its own, and known already.
    RobotConfig.register_subclass(SMOOTH_ROBOT)(SmoothRobotConfig)
