"""The guard of a velocity controller, and descriptions on topics, without the middleware."""

import os
import sys
import threading
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy")

from ros2_graph import Graph, qualities_of

from hrc_learn.hardware import ros2_topics
from hrc_learn.hardware.ros2_topics import (
    found_description,
    guard_velocities,
    quality,
    read_description,
    ros2_origin,
    stamp_of,
    start_guard,
)

# Stand-ins are not of the annotated types.
pytestmark = pytest.mark.simulation

TOPIC, TIMEOUT = "/commands", 0.2


class GuardedGraph(Graph):
    """A graph on which a velocity is commanded now and then, until its commander dies.

    Attributes:
        commands: Velocities by the time at which they are commanded.
        death: Time at which the commander dies.
        publishers: Publishers on the topic.
    """

    def __init__(self, commands=(), death=60.0):
        super().__init__()
        self.commands, self.death, self.publishers, self.zeros = dict(commands), death, 2, []

    def count_publishers(self, topic):
        assert topic == TOPIC
        return self.publishers

    def create_publisher(self, kind, topic, quality):
        publisher = super().create_publisher(kind, topic, quality)

        def publish(message):
            assert list(message.data) == [0.0] * 3
            self.zeros.append(self.now)
            self.takers[TOPIC](message)  # it hears its own

        publisher.publish = publish
        return publisher

    def sleep(self, duration):
        before = self.now
        super().sleep(duration)
        for at, velocity in self.commands.items():
            if before < at <= self.now:
                self.takers[TOPIC](SimpleNamespace(data=velocity))


def guarded(monkeypatch, graph, controllers=1):
    monkeypatch.setattr(ros2_topics, "Ros2Session", lambda name: graph)
    monkeypatch.setattr(ros2_topics, "time", graph)
    monkeypatch.setattr(os, "getppid", lambda: 1 if graph.now > graph.death else 77)
    guard_velocities(TOPIC, 3, TIMEOUT, controllers, 77)


def test_zeros_follow_a_velocity_that_nobody_renews_and_the_death_of_its_commander(
    monkeypatch, capsys
):
    moving, rest = [0.0, 0.1, 0.0], [0.0, 0.0, 0.0]
    commands = {51.0 + 0.1 * k: moving for k in range(10)} | {53.0: moving, 53.1: rest}
    graph = GuardedGraph(commands, death=55.0)
    graph.listeners = 2  # the controller, and itself
    guarded(monkeypatch, graph)
    assert capsys.readouterr().out == "ready\n"
    # Once after the last velocity at 51.9 s; none after a rest, or while it is renewed.
    (once,) = [at for at in graph.zeros if at < 55.0]
    assert 51.9 + TIMEOUT < once <= 51.9 + 1.5 * TIMEOUT
    farewell = [at for at in graph.zeros if at >= 55.0]
    assert farewell[-1] - farewell[0] == pytest.approx(1.0, abs=TIMEOUT / 2)
    assert len(farewell) == pytest.approx(5 / TIMEOUT, abs=1)
    assert graph.closed
    assert set(graph.sleeps) == {TIMEOUT / 5}  # nothing is waited for in the beginning
    assert qualities_of(graph) == {TOPIC: (True, False)}


@pytest.mark.parametrize(("listeners", "publishers"), [(2, 2), (3, 1), (3, 2)])
def test_a_guard_that_does_not_reach_all_controllers_ends(
    monkeypatch, capsys, listeners, publishers
):
    graph, begun = GuardedGraph(death=62.5), 50.0
    graph.listeners, graph.publishers = listeners, publishers
    if (listeners, publishers) == (3, 2):
        guarded(monkeypatch, graph, controllers=2)
        assert capsys.readouterr().out == "ready\n"
        return
    with pytest.raises(SystemExit, match=f"{TOPIC}: {listeners - 1} of 2 controllers found"):
        guarded(monkeypatch, graph, controllers=2)
    assert begun + 10 < graph.now <= begun + 10.03
    assert set(graph.sleeps) == {0.02}


def test_a_guard_whose_commander_dies_early_does_not_wait(monkeypatch):
    graph = GuardedGraph(death=51.0)
    with pytest.raises(SystemExit):
        guarded(monkeypatch, graph, controllers=2)
    assert graph.now == pytest.approx(51.0, abs=0.05)
    graph = GuardedGraph(death=49.0)  # before the guard has started
    guarded(monkeypatch, graph, controllers=0)
    assert graph.now == pytest.approx(51.0, abs=0.1)
    assert graph.closed


@pytest.mark.parametrize("line", [b"ready\n", b""])
def test_a_guard_is_a_process_that_says_when_it_is_ready(monkeypatch, line):
    words = []

    def open_process(command, stdout, start_new_session):
        assert start_new_session  # signals of a terminal do not reach it
        words.extend(command)
        return SimpleNamespace(stdout=SimpleNamespace(readline=lambda: line))

    monkeypatch.setattr(ros2_topics.subprocess, "Popen", open_process)
    if line:
        assert start_guard(TOPIC, 7, 0.3, 2).stdout is not None
        assert words[0] == sys.executable
        assert words[2:] == [TOPIC, "7", "0.3", "2", str(os.getpid())]
        return
    with pytest.raises(ConnectionError, match=f"the guard of {TOPIC} does not start"):
        start_guard(TOPIC, 7, 0.3, 2)


class Described(Graph):
    """A graph on which a robot describes itself."""

    text = "<robot name='r'/>"

    def create_subscription(self, kind, topic, take, quality):
        self.qualities[topic] = quality
        if self.text is not None:
            take(SimpleNamespace(data=self.text))


def test_a_robot_is_described_by_a_topic_and_else_by_the_name(monkeypatch, tmp_path):
    graph = Described()
    monkeypatch.setattr(ros2_topics, "Ros2Session", lambda name: graph)
    assert read_description("/robot_description") == graph.text
    assert graph.closed
    assert qualities_of(graph) == {"/robot_description": (True, True)}
    for name in ("panda", "robot.urdf", "/some/robot.urdf:tip", f"{tmp_path}:tip"):
        assert found_description(name) == name
    for name, links in (("/robot_description", ""), ("/robot:base:tool0", ":base:tool0")):
        file, colon, rest = found_description(name).partition(":")
        assert colon + rest == links
        with open(file, encoding="utf-8") as description:
            assert description.read() == graph.text
    graph.text = None
    with pytest.raises(ConnectionError, match=r"no description on /none for 0\.01 s: is robot"):
        read_description("/none", timeout=0.01)


@pytest.mark.parametrize(
    ("place", "variables", "words"),
    [
        ("purelib", {}, "the wheels' rclpy in {}, domain 0"),
        ("platlib", {"ROS_DISTRO": "jazzy"}, "the wheels' rclpy in {}, domain 0"),
        (None, {"ROS_DISTRO": "jazzy"}, "the system's rclpy jazzy in {}, domain 0"),
        (None, {"ROS_DOMAIN_ID": "7"}, "the system's rclpy in {}, domain 7"),
    ],
)
def test_the_installation_of_ros_is_named_in_a_line(
    monkeypatch, tmp_path, place, variables, words
):
    import rclpy

    places = {"purelib": tmp_path / "pure", "platlib": tmp_path / "plat"}
    monkeypatch.setattr(ros2_topics.sysconfig, "get_path", lambda name: str(places[name]))
    folder = places.get(place, tmp_path / "opt")
    monkeypatch.setattr(rclpy, "__file__", str(folder / "rclpy" / "__init__.py"))
    for name in ("ROS_DISTRO", "ROS_DOMAIN_ID"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert ros2_origin() == f"ROS 2: {words.format(folder)}"


@pytest.mark.parametrize("reliable", [False, True])
@pytest.mark.parametrize("latched", [False, True])
def test_a_quality_of_service_keeps_one_message(reliable, latched):
    graph = Graph()
    graph.qualities["x"] = quality(reliable=reliable, latched=latched)
    assert qualities_of(graph) == {"x": (reliable, latched)}
    graph.qualities["x"] = quality()
    assert qualities_of(graph) == {"x": (False, False)}


def test_a_stamp_is_in_seconds():
    time = SimpleNamespace(sec=12, nanosec=345_000_000)
    message = SimpleNamespace(header=SimpleNamespace(stamp=time))
    assert stamp_of(message) == pytest.approx(12.345, abs=1e-12)


def test_a_session_spins_its_node_and_leaves_the_graph(monkeypatch):
    import rclpy
    import rclpy.executors

    said, over = [], threading.Event()

    class Executor:
        def __init__(self, context):
            said.append(("executor", context))

        def add_node(self, node):
            said.append(("node", node))

        def spin(self):
            assert over.wait(20)
            raise rclpy.executors.ExternalShutdownException

        def shutdown(self, timeout_sec):
            said.append(("shutdown", timeout_sec))
            over.set()

    context = SimpleNamespace(try_shutdown=lambda: said.append("context"))
    monkeypatch.setattr(rclpy, "Context", lambda: context)
    monkeypatch.setattr(rclpy, "init", lambda **options: said.append(options))
    monkeypatch.setattr(rclpy.executors, "SingleThreadedExecutor", Executor)
    session = ros2_topics.Ros2Session("mine", lambda name, context: (name, context))
    assert session.node == ("mine", context)
    signals = rclpy.signals.SignalHandlerOptions.NO
    assert said == [
        {"context": context, "signal_handler_options": signals},
        ("executor", context),
        ("node", session.node),
    ]
    assert session._thread.is_alive()
    assert session._thread.daemon  # a program that forgets to close it may end
    session.close()
    assert said[3:] == [("shutdown", 1.0), "context"]
    assert not session._thread.is_alive()
