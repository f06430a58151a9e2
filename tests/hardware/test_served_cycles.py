"""A served arm cycle by cycle: its world, its driver and the clock are the test's."""

import ipaddress
import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hrc_learn.hardware import protocol_server
from hrc_learn.hardware.protocol_server import (
    CYCLE,
    ServedArm,
    loopback_addresses,
    serve_world,
)
from hrc_learn.protocols import ArmState
from hrc_learn.sim.arm_model import FINGER_STROKE

# Stand-ins are not of the annotated types.
pytestmark = pytest.mark.simulation

PATIENCE = 20.0


class Link:
    """World, robot, connection and clock of a server.

    Attributes:
        answers: Whether the driver answers a cycle, by its number.
        motion: Number of the motion, 0 without one.
        udp_connected: Whether a driver is connected.
    """

    hostname = "127.1.2.3"

    def __init__(self):
        self.time, self.now, self.cycle = 7.0, 0.0, 0
        self.model = SimpleNamespace(opt=SimpleNamespace(timestep=0.002))
        self.answers, self.motion, self.udp_connected = lambda cycle: True, 0, False
        self.answered, self.went_on, self.calls, self.sleeps = False, [], [], []
        self.failure, self.gripper_server = None, SimpleNamespace(reset_state=self.note("hand"))

    def note(self, word):
        return lambda *_: self.calls.append(word)

    # As the module of the robot.

    def ServedRobot(self, world):
        assert world is self
        return self

    def PunctualServer(self, robot, addresses):
        assert robot is self
        assert len(addresses) == 50
        return self

    # As the robot.

    def step(self):
        if self.failure is not None:
            raise self.failure
        self.time += CYCLE

    def begin_cycle(self):
        self.answered, self.cycle = False, self.cycle + 1

    def go_on(self):
        self.went_on.append(self.cycle)

    # As the connection.

    @property
    def current_motion_id(self):
        return self.motion

    def init(self):
        self.calls.append("init")

    def send_state(self):
        self.answered = False

    def process_commands(self):
        self.answered = bool(self.motion) and self.answers(self.cycle)

    def cleanup(self):
        self.calls.append("cleanup")

    def reset_state(self):
        self.calls.append("reset")

    # As the clock: each look at it takes 0.1 ms.

    def monotonic(self):
        self.now += 1e-4
        return self.now

    def sleep(self, duration):
        self.sleeps.append(duration)
        self.now += duration


@pytest.fixture
def link(monkeypatch):
    link = Link()
    monkeypatch.setattr(protocol_server, "imported", lambda name, advice: link)
    monkeypatch.setattr(protocol_server, "time", link)
    monkeypatch.setattr(protocol_server, "_SIGN_OF_LIFE", PATIENCE)
    return link


@pytest.fixture
def server(link):
    with serve_world(link) as server:
        yield server


def test_a_world_steps_in_cycles_while_it_is_served(link):
    with serve_world(link) as server:
        assert link.model.opt.timestep == CYCLE
        assert server.address == "127.1.2.3"
        assert link.calls == ["init"]
        assert server.cycles == 0
        assert server._thread.daemon
    assert link.model.opt.timestep == 0.002
    assert link.calls == ["init", "cleanup", "reset", "hand"]


def test_time_passes_in_whole_cycles_and_what_is_left_counts(link, server):
    for duration, cycles in ((0.01, 10), (0.0097, 10), (0.0096, 9), (0.0, 0), (0.0004, 1)):
        before = link.cycle
        server.advance(duration)
        assert link.cycle - before == cycles
        assert server.cycles == link.cycle


def test_a_loop_that_is_late_lets_go_what_is_lost(link, server):
    server.advance(0.01)
    link.time += 0.1  # while the driver was called
    server.advance(0.02)
    assert link.cycle == 10
    server.advance(0.02)
    assert link.cycle == 30
    link.time += 0.1
    server.begin()  # this time does not count
    server.advance(0.02)
    assert link.cycle == 50


def test_the_clock_of_the_arm_begins_as_its_driver_connects(link, server):
    server.advance(0.005)
    link.udp_connected = True
    server.advance(0.003)
    # The driver has been sent the cycles 0, 1 and 2.
    assert server.clock_offset == pytest.approx(link.time - 2 * CYCLE)
    server.advance(0.004)
    assert server.clock_offset == pytest.approx(link.time - 6 * CYCLE)
    link.udp_connected = False
    server.advance(0.004)
    link.udp_connected = True
    server.advance(0.001)
    assert server.clock_offset == pytest.approx(link.time)


def test_without_answers_the_arm_goes_on_for_twenty_cycles(link, server):
    link.motion = 3
    silent = {*range(5, 8), *range(20, 45)}
    link.answers = lambda cycle: cycle not in silent
    server.advance(0.06)
    assert server.missed == len(silent)
    assert link.went_on == [5, 6, 7, *range(20, 40)]
    # Each was waited for, for 10 ms.
    assert link.now == pytest.approx(0.01 * len(silent), rel=0.06)
    link.motion, link.answers = 0, lambda cycle: False
    server.advance(0.01)  # at rest nothing is missed
    assert server.missed == len(silent)
    assert link.went_on[-1] == 39


def test_while_the_driver_is_called_time_passes_no_faster_than_it_does(link, server):
    with server.running():
        while link.cycle < 20:
            threading.Event().wait(0.001)
    before = link.cycle
    server.advance(0.0)
    assert link.cycle - before <= 1
    waits = [duration for duration in link.sleeps if duration]
    assert len(waits) >= 19
    # What a cycle took by the clock is not waited for again.
    assert max(waits) < CYCLE
    assert min(waits) > CYCLE - 4e-4


def test_a_slow_cycle_is_not_waited_for_in_vain(link, server):
    link.begin_cycle = lambda: setattr(link, "cycle", link.cycle + 1) or link.sleep(0.5)
    with server.running():
        while link.cycle < 3:
            threading.Event().wait(0.001)
    assert set(link.sleeps) == {0.5, 0.0}


def test_physics_that_fails_is_raised_from_then_on_and_ends_the_connection(link, server):
    server.advance(0.002)
    link.failure = ArithmeticError("diverged")
    for _ in range(2):
        with pytest.raises(ArithmeticError, match="diverged"):
            server.advance(0.01)
    with pytest.raises(ArithmeticError, match="diverged"), server.running():
        pass
    server._thread.join(PATIENCE)
    assert link.calls == ["init", "cleanup", "reset", "hand"]


def test_a_world_that_waits_gives_signs_of_life(link, monkeypatch):
    monkeypatch.setattr(protocol_server, "_SIGN_OF_LIFE", 1e-3)
    came = threading.Event()
    link.begin_cycle = lambda: link.time > 7.0029 and came.set()
    with serve_world(link):
        assert came.wait(PATIENCE)


def test_a_served_arm_has_the_time_of_its_world(link, server):
    link.udp_connected = True
    server.advance(0.05)
    calls = []
    state = ArmState(
        time=0.049, joint_position=np.ones(7), joint_velocity=np.zeros(7), gripper_width=0.01
    )
    arm = SimpleNamespace(
        read=lambda: state,
        command=lambda velocity: calls.append(("command", *velocity)),
        move=lambda width: calls.append(("move", width)),
        close=lambda: calls.append("close"),
    )
    link.time += 0.3
    served = ServedArm(arm, server)
    link.udp_connected, server.running = True, lambda: threading.Lock()
    found = served.read()
    assert found.time == pytest.approx(link.time)
    assert replace(found, time=0.049) == state
    served.command(np.arange(7.0))
    served.move(0.02)
    served.close()
    assert calls == [("command", *np.arange(7.0)), ("move", 0.02), "close"]
    before = link.cycle
    server.advance(0.01)  # counted from the beginning of the arm
    assert link.cycle - before == 10


@pytest.mark.parametrize("end", [0, -1])
def test_addresses_are_of_this_machine_and_of_hosts(monkeypatch, end):
    asked = []

    def choose(*limits):
        asked.append(limits)
        return range(*limits)[end]

    random = SimpleNamespace(Random=lambda: SimpleNamespace(randrange=choose))
    monkeypatch.setattr(protocol_server, "random", random)
    addresses = [ipaddress.ip_address(text) for text in loopback_addresses()]
    assert len(addresses) == 50
    assert all(address.is_loopback for address in addresses)
    assert int(addresses[0]) & 0xFF not in (0, 255)
    assert addresses[0] == ipaddress.ip_address(("127.1.0.1", "127.254.255.254")[end])


class Simulated:
    """A world whose arm does what it is commanded, and whose gripper is where it was moved."""

    def __init__(self):
        self.q, self.velocity, self.width, self.commands = np.zeros(7), np.zeros(7), 0.03, []
        self.fingers = {name: np.zeros(2) for name in ("finger_left", "finger_right")}
        self.model = SimpleNamespace(
            actuator=lambda name: SimpleNamespace(forcerange=self.fingers[name])
        )
        self.config = SimpleNamespace(arm=SimpleNamespace(grip_force=30.0))
        self.arm, self.time, self.moves = self, 0.0, []

    def read(self):
        return ArmState(
            time=self.time,
            joint_position=self.q.copy(),
            joint_velocity=self.velocity.copy(),
            gripper_width=self.width,
            external_torque=np.arange(7.0),
        )

    def command(self, velocity):
        self.velocity = np.array(velocity)
        self.commands.append(self.velocity)

    def move(self, width):
        self.width = width
        self.moves.append(width)

    def advance(self, duration):
        self.time, self.q = self.time + duration, self.q + duration * self.velocity


@pytest.fixture
def served_robot():
    pytest.importorskip("franky_sim")
    from hrc_learn.hardware import served_robot

    return served_robot


@pytest.fixture
def robot(served_robot):
    robot = served_robot.ServedRobot(Simulated())
    assert not robot.answered
    robot.joint_position_control(np.zeros(7))  # a step needs a command before it
    return robot


def cycle(robot, velocity=None):
    """One cycle with an answer, or without one."""
    robot.step()
    robot.begin_cycle()
    assert not robot.answered
    if velocity is None:
        robot.go_on()
        assert not robot.answered
    else:
        robot.joint_velocity_control(velocity)
        assert robot.answered


def test_a_robot_reports_the_arm_and_the_acceleration_of_its_commands(robot):
    world, one = robot._world, np.eye(7)[2]
    velocities = [0.1, 0.3, 0.2]
    for velocity in velocities:
        cycle(robot, velocity * one)
    robot.step()
    state = robot.state
    assert world.time == pytest.approx(4 * CYCLE)
    np.testing.assert_allclose(state.q, CYCLE * sum(velocities) * one, atol=1e-15)
    np.testing.assert_allclose(state.dq, 0.2 * one)
    np.testing.assert_allclose(state.dq_d, 0.2 * one)
    np.testing.assert_allclose(state.ddq_d, (0.2 - 0.3) / CYCLE * one)
    np.testing.assert_array_equal(state.tau_ext_hat_filtered, np.arange(7.0))


def test_without_an_answer_the_acceleration_is_kept_and_a_repeated_command_is_none(robot):
    one = np.eye(7)[4]
    cycle(robot, 0.1 * one)
    cycle(robot, 0.15 * one)
    for expected in (0.2, 0.25, 0.3):
        cycle(robot)
        np.testing.assert_allclose(robot.velocity, expected * one)
    robot.step()
    robot.begin_cycle()
    robot.joint_velocity_control(9.0 * one, has_new_command=False)
    assert not robot.answered
    np.testing.assert_allclose(robot.velocity, 0.3 * one)


def test_only_joint_velocities_move_the_arm(robot):
    cycle(robot, np.ones(7))
    robot._set_server(SimpleNamespace(current_motion_id=0))
    robot.joint_position_control(np.ones(7))  # as the package holds an arm without a motion
    np.testing.assert_array_equal(robot._world.velocity, np.zeros(7))
    robot._set_server(SimpleNamespace(current_motion_id=4))
    with pytest.raises(NotImplementedError, match="joint velocity motions only"):
        robot.joint_position_control(np.ones(7))
    robot._set_server(None)
    robot.joint_position_control(np.ones(7))


@pytest.mark.parametrize(("force", "applied"), [(12.0, 12.0), (70.0, 30.0)])
@pytest.mark.parametrize(
    ("goal", "reached"), [(0.05, 0.05), (0.0, 0.0), (0.2, 2 * FINGER_STROKE), (-0.1, 0.0)]
)
def test_fingers_move_at_their_speed_to_where_they_can(robot, force, applied, goal, reached):
    world = robot._world
    cycle(robot, np.zeros(7))
    assert world.moves == []
    robot.set_hand_goal(goal, 2.0, force)
    for limits in world.fingers.values():
        np.testing.assert_array_equal(limits, [-applied, applied])
    for _ in range(20):
        cycle(robot, np.zeros(7))
    # Two fingers at 2 m/s change the width by 4 mm in a cycle.
    assert world.moves[0] == pytest.approx(0.03 + 0.004 * np.sign(goal - 0.03))
    assert np.abs(np.diff(world.moves)).max() == pytest.approx(0.004)
    assert world.moves[-1] == pytest.approx(reached)


@pytest.mark.parametrize(
    ("number", "taken"), [(41, True), (40, False), (42, False), (297, False)]
)
def test_an_answer_is_taken_for_its_own_state_only(served_robot, monkeypatch, number, taken):
    came = []
    monkeypatch.setattr(
        served_robot.FrankaRobotServer,
        "_handle_udp_command",
        lambda server, data: came.append(data),
    )
    server = served_robot.PunctualServer.__new__(served_robot.PunctualServer)
    server._FrankaServer__message_id = 42  # counted on since it was sent
    data = number.to_bytes(8, "little") + b"\1" * 8
    server._handle_udp_command(data)
    assert came == [data] * taken
