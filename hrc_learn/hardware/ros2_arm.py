"""Drive an arm over ROS 2 topics: joint states come in, commands go to standard controllers.

Tested over real middleware against our simulated arm; NOT RUN ON HARDWARE. If the system's
ROS 2 has been sourced, this ROS 2 is used, otherwise the wheels of `hrc-learn[ros2]`.
"""

from __future__ import annotations

import atexit
import math
import subprocess
import threading
import time
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from hrc_learn.geometry.numerics import check_settings
from hrc_learn.hardware.driver_process import ArmFaultError, Connected, checked_velocity
from hrc_learn.hardware.lerobot_arm import led_goal
from hrc_learn.hardware.ros2_topics import Ros2Session, quality, stamp_of, start_guard
from hrc_learn.kinematics import SerialChain
from hrc_learn.protocols import ArmState
from hrc_learn.watchdog import Watchdog

_CLOCK_RESET = 1.0
"""Backward step of the time stamps [s] above which the clock must have been reset. After a
smaller step, the message was only reordered."""


@dataclass(frozen=True, kw_only=True)
class Ros2Config:
    """Topics and settings of an arm."""

    joint_states: str = "/joint_states"
    """Topic of the joint states. Joints are found by name."""
    base: str = "base_link"
    """Frame of goals and markers of `hrc serve --ros2`; empty: goals of any frame are taken."""
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
        check_settings(self, finite=("timeout", "silence", "startup", "lag"))
        if bool(self.gripper) != bool(self.gripper_joint):
            raise ValueError(
                "gripper and gripper_joint belong together: give both, or neither."
            )


class Ros2Arm(Connected):
    """An arm of ros2_control, or one with the same topics, driven by velocities.

    A velocity holds for at most the config's `timeout`. Reordered or incomplete joint states
    are ignored; once the newest is older than `silence`, `read` and `command` raise
    `ArmFaultError` until new ones come. If this process dies, a trajectory ends at rest by
    itself, and a position is held. A velocity controller would hold its last command for ever:
    therefore, a guard in a process of its own then sends zeros.

    Attributes:
        session: The node.
        ignored: Number of joint states with all joints that were reordered, or lacked a finite
            position of a joint.
        received: Arrival time of the newest joint state, by this machine's monotonic clock [s].
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
        self.session = Ros2Session("hrc_arm")
        from sensor_msgs.msg import JointState
        from std_msgs.msg import Float64MultiArray
        from trajectory_msgs.msg import JointTrajectory

        self._lock, self._changed = threading.Lock(), threading.Condition()
        self._state: ArmState | None = None
        self._offset, self.received, self._seen = math.inf, -math.inf, ()
        self._velocity = np.zeros(len(self._names))
        self._goal: np.ndarray | None = None
        self._commanded_at, self._moved_at, self._step = -math.inf, 0.0, config.timeout
        node, kind, self._numbers = self.session.node, config.interface, Float64MultiArray
        form = JointTrajectory if kind == "trajectory" else Float64MultiArray
        self._hand, once = None, quality(reliable=True)
        if config.gripper:
            self._hand = node.create_publisher(Float64MultiArray, config.gripper, once)
        self._commands = node.create_publisher(form, config.command, once)
        node.create_subscription(JointState, config.joint_states, self._on_state, quality())
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
            missing = ", ".join(sorted({*self._names} - {*self._seen}))
            why = f"{missing} are not among {', '.join(self._seen)}"
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

    def _on_state(self, message: Any) -> None:
        names, now = message.name, time.monotonic()
        self._seen = names
        places = {name: i for i, name in enumerate(names)}
        if not {*self._names} <= places.keys():
            return
        order = [places[name] for name in self._names]
        complete = len(message.position) == len(names)
        position = np.array(message.position if complete else [np.nan] * len(names))[order]
        stamp, last = stamp_of(message) or now, self._state
        reordered = last is not None and stamp <= last.time
        if reordered and last is not None and last.time - stamp > _CLOCK_RESET:
            reordered, self._offset, last = False, math.inf, None
        if reordered or not np.isfinite(position).all():
            self.ignored += 1
            return
        velocity = np.array(message.velocity, float)
        if len(velocity) == len(names) and np.isfinite(velocity[order]).all():
            velocity = velocity[order]
        elif last is None:
            velocity = np.zeros(len(order))
        else:
            velocity = (position - last.joint_position) / (stamp - last.time)
        config, width = self.config, 0.0
        if config.gripper_joint in places:
            moved = message.position[places[config.gripper_joint]] - config.gripper_closed
            width = config.opening * moved / (config.gripper_open - config.gripper_closed)
        elif last is not None:
            width = last.gripper_width
        state = ArmState(
            time=stamp, joint_position=position, joint_velocity=velocity, gripper_width=width
        )
        with self._changed:
            # The fastest message so far determines the offset of the robot's clock.
            self._offset = min(self._offset, now - stamp)
            self._state, self.received = state, now
            self._changed.notify_all()
        if config.interface == "position" and self._velocity.any():
            with self._lock:
                self._send(self._velocity, state)

    def read(self) -> ArmState:
        """Return the newest state; `time` is the stamp of its message [s].

        Raises:
            ArmFaultError: The state is older than the config's `silence`.
        """
        with self._changed:
            state, offset = self._state, self._offset
        assert state is not None
        age = time.monotonic() - (state.time + offset)
        if age > self.config.silence:
            raise ArmFaultError(
                f"the newest joint state on {self.config.joint_states} is {age:.2f} s old: the "
                "arm is stopped. Check its driver and the network."
            )
        return state

    def wait(self, after: float, timeout: float) -> bool:
        """Wait for a state newer than a given time; False after the timeout [s]."""
        with self._changed:
            newer = lambda: self._state is not None and self._state.time > after  # noqa: E731
            return self._changed.wait_for(newer, timeout)

    def command(self, joint_velocity: Float[np.ndarray, " joints"]) -> None:
        """Set the joint velocities to hold [rad/s].

        Raises:
            ValueError: They are not finite, or beyond the limits of the arm's description.
            ArmFaultError: The joint states are too old.
        """
        velocity = checked_velocity(
            joint_velocity, self._names, self._chain.limits.velocity.numpy()
        )
        try:
            state = self.read()
        except ArmFaultError:
            self.stop()
            raise
        self._dog.feed()
        with self._lock:
            self._send(velocity, state)
            self._commanded_at = time.monotonic()

    def _send(self, velocity: np.ndarray, state: ArmState) -> None:
        """Send a velocity, starting from where the previous one has moved the goal by now."""
        now, config, rest = time.monotonic(), self.config, self.config.timeout
        elapsed = now - self._moved_at
        if config.interface == "trajectory":
            # Distance along the last trajectory, as a time at its velocity: the trajectory
            # keeps the velocity for its step, then brakes.
            coast = np.clip(elapsed - self._step, 0, rest)
            moved = min(elapsed, self._step) + coast * (1 - 0.5 * coast / rest)
        else:
            # The arm has waited at the last position: a sudden catch-up would be a jump.
            held = min(now, self._commanded_at + rest) - self._moved_at
            moved = np.clip(held, 0, rest / 3)
        here, limits = state.joint_position, self._chain.limits
        goal = here if self._goal is None else self._goal + moved * self._velocity
        bounds = (here, config.lag, limits.lower.numpy(), limits.upper.numpy())
        self._goal = goal = led_goal(goal, *bounds)
        self._velocity, self._moved_at = velocity, now
        if config.interface == "trajectory":
            self._step = float(np.clip(elapsed, 1e-3, rest))
            ahead = led_goal(goal + self._step * velocity, *bounds)
            self._commands.publish(self._trajectory(ahead, velocity))
        else:
            values = velocity if config.interface == "velocity" else goal
            self._commands.publish(self._numbers(data=values.tolist()))

    def _trajectory(self, goal: np.ndarray, velocity: np.ndarray) -> Any:
        """Trajectory that continues with the velocity and then comes to rest."""
        from rclpy.duration import Duration
        from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

        step, rest = self._step, self.config.timeout
        end = goal + 0.5 * rest * velocity
        message: Any = JointTrajectory(joint_names=list(self._names))
        message.header.stamp = self.session.node.get_clock().now().to_msg()
        for at, position, speed in (step, goal, velocity), (step + rest, end, 0 * velocity):
            point = JointTrajectoryPoint(positions=position.tolist(), velocities=speed.tolist())
            point.time_from_start = Duration(seconds=at).to_msg()
            message.points.append(point)
        return message

    def move(self, width: float) -> None:
        """Set the opening of the gripper [m], if there is one."""
        config = self.config
        if self._hand is None:
            return
        share = float(np.clip(width / config.opening, 0.0, 1.0))
        travel = config.gripper_open - config.gripper_closed
        self._hand.publish(self._numbers(data=[config.gripper_closed + share * travel]))

    def stop(self) -> None:
        """Bring the arm to rest, by zero velocities or by holding the last position."""
        with self._lock:
            state = self._state
            if state is not None:
                self._send(np.zeros(len(self._names)), state)

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
        atexit.unregister(self.close)
        self._dog.close()
        self.stop()
        time.sleep(0.05)  # for the last message to leave
        if self._guard is not None:
            self._guard.kill()
            self._guard.wait()
        self.session.close()
