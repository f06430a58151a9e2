"""The guard of a velocity controller, and descriptions on topics, without the middleware."""

import os
import sys
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy")

from ros2_graph import Graph

from hrc_learn.hardware import ros2_topics
from hrc_learn.hardware.ros2_topics import (
    found_description,
    guard_velocities,
    read_description,
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
    guard_velocities(TOPIC, 3, TIMEOUT, controllers)


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
    assert graph.now == pytest.approx(begun + 10, abs=0.05)


def test_a_guard_whose_commander_dies_early_does_not_wait(monkeypatch):
    graph = GuardedGraph(death=51.0)
    with pytest.raises(SystemExit):
        guarded(monkeypatch, graph, controllers=2)
    assert graph.now == pytest.approx(51.0, abs=0.05)


@pytest.mark.parametrize("line", [b"ready\n", b""])
def test_a_guard_is_a_process_that_says_when_it_is_ready(monkeypatch, line):
    words = []

    def open_process(command, stdout):
        words.extend(command)
        return SimpleNamespace(stdout=SimpleNamespace(readline=lambda: line))

    monkeypatch.setattr(ros2_topics.subprocess, "Popen", open_process)
    if line:
        assert start_guard(TOPIC, 7, 0.3, 2).stdout is not None
        assert words[0] == sys.executable
        assert words[2:] == [TOPIC, "7", "0.3", "2"]
        return
    with pytest.raises(ConnectionError, match=f"the guard of {TOPIC} does not start"):
        start_guard(TOPIC, 7, 0.3, 2)


class Described(Graph):
    """A graph on which a robot describes itself."""

    text = "<robot name='r'/>"

    def create_subscription(self, kind, topic, take, quality):
        if self.text is not None:
            take(SimpleNamespace(data=self.text))


def test_a_robot_is_described_by_a_topic_and_else_by_the_name(monkeypatch, tmp_path):
    graph = Described()
    monkeypatch.setattr(ros2_topics, "Ros2Session", lambda name: graph)
    assert read_description("/robot_description") == graph.text
    assert graph.closed
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
