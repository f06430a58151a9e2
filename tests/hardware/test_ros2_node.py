"""The controller as a lifecycle node, on the real middleware, against our simulated arm."""

import json
import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tyro

os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"
pytest.importorskip("rclpy")

from commands import hrc
from ros2_robot import Ros2Robot
from unchecked import shapes_unchecked

from hrc_learn.hardware.ros2_node import PARAMETERS, ControllerNode
from hrc_learn.hardware.ros2_topics import quality
from hrc_learn.kinematics import panda
from hrc_learn.sim import SceneConfig, World

pytestmark = [pytest.mark.realtime, pytest.mark.simulation]
POSE = panda.chain.forward(panda.chain.ready)


@pytest.fixture(autouse=True)
def _unchecked():
    with shapes_unchecked():
        yield


@pytest.fixture
def robot():
    world = World(replace(SceneConfig(), timestep=0.002))
    world.reset(panda.chain.ready.numpy())
    with Ros2Robot(world, rate=100.0) as robot:
        yield robot


@pytest.fixture
def node(robot):
    node = ControllerNode(panda.chain)
    yield node
    node.close()


def until(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < end, "it does not come"
        time.sleep(0.02)
    return value


class Peer:
    """Publishes to the node and hears it."""

    def __init__(self, robot):
        self.node, self.heard = robot.session.node, {}

    def send(self, kind, topic, **values):
        publisher = self.node.create_publisher(kind, topic, quality(reliable=True))
        until(publisher.get_subscription_count)
        publisher.publish(kind(**values))

    def hear(self, kind, topic):
        self.node.create_subscription(
            kind, topic, lambda m: self.heard.update({topic: m}), quality(reliable=True)
        )


def goal_at(position, frame="base_link"):
    from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion

    w, x, y, z = map(float, POSE.orientation)
    at = Point(**dict(zip("xyz", map(float, position), strict=True)))
    message = PoseStamped(pose=Pose(position=at, orientation=Quaternion(x=x, y=y, z=z, w=w)))
    message.header.frame_id = frame
    return {"header": message.header, "pose": message.pose}


def test_it_goes_to_a_goal_and_stops_when_the_robot_falls_silent(robot, node):
    from diagnostic_msgs.msg import DiagnosticArray
    from geometry_msgs.msg import PoseStamped
    from visualization_msgs.msg import MarkerArray

    peer = Peer(robot)
    peer.hear(DiagnosticArray, "/diagnostics")
    peer.hear(MarkerArray, "/hrc_learn/markers")
    assert node.start()
    goal = POSE.position.numpy() + np.array([0.03, -0.04, 0.03])
    peer.send(PoseStamped, "/hrc_learn/goal", **goal_at(goal + 1, "camera"))  # refused
    peer.send(PoseStamped, "/hrc_learn/goal", **goal_at(goal))

    def apart():
        tool = panda.chain.forward(robot.state.joint_position).position.numpy()
        return np.abs(tool - goal).max()

    until(lambda: apart() < 0.022)  # the box has half edges of 0.02 m
    assert robot.violations == 0
    box, path = until(lambda: peer.heard.get("/hrc_learn/markers")).markers
    assert (box.scale.x, box.header.frame_id) == (0.04, "base_link")
    assert len(path.points) > 1
    until(lambda: "/diagnostics" in peer.heard)
    robot.pause()
    silent = until(lambda: (s := peer.heard["/diagnostics"].status[0]).level != b"\0" and s)
    assert "the newest joint state on /joint_states is" in silent.message
    robot.resume()
    until(lambda: np.abs(robot.state.joint_velocity).max() < 0.01)
    assert node.node.trigger_activate() is not None  # goes on from where the arm is
    assert np.isfinite(node.figures()["latency_p99_ms"])


def test_images_with_a_marker_move_the_arm_towards_the_target(robot, node):
    import cv2
    from geometry_msgs.msg import Point, PointStamped
    from rclpy.parameter import Parameter
    from sensor_msgs.msg import CompressedImage

    assert node.node.set_parameters([Parameter("marker", value=7.0)])[0].successful
    assert node.start()
    drawn = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    image = np.full((480, 640), 255, np.uint8)
    image[200:280, 300:380] = cv2.aruco.generateImageMarker(drawn, 7, 80)
    data = cv2.imencode(".png", image)[1].tobytes()
    peer, start = Peer(robot), robot.state.joint_position
    target = Point(x=320.0, y=240.0, z=0.0)
    peer.send(PointStamped, "/hrc_learn/target", point=target)

    def moves():
        peer.send(CompressedImage, "/hrc_learn/image/compressed", format="png", data=data)
        return np.abs(robot.state.joint_position - start).max() > 0.01

    until(moves)
    assert node.stopped == ""
    assert robot.violations == 0


def test_a_missing_heartbeat_stops_it(robot, node):
    from rclpy.parameter import Parameter

    low, high = PARAMETERS["heartbeat"][1:3]
    refused = node.node.set_parameters([Parameter("heartbeat", value=high + 1)])
    assert not refused[0].successful
    assert low == 0
    assert node.node.set_parameters([Parameter("heartbeat", value=0.3)])[0].successful
    assert node.start()
    until(lambda: node.stopped.startswith("no heartbeat for 0.3"))


def test_the_command_serves_the_node(robot, tmp_path):
    outcome = hrc(
        "serve", "--ros2", "--config", "step=eager", "--duration", "2", "--json", tmp_path / "j"
    )
    assert outcome.status == 0, outcome.error
    assert "ROS 2: " in outcome.output
    figures = json.loads((tmp_path / "j").read_text())
    assert figures["commands"] > 10
    assert figures["safety_invalid"] == 0


def test_the_launch_file_starts_a_command_that_exists():
    """Launch files in XML need no ROS to be read; the command line parses what they start."""
    from xml.etree import ElementTree

    from hrc_learn.cli.arguments import Serve

    file = Path(__file__).parents[2] / "docs/howto/ros2_launch.xml"
    launch = ElementTree.parse(file).getroot()
    (started,) = launch.findall("executable")
    defaults = {one.get("name"): one.get("default", "") for one in launch.findall("arg")}
    words = started.attrib["cmd"]
    for name, value in defaults.items():
        words = words.replace(f"$(var {name})", value)
    program, command, *options = words.split()
    assert (program, command) == ("hrc", "serve")
    parsed = tyro.cli(Serve, args=options)
    assert parsed.ros2
    assert parsed.robot == "/robot_description:tool0"
    assert parsed.config == ("autostart=false",)
