"""An arm of ROS 2 message by message: graph and clock are the test's, not the middleware's."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy")

from ros2_graph import Graph, qualities_of

from hrc_learn.hardware import ArmFaultError, Ros2Arm, Ros2Config, ros2_arm
from hrc_learn.kinematics import panda

# Stand-ins are not of the annotated types.
pytestmark = pytest.mark.simulation

NAMES = panda.chain.joint_names
READY = panda.chain.ready.numpy()
LIMITS = panda.chain.limits
COMMANDS, STATES = Ros2Config().command, Ros2Config().joint_states


@pytest.fixture
def guards():
    return []


@pytest.fixture
def graph(monkeypatch, guards):
    graph = Graph()
    monkeypatch.setattr(ros2_arm, "time", graph)
    monkeypatch.setattr(ros2_arm, "Watchdog", graph.Watchdog)
    monkeypatch.setattr(ros2_arm, "Ros2Session", lambda name: graph)

    def start_guard(*numbers):
        guards.append(numbers)
        end = lambda word: lambda: guards.append(word)  # noqa: E731
        return SimpleNamespace(kill=end("killed"), wait=end("waited"))

    monkeypatch.setattr(ros2_arm, "start_guard", start_guard)
    return graph


def position_arm(graph, **settings):
    return Ros2Arm(panda.chain, Ros2Config(interface="position", **settings))


def test_a_velocity_controller_has_a_guard_and_ends_at_rest(graph, guards):
    graph.listeners = 3
    with Ros2Arm(panda.chain, Ros2Config(timeout=0.2)) as arm:
        assert guards == [(COMMANDS, 7, pytest.approx(0.3), 3)]
        arm.command(np.full(7, 0.1))
    (first, moved), (last, rest) = graph.sent
    assert first == last == COMMANDS
    np.testing.assert_array_equal(moved.data, np.full(7, 0.1))
    np.testing.assert_array_equal(rest.data, np.zeros(7))
    assert graph.trips == [0.2, "start", "feed", "close"]
    assert guards[1:] == ["killed", "waited"]
    assert graph.closed


def test_a_position_controller_needs_no_guard(graph, guards):
    position_arm(graph)
    assert guards == []


def test_the_robot_that_is_silent_and_the_controller_that_is_missing_are_named(graph):
    graph.listeners, begun = 0, graph.now
    with pytest.raises(ConnectionError, match=f"no controller listens on {COMMANDS}: is it"):
        position_arm(graph, startup=3.0)
    assert graph.now == pytest.approx(begun + 3, abs=0.05)
    assert graph.closed
    graph.greeting = []
    with pytest.raises(ConnectionError, match=r"on /states for 0\.01 s: is its driver running"):
        position_arm(graph, startup=0.01, joint_states="/states")
    graph.greeting = [(1.0, READY[:5], (), (*NAMES[:4], "finger"))]
    missing = "panda_joint5, panda_joint6, panda_joint7 are not among panda_joint1, .*, finger"
    with pytest.raises(ConnectionError, match=missing):
        position_arm(graph, startup=0.01)


def test_joints_are_found_by_name_and_speeds_measured_where_none_are_sent(graph):
    arm, rng = position_arm(graph), np.random.default_rng(0)
    assert arm.read().gripper_width == 0.0
    np.testing.assert_array_equal(arm.read().joint_velocity, np.zeros(7))
    other, speed = READY + rng.normal(size=7), rng.normal(size=7)
    names = ["finger", *NAMES[::-1]]
    graph.state(10.1, [0.02, *other[::-1]], [0.5, *speed[::-1]], names)
    state = arm.read()
    assert state.time == pytest.approx(10.1)
    np.testing.assert_array_equal(state.joint_position, other)
    np.testing.assert_array_equal(state.joint_velocity, speed)
    for at, velocity in ((10.3, ()), (10.5, [np.nan, *speed[1:]]), (10.7, speed[:6])):
        before, after = arm.read(), READY + rng.normal(size=7)
        graph.state(at, after, velocity)
        slope = (after - before.joint_position) / 0.2
        np.testing.assert_allclose(arm.read().joint_velocity, slope)


def test_states_that_are_old_or_partial_are_not_used_and_a_new_clock_is(graph):
    arm = position_arm(graph)
    graph.state(10.5, READY)
    for at, position, ignored in (
        (10.5, READY + 1, 1),  # sent again
        (10.4, READY + 1, 2),
        (9.6, READY + 1, 3),
        (10.6, [np.inf, *READY[1:]], 4),
    ):
        graph.state(at, position)
        assert arm.ignored == ignored
    graph.state(10.7, READY[:6], (), NAMES[:6])  # of another part of the robot
    assert arm.ignored == 4
    for position in (READY[:6], ()):  # names without positions
        graph.state(10.8, position, np.zeros(7))
    assert arm.ignored == 6
    np.testing.assert_array_equal(arm.read().joint_position, READY)
    graph.now += 100
    graph.state(9.4, READY + 1)  # a second back: a clock that was set anew
    assert arm.ignored == 6
    assert arm.read().time == pytest.approx(9.4)
    np.testing.assert_array_equal(arm.read().joint_velocity, np.zeros(7))
    graph.state(9.9, READY + 2)
    np.testing.assert_allclose(arm.read().joint_velocity, np.full(7, 2.0))


def test_the_age_of_a_state_counts_from_its_stamp_by_the_quickest_message(graph):
    arm = position_arm(graph)  # 40 s between the clocks
    graph.now += 1.0
    graph.state(11.1, READY)  # quicker than the first by 0.1 s
    assert arm.received == graph.now
    graph.now += 0.19
    arm.read()
    graph.now += 0.02
    text = r"the newest joint state on /joint_states is 0\.21 s old: the arm is stopped"
    with pytest.raises(ArmFaultError, match=text):
        arm.read()
    with pytest.raises(ArmFaultError, match=text):
        arm.recover()
    graph.state(11.12, READY)  # late by 0.19 s
    arm.read()
    graph.now += 0.02
    with pytest.raises(ArmFaultError, match=text):
        arm.command(np.zeros(7))
    assert graph.trips.count("feed") == 0
    np.testing.assert_allclose(graph.sent[-1][1].data, READY)  # it is held there


def test_commands_are_integrated_for_their_time_and_led_by_the_measured_arm(graph):
    arm = position_arm(graph, timeout=0.15, lag=0.1)
    velocity = 0.5 * np.array([1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0])
    arm.command(velocity)
    np.testing.assert_allclose(graph.sent[-1][1].data, READY)
    for passed, moved in ((0.02, 0.02), (0.03, 0.05), (1.0, 0.1), (0.05, 0.15), (0.05, 0.2)):
        graph.now += passed
        graph.state(10.0 + graph.now - 50, READY)
        arm.command(velocity)
        goal = READY + np.clip(moved * velocity, -0.1, 0.1)
        np.testing.assert_allclose(graph.sent[-1][1].data, goal)
    arm.stop()
    np.testing.assert_allclose(graph.sent[-1][1].data, READY + 0.1 * np.sign(velocity))
    arm.recover()
    arm.command(velocity)
    np.testing.assert_allclose(graph.sent[-1][1].data, READY)
    with pytest.raises(ValueError, match=r"panda_joint7: 9\.000 rad/s is beyond its limit"):
        arm.command(np.array([*np.zeros(6), 9.0]))


@pytest.mark.parametrize("end", ["lower", "upper"])
def test_commanded_positions_stay_within_the_limits(graph, end):
    limit, sign = getattr(LIMITS, end).numpy(), 1.0 if end == "upper" else -1.0
    graph.greeting = [(10.0, limit - sign * 0.02)]
    arm = position_arm(graph)
    for _ in range(3):
        arm.command(np.full(7, 0.5 * sign))
        graph.now += 0.05
    np.testing.assert_allclose(graph.sent[-1][1].data, limit)


def test_a_trajectory_goes_on_with_the_velocity_and_ends_at_rest(graph):
    config = Ros2Config(interface="trajectory", timeout=0.2)
    arm, velocity = Ros2Arm(panda.chain, config), np.linspace(-0.3, 0.3, 7)
    for passed, step in ((0.0, 0.2), (0.05, 0.05), (0.0, 1e-3)):
        graph.now += passed
        arm.command(velocity)
        message = graph.sent[-1][1]
        assert tuple(message.joint_names) == NAMES
        begun = message.header.stamp  # by the robot's clock
        assert begun.sec + 1e-9 * begun.nanosec == pytest.approx(graph.now - 40, abs=1e-8)
        ahead, end = message.points
        times = [p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in (ahead, end)]
        assert times == pytest.approx([step, step + 0.2])
        np.testing.assert_allclose(ahead.velocities, velocity)
        np.testing.assert_array_equal(end.velocities, np.zeros(7))
        # At constant deceleration to rest the way is half of what the velocity would go.
        way = np.array(end.positions) - np.array(ahead.positions)
        np.testing.assert_allclose(way, 0.5 * 0.2 * velocity)
    np.testing.assert_allclose(ahead.positions, READY + 0.051 * velocity)


def test_a_trajectory_begins_by_the_clock_of_the_robot_or_at_once(graph):
    """Stock controllers drop a trajectory that ends in their past."""
    config = Ros2Config(interface="trajectory")
    for first, begin in ((1e-3, 0.2), (1.7e9, 1.7e9 + 0.2 - 1e-3), (0.0, 0.0)):
        graph.now, graph.greeting = 50.0, [(first, READY)]
        with Ros2Arm(panda.chain, config) as arm:
            graph.now += 0.1
            graph.state(first and first + 0.15, READY)  # quicker than the first by 0.05 s
            graph.now += 0.05 - 1e-3
            arm.command(np.zeros(7))
            begun = graph.sent[-1][1].header.stamp
            assert begun.sec + 1e-9 * begun.nanosec == pytest.approx(begin, abs=1e-6)
            arm.close()
            sent = len(graph.sent)
        assert len(graph.sent) == sent  # closed once


def test_a_position_goes_on_with_the_states_and_never_jumps(graph):
    arm = position_arm(graph, timeout=0.15)
    velocity = np.zeros(7)
    velocity[0] = 1.0

    def wait(duration):
        """Let states come at 100 Hz."""
        for _ in range(round(100 * duration)):
            graph.now += 0.01
            graph.state(graph.now - 40, arm._goal)

    arm.command(velocity)
    wait(0.14)  # a late loop
    arm.command(velocity)
    wait(0.5)
    arm.stop()
    expired = READY + (0.14 + 0.15) * velocity
    np.testing.assert_allclose(graph.sent[-1][1].data, expired)
    wait(0.4)
    arm.command(velocity)  # after a pause
    np.testing.assert_allclose(graph.sent[-1][1].data, expired)
    wait(0.05)
    graph.now += 0.14  # this process was suspended
    arm.command(velocity)
    goals = np.array([message.data for _, message in graph.sent])
    np.testing.assert_allclose(goals[-1], expired + 0.1 * velocity)
    steps = np.diff(goals, axis=0)
    assert np.abs(steps[:-1]).max() < 0.01 + 1e-9
    assert np.abs(steps[-1]).max() < 0.05 + 1e-9


def test_a_trajectory_goes_on_from_where_the_last_one_is(graph):
    """Each is followed by cubic splines, as stock controllers do."""
    from scipy.interpolate import CubicHermiteSpline

    arm = Ros2Arm(panda.chain, Ros2Config(interface="trajectory", timeout=0.15, lag=3.0))
    velocity = np.zeros(7)
    velocity[0] = 1.0
    at, speed, fastest = READY[0], 0.0, 0.0
    asked = [(1, 0.01)] * 5 + [(1, 0.1), (1, 0.01), (1, 0.15), (0, 8.0)] + [(1, 0.01)] * 5
    for factor, passed in asked:
        arm.command(factor * velocity) if factor else arm.stop()
        points = graph.sent[-1][1].points
        times = [
            0.0,
            *(p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in points),
        ]
        positions = [at, *(p.positions[0] for p in points)]
        speeds = [speed, *(p.velocities[0] for p in points)]
        fastest = max(fastest, np.abs(np.diff(positions) / np.diff(times)).max())
        path = CubicHermiteSpline(times, positions, speeds)
        end = min(passed, times[-1])
        at, speed = float(path(end)), float(path(end, 1))
        graph.now += passed
        graph.state(graph.now - 40, READY)
    assert fastest < 2.0  # a velocity that begins at once, not with a ramp, is caught up with


def test_a_gripper_is_read_from_its_joint_and_led_within_its_travel(graph):
    hand = {"gripper": "/hand", "gripper_joint": "knuckle", "opening": 0.08}
    hand |= {"gripper_open": 0.1, "gripper_closed": 0.9}  # it closes as it turns
    names = (*NAMES, "knuckle")
    graph.greeting = [(10.0, [*READY, 0.3], (), names)]
    arm = position_arm(graph, **hand)
    assert arm.read().gripper_width == pytest.approx(0.06)
    graph.state(10.1, READY)
    assert arm.read().gripper_width == pytest.approx(0.06)
    for width, angle in ((0.02, 0.7), (0.2, 0.1), (-1.0, 0.9)):
        arm.move(width)
        topic, message = graph.sent[-1]
        assert topic == "/hand"
        assert list(message.data) == pytest.approx([angle])
    bare = position_arm(graph)
    bare.move(0.05)
    assert graph.sent[-1] == (topic, message)


def test_a_gripper_with_messages_of_its_own_is_read_and_missed(graph):
    hand = {"gripper": "/hand", "gripper_joint": "knuckle", "startup": 0.01}
    with pytest.raises(
        ConnectionError, match=f"knuckle are not among {NAMES[0]}, .*{NAMES[6]}$"
    ):
        position_arm(graph, **hand)
    graph.greeting = [(10.0, [0.03], (), ["knuckle"]), (10.01, READY)]
    arm = position_arm(graph, **hand)
    assert arm.read().gripper_width == pytest.approx(0.06)
    for angle in (0.01, np.nan):
        graph.state(10.02, [angle], (), ["knuckle"])
    graph.state(10.03, READY)
    assert arm.read().gripper_width == pytest.approx(0.02)
    with pytest.raises(ValueError, match="width of the gripper must be a number"):
        arm.move(np.nan)
    graph.greeting = [(10.0, [*READY[:6], np.nan])]
    with pytest.raises(ConnectionError, match="positions are missing or not finite"):
        position_arm(graph, startup=0.01)


def test_a_clock_that_steps_back_by_less_than_a_second_is_followed(graph):
    """As NTP sets a clock that is more than 0.128 s off."""
    arm = position_arm(graph)
    for k in range(50):
        graph.now += 0.02
        graph.state(10.0 + 0.02 * k - 0.5 * (k > 10), READY + k)
    state = arm.read()
    assert state.time == pytest.approx(10.48)
    assert arm.ignored <= 12  # for as long as a silence
    assert state.joint_position[0] == pytest.approx(READY[0] + 49)
    graph.now += 0.19
    arm.read()
    for _ in range(30):  # a driver that hangs repeats its last state
        graph.now += 0.02
        graph.state(10.48, READY)
    with pytest.raises(ArmFaultError, match=r"is 0\.79 s old"):
        arm.read()


@pytest.mark.parametrize("speed", [1.0, 0.5, 0.02])
def test_states_of_a_slow_simulator_count_as_old_only_if_none_come(graph, speed):
    arm = position_arm(graph)
    graph.clocks = 1  # discovered later than the states
    for k in range(1, 200):
        graph.now += 0.02
        graph.state(10.0 + 0.02 * speed * k, READY)
        arm.read()
    graph.now += 0.19
    arm.read()
    graph.now += 0.02
    with pytest.raises(ArmFaultError, match=r"is 0\.21 s old"):
        arm.read()


@pytest.mark.parametrize("drift", [-3e-4, 3e-4])
def test_a_clock_that_drifts_does_not_make_states_old(graph, drift):
    arm = position_arm(graph)
    for k in range(1, 1000):
        graph.now += 1.0
        graph.state(10.0 + k * (1 - drift), READY)
        arm.read()
    graph.now += 0.21
    with pytest.raises(ArmFaultError, match=r"is 0\.21 s old"):
        arm.read()


def test_each_newer_state_is_answered_in_the_thread_that_receives_it(graph):
    answered = []
    arm = position_arm(graph)
    arm.answer = lambda: answered.append(arm.read().time)
    for at in (10.1, 10.05, 10.1, 10.2):  # the second is reordered, and the third came before
        graph.state(at, READY)
    assert answered == [10.1, 10.2]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        *(({name: 0.0}, f"{name} must be positive") for name in ("timeout", "lag", "startup")),
        ({"silence": np.inf}, "silence must be finite"),
        ({"gripper": "/g"}, "belong together"),
        ({"gripper_joint": "g"}, "belong together"),
        ({"opening": 0.0}, "opening must be positive"),
        ({"gripper_closed": 0.04}, "gripper_open and gripper_closed must be"),
        ({"gripper_open": np.nan}, "gripper_open must be finite"),
    ],
)
def test_settings_are_checked(settings, message):
    with pytest.raises(ValueError, match=message):
        Ros2Config(**settings)


def test_limits_of_time_are_exclusive(graph):
    """By clocks in binary fractions of a second, which are exact."""
    arm = position_arm(graph, silence=0.25)
    graph.state(11.5, READY)
    graph.state(10.5, READY + 1)  # a whole second back: reordered still
    assert arm.ignored == 1
    graph.now = 50.5
    graph.state(12.0, READY)
    graph.now += 0.25
    arm.read()
    graph.now += 2**-20
    with pytest.raises(ArmFaultError):
        arm.read()


def test_states_are_the_newest_and_commands_arrive(graph):
    graph.greeting = [(10.0, [*READY, 0.0], (), (*NAMES, "knuckle"))]
    arm = position_arm(graph, gripper="/hand", gripper_joint="knuckle")
    assert qualities_of(graph) == {
        STATES: (False, False),
        COMMANDS: (True, False),
        "/hand": (True, False),
    }
    arm.close()
    assert graph.closed
    assert 0.05 in graph.sleeps  # for the last message to leave


def test_controllers_are_waited_for_and_then_missed_by_their_topic(graph):
    begun, graph.listeners = graph.now, 0
    text = f"no controller listens on {COMMANDS}: is it active"
    with pytest.raises(ConnectionError, match=text):
        position_arm(graph, startup=4.0)
    assert begun + 4 < graph.now <= begun + 4.03
    assert set(graph.sleeps) == {0.02}
    assert graph.closed


@pytest.mark.parametrize(
    ("interface", "kind"),
    [
        ("velocity", "Float64MultiArray"),
        ("position", "Float64MultiArray"),
        ("trajectory", "JointTrajectory"),
    ],
)
def test_commands_are_messages_of_the_controllers_kind(graph, guards, interface, kind):
    Ros2Arm(panda.chain, Ros2Config(interface=interface))
    assert graph.kinds == {COMMANDS: kind}
    assert bool(guards) == (interface == "velocity")


def feel(graph, force, torque, frame="tool0"):
    """Send a wrench, as it comes from the middleware: in CDR."""
    from geometry_msgs.msg import Vector3, Wrench, WrenchStamped
    from rclpy.serialization import deserialize_message, serialize_message

    x, y = (Vector3(**dict(zip("xyz", map(float, v), strict=True))) for v in (force, torque))
    message = WrenchStamped(wrench=Wrench(force=x, torque=y))
    message.header.frame_id = frame
    graph.takers["/wrench"](deserialize_message(serialize_message(message), WrenchStamped))


def feeling_arm(graph):
    """An arm whose sensor is the first to report."""
    subscribe = graph.create_subscription

    def create_subscription(kind, topic, take, quality):
        subscribe(kind, topic, take, quality)
        if topic == "/wrench":
            feel(graph, np.zeros(3), np.zeros(3))
            graph.state(10.0, READY)

    graph.create_subscription = create_subscription
    return Ros2Arm(panda.chain, Ros2Config(wrench="/wrench"))


def test_a_wrench_becomes_torques_of_the_joints_as_in_mujoco(graph):
    import mujoco

    from hrc_learn.sim import SceneConfig, World

    world, rng = World(SceneConfig()), np.random.default_rng(0)
    with feeling_arm(graph) as arm:
        for frame in ("tool0", "base_link", ""):
            q, force, torque = READY + 0.2 * rng.normal(size=7), *rng.normal(size=(2, 3))
            feel(graph, force, torque, frame)
            graph.now += 0.01
            graph.state(graph.now - 40, q)
            world.reset(q)
            tool, made = world.arm.tcp_pose(), np.zeros(world.model.nv)
            turn = np.eye(3) if frame == "base_link" else tool[:3, :3]
            force, torque, hand = turn @ force, turn @ torque, world.model.body("hand").id
            mujoco.mj_applyFT(world.model, world.data, force, torque, tool[:3, 3], hand, made)
            np.testing.assert_allclose(arm.read().external_torque, made[:7], atol=1e-6)
            feel(graph, force, np.full(3, np.nan))  # is not taken
        graph.now += 0.185  # since the last wrench: 10 ms more
        graph.state(graph.now - 40, q)
        arm.read()
        graph.now += 0.02
        graph.state(graph.now - 40, q)
        text = r"/wrench in frame base_link or tool0 is 0\.2[12] s old: the arm is stopped"
        with pytest.raises(ArmFaultError, match=text):
            arm.command(np.zeros(7))


def test_a_wrench_in_an_unknown_frame_stops_the_arm(graph):
    with feeling_arm(graph) as arm:
        for step in range(3):
            graph.now += 0.15
            feel(graph, np.ones(3), np.ones(3), "sensor_link")
            graph.state(10.0 + 0.15 * (step + 1), READY)
        text = "wrench on /wrench in frame base_link or tool0 is 0.* s old: the arm is stopped"
        with pytest.raises(ArmFaultError, match=text):
            arm.read()
        feel(graph, np.ones(3), np.ones(3), "tool0")
        assert np.isfinite(arm.read().external_torque).all()


def test_a_push_that_the_sensor_feels_pauses_the_task(graph):
    from hrc_learn.teleoperation import Touch

    touch, paused = Touch(panda), []
    with feeling_arm(graph) as arm:
        for k in range(200):
            graph.now += 0.01
            feel(graph, [0.0, 0.0, 20.0 if k > 100 else 0.0], np.zeros(3))
            graph.state(graph.now - 40, READY, np.zeros(7))
            paused.append(touch.read(arm.read()).pause)
    assert not any(paused[:100])
    assert all(paused[140:])


def test_a_sensor_that_is_silent_is_missed(graph):
    text = "the wrench or their positions are missing or not finite"
    with pytest.raises(ConnectionError, match=text):
        Ros2Arm(panda.chain, Ros2Config(wrench="/wrench", startup=0.01))


class MockSystem:
    """The system of ros2_control's `mock_components`, with its joint state broadcaster.

    Each period, the states become the commands of the period before; with `dynamics`,
    velocities and positions are integrated and differentiated backwards (`generic_system.cpp`).
    Velocities that nothing has set are NaN. Times are those of a simulation.
    """

    def __init__(self, graph, interface, *, dynamics, period=0.01):
        self.graph, self.interface, self.dynamics = graph, interface, dynamics
        self.period, self.clock, self.order = period, 3.0, None
        self.q, self.v = READY.copy(), np.full(7, 0.0 if dynamics else np.nan)

    def turn(self):
        order, position = self.order, self.q
        if self.interface == "velocity":
            self.q = self.q + self.period * self.v if self.dynamics else self.q
            self.v = self.v if order is None else order
        elif order is not None:
            self.q = order
            self.v = (order - position) / self.period if self.dynamics else self.v
        sent = [message for topic, message in self.graph.sent if topic == COMMANDS]
        self.order = np.array(sent[-1].data) if sent else None
        self.graph.now += self.period
        self.clock += self.period
        self.graph.state(self.clock, self.q[::-1], self.v[::-1], NAMES[::-1])


@pytest.mark.parametrize("interface", ["position", "velocity"])
@pytest.mark.parametrize("dynamics", [True, False])
def test_the_mock_system_of_ros2_control_follows(graph, interface, dynamics):
    graph.greeting = [(3.0, READY, np.full(7, np.nan))]
    arm = Ros2Arm(panda.chain, Ros2Config(interface=interface))
    mock = MockSystem(graph, interface, dynamics=dynamics)
    velocity = 0.3 * np.array([1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0])
    for _ in range(50):
        arm.command(velocity)
        mock.turn()
    state = arm.read()
    # Without dynamics, a commanded velocity moves nothing.
    factor = 0.0 if interface == "velocity" and not dynamics else 0.01
    moved = (state.joint_position - READY) / velocity
    np.testing.assert_allclose(moved, 49 * factor, atol=1.01 * factor + 1e-9)  # one period late
    np.testing.assert_allclose(state.joint_velocity, velocity)
    arm.stop()
    for _ in range(3):
        mock.turn()
    rest = arm.read()
    mock.turn()
    np.testing.assert_array_equal(arm.read().joint_position, rest.joint_position)
    np.testing.assert_allclose(arm.read().joint_velocity, np.zeros(7), atol=1e-12)


def test_a_mock_system_without_initial_positions_is_refused(graph):
    graph.greeting = [(3.0, np.full(7, np.nan))]
    with pytest.raises(ConnectionError, match="are missing or not finite"):
        position_arm(graph, startup=0.01)
