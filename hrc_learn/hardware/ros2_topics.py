"""Use ROS 2: report the installation, run a node in a thread, and set the quality of service.

Run as a program, this module guards a velocity controller: see `guard_velocities`. It imports
nothing of this package, so that the guard is ready in half a second.
"""

import atexit
import os
import queue
import signal
import subprocess
import sys
import sysconfig
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

_STARTUP = 10.0
"""Longest wait for a description of the robot, and for the guard [s]."""


_FAREWELL = 1.0
"""Time for which the guard sends zeros after the process that started it has died [s]."""


def ros2_origin() -> str:
    """One line that says which ROS 2 is used."""
    import rclpy

    place = Path(rclpy.__file__).parents[1]
    wheels = place in map(Path, (sysconfig.get_path("purelib"), sysconfig.get_path("platlib")))
    distribution = os.environ.get("ROS_DISTRO", "")
    name = "the wheels' rclpy" if wheels else f"the system's rclpy {distribution}".rstrip()
    domain = os.environ.get("ROS_DOMAIN_ID", "0")
    return f"ROS 2: {name} in {place}, domain {domain}"


class Ros2Session:
    """A ROS 2 node, and the thread that receives its messages.

    Attributes:
        node: The node.
    """

    def __init__(self, name: str, make: Callable[..., Any] | None = None):
        """Join the graph.

        Args:
            name: Name of the node.
            make: Creates the node; None: a plain node.
        """
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        self._context = rclpy.Context()
        # The program handles signals itself: it brings the arm to rest first.
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self.node = (make or rclpy.create_node)(name, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, name=name, daemon=True)
        self._thread.start()
        atexit.register(self.close)  # the middleware aborts a process that leaves it open

    def _spin(self) -> None:
        from rclpy.executors import ExternalShutdownException

        with suppress(ExternalShutdownException):
            self._executor.spin()

    def close(self) -> None:
        """Leave the graph."""
        atexit.unregister(self.close)
        self._executor.shutdown(timeout_sec=1.0)
        self._context.try_shutdown()
        self._thread.join(2.0)


def quality(*, reliable: bool = False, latched: bool = False) -> Any:
    """Quality of service that keeps the newest message only.

    Args:
        reliable: True resends lost messages, for commands. False (best effort) is for states,
            because a resent state would be outdated; it accepts both kinds of publishers.
        latched: True keeps the last message for later subscribers, for descriptions.
    """
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    policy = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(depth=1, reliability=policy, durability=durability)


def read_description(topic: str = "/robot_description", timeout: float = _STARTUP) -> str:
    """Read the description (URDF) that a robot publishes.

    Raises:
        ConnectionError: No description has come within the timeout [s].
    """
    from std_msgs.msg import String

    session, found = Ros2Session("hrc_description"), queue.SimpleQueue[String]()
    form = quality(reliable=True, latched=True)
    session.node.create_subscription(String, topic, found.put, form)
    try:
        return found.get(timeout=timeout).data
    except queue.Empty:
        text = f"no description on {topic} for {timeout:g} s: is robot_state_publisher running"
        raise ConnectionError(f"{text}, and is ROS_DOMAIN_ID the same?") from None
    finally:
        session.close()


def found_description(name: str) -> str:
    """Save the description that a robot publishes on a topic, and return the name of the file.
    Any other name is returned unchanged.

    Args:
        name: Topic, such as /robot_description or /robot_description:TIP, or any other name.
    """
    topic, colon, links = name.partition(":")
    if not topic.startswith("/") or Path(topic).exists() or Path(topic).suffix:
        return name
    file = Path(tempfile.mkdtemp(prefix="hrc_")) / "robot.urdf"
    file.write_text(read_description(topic), encoding="utf-8")
    return f"{file}{colon}{links}"


def stamp_of(message: Any) -> float:
    """Time in the header of a message [s]; 0 if there is none."""
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def start_guard(topic: str, joints: int, timeout: float, controllers: int) -> subprocess.Popen:
    """Start the process of `guard_velocities`, and wait until it receives the commands and
    reaches the controllers.

    Args:
        topic: Topic of the velocity controller.
        joints: Number of its joints.
        timeout: Longest time without a command after a nonzero velocity [s].
        controllers: Number of controllers that subscribe to the topic.

    Raises:
        ConnectionError: The guard does not start.
    """
    numbers = map(str, (joints, timeout, controllers, os.getpid()))
    words = [sys.executable, str(Path(__file__)), topic, *numbers]
    # In a separate session: a closed terminal or Ctrl-C must not end the guard before the
    # commanding process.
    process = subprocess.Popen(words, stdout=subprocess.PIPE, start_new_session=True)
    assert process.stdout is not None
    if not process.stdout.readline():
        raise ConnectionError(f"the guard of {topic} does not start: see its error above")
    return process


def guard_velocities(
    topic: str, joints: int, timeout: float, controllers: int, parent: int
) -> None:
    """Send zeros once the last command is a nonzero velocity and older than the timeout.

    After the process that started the guard (ID `parent`) has died, the guard sends zeros for
    another second.
    """
    from std_msgs.msg import Float64MultiArray

    session = Ros2Session(f"hrc_guard_{os.getpid()}")
    newest = {"moving": 0.0, "time": 0.0}

    def take(message: Any) -> None:
        newest.update(moving=float(any(message.data)), time=time.monotonic())

    session.node.create_subscription(Float64MultiArray, topic, take, quality(reliable=True))
    zeros = session.node.create_publisher(Float64MultiArray, topic, quality(reliable=True))
    end = time.monotonic() + _STARTUP
    # Both counts include this process; the others are the controllers and the commanding
    # process.
    while (
        zeros.get_subscription_count() < controllers + 1
        or session.node.count_publishers(topic) < 2
    ):
        if time.monotonic() > end or os.getppid() != parent:
            found = zeros.get_subscription_count() - 1
            sys.exit(f"{topic}: {found} of {controllers} controllers found in {_STARTUP:g} s")
        time.sleep(0.02)
    print("ready", flush=True)
    rest = Float64MultiArray(data=[0.0] * joints)
    while os.getppid() == parent:
        time.sleep(timeout / 5)
        if newest["moving"] and time.monotonic() - newest["time"] > timeout:
            zeros.publish(rest)
    # The guard receives its own zeros, but a controller may not have received them yet. It
    # would lose them if the publisher left the graph now.
    end = time.monotonic() + _FAREWELL
    while time.monotonic() < end:
        zeros.publish(rest)
        time.sleep(timeout / 5)
    session.close()


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # it ends after the commanding process
    topic, joints, timeout, *numbers = sys.argv[1:]
    guard_velocities(topic, int(joints), float(timeout), *map(int, numbers))
