"""Drive an arm over ROS 2 topics: joint states come in, commands go to standard controllers.

Tested over real middleware against our simulated arm; NOT RUN ON HARDWARE. The system's ROS 2
is used if it has been sourced; otherwise, the wheels of `hrc-learn[ros2]` are used.
"""

from __future__ import annotations

import atexit
import math
import subprocess
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry.numerics import check_settings
from hrc_learn.hardware.driver_process import ArmFaultError, Connected, checked_velocity
from hrc_learn.hardware.lerobot_arm import led_goal, opened_fraction
from hrc_learn.hardware.ros2_topics import Ros2Session, quality, stamp_of, start_guard
from hrc_learn.kinematics import SerialChain
from hrc_learn.protocols import ArmState
from hrc_learn.watchdog import Watchdog

_CLOCK_RESET = 1.0
"""Backward step of the time stamps [s] above which the clock must have been reset. A smaller
step means that the message was reordered, unless no newer message comes for `silence`."""
_DRIFT = 5e-4
"""Fastest drift of the robot's clock against this machine's [s/s]: NTP slews a clock by 500 ppm
at most. A difference that grows faster is a delay of the messages, unless the clock belongs to
a simulator (topic /clock), which may be slower than real time."""


@dataclass(frozen=True, kw_only=True)
class Ros2Config:
    """Topics and settings of an arm."""

    joint_states: str = "/joint_states"
    """Topic of the joint states. Joints are found by name."""
    base: str = "base_link"
    """Frame of goals and markers of `hrc serve --ros2`; empty: all frames are accepted."""
    command: str = "/forward_velocity_controller/commands"
    """Topic of the commands to the controller."""
    interface: Literal["velocity", "position", "trajectory"] = "velocity"
    """Commands: velocities or positions (Float64MultiArray), or short trajectories that end at
    rest (JointTrajectory)."""
    timeout: float = 0.15
    """Longest time for which a velocity holds without another command [s]."""
    silence: float = 0.2
    """Largest age of the newest joint state [s]."""
    startup: float = 10.0
    """Longest wait for the first joint state, and for controllers [s]."""
    lag: float = 0.35
    """Largest distance of commanded positions from the measured ones [rad]."""
    wrench: str = ""
    """Topic of a force and torque sensor (WrenchStamped); empty: no sensor. The wrench acts on
    the end effector at the tool centre point, along the axes of its frame: `base` or
    `wrench_frame`."""
    wrench_frame: str = "tool0"
    """Frame with the axes of the end effector; a wrench without a frame is assumed to be in
    this frame. A wrench in an unknown frame stops the arm."""
    gripper: str = ""
    """Topic of a gripper's position controller (Float64MultiArray); empty: no gripper."""
    gripper_joint: str = ""
    """Joint of the gripper in the joint states."""
    opening: float = 0.08
    """Opening of the gripper [m] at `gripper_open`."""
    gripper_open: float = 0.04
    """Position of `gripper_joint` when open, in its own unit."""
    gripper_closed: float = 0.0
    """Position of `gripper_joint` when closed."""

    def __post_init__(self) -> None:
        numbers = "timeout", "silence", "startup", "lag", "opening"
        check_settings(self, positive=numbers)
        if self.gripper_open == self.gripper_closed:
            raise ValueError("gripper_open and gripper_closed must be different.")
        if bool(self.gripper) != bool(self.gripper_joint):
            raise ValueError("gripper and gripper_joint belong together: give both or neither.")


class Ros2Arm(Connected):
    """An arm of ros2_control, or one with the same topics, driven by velocities.

    A velocity holds for at most the config's `timeout`. Reordered or incomplete joint states
    are ignored; once the newest joint state or the newest wrench is older than `silence`,
    `read` and `command` raise `ArmFaultError` until a new one arrives. If this process dies, a
    trajectory ends at rest by itself, and a position is held. A velocity controller would hold
    its last command for ever: for this interface, a guard in a separate process then sends zero
    velocities.

    Attributes:
        session: The node.
        ignored: Number of joint states that named all joints, but were ignored because they
            were reordered or contained a position that is not finite.
        received: Arrival time of the newest joint state, by this machine's monotonic clock [s].
        answer: Called after each new joint state, in the thread that has received it.
    """

    def __init__(self, chain: SerialChain, config: Ros2Config | None = None):
        """Wait for joint states and controllers.

        Args:
            chain: Kinematics and limits of the arm.
            config: Topics and settings.

        Raises:
            ModuleNotFoundError: ROS 2 is not installed.
            ConnectionError: No joint state with all joints has come, or no controller listens.
        """
        self.config = config = config or Ros2Config()
        self._chain, self._names, self.ignored = chain, chain.joint_names, 0
        self.answer: Callable[[], None] = lambda: None
        self.session = Ros2Session("hrc_arm")
        from geometry_msgs.msg import WrenchStamped
        from sensor_msgs.msg import JointState
        from std_msgs.msg import Float64MultiArray
        from trajectory_msgs.msg import JointTrajectory

        self._lock, self._changed = threading.Lock(), threading.Condition()
        self._state: ArmState | None = None
        self._offset, self.received, self._seen = math.inf, -math.inf, dict[str, float]()
        self._width = math.nan if config.gripper else 0.0
        # Time of the newest wrench [s]; its frame, its force [N] and its torque [N m].
        self._felt = -math.inf if config.wrench else math.inf
        self._wrench = "", np.zeros((2, 3))
        self._velocity = np.zeros(len(self._names))
        self._goal: np.ndarray | None = None
        # Times of the last command and of the last change of the goal [s].
        # After this change, the goal moves at the velocity for `_hold`, then brakes for
        # `_brake` [s].
        self._commanded_at, self._moved_at = -math.inf, 0.0
        self._hold = self._brake = 0.0
        self._closed = False
        node, kind, self._numbers = self.session.node, config.interface, Float64MultiArray
        form = JointTrajectory if kind == "trajectory" else Float64MultiArray
        self._hand, once = None, quality(reliable=True)
        if config.gripper:
            self._hand = node.create_publisher(Float64MultiArray, config.gripper, once)
        self._commands = node.create_publisher(form, config.command, once)
        node.create_subscription(JointState, config.joint_states, self._on_state, quality())
        if config.wrench:
            node.create_subscription(WrenchStamped, config.wrench, self._on_wrench, quality())
        self._guard: subprocess.Popen | None = None
        self._dog = Watchdog(config.timeout, self.stop)
        try:
            self._await_state()
            self._await_controllers()
            if kind == "velocity":
                longest = 1.5 * config.timeout
                heard = self._commands.get_subscription_count()
                self._guard = start_guard(config.command, len(self._names), longest, heard)
        except BaseException:
            self.session.close()
            raise
        self._dog.start()
        atexit.register(self.close)

    def _await_state(self) -> None:
        with self._changed:
            if self._changed.wait_for(lambda: self._state is not None, self.config.startup):
                return
        why = "is its driver running, and ROS_DOMAIN_ID the same?"
        if self._seen:
            missing = sorted({*self._names, self.config.gripper_joint} - {*self._seen, ""})
            why = f"{', '.join(missing)} are not among {', '.join(self._seen)}"
            why = why if missing else "the wrench or their positions are missing or not finite"
        topic, longest = self.config.joint_states, self.config.startup
        raise ConnectionError(f"no joint states of the arm on {topic} for {longest:g} s: {why}")

    def _await_controllers(self) -> None:
        """Wait until a controller subscribes: earlier commands would be lost."""
        end = time.monotonic() + self.config.startup
        for publisher in filter(None, (self._commands, self._hand)):
            while not publisher.get_subscription_count():
                if time.monotonic() > end:
                    text = f"no controller listens on {publisher.topic_name}: is it active"
                    raise ConnectionError(f"{text} (ros2 control list_controllers)?")
                time.sleep(0.02)

    def _on_wrench(self, message: Any) -> None:
        parts = message.wrench.force, message.wrench.torque
        values = np.array([[part.x, part.y, part.z] for part in parts])
        frame, known = message.header.frame_id, ("", self.config.base, self.config.wrench_frame)
        if frame in known and np.isfinite(values).all():
            self._wrench, self._felt = (frame, values), time.monotonic()

    def _on_state(self, message: Any) -> None:
        config, now, last = self.config, time.monotonic(), self._state
        missing = [math.nan] * len(message.name)
        position, speed = (
            dict(zip(message.name, x if len(x) == len(missing) else missing, strict=True))
            for x in (message.position, message.velocity)
        )
        self._seen |= position
        opened = position.get(config.gripper_joint, math.nan) - config.gripper_closed
        if math.isfinite(opened):
            travel = config.gripper_open - config.gripper_closed
            self._width = config.opening * opened / travel
        complete = not math.isnan(self._width) and self._felt > -math.inf
        if not (complete and {*self._names} <= position.keys()):
            return
        q, velocity = (np.array([x[name] for name in self._names]) for x in (position, speed))
        stamp = stamp_of(message) or now
        back = -math.inf if last is None else last.time - stamp
        reset = back > (_CLOCK_RESET if now - self.received <= config.silence else 0.0)
        if (back >= 0 and not reset) or not np.isfinite(q).all():
            self.ignored += 1
            return
        last = None if reset else last
        if not np.isfinite(velocity).all():
            velocity = np.zeros(len(q))
            if last is not None:
                velocity = (q - last.joint_position) / (stamp - last.time)
        torque = None
        if config.wrench:
            frame, wrench = self._wrench
            tip, J = self._chain.transform_and_jacobian(torch.from_numpy(q))
            wrench = wrench if frame == config.base else wrench @ tip[:, :3].numpy().T
            torque = J.numpy().T @ wrench.ravel()
        state = ArmState(
            time=stamp,
            joint_position=q,
            joint_velocity=velocity,
            gripper_width=self._width,
            external_torque=torque,
        )
        with self._changed:
            # The fastest message so far determines the offset of the robot's clock.
            # A drift of 1 allows for a clock of any speed, even one that stands still.
            drift = 1.0 if self.session.node.count_publishers("/clock") else _DRIFT
            drifted = self._offset + drift * (now - self.received)
            self._offset = now - stamp if last is None else min(drifted, now - stamp)
            self._state, self.received = state, now
            self._changed.notify_all()
        if config.interface == "position" and self._velocity.any():
            with self._lock:
                self._send(self._velocity, state)
        self.answer()

    def read(self) -> ArmState:
        """Return the newest state; `time` is the stamp of its message [s].

        Raises:
            ArmFaultError: The state or the wrench is older than the config's `silence`.
        """
        with self._changed:
            state, offset = self._state, self._offset
        assert state is not None
        config, taken = self.config, state.time + offset
        frames = " or ".join(filter(None, (config.base, config.wrench_frame)))
        wrench = (self._felt, f"wrench on {config.wrench} in frame {frames}")
        since, what = min((taken, f"joint state on {config.joint_states}"), wrench)
        if (age := time.monotonic() - since) > config.silence:
            raise ArmFaultError(
                f"the newest {what} is {age:.2f} s old: the arm is stopped. Check its driver "
                "and the network."
            )
        return state

    def command(self, joint_velocity: Float[np.ndarray, " joints"]) -> None:
        """Set the joint velocities to hold [rad/s].

        Raises:
            ValueError: The velocities are not finite, or beyond the limits of the arm's
                description.
            ArmFaultError: The joint states are too old.
        """
        fastest = self._chain.limits.velocity.numpy()
        velocity = checked_velocity(joint_velocity, self._names, fastest)
        try:
            state = self.read()
        except ArmFaultError:
            self.stop()
            raise
        self._dog.feed()
        with self._lock:
            self._commanded_at = time.monotonic()
            self._send(velocity, state)

    def _send(self, velocity: np.ndarray, state: ArmState) -> None:
        """Send a velocity, starting from the goal that the previous velocity has reached by
        now.
        """
        now, config, rest = time.monotonic(), self.config, self.config.timeout
        elapsed = now - self._moved_at
        # Distance that the goal has moved since then, expressed as a time at the previous
        # velocity.
        coast = np.clip(elapsed - self._hold, 0, self._brake)
        moved = min(elapsed, self._hold) + coast * (1 - 0.5 * coast / rest)
        here, limits = state.joint_position, self._chain.limits
        goal = here if self._goal is None else self._goal + moved * self._velocity
        bounds = (here, config.lag, limits.lower.numpy(), limits.upper.numpy())
        self._goal = goal = led_goal(goal, *bounds)
        self._velocity, self._moved_at = velocity, now
        if config.interface == "trajectory":
            self._hold, self._brake = float(np.clip(elapsed, 1e-3, rest)), rest
            ahead = led_goal(goal + self._hold * velocity, *bounds)
            self._commands.publish(self._trajectory(ahead, velocity))
        else:
            # The arm has waited at the last position, and must not jump to catch up.
            self._hold = float(np.clip(self._commanded_at + rest - now, 0, rest / 3))
            values = velocity if config.interface == "velocity" else goal
            self._commands.publish(self._numbers(data=values.tolist()))

    def _trajectory(self, goal: np.ndarray, velocity: np.ndarray) -> Any:
        """Trajectory that continues with the velocity and then comes to rest."""
        from rclpy.duration import Duration
        from rclpy.time import Time
        from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

        step, rest = self._hold, self.config.timeout
        end = goal + 0.5 * rest * velocity
        message: Any = JointTrajectory(joint_names=list(self._names))
        # The stamp is a time of the robot's clock, which differs from this machine's clock in a
        # simulation, or without NTP. If states have no stamps, this clock is unknown: a stamp
        # of zero starts the trajectory immediately.
        if self._offset:
            message.header.stamp = Time(seconds=time.monotonic() - self._offset).to_msg()
        for at, position, speed in (step, goal, velocity), (step + rest, end, 0 * velocity):
            point = JointTrajectoryPoint(positions=position.tolist(), velocities=speed.tolist())
            point.time_from_start = Duration(seconds=at).to_msg()
            message.points.append(point)
        return message

    def move(self, width: float) -> None:
        """Set the opening of the gripper [m], if there is one.

        Raises:
            ValueError: The opening is NaN.
        """
        config = self.config
        if self._hand is None:
            return
        share = opened_fraction(width, config.opening)
        travel = config.gripper_open - config.gripper_closed
        self._hand.publish(self._numbers(data=[config.gripper_closed + share * travel]))

    def stop(self) -> None:
        """Bring the arm to rest, by zero velocities or by holding the last position."""
        with self._lock:
            if self._state is not None:
                self._send(np.zeros(len(self._names)), self._state)

    def recover(self) -> None:
        """Continue from where the arm is, once joint states come again.

        Raises:
            ArmFaultError: The newest joint state is still too old.
        """
        self.read()
        with self._lock:
            self._goal, self._velocity = None, np.zeros(len(self._names))

    def close(self) -> None:
        """Stop the arm and leave the graph."""
        if self._closed:
            return
        self._closed = True
        atexit.unregister(self.close)
        self._dog.close()
        self.stop()
        time.sleep(0.05)  # for the last message to leave
        if self._guard is not None:
            self._guard.kill()
            self._guard.wait()
        self.session.close()
