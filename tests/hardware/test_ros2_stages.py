"""The controller's node message by message: its arm, its clock and its graph are the test's."""

import threading

import numpy as np
import pytest

pytest.importorskip("rclpy")

from ros2_graph import READY, Graph, qualities_of, stamp
from unchecked import shapes_unchecked

from hrc_learn.deploy import EagerRunner
from hrc_learn.hardware import ArmFaultError, Ros2Config, ros2_node
from hrc_learn.kinematics import panda
from hrc_learn.protocols import ArmState

pytestmark = pytest.mark.simulation

POSE = panda.chain.forward(panda.chain.ready)
CENTRE, TURN = POSE.position.numpy(), POSE.orientation.numpy()
DT = 0.02
PATIENCE = 20.0


class Arm:
    """An arm that does what it is commanded; the test decides when a joint state comes.

    Attributes:
        answer: Called after each new joint state.
        fault: Raised by reading.
    """

    def __init__(self, clock):
        self.q, self.velocity, self.time = READY.copy(), np.zeros(7), 100.0
        self.clock, self.fault, self.ignored, self.received = clock, None, 3, clock.now
        self.calls, self.commands, self.answer = [], [], lambda: None

    def read(self):
        if self.fault is not None:
            raise self.fault
        return ArmState(
            time=self.time,
            joint_position=self.q.copy(),
            joint_velocity=self.velocity.copy(),
            gripper_width=0.0,
        )

    def turn(self, dt=DT):
        """Receive a joint state that is newer by so much [s]."""
        self.q, self.time = self.q + dt * self.velocity, self.time + dt
        self.clock.now += dt
        self.received = self.clock.now - 2e-3
        self.answer()

    def command(self, velocity):
        self.velocity = np.array(velocity)
        self.commands.append(self.velocity)

    def stop(self):
        self.velocity = np.zeros(7)
        self.calls.append("stop")

    def recover(self):
        self.calls.append("recover")

    def close(self):
        self.calls.append("close")


@pytest.fixture
def graph():
    return Graph()


@pytest.fixture
def arm(graph):
    return Arm(graph)


@pytest.fixture
def node(graph, arm, monkeypatch):
    monkeypatch.setattr(ros2_node, "Ros2Session", lambda name, make: graph)
    monkeypatch.setattr(ros2_node, "Ros2Arm", lambda chain, config: arm)
    monkeypatch.setattr(ros2_node, "time", graph)
    runners, controllers = [], []

    def make(controller, observation):
        controllers.append(controller)
        runners.append(EagerRunner(controller, observation))
        return runners[-1]

    with shapes_unchecked():
        node = ros2_node.ControllerNode(panda.chain, Ros2Config(silence=0.2), None, make)
        node.runners, node.controllers = runners, controllers
        yield node
        node.close()


@pytest.fixture
def values(node):
    """What the step observes, of a node that is active."""
    assert node.start()
    return node.runners[-1].observation


def xyz(values):
    return dict(zip("xyz", map(float, values), strict=True))


def goal_at(position, turn=TURN, frame="base_link"):
    from geometry_msgs.msg import Point, PoseStamped, Quaternion

    message = PoseStamped()
    message.header.frame_id = frame
    message.pose.position = Point(**xyz(position))
    w, x, y, z = map(float, turn)
    message.pose.orientation = Quaternion(w=w, x=x, y=y, z=z)
    return message


def marked(x, y, at=0.0):
    from geometry_msgs.msg import Point, PointStamped

    message = PointStamped(point=Point(x=x, y=y, z=0.0))
    message.header.stamp = stamp(at)
    return message


def sent(graph, topic):
    return [message for name, message in graph.sent if name == topic]


def test_the_tool_goes_to_the_box_of_a_goal_within_the_caps_that_are_parameters(
    graph, arm, node
):
    graph.parameters["region_size"].value = 0.01
    graph.parameters["linear_speed"].value = 0.08
    assert node.start()
    assert arm.calls == ["recover"]
    for _ in range(3):
        arm.turn()
    np.testing.assert_allclose(arm.q, READY, atol=1e-4)  # it holds the tool where it was
    goal = CENTRE + np.array([0.04, -0.05, 0.03])
    graph.takers["~/goal"](goal_at(goal, 2 * TURN))
    tool = [CENTRE]
    for _ in range(70):
        arm.turn()
        tool.append(panda.chain.forward(arm.q).position.numpy())
    assert np.abs(tool[-1] - goal).max() < 0.011
    speed = np.linalg.norm(np.diff(tool, axis=0), axis=1) / DT
    assert 0.05 < speed.max() < 0.085
    turned = panda.chain.forward(arm.q).orientation.numpy()
    assert abs(turned @ TURN) > 0.999
    assert len(arm.commands) == 73
    figures = node.figures()
    assert figures["commands"] == 73
    assert figures["safety_invalid"] == 0
    # The clock of the machine stands still while the step is computed.
    assert figures["latency_p50_ms"] == pytest.approx(2.0)
    box, path = sent(graph, "~/markers")[-1].markers
    assert (box.header.frame_id, box.ns, path.ns) == ("base_link", "hrc_learn", "hrc_learn")
    assert (box.scale.x, box.scale.y, box.scale.z) == (0.02, 0.02, 0.02)
    at = box.pose.position
    np.testing.assert_allclose([at.x, at.y, at.z], goal)
    assert box.type == box.CUBE
    assert path.type == path.LINE_STRIP
    assert box.id != path.id
    colours = [[getattr(one.color, part) for part in "rgba"] for one in (box, path)]
    np.testing.assert_allclose(colours, [[0.2, 0.6, 1.0, 0.3], [1.0, 0.6, 0.1, 1.0]], rtol=1e-6)
    assert path.scale.x == 0.004
    assert (box.id, path.id) == (0, 1)
    shown = len(sent(graph, "~/markers"))
    assert 12 <= shown <= 15  # one in 0.1 s of 1.46 s
    assert len(path.points) == shown
    np.testing.assert_allclose(
        [path.points[-1].x, path.points[-1].y, path.points[-1].z], tool[-1], atol=0.01
    )
    last = sent(graph, "/diagnostics")[-1].status[0]
    assert len(sent(graph, "/diagnostics")) == 2  # at once, and after a second
    assert (last.level, last.message) == (b"\0", "active")
    rows = {row.key: row.value for row in last.values}
    assert rows["ignored_states"] == "3"
    assert rows["latency_p99_ms"] == "2"


def test_goals_and_regions_that_make_no_sense_change_nothing(graph, node, values):
    from visualization_msgs.msg import Marker

    box = lambda: (  # noqa: E731
        *values["goals.position.centre"],
        *values["goals.position.half_size"],
        *values["goals.orientation.goal"],
    )
    held = box()
    np.testing.assert_allclose(held, (*CENTRE, 0.02, 0.02, 0.02, *TURN), atol=1e-12)
    wrong = [
        goal_at(CENTRE + 1, frame="camera"),
        goal_at([np.nan, 0, 0]),
        goal_at([0, 0, 0], [0, 0, 0, 0]),
        goal_at([0, 0, 0], [np.nan, 0, 0, 0]),
        goal_at([0, 0, 0], [np.inf, 0, 0, 0]),
    ]
    for message in wrong:
        graph.takers["~/goal"](message)
        assert box() == held
    assert graph.log[0] == "a goal in frame camera is refused: give it in base_link"
    assert graph.log[1:] == ["a goal with NaN or without orientation is refused"] * 4
    region = Marker()
    region.scale.x = region.scale.y = region.scale.z = 0.1
    half = np.sqrt(0.5)
    for goal in (*wrong, goal_at(CENTRE, [half, 0, 0, half])):
        region.header, region.pose = goal.header, goal.pose
        graph.takers["~/region"](region)
        assert box() == held
    assert graph.log[5] == "a region in frame camera is refused: give it in base_link"
    assert graph.log[-1].startswith("a region is refused: give edges longer than 0,")
    region.pose = goal_at([0.4, 0.1, 0.5], [-1, 0, 0, 0]).pose
    for edges in ([0.1, 0.0, 0.1], [0.1, 0.2, -0.1], [np.nan, 0.1, 0.1]):
        region.scale.x, region.scale.y, region.scale.z = edges
        graph.takers["~/region"](region)
        assert box() == held
    region.scale.x, region.scale.y, region.scale.z = 0.1, 0.2, 0.3
    graph.takers["~/region"](region)
    np.testing.assert_allclose(box(), (0.4, 0.1, 0.5, 0.05, 0.1, 0.15, *TURN), atol=1e-12)
    graph.takers["~/goal"](goal_at([0.3, 0.2, 0.6], [0, 0, 3, 0], frame=""))
    np.testing.assert_allclose(box(), (0.3, 0.2, 0.6, 0.05, 0.1, 0.15, 0, 0, 1, 0), atol=1e-12)


def test_messages_that_cannot_be_used_are_refused_and_do_not_end_the_thread(graph, node):
    from sensor_msgs.msg import CompressedImage

    graph.takers["~/goal"](goal_at(CENTRE))
    assert graph.log == ["a message is refused: configure the node first"]
    graph.parameters["marker"].value = 7.0
    assert node.start()
    graph.takers["~/image/compressed"](CompressedImage(format="png", data=b"no image"))
    assert len(graph.log) == 2


@pytest.mark.long
def test_a_camera_that_falls_silent_stops_the_arm_that_follows_its_feature(
    graph, arm, node, values
):
    graph.takers["~/target"](marked(350.0, 260.0))
    for _ in range(40):
        arm.turn()
        graph.takers["~/feature"](marked(310.0, 220.0, arm.time))
    assert np.abs(arm.velocity).max() > 1e-3
    ages = []
    for _ in range(60):
        arm.turn()
        ages.append(float(values["feature_age"]))
    np.testing.assert_allclose(ages, DT * np.arange(1, 61))
    np.testing.assert_allclose(arm.velocity, 0, atol=1e-9)


def test_a_feature_that_comes_during_a_step_counts_in_the_next(graph, arm, node, values):
    step, came = node.runners[-1].step, []

    def slow():
        command = step()
        feature = (marked(310.0, 220.0, arm.time),)
        came.append(threading.Thread(target=graph.takers["~/feature"], args=feature))
        came[0].start()
        came[0].join(0.05)
        return command

    arm.turn()
    node.runners[-1].step = slow
    arm.turn()
    came[0].join()
    np.testing.assert_array_equal(values["feature"], [310.0, 220.0])
    assert values["feature_visible"] == values["feature_new"] == 1


def test_a_clock_that_was_set_back_does_not_hold_the_arm(arm, node, values):
    for _ in range(3):
        arm.turn()
    commands = len(arm.commands)
    arm.turn(-50.0)
    arm.turn()
    assert len(arm.commands) == commands + 2
    assert node.figures()["commands"] == commands + 2
    assert values["dt"] == pytest.approx(DT)


def test_a_feature_is_paired_with_the_posture_of_its_image(graph, arm, node, values):
    graph.takers["~/goal"](goal_at(CENTRE + 0.05))
    postures = {}
    for _ in range(10):
        arm.turn()
        postures[round(arm.time, 3)] = arm.q
    for at, age in ((100.0 + 7 * DT + 0.003, 3 * DT), (0.0, 0.0), (arm.time + 5, 0.0)):
        graph.takers["~/feature"](marked(310.0, 220.0, at))
        assert values["feature_visible"] == values["feature_new"] == 1
        np.testing.assert_array_equal(values["feature"], [310.0, 220.0])
        posture = postures[round(arm.time - age, 3)]
        np.testing.assert_array_equal(values["image_joint_position"], posture)
        arm.turn()
        postures[round(arm.time, 3)] = arm.q
        assert values["feature_age"] == pytest.approx(age + DT)
    graph.takers["~/feature"](marked(np.nan, 220.0))
    assert values["feature_visible"] == values["feature_new"] == 0
    np.testing.assert_array_equal(values["feature"], [310.0, 220.0])
    graph.takers["~/feature"](marked(310.0, 220.0))
    arm.turn()
    assert values["feature_new"] == 0  # it counts once
    assert values["feature_visible"] == 1


def test_a_target_switches_vision_on_and_none_off_and_pushes_have_their_size(
    graph, node, values
):
    from std_msgs.msg import Float64MultiArray

    assert values["goals.vision_enabled"] == 0
    for x, enabled in ((320.0, 1), (np.nan, 0), (np.inf, 0)):
        graph.takers["~/target"](marked(x, 240.0))
        assert values["goals.vision_enabled"] == enabled
        np.testing.assert_array_equal(values["goals.vision.target"], [x, 240.0])
    push = np.arange(7.0)
    graph.takers["~/push"](Float64MultiArray(data=push.tolist()))
    graph.takers["~/push"](Float64MultiArray(data=[9.0] * 6))
    graph.takers["~/push"](Float64MultiArray(data=[*push[:6].tolist(), np.nan]))
    assert graph.log == ["a push is refused: give 7 finite numbers"] * 2
    np.testing.assert_array_equal(values["nullspace_input"], push)


def test_a_push_that_is_not_renewed_ends(graph, arm, node, values):
    from std_msgs.msg import Float64MultiArray

    for _ in range(3):
        graph.takers["~/push"](Float64MultiArray(data=[2.0] * 7))
        for _ in range(12):  # 0.24 s
            arm.turn()
            assert (values["nullspace_input"] == 2.0).all()
    arm.turn()
    assert not values["nullspace_input"].any()


@pytest.mark.parametrize("marker", [7.0, 0.0, -1.0])
def test_a_marker_in_an_image_is_the_feature_if_one_is_looked_for(graph, arm, node, marker):
    import cv2
    from sensor_msgs.msg import CompressedImage

    graph.parameters["marker"].value = marker
    assert node.start()
    values = node.runners[-1].observation
    arm.turn()
    drawn = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    for number, seen in ((max(round(marker), 0), True), (8, False)):
        image = np.full((240, 320), 255, np.uint8)
        image[100:180, 150:230] = cv2.aruco.generateImageMarker(drawn, number, 80)
        data = cv2.imencode(".png", image)[1].tobytes()
        graph.takers["~/image/compressed"](CompressedImage(format="png", data=data))
        assert values["feature_visible"] == (seen and marker >= 0)
    if marker >= 0:
        np.testing.assert_allclose(values["feature"], [189.5, 139.5], atol=0.6)


def test_steps_follow_the_clock_of_the_robot_within_bounds(arm, node, values):
    for dt, taken in ((DT, None), (0.03, 0.03), (2e-4, 1e-3), (0.9, 0.2)):
        arm.turn(dt)
        if taken is not None:
            assert values["dt"] == pytest.approx(taken)


@pytest.mark.parametrize("reason", ["silence", "heartbeat", "crash"])
def test_whatever_goes_wrong_brings_the_arm_to_rest_and_is_told(graph, arm, node, reason):
    graph.parameters["heartbeat"].value = 0.31 if reason == "heartbeat" else 0.0
    assert node.start()
    for _ in range(20):
        arm.turn()
        if reason == "heartbeat":
            graph.takers["~/heartbeat"](None)
    assert node.stopped == ""
    text = {
        "silence": "the newest joint state is old",
        "heartbeat": r"no heartbeat for 0.32 s: send ~/heartbeat",
        "crash": "a bug",
    }[reason]
    if reason == "heartbeat":
        for _ in range(16):
            arm.turn()
    else:
        arm.fault = (ArmFaultError if reason == "silence" else RuntimeError)(text)
    for _ in range(2000):
        if arm.calls.count("stop") >= 2:  # by the loop, and by the stage
            break
        threading.Event().wait(0.01)
    assert node.stopped == text
    assert arm.calls[:3] == ["recover", "stop", "stop"]
    assert f"deactivated: {text}" in graph.log
    status = sent(graph, "/diagnostics")[-1].status[0]
    assert (status.level, status.message) == (b"\2", text)
    arm.fault = None
    arm.calls.clear()
    assert graph.trigger_activate() is not None
    assert node.stopped == ""
    before = len(arm.commands)
    arm.turn()
    assert len(arm.commands) == before + 1


def test_a_stage_that_fails_says_why(graph, arm, node):
    arm.recover = lambda: (_ for _ in ()).throw(ArmFaultError("no joint states"))
    assert not node.start()
    assert graph.log == ["no joint states"]
    assert np.isnan(node.figures()["latency_p50_ms"])
    graph.trigger_deactivate()
    assert arm.calls == ["stop"]
    node.close()
    assert arm.calls == ["stop", "stop", "close"]
    assert graph.closed


def test_parameters_are_described_with_their_range(graph, node):
    from hrc_learn.hardware.ros2_node import PARAMETERS

    assert graph.parameters.keys() == PARAMETERS.keys()
    for name, (value, low, high, text) in PARAMETERS.items():
        assert low <= value <= high
        assert graph.parameters[name].value == value
        form = graph.forms[name]
        assert form.description == text
        (bounds,) = form.floating_point_range
        assert (bounds.from_value, bounds.to_value) == (low, high)


def test_limits_of_time_are_exclusive(graph, arm, node):
    """By a clock in 64ths of a second, which is exact."""
    graph.parameters["heartbeat"].value = 0.25
    assert node.start()
    for _ in range(16):
        arm.turn(1 / 64)
    assert node.stopped == ""  # a quarter of a second without a heartbeat
    assert len(arm.commands) == 16
    # Markers in the first step, and in those more than 0.1 s after the last: each seventh.
    assert len(sent(graph, "~/markers")) == 3
    arm.turn(1 / 64)
    for _ in range(2000):
        if node.stopped:
            break
        threading.Event().wait(0.01)
    assert node.stopped == "no heartbeat for 0.27 s: send ~/heartbeat"


def test_a_state_after_the_end_is_not_answered(graph, arm, node, values):
    arm.turn()
    graph.trigger_deactivate()
    commands = len(arm.commands)
    arm.turn()
    assert len(arm.commands) == commands


def test_deactivating_waits_for_the_step_under_way(graph, arm, node, values):
    step, inside, go_on = node.runners[-1].step, threading.Event(), threading.Event()

    def slow():
        inside.set()
        assert go_on.wait(PATIENCE)
        return step()

    node.runners[-1].step = slow
    answering = threading.Thread(target=arm.turn)
    answering.start()
    assert inside.wait(PATIENCE)
    ending = threading.Thread(target=graph.trigger_deactivate)
    ending.start()
    ending.join(0.2)
    assert "stop" not in arm.calls  # a command after the stop would move the arm
    go_on.set()
    answering.join(PATIENCE)
    ending.join(PATIENCE)
    assert arm.calls[-1] == "stop"
    assert not arm.velocity.any()


def test_diagnostics_come_each_second(graph, arm, node, values):
    # In the first step, and in those more than a second after the last: each fifth.
    for k in range(12):
        arm.turn(0.25)
        assert len(sent(graph, "/diagnostics")) == 1 + k // 5


def test_activating_forgets_goals_features_and_pushes(graph, arm, node, values):
    from std_msgs.msg import Float64MultiArray

    graph.takers["~/goal"](goal_at(CENTRE + 0.1, [0, 1, 0, 0]))
    graph.takers["~/target"](marked(320.0, 240.0))
    graph.takers["~/push"](Float64MultiArray(data=[1.0] * 7))
    arm.turn()
    graph.takers["~/feature"](marked(310.0, 220.0))
    graph.trigger_deactivate()
    assert "stop" in arm.calls
    arm.calls.clear()
    arm.q = READY + 0.05
    graph.parameters["region_size"].value = 0.03
    assert graph.trigger_activate() == node._done.SUCCESS
    pose = panda.chain.forward(arm.q)
    np.testing.assert_allclose(values["goals.position.centre"], pose.position.numpy())
    np.testing.assert_allclose(values["goals.orientation.goal"], pose.orientation.numpy())
    np.testing.assert_array_equal(values["goals.position.half_size"], [0.03] * 3)
    np.testing.assert_array_equal(values["nullspace_input"], np.zeros(7))
    assert values["goals.vision_enabled"] == values["feature_visible"] == 0
    assert arm.calls == ["recover"]


def test_the_step_begins_with_the_parameters_and_the_image_jacobian_of_the_paper(graph, node):
    from hrc_learn.controller import INITIAL_IMAGE_JACOBIAN

    settings = {"linear_speed": 0.2, "angular_speed": 0.7, "tcp_speed": 0.4, "null_damping": 9}
    for name, value in settings.items():
        graph.parameters[name].value = float(value)
    assert graph.trigger_configure() == node._done.SUCCESS
    (runner,), (controller,) = node.runners, node.controllers
    config = controller.config
    found = [config.linear_speed, config.angular_speed, config.safety.tcp_speed]
    assert [*found, config.null_damping] == list(settings.values())
    assert runner.observation["dt"] == 0.002
    assert runner.observation["goals.vision_enabled"] == 0
    network = controller.estimator.network
    assert float(network.width) == pytest.approx(0.1)
    first = np.ravel(INITIAL_IMAGE_JACOBIAN)
    for weights in network.weight.detach().numpy().T:  # of every neuron
        np.testing.assert_allclose(weights, first)


def test_states_and_features_are_the_newest_and_commands_arrive(graph, node):
    assert {topic: reliable for topic, (reliable, _) in qualities_of(graph).items()} == {
        "~/goal": True,
        "~/region": True,
        "~/target": True,
        "~/feature": False,
        "~/image": False,
        "~/image/compressed": False,
        "~/push": False,
        "~/heartbeat": False,
        "/diagnostics": True,
        "~/markers": True,
    }


def test_latencies_are_percentiles_in_milliseconds_of_the_newest(node):
    rng = np.random.default_rng(0)
    times = rng.exponential(2e-3, size=700)
    node.latencies.extend(times)
    for recent in (0, 500, 1):
        figures = node.figures(recent) if recent else node.figures()
        chosen = 1e3 * times[-recent:]
        assert figures["latency_p50_ms"] == pytest.approx(np.median(chosen))
        assert figures["latency_p99_ms"] == pytest.approx(np.quantile(chosen, 0.99))
        assert figures["latency_p100_ms"] == chosen.max()
