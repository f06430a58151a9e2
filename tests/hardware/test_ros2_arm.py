"""An arm over topics of ROS 2, on the real middleware, against our simulated arm."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

# A graph of this process alone: tests run beside each other, and beside a user's robots.
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
# A killed process leaves its shared memory locked.
os.environ["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"
pytest.importorskip("rclpy")

from ros2_robot import Ros2Robot
from unchecked import shapes_unchecked

from hrc_learn.experiments.real_arm import ArmSite, run_on_arm
from hrc_learn.hardware import ArmFaultError, ArmProcess, Ros2Arm, Ros2Config
from hrc_learn.hardware.ros2_topics import Ros2Session, quality, read_description, ros2_origin
from hrc_learn.kinematics import panda
from hrc_learn.sim import SceneConfig, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.grasping import joint_plan

pytestmark = [pytest.mark.realtime, pytest.mark.simulation]
NAMES = panda.chain.joint_names
READY = panda.chain.ready.numpy()


@pytest.fixture(autouse=True)
def _unchecked():
    with shapes_unchecked():
        yield


@pytest.fixture
def world():
    world = World(replace(SceneConfig(), timestep=0.002))
    world.reset(READY)
    return world


def drive(arm, velocity, seconds, period=0.005):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        arm.command(velocity)
        time.sleep(period)


def rests(robot, within):
    """Seconds until the robot is at rest."""
    began = time.monotonic()
    while time.monotonic() - began < within:
        if np.abs(robot.state.joint_velocity).max() < 0.01:
            return time.monotonic() - began
        time.sleep(0.005)
    velocity, late = robot.state.joint_velocity, robot.late
    raise AssertionError(f"the arm moves by {velocity} after {within} s, {late:.2f} s late")


@pytest.mark.parametrize("interface", ["velocity", "position", "trajectory"])
def test_each_controller_moves_the_arm_and_a_silent_loop_stops_it(world, interface):
    config = Ros2Config(
        interface=interface, gripper="/hand/commands", gripper_joint="finger", gripper_open=0.04
    )
    with Ros2Robot(world, config) as robot, Ros2Arm(panda.chain, config) as arm:
        velocity = np.zeros(7)
        velocity[0] = 0.3
        start = robot.state
        arm.move(0.05)
        drive(arm, velocity, 0.8)
        end = robot.state
        moved = end.joint_position - start.joint_position
        # By the robot's own clock: it falls behind on a busy machine.
        assert moved[0] == pytest.approx(0.3 * (end.time - start.time), abs=0.06)
        assert moved[0] > 0.05
        np.testing.assert_allclose(moved[1:], 0, atol=5e-3)
        assert rests(robot, 1.0) > 0.05
        assert arm.read().gripper_width == pytest.approx(0.05, abs=5e-3)
        assert robot.violations == 0


class Publisher:
    """Joint states as a test wants them."""

    def __init__(self, topic="/joint_states"):
        from sensor_msgs.msg import JointState
        from std_msgs.msg import Float64MultiArray

        self.session, self._kind = Ros2Session("joints"), JointState
        node = self.session.node
        self._states = node.create_publisher(JointState, topic, quality(reliable=True))
        command = Ros2Config().command
        node.create_subscription(Float64MultiArray, command, lambda _: None, quality())

    def send(self, stamp, position, names=NAMES):
        message = self._kind(name=list(names), position=[float(x) for x in position])
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(
            round(stamp * 1e9), 10**9
        )
        self._states.publish(message)
        time.sleep(0.02)


@pytest.fixture
def arm_of_messages():
    publisher, found = Publisher(), []
    import threading

    opened = threading.Thread(
        target=lambda: found.append(Ros2Arm(panda.chain, Ros2Config(interface="position")))
    )
    opened.start()
    stamp = 100.0
    while opened.is_alive():
        stamp += 0.02
        publisher.send(stamp, READY)
    with found[0] as arm:
        yield publisher, arm, stamp
    publisher.session.close()


def test_joints_are_found_by_name_and_old_or_partial_messages_are_ignored(arm_of_messages):
    publisher, arm, stamp = arm_of_messages
    other = READY + 0.1 * np.arange(7)
    publisher.send(stamp + 0.1, [0.02, *other[::-1]], ["finger", *NAMES[::-1]])
    np.testing.assert_allclose(arm.read().joint_position, other)
    publisher.send(stamp + 0.05, READY)  # reordered
    publisher.send(stamp + 0.15, [np.nan, *other[1:]])
    publisher.send(stamp + 0.2, [0.02], ["finger"])
    np.testing.assert_allclose(arm.read().joint_position, other)
    assert arm.ignored == 2
    publisher.send(stamp - 50, READY)  # the clock was set anew, as by a simulation
    assert arm.read().time == pytest.approx(stamp - 50)


def test_an_old_state_stops_the_arm_until_new_ones_come(arm_of_messages):
    publisher, arm, stamp = arm_of_messages
    publisher.send(stamp + 0.1, READY)
    arm.command(np.zeros(7))
    time.sleep(0.3)
    with pytest.raises(ArmFaultError, match=r"/joint_states is 0\.\d+ s old: the arm"):
        arm.command(np.full(7, 0.1))
    publisher.send(stamp + 0.45, READY)
    arm.recover()
    arm.command(np.full(7, 0.1))
    with pytest.raises(ValueError, match=r"joint1: 9\.000 rad/s is beyond its limit"):
        arm.command(np.full(7, 9.0))


LOOP = """
import signal, time
import numpy as np
from hrc_learn.hardware import Ros2Arm, Ros2Config
from hrc_learn.kinematics import panda
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # ignored if the tests run under nohup
with Ros2Arm(panda.chain, Ros2Config()) as arm:
    print("ready", flush=True)
    while True:
        arm.command(np.array([0.3, 0, 0, 0, 0, 0, 0]))
        time.sleep(0.005)
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGHUP, signal.SIGTERM])
def test_a_killed_node_leaves_the_arm_at_rest(world, number):
    """The velocity controller has no time-out of its own: the guard sends zeros, also if a
    terminal or a supervisor ends all processes of the node.
    """
    with Ros2Robot(world) as robot:
        node = subprocess.Popen(
            [sys.executable, "-c", LOOP],
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        assert node.stdout is not None
        assert node.stdout.readline() == "ready\n"
        time.sleep(0.3)
        assert robot.state.joint_velocity[0] > 0.2
        os.killpg(node.pid, number)
        node.wait()
        assert rests(robot, 2.0) < 1.0


def test_a_short_job_runs_over_topics():
    """The work cell's loop and safety filter, an arm process and the middleware."""
    workplace = Workplace.of(panda)
    world = World(replace(workplace.scene, timestep=0.002))
    world.reset(READY)
    goal = READY + 0.15 * np.array([1, -1, 1, 1, -1, 1, 1])

    def task(cell, check):
        plan = joint_plan(cell, cell.joints, torch.from_numpy(goal))
        check(plan)
        # On a busy machine the loop comes late: half a second at the end makes up for it.
        cell.follow_path(np.concatenate([plan.path, np.repeat(plan.path[-1:], 50, axis=0)]))
        return ""

    with Ros2Robot(world) as robot:
        done = run_on_arm(ArmSite(driver="ros2", touch=False), workplace, task)
        assert done.failure == ""
        np.testing.assert_allclose(robot.state.joint_position, goal, atol=0.02)
        assert robot.violations == 0
        assert rests(robot, 1.0) < 0.5


def test_the_driver_runs_in_a_process_of_its_own(world):
    from functools import partial

    with (
        Ros2Robot(world) as robot,
        ArmProcess(partial(Ros2Arm, panda.chain), timeout=0.15) as arm,
    ):
        drive(arm, np.array([0.3, 0, 0, 0, 0, 0, 0]), 0.5)
        assert arm.trips == 0
        assert rests(robot, 1.0) > 0.05


def test_a_description_is_read_from_its_topic():
    from std_msgs.msg import String

    session = Ros2Session("publisher")
    form = quality(reliable=True, latched=True)
    publisher = session.node.create_publisher(String, "/robot_description", form)
    publisher.publish(String(data="<robot name='r'/>"))
    assert read_description() == "<robot name='r'/>"
    with pytest.raises(ConnectionError, match=r"no description on /elsewhere for 0\.3 s"):
        read_description("/elsewhere", timeout=0.3)
    session.close()


def test_one_line_says_which_ros_is_used(monkeypatch):
    monkeypatch.delenv("ROS_DISTRO", raising=False)
    assert ros2_origin().startswith("ROS 2: the wheels' rclpy in ")
    assert ros2_origin().endswith(f"domain {os.environ['ROS_DOMAIN_ID']}")
