"""Arms behind drivers call by call: driver, topics and clock are the test's."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("lerobot")

from lerobot.utils.errors import DeviceAlreadyConnectedError

from hrc_learn.hardware import FrankyArm, Ros2Config
from hrc_learn.kinematics import panda
from hrc_learn.lerobot import driven_arms
from hrc_learn.lerobot.arm_values import GRIPPER, ArmValues
from hrc_learn.lerobot.driven_arms import (
    FrankaPanda,
    FrankaPandaConfig,
    Ros2ArmRobotConfig,
    Ros2Camera,
    Ros2CameraConfig,
)
from hrc_learn.lerobot.person import PersonConfig
from hrc_learn.protocols import ArmState

# Stand-ins are not of the annotated types.
pytestmark = pytest.mark.simulation

READY = panda.chain.ready.numpy()
JOINTS = ArmValues(panda.chain).joints


@pytest.mark.parametrize(
    "make", [lambda **x: FrankaPandaConfig(ip="x", **x), Ros2ArmRobotConfig]
)
@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"fps": 5.0, "timeout": 0.31}, ""),
        ({"fps": 4.99, "timeout": 0.5}, "fps must be from 5 to 1000, but is 4.99"),
        ({"fps": 1000.0}, ""),
        ({"fps": 1000.1}, "fps must be from 5 to 1000"),
        ({"fps": 8.0, "timeout": 0.1875}, "longer than an action and a half at 8 fps"),
        ({"fps": 8.0, "timeout": 0.1876}, ""),
        (
            {"person": PersonConfig(kind="scripted"), "action_space": "ee"},
            "simulated arms only",
        ),
    ],
)
def test_settings_of_real_arms_are_checked(make, settings, complaint):
    if complaint:
        with pytest.raises(ValueError, match=complaint):
            make(**settings)
    else:
        make(**settings)


class Process:
    """The process of a driver: an arm that does what it is told, and what was asked of it."""

    def __init__(self, driver, timeout):
        self.driver, self.timeout, self.stops, self.calls = driver, timeout, 4, []
        self.trips = 4  # as of the last answer
        self.q, self.velocity, self.now = READY.copy(), np.zeros(7), 1.0

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.calls.append("close")

    def read(self):
        self.trips = self.stops
        return ArmState(
            time=self.now,
            joint_position=self.q.copy(),
            joint_velocity=self.velocity.copy(),
            gripper_width=0.04,
        )

    def command(self, velocity):
        if self.trips == self.stops:
            self.velocity = np.array(velocity)
        self.trips = self.stops

    def move(self, width):
        self.calls.append(("move", width))

    def feed(self):
        self.calls.append("feed")
        self.trips = self.stops

    def turn(self, dt):
        self.q, self.now = self.q + dt * self.velocity, self.now + dt


@pytest.fixture
def robot(monkeypatch, tmp_path):
    monkeypatch.setattr(driven_arms, "ArmProcess", Process)
    config = FrankaPandaConfig(calibration_dir=tmp_path, ip="10.0.0.1", fps=20.0, timeout=0.2)
    robot = FrankaPanda(config)
    camera = SimpleNamespace(
        connect=lambda: seen.append("connect"),
        disconnect=lambda: seen.append("disconnect"),
        read_latest=lambda: "image",
    )
    robot.cameras, robot.seen = {"front": camera}, []
    seen = robot.seen
    robot.judged = False
    robot.connect()
    yield robot
    if robot.is_connected:
        robot.disconnect()


def act(robot, joints, **more):
    sent = robot.send_action(dict(zip(JOINTS, joints.tolist(), strict=True)) | more)
    robot.arm.turn(robot.dt)
    return sent


def test_an_arm_is_driven_in_a_process_and_ends_with_its_cameras(robot):
    process = robot.arm
    assert process.timeout == 0.2
    assert process.driver.func is FrankyArm
    assert process.driver.args == ("10.0.0.1", robot.config.driver())
    assert robot.get_observation()["front"] == "image"
    assert robot.seen == ["connect"]
    robot.disconnect()
    assert process.calls == ["close"]
    assert robot.seen == ["connect", "disconnect"]


def test_each_action_is_a_sign_of_life_and_a_width_that_is_none_moves_nothing(robot):
    robot.arm.calls.clear()
    act(robot, READY, **{GRIPPER: 0.03})
    assert robot.arm.calls == ["feed", ("move", 0.03)]
    robot.arm.calls.clear()
    act(robot, READY)
    assert robot.arm.calls == ["feed"]


def test_after_a_stop_the_arm_goes_on_from_rest(robot):
    goal = READY + 0.5 * np.eye(7)[0]
    for _ in range(6):
        act(robot, goal)
    fast = abs(robot.arm.velocity[0])
    first = panda.chain.limits.acceleration.numpy()[0] * robot.config.dynamics * robot.dt
    assert fast > 2 * first
    robot.get_observation()
    robot.arm.stops += 1  # by the watchdog, while the policy computes the action
    robot.arm.velocity = np.zeros(7)
    act(robot, goal)
    assert abs(robot.arm.velocity[0]) < 0.5 * fast
    for _ in range(5):  # once: the number is known from now on
        act(robot, goal)
    assert abs(robot.arm.velocity[0]) > 0.5 * fast


class Topic:
    """An image topic, with the clock: each wait for an image lets the next one come."""

    def __init__(self):
        self.now, self.images, self.waits, self.closed, self.node = 5.0, [], [], 0, self
        self.delay = 0.01

    def Ros2Session(self, name):
        return self

    def create_subscription(self, kind, topic, take, quality):
        self.kind, self.topic, self.take = kind.__name__, topic, take

    def close(self):
        self.closed += 1

    def monotonic(self):
        return self.now

    # As the condition.

    def Condition(self):
        return self

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def notify_all(self):
        pass

    def wait_for(self, reached, timeout):
        self.waits.append(timeout)
        if self.images:
            self.now += self.delay
            self.take(image(*self.images.pop(0)))
        return reached()


def image(width, height, colour=(250, 120, 20)):
    from sensor_msgs.msg import Image

    data = np.full((height, width, 3), colour, np.uint8).tobytes()
    return Image(height=height, width=width, encoding="rgb8", step=3 * width, data=data)


@pytest.fixture
def topic(monkeypatch):
    pytest.importorskip("rclpy")
    topic = Topic()
    monkeypatch.setattr(driven_arms, "Ros2Session", topic.Ros2Session)
    monkeypatch.setattr(driven_arms, "time", topic)
    monkeypatch.setattr(driven_arms, "threading", topic)
    return topic


def camera_of(topic, images=((64, 48),), name="/front", **settings):
    topic.images = list(images)
    config = Ros2CameraConfig(topic=name, **{"width": 64, "height": 48} | settings)
    return Ros2Camera(config)


@pytest.mark.parametrize(
    ("name", "kind"), [("/front", "Image"), ("/front/compressed", "CompressedImage")]
)
def test_a_camera_waits_for_its_first_image(topic, name, kind):
    camera = camera_of(topic, name=name)
    assert not camera.is_connected
    camera.connect()
    assert camera.is_connected
    assert (topic.kind, topic.topic) == (kind, name)
    assert topic.waits == [2.0]
    camera.disconnect()
    camera.disconnect()
    assert topic.closed == 1
    assert not camera.is_connected


@pytest.mark.parametrize("size", [(48, 64), (64, 47), (65, 48)])
def test_images_of_another_size_are_refused_with_both(topic, size):
    camera = camera_of(topic, [size])
    with pytest.raises(ConnectionError, match=f"publishes {size[0]}x{size[1]}, not 64x48"):
        camera.connect()
    assert topic.closed == 1
    assert not camera.is_connected


def test_a_camera_that_sends_nothing_usable_is_left_disconnected_and_says_why(topic):
    from sensor_msgs.msg import Image

    camera = camera_of(topic, [])
    with pytest.raises(ConnectionError, match=r"no image on /front for 2 s: is the camera's"):
        camera.connect()
    assert (topic.closed, camera.is_connected) == (1, False)
    topic.images = [(64, 48)]
    camera.connect()
    with pytest.raises(DeviceAlreadyConnectedError):
        camera.connect()
    topic.take(Image(height=48, width=64, encoding="32FC1", step=256, data=bytes(48 * 256)))
    topic.now += 1.0
    with pytest.raises(ConnectionError, match=r"1\.00 s old \(images of encoding 32FC1"):
        camera.read_latest()
    with pytest.raises(ConnectionError, match=r"for 0\.2 s \(images of encoding 32FC1"):
        camera.async_read()


@pytest.mark.parametrize("size", [{"width": 0}, {"height": 0}, {"width": None}])
def test_a_camera_of_a_topic_has_a_size(size):
    with pytest.raises(ValueError, match="camera /front: give width and height"):
        Ros2CameraConfig(topic="/front", **{"width": 64, "height": 48} | size)


def test_the_next_image_is_one_that_comes_after_the_call(topic):
    camera = camera_of(topic, [(64, 48)] * 3)
    camera.connect()
    assert tuple(camera.async_read()[3, 5]) == (250, 120, 20)
    assert topic.waits[-1] == 0.2
    camera.async_read(350)
    assert topic.waits[-1] == 0.35
    with pytest.raises(
        ConnectionError, match=r"no image on /front for 0\.2 s: is the camera's"
    ):
        camera.async_read()
    topic.images, topic.delay = [(64, 48)], 0.0  # at the time of the call, not after it
    with pytest.raises(ConnectionError, match=r"for 2 s"):
        camera.read()


def test_the_newest_image_is_half_a_second_old_at_most(topic):
    camera = camera_of(topic)
    with pytest.raises(ConnectionError, match="the newest image on /front is"):
        camera.read_latest(10**9)
    topic.now, topic.delay = 7.0, 0.125
    camera.connect()
    topic.now = 7.125 + 0.5
    assert camera.read_latest().shape == (48, 64, 3)
    topic.now += 0.01
    with pytest.raises(ConnectionError, match=r"/front is 0\.51 s old"):
        camera.read_latest()
    assert camera.read_latest(600).shape == (48, 64, 3)


def test_an_arm_of_topics_is_driven_with_its_topics(monkeypatch, tmp_path):
    pytest.importorskip("rclpy")
    topics = Ros2Config(command="/mine", timeout=0.15)
    for fps, holds in ((20, 0.15), (5, 0.3)):  # until the next action, even a late one
        config = Ros2ArmRobotConfig(
            calibration_dir=tmp_path, arm="panda", topics=topics, fps=fps, timeout=0.5
        )
        driver = driven_arms.Ros2ArmRobot(config)._driver()
        assert driver.func is driven_arms.Ros2Arm
        assert driver.args[1].timeout == pytest.approx(holds)
        assert replace(driver.args[1], timeout=topics.timeout) == topics
    assert driver.args[0].joint_names == panda.chain.joint_names
