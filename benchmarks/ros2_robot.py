"""Publish the simulated workplace as a ROS 2 robot with the topics of standard controllers.

python benchmarks/ros2_robot.py --interface trajectory
"""

from __future__ import annotations

import math
import random
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import torch

from hrc_learn import cli
from hrc_learn.cli import write_values
from hrc_learn.hardware.ros2_arm import Ros2Config
from hrc_learn.hardware.ros2_topics import Ros2Session, quality, ros2_origin, stamp_of
from hrc_learn.kinematics import ArmChoice
from hrc_learn.protocols import ArmState
from hrc_learn.sim import SceneConfig
from hrc_learn.sim.world import World

_BEHIND = 0.5
"""Largest delay that is caught up on a busy machine [s]."""
_GAIN = 20.0
"""Gain of the position controller [1/s]."""
_UNANSWERED = 0.01
"""Time without a command before the robot waits for the next one [s]: the loop's period."""
_SLOWER = 2
"""Joint states for each wrench and for each message of a simulated clock."""


def stamp_at(seconds: float) -> Any:
    """Time stamp of a message at a time [s]."""
    from rclpy.time import Time

    return Time(seconds=seconds).to_msg()


class Ros2Robot:
    """Steps a world in real time, publishes its joints and follows commands.

    As with ros2_control, a velocity holds until the next one: there is no timeout. Commands
    beyond the joints' limits are counted and executed.

    Attributes:
        world: The world.
        violations: Number of steps in which a joint was beyond its limits of position or speed.
        commands: Number of commands received.
        state: Newest reading. Use it instead of the world's own while the world is stepped.
        late: Delay of the last step behind real time [s].
        now: Time stamp of the last step [s].
        held: Total of the waits for commands [s].
    """

    def __init__(
        self,
        world: World,
        config: Ros2Config | None = None,
        rate: float = 500.0,
        hostile: float = 0.0,
        waits: float = 0.0,
    ):
        """Publish joint states.

        Args:
            world: The world.
            config: Topics.
            rate: Joint states a second.
            hostile: Fraction of states and of commands that are lost, and as many that come
                50 ms late, after newer ones.
            waits: Longest wait for the next command [s], once the first has come; shorter than
                the driver's `silence`. Positive: the robot's clock stands still meanwhile, and
                is published as simulators do, so that a busy machine changes nothing.
        """
        from geometry_msgs.msg import WrenchStamped
        from rosgraph_msgs.msg import Clock
        from sensor_msgs.msg import JointState
        from std_msgs.msg import Float64MultiArray
        from trajectory_msgs.msg import JointTrajectory

        self.world, self._config = world, config or Ros2Config()
        self._rate, self.violations, self.commands = rate, 0, 0
        self._sensed, self._waits = 0, waits
        self._silent, self._hostile, self._chance = False, hostile, random.Random(0)
        self._late: list[tuple[float, Any]] = []
        self.late, self.now, self.state = 0.0, time.time(), world.arm.read()
        self.held = 0.0
        self._heard, self._answered = threading.Event(), math.inf
        self._chain = world.arm.robot.chain
        self._velocity = self._sent = np.zeros(len(self._chain.joint_names))
        self._path: tuple[np.ndarray, np.ndarray] | None = None
        self.session, self._ended = Ros2Session("hrc_robot"), threading.Event()
        node, config = self.session.node, self._config
        reliable = quality(reliable=True)
        self._states = node.create_publisher(
            JointState, config.joint_states, quality(reliable=True)
        )
        if config.wrench:
            self._wrenches = node.create_publisher(WrenchStamped, config.wrench, reliable)
        self._clocks = node.create_publisher(Clock, "/clock", reliable) if waits else None
        trajectory = config.interface == "trajectory"
        form = JointTrajectory if trajectory else Float64MultiArray
        take = self._on_trajectory if trajectory else self._on_values
        node.create_subscription(form, config.command, take, reliable)
        if config.gripper:
            node.create_subscription(Float64MultiArray, config.gripper, self._on_hand, reliable)
        self._thread = threading.Thread(target=self._run, name="ros2 robot", daemon=True)
        self._thread.start()

    def _meets_trouble(self, act: Any) -> bool:
        """True if a message is lost, or delayed by 50 ms."""
        chance = self._chance.random()
        if chance < self._hostile:
            self._late.append((time.monotonic() + 0.05, act))
        return chance < 2 * self._hostile

    def _on_values(self, message: Any, late: bool = False) -> None:
        if not late and self._meets_trouble(lambda: self._on_values(message, True)):
            return
        self.commands += 1
        self._heard.set()
        values = np.array(message.data)
        if self._config.interface == "velocity":
            self._velocity = values
        else:
            self._path = (np.array([-np.inf]), values[None])

    def _on_hand(self, message: Any) -> None:
        config = self._config
        share = (message.data[0] - config.gripper_closed) / (
            config.gripper_open - config.gripper_closed
        )
        self.world.arm.move(share * config.opening)

    def _on_trajectory(self, message: Any) -> None:
        self.commands += 1
        self._heard.set()
        order = [message.joint_names.index(name) for name in self._chain.joint_names]
        times = [
            p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in message.points
        ]
        begin = stamp_of(message) or self.now
        positions = np.array([p.positions for p in message.points])[:, order]
        self._path = (begin + np.array(times), positions)

    def pause(self) -> None:
        """Stop publishing joint states, while the arm continues."""
        self._silent = True

    def resume(self) -> None:
        """Publish joint states again."""
        self._silent = False

    def _run(self) -> None:
        due, period = time.monotonic(), 1 / self._rate
        while not self._ended.is_set():
            self.late = time.monotonic() - due
            # A clock that waits is that of the world.
            self.now = self.now + period if self._waits else time.time()
            self._step()
            self.held += self._wait_for_command()
            due = max(due + period, time.monotonic() - _BEHIND)
            time.sleep(max(0.0, due - time.monotonic()))

    def _wait_for_command(self) -> float:
        """Let the clock stand still until the loop has answered; returns for how long [s]."""
        begun = time.monotonic()
        if self._waits and self.now - self._answered > _UNANSWERED:
            self._heard.wait(self._waits)
        if self._heard.is_set():
            self._answered = self.now
            self._heard.clear()
        return time.monotonic() - begun

    def _step(self) -> None:
        arm, limits = self.world.arm, self._chain.limits
        path, velocity = self._path, self._velocity
        if path is not None:
            q = arm.read().joint_position
            ahead = [np.interp(self.now, path[0], column) for column in path[1].T]
            fastest = limits.velocity.numpy()
            velocity = np.clip(_GAIN * (np.array(ahead) - q), -fastest, fastest)
        if velocity is not self._sent:  # the arm delays each command by a time of its own
            arm.command(velocity)
        self._sent = velocity
        self.world.advance(1 / self._rate)
        self.state = state = arm.read()
        fast = np.abs(state.joint_velocity) > 1.02 * limits.velocity.numpy()
        low = state.joint_position < limits.lower.numpy() - 1e-3
        high = state.joint_position > limits.upper.numpy() + 1e-3
        self.violations += bool((fast | low | high).any())
        due = [one for one in self._late if one[0] <= time.monotonic()]
        for one in due:
            self._late.remove(one)
            one[1]()
        if not self._silent:
            self._publish(state)

    def _publish(self, state: ArmState) -> None:
        from rosgraph_msgs.msg import Clock
        from sensor_msgs.msg import JointState

        hand, config = [], self._config
        if config.gripper_joint:
            travel = config.gripper_open - config.gripper_closed
            hand = [config.gripper_closed + travel * state.gripper_width / config.opening]
        message = JointState(
            name=[*self._chain.joint_names, *([config.gripper_joint] if hand else ())],
            position=[*state.joint_position.tolist(), *hand],
            velocity=[*state.joint_velocity.tolist(), *(0.0 for _ in hand)],
        )
        message.header.stamp = stamp_at(self.now)
        self._sensed = (self._sensed + 1) % _SLOWER
        if self._config.wrench and not self._sensed:
            self._publish_wrench(state)
        if self._clocks is not None and not self._sensed:
            self._clocks.publish(Clock(clock=message.header.stamp))
        if not self._meets_trouble(lambda: self._states.publish(message)):
            self._states.publish(message)

    def _publish_wrench(self, state: ArmState) -> None:
        """Publish the wrench at the tool that best explains the external torques."""
        from geometry_msgs.msg import WrenchStamped

        assert state.external_torque is not None, "the arm estimates no torques"
        _, J = self._chain.transform_and_jacobian(torch.from_numpy(state.joint_position))
        wrench = np.linalg.lstsq(J.mT.numpy(), state.external_torque, rcond=None)[0].tolist()
        message = WrenchStamped()
        message.header.frame_id = self._config.base
        message.header.stamp = stamp_at(self.now)
        for part, values in zip(("force", "torque"), (wrench[:3], wrench[3:]), strict=True):
            for axis, value in zip("xyz", values, strict=True):
                setattr(getattr(message.wrench, part), axis, value)
        self._wrenches.publish(message)

    def close(self) -> None:
        """Stop publishing."""
        self._ended.set()
        self._thread.join(2.0)
        self.session.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@dataclass(frozen=True, kw_only=True)
class Args:
    """Publish a simulated arm until Ctrl-C."""

    robot: str = "panda"
    """Arm by name, or its description."""
    interface: Literal["velocity", "position", "trajectory"] = "velocity"
    """Controller that listens on /forward_velocity_controller/commands or on `command`."""
    command: str = Ros2Config.command
    """Topic of the controller."""
    hostile: float = 0.0
    """Fraction of states and commands that are lost; the same fraction is delayed by 50 ms."""
    duration: float = float("inf")
    """Duration [s]."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> None:
    """Run until the end."""
    config = Ros2Config(interface=args.interface, command=args.command)
    scene = replace(SceneConfig(), timestep=0.002)
    arm = ArmChoice(args.robot).work_arm()
    world = World(replace(scene, arm=replace(scene.arm, robot=arm)))
    world.reset(arm.chain.ready.numpy())
    end = time.monotonic() + args.duration
    with Ros2Robot(world, config, hostile=args.hostile) as robot, suppress(KeyboardInterrupt):
        print(ros2_origin(), flush=True)
        while time.monotonic() < end:
            time.sleep(0.1)
    figures = {"commands": robot.commands, "violations": robot.violations}
    write_values(args.json, figures)


if __name__ == "__main__":
    cli.run(main, Args)
