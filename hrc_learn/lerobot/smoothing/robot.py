"""LeRobot robot wrapper that sends setpoints on a smooth path between actions."""

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
from jaxtyping import Float
from lerobot.robots import Robot, RobotConfig, make_robot_from_config
from lerobot.utils.errors import DeviceNotConnectedError

from hrc_learn.controller.motion_filter import MotionState
from hrc_learn.lerobot.smoothing.action_limits import ActionLimits

logger = logging.getLogger(__name__)

SMOOTH_ROBOT = "smooth"
_LATE = 2.0
"""Setpoint periods after which a setpoint counts as late."""
_WAIT = 0.5
"""Action periods to wait for a late action before the motion comes to rest."""
_BEHIND = 1.0
"""Total duration of queued actions above which a warning is given [s]."""
_FOLLOW = 0.1
"""Fraction of an action's lateness by which later actions are postponed. A small fraction
suppresses the jitter of the loop, but follows its drift.
"""


LARGEST_DEGREE = 3
_LATEST = 1.5
"""Action periods after an action at which the curve stops if no other action comes."""


class ActionUpsampler:
    """Setpoints between actions, on a B-spline, within limits.

    The last d + 1 actions are the control points of a uniform B-spline of degree d. Degree 0
    holds the newest action, degree 1 interpolates linearly, degree 2 has continuous velocity,
    and degree 3 also continuous acceleration. The derivatives of the curve lie between the
    differences of its control points. Therefore, if the actions keep the limits at their own
    rate, the setpoints keep them at any rate. For other actions, a `MotionFilter` at the
    setpoint rate keeps the limits.

    A curve of degree d lags behind the actions by (d + 1)/2 action periods. For a smaller
    latency, each control point is extrapolated along the difference of the last two actions.
    This amplifies the noise of the actions.

    Attributes:
        latency: Latency of the curve behind the actions [s].
        position: Last setpoint.
    """

    def __init__(
        self,
        limits: ActionLimits,
        rate: float,
        *,
        degree: int = LARGEST_DEGREE,
        latency: float | None = None,
    ):
        """Prepare the curve; the motion starts with `reset`.

        Args:
            limits: Limits of the actions, with their rate.
            rate: Setpoints a second; at least as many as actions.
            degree: Degree of the curve, 0 to 3.
            latency: Latency of the curve in action periods; None: (degree + 1)/2, the largest.

        Raises:
            ValueError: An argument is out of its range.
        """
        if not 0 <= degree <= LARGEST_DEGREE:
            raise ValueError(f"degree must be 0 to {LARGEST_DEGREE}, got {degree}")
        if not limits.fps <= rate < float("inf"):
            text = f"rate must be at least the {limits.fps:g} actions a second, got {rate:g}"
            raise ValueError(text)
        own = (degree + 1) / 2
        latency = own if latency is None else latency
        if not 0 <= latency <= own:
            raise ValueError(
                f"latency must be 0 to {own:g} actions for a curve of degree {degree}, got "
                f"{latency:g}"
            )
        self.limits, self.rate, self.degree = limits, rate, degree
        self.latency = latency / limits.fps
        self._lead = own - latency
        self._filter = limits.motion_filter(1 / rate)
        self._points: np.ndarray | None = None
        self._phase = 0.0

    @property
    def position(self) -> Float[np.ndarray, "*batch D"]:
        return self._state.position

    def reset(
        self,
        position: Float[np.ndarray, "*batch D"],
        velocity: Float[np.ndarray, "*batch D"] | float = 0.0,
    ) -> None:
        """Start from the present motion of one robot or of a batch of robots.

        Args:
            position: Position.
            velocity: Velocity [1/s].

        Raises:
            ValueError: The position has another number of values than the limits.
        """
        position = self._checked(position)
        self._state = MotionState.moving(position, velocity)
        self._points = np.repeat(position[None], self.degree + 1, axis=0)
        self._newest, self._phase = position, 0.0

    def push(self, action: Float[np.ndarray, "*batch D"]) -> None:
        """Append the next action; the phase of `setpoint` then counts from this action.

        Values that are not finite are replaced by the previous ones.

        Raises:
            ValueError: The action has another number of values than the limits.
            RuntimeError: There was no `reset`.
        """
        if self._points is None:
            raise RuntimeError("call reset() with the position of the robot first")
        action = self._checked(action)
        action = np.where(np.isfinite(action), action, self._newest)
        ahead = action + self._lead * (action - self._newest)
        self._points = np.concatenate([self._points[1:], ahead[None]])
        self._newest = action

    def repeat(self) -> None:
        """Append the newest action again; after some repetitions, the motion comes to rest."""
        self.push(self._newest)

    def setpoint(self, phase: float) -> Float[np.ndarray, "*batch D"]:
        """The next setpoint, 1/rate seconds after the last one.

        Args:
            phase: Time since the newest action, in action periods. If the next action is late
                (phase > 1), the curve continues for half a period.
        """
        assert self._points is not None  # reset() comes before push()
        weights = _weights(self.degree, min(phase, _LATEST))
        self._state = self._filter.step(self._state, np.tensordot(weights, self._points, 1))
        return self._state.position

    def frame(self, action: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "n *batch D"]:
        """All setpoints until the next action is due.

        If the setpoint rate is no multiple of the action rate, the number of setpoints varies.

        Raises:
            ValueError: Same as `push`.
        """
        self.push(action)
        made, step = [], self.limits.fps / self.rate
        # Rounding must not add a setpoint just before the next action.
        while self._phase < 1 - 1e-9:
            made.append(self.setpoint(self._phase))
            self._phase += step
        self._phase -= 1
        return np.stack(made)

    def _checked(self, values: np.ndarray) -> np.ndarray:
        values = np.asarray(values, dtype=np.float64)
        if values.shape[-1:] != (len(self.limits.names),):
            raise ValueError(
                f"limits are given for {', '.join(self.limits.names)}, but there are values "
                f"of shape {values.shape}"
            )
        return values


def _weights(degree: int, u: float) -> Float[np.ndarray, " points"]:
    """Weights of the control points, oldest first, by the recursion of Cox and de Boor."""
    weights = np.array([1.0])
    for d in range(1, degree + 1):
        k = np.arange(d)
        rising = (u + d - 1 - k) / d
        weights = np.append(weights * (1 - rising), 0.0) + np.append(0.0, weights * rising)
    return weights


@RobotConfig.register_subclass(SMOOTH_ROBOT)
@dataclass(kw_only=True)
class SmoothRobotConfig(RobotConfig):
    """Settings of a robot that moves smoothly between actions. For example:

    `--robot.type=smooth --robot.of=so101_follower --robot.options='{port: /dev/ttyACM0}'`
    """

    of: str = ""
    """Type of the wrapped robot, as in --robot.type."""
    options: dict[str, Any] = field(default_factory=dict)
    """Settings of the wrapped robot, as YAML. Without the wrapper, a setting would be given as
    --robot.NAME=VALUE."""
    limits: Path | None = None
    """File of limits, as `hrc smooth --limits` writes it."""
    rate: float = 250.0
    """Setpoints sent to the robot per second."""
    degree: int = 3
    """Degree of the curve between the actions: 0 holds each action, 1 is LeRobot's
    interpolation, 2 has continuous velocity, and 3 continuous acceleration too.
    """
    latency: float | None = None
    """Latency of the curve, in action periods; at most (degree + 1)/2, the default."""
    clock: Literal["wall", "actions"] = "wall"
    """"wall": a thread sends setpoints in real time. "actions": all setpoints of an action are
    sent at once, for a simulated robot whose time advances with them.
    """


class SmoothRobot(Robot):
    """Moves a wrapped robot from action to action on a smooth path within limits.

    It has the observations and actions of the wrapped robot, so every LeRobot program and
    inference mode can use it in place of that robot. The motors receive setpoints, which reach
    an action about `latency` after the action was sent. If no more actions come, the motion
    comes to rest at the last action. At `connect` and `begin`, the path starts at the robot's
    present position.

    Attributes:
        inner: The wrapped robot.
        upsampler: Upsampler of the actions.
        late: Number of setpoints that were sent more than a period late, for example because a
            camera kept the robot busy.
        sent: Number of all setpoints.
    """

    config_class = SmoothRobotConfig
    name = SMOOTH_ROBOT

    def __init__(self, config: SmoothRobotConfig):
        """Make the wrapped robot and the upsampler.

        Raises:
            ValueError: There is no such robot, or its actions are not those of the limits.
        """
        super().__init__(config)
        if config.of not in RobotConfig.get_known_choices() or config.of == SMOOTH_ROBOT:
            known = ", ".join(sorted(RobotConfig.get_known_choices().keys() - {SMOOTH_ROBOT}))
            raise ValueError(f"--robot.of must be one of {known}; got {config.of!r}")
        if config.limits is None:
            raise ValueError(
                "--robot.limits is needed: `hrc smooth --dataset FOLDER --limits FILE` writes "
                "such a file."
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
        self._readings = deque[tuple[float, np.ndarray]](maxlen=2)

    @property
    def observation_features(self) -> dict[str, Any]:
        return self.inner.observation_features

    @property
    def action_features(self) -> dict[str, Any]:
        return self.inner.action_features

    @property
    def cameras(self) -> Any:
        """Cameras of the wrapped robot, by name."""
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
        self._error = None
        self.begin()
        if self.config.clock == "wall":
            self._stop.clear()
            self._thread = Thread(target=self._send_all, daemon=True, name="smooth motion")
            self._thread.start()

    def begin(self) -> None:
        """Restart the path at the robot's present position, for example after a manual motion.

        Raises:
            ValueError: The robot does not report its position for a value of its actions.
        """
        self._readings.clear()
        self._observed()
        _, here = self._readings[-1]
        if unknown := [n for n, x in zip(self._names, here, strict=True) if x != x]:
            raise ValueError(
                f"{self.inner} does not report {', '.join(unknown)}, so it is not known "
                "where its motion begins: check the sensor"
            )
        with self._bus:
            self._actions.clear()
            self._started = None
            self.upsampler.reset(here)

    def get_observation(self) -> dict[str, Any]:
        self._complain()
        return self._observed()

    def _observed(self) -> dict[str, Any]:
        with self._bus:
            seen = self.inner.get_observation()
            here = np.array([float(seen.get(name, np.nan)) for name in self._names])
            self._readings.append((time.perf_counter(), here))
            return seen

    def _start(self, now: float) -> None:
        """Start the path from the motion that was measured before the first action."""
        (then, before), (last, here) = self._readings[0], self._readings[-1]
        limits = self.upsampler.limits
        if now - last > 1 / limits.fps or not np.isfinite(here).all():
            return  # no motion was measured just now: the robot counts as at rest
        velocity = (here - before) / (last - then) if last > then else np.zeros_like(here)
        # A velocity beyond the limits means that the robot was moved by other means between
        # the readings: start at rest.
        slow = bool((np.abs(velocity) <= limits.velocity).all())
        self.upsampler.reset(here, velocity if slow else 0.0)

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Continue the motion to an action.

        Args:
            action: Values by name. Values that are not named keep their last target.

        Returns:
            The setpoint that was sent last.

        Raises:
            DeviceNotConnectedError: The robot is not connected, or refused a setpoint.
        """
        self._complain()
        if not self.is_connected:
            raise DeviceNotConnectedError(f"{self} is not connected: call connect() first.")
        with self._bus:
            # NaN is replaced by the previous value.
            values = np.array([float(action.get(name, np.nan)) for name in self._names])
            if self.config.clock == "wall":
                self._actions.append(values)
                if len(self._actions) == round(_BEHIND * (fps := self.upsampler.limits.fps)):
                    text = "actions come faster than the %g a second of %s: the robot is behind"
                    logger.warning(f"{text} by %g s", fps, self.config.limits, _BEHIND)
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
                f"{self.inner} refused a setpoint: {self._error}"
            ) from self._error

    def _named(self, values: np.ndarray) -> dict[str, float]:
        return dict(zip(self._names, values.tolist(), strict=True))

    def _send(self, setpoint: np.ndarray) -> None:
        self.inner.send_action(self._named(setpoint))
        self.sent += 1

    def _send_all(self) -> None:
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
                due = now  # missed setpoints are not sent in a burst
            due += period

    def _phase(self, now: float) -> float:
        """Time since the newest action of the path, in action periods; appends due actions.

        The first action is due when it comes. Each further action is due one action period
        after the previous one.
        """
        fps = self.upsampler.limits.fps
        if self._started is None:
            self._start(now)
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
