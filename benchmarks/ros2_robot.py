"""Publish the simulated workplace as a ROS 2 robot with the topics of standard controllers.

python benchmarks/ros2_robot.py --interface trajectory
"""

from __future__ import annotations

import random
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

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
    """

    def __init__(
        self,
        world: World,
        config: Ros2Config | None = None,
        rate: float = 500.0,
        hostile: float = 0.0,
    ):
        """Publish joint states.

        Args:
            world: The world.
            config: Topics.
            rate: Joint states a second.
            hostile: Fraction of states and of commands that are lost, and as many that come
                50 ms late, after newer ones.
        """
        from sensor_msgs.msg import JointState
        from std_msgs.msg import Float64MultiArray
        from trajectory_msgs.msg import JointTrajectory

        self.world, self._config = world, config or Ros2Config()
        self._rate, self.violations, self.commands = rate, 0, 0
        self._silent, self._hostile, self._chance = False, hostile, random.Random(0)
        self._late: list[tuple[float, Any]] = []
        self.late, self.state = 0.0, world.arm.read()
        self._chain = world.arm.robot.chain
        self._velocity = np.zeros(len(self._chain.joint_names))
        self._path: tuple[np.ndarray, np.ndarray] | None = None
        self.session, self._ended = Ros2Session("hrc_robot"), threading.Event()
        node, config = self.session.node, self._config
        reliable = quality(reliable=True)
        self._states = node.create_publisher(
            JointState, config.joint_states, quality(reliable=True)
        )
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
        order = [message.joint_names.index(name) for name in self._chain.joint_names]
        times = [
            p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in message.points
        ]
        begin = stamp_of(message) or time.time()
        positions = np.array([p.positions for p in message.points])[:, order]
        self._path = (begin + np.array(times), positions)

    def pause(self) -> None:
        """Stop publishing joint states, while the arm continues."""
        self._silent = True

    def resume(self) -> None:
        """Publish joint states again."""
        self._silent = False

    def _run(self) -> None:
        due = time.monotonic()
        while not self._ended.is_set():
            due = max(due + 1 / self._rate, time.monotonic() - _BEHIND)
            self.late = time.monotonic() - due
            self._step()
            time.sleep(max(0.0, due - time.monotonic()))

    def _step(self) -> None:
        arm, limits = self.world.arm, self._chain.limits
        path, velocity = self._path, self._velocity
        if path is not None:
            q = arm.read().joint_position
            ahead = [np.interp(time.time(), path[0], column) for column in path[1].T]
            fastest = limits.velocity.numpy()
            velocity = np.clip(_GAIN * (np.array(ahead) - q), -fastest, fastest)
        arm.command(velocity)
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
        message.header.stamp = self.session.node.get_clock().now().to_msg()
        if not self._meets_trouble(lambda: self._states.publish(message)):
            self._states.publish(message)

    def close(self) -> None:
        """Stop publishing."""
        self._ended.set()
        self._thread.join(2.0)
        self.session.close()

    def __enter__(self) -> Ros2Robot:
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
