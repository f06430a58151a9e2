"""Orders of a program to a Franka arm's loop, and what it reads of it: the loop and the clock
are the test's.
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hrc_learn.hardware import DriverError, FrankaArm, FrankaConfig, franka_arm
from hrc_learn.hardware.franka_memory import Phase, Report
from hrc_learn.kinematics import SerialChain, fr3, panda

# Stand-ins are not of the annotated types.
pytestmark = pytest.mark.simulation

CONFIG = FrankaConfig(realtime=False, compiled=False, gripper=False)
VELOCITY = np.arange(7) / 10


class Loop:
    """The loop's process and the clock of the machine.

    Attributes:
        turn: What the loop does with the orders while the program waits.
        pause: How long each of its waits lasts, however short it wanted it [s].
    """

    pid, pause = 4711, 0.02

    def __init__(self):
        self.now, self.alive, self.killed, self.patience = 5.0, False, False, []
        self.report, self.turn = Report(phase=Phase.IDLE), lambda orders: None

    def get_context(self, kind):
        assert kind == "spawn"
        return self

    def Process(self, *, target, args, name, daemon):
        assert daemon  # it ends with the program
        self.shared = args[0]
        return self

    def start(self):
        self.alive = True
        self.publish()

    def is_alive(self):
        return self.alive

    def join(self, patience=None):
        self.patience.append(patience)
        self.turn(self.orders)

    def kill(self):
        self.alive, self.killed = False, True

    @property
    def orders(self):
        return self.shared.orders.read()

    def publish(self, **changed):
        """Report changes, read now."""
        self.report = replace(self.report, stamp=self.now, **changed)
        self.shared.report.write(self.report)

    def monotonic(self):
        return self.now

    def sleep(self, duration):
        self.now += self.pause
        self.turn(self.orders)


@pytest.fixture
def loop(monkeypatch):
    loop = Loop()
    monkeypatch.setattr(franka_arm, "time", loop)
    monkeypatch.setattr(franka_arm, "multiprocessing", loop)
    return loop


@pytest.fixture
def arm(loop):
    return FrankaArm("arm", fr3, CONFIG)


def test_an_arm_is_open_once_its_loop_idles(loop):
    begun = loop.now
    loop.report = Report(phase=Phase.STARTING)

    def turn(orders):
        if loop.now > begun + 2.0:
            loop.publish(phase=Phase.IDLE)

    loop.turn = turn
    arm = FrankaArm("arm", fr3, CONFIG)
    assert loop.now == pytest.approx(begun + 2.0, abs=0.03)
    assert (arm.pid, arm.gripper, arm.fault, loop.killed) == (4711, None, "", False)


@pytest.mark.parametrize("ends", [True, False])
def test_a_loop_that_does_not_begin_is_killed_and_says_why(loop, ends):
    loop.report, begun = Report(phase=Phase.STARTING), loop.now

    def turn(orders):
        loop.shared.message = "NetworkException: refused."
        if ends:
            loop.publish(phase=Phase.ENDED)

    loop.turn = turn
    text = "cannot connect: the process of the loop has ended. NetworkException: refused."
    with pytest.raises(DriverError) as raised:
        FrankaArm("arm", fr3, CONFIG)
    if ends:
        assert str(raised.value).startswith(text)
        assert str(raised.value).endswith("make sure that it is at rest, and connect again.")
    else:
        assert str(raised.value) == "cannot connect within 60 s. "
        assert loop.now == pytest.approx(begun + 60, abs=0.03)
    assert loop.killed


def test_the_state_is_the_newest_report(loop, arm):
    numbers = np.arange(21.0).reshape(3, 7)
    names = ("joint_position", "joint_velocity", "external_torque")
    loop.publish(time=7.5, **dict(zip(names, numbers, strict=True)))
    state = arm.read()
    assert state.time == 7.5
    assert math.isnan(state.gripper_width)
    for name, values in zip(names, numbers, strict=True):
        np.testing.assert_array_equal(getattr(state, name), values)


@pytest.mark.parametrize(("lockstep", "longest"), [(False, 0.2), (True, 2.0)])
def test_a_reading_that_is_too_old_is_an_error_but_during_a_recovery(loop, lockstep, longest):
    arm = FrankaArm("arm", fr3, replace(CONFIG, lockstep=lockstep))
    loop.now += longest - 0.01
    arm.read()
    loop.now += 0.02
    with pytest.raises(DriverError, match=f"no state for {longest + 0.01:.2f} s: something"):
        arm.read()
    loop.publish(phase=Phase.RECOVERING)
    loop.now += 10
    arm.read()
    loop.publish(phase=Phase.FAULTED)
    loop.shared.message = "a reflex"
    assert arm.fault == "a reflex"
    loop.now += 10
    with pytest.raises(DriverError, match=r"^a reflex$"):
        arm.read()
    loop.alive = False
    loop.publish(phase=Phase.IDLE)
    loop.now += 10
    with pytest.raises(DriverError, match=r"the loop has ended\. a reflex The control box"):
        arm.read()


def test_a_command_is_ordered_with_its_time_unless_the_arm_has_stopped(loop, arm):
    arm.command(VELOCITY)
    orders = loop.orders
    np.testing.assert_array_equal(orders.joint_velocity, VELOCITY)
    assert (orders.stamp, orders.stop, orders.end, orders.recoveries) == (5.0, False, False, 0)
    with pytest.raises(ValueError, match="7 finite numbers"):
        arm.command(VELOCITY[:6])
    arm.command(1e3 * VELOCITY)  # the loop's filter keeps the limits
    loop.shared.message = "a reflex"
    loop.publish(phase=Phase.FAULTED)
    with pytest.raises(DriverError, match=r"^a reflex$"):
        arm.command(VELOCITY)
    loop.publish(phase=Phase.IDLE)
    loop.alive = False
    with pytest.raises(DriverError, match="connect again"):
        arm.command(VELOCITY)
    with pytest.raises(DriverError, match="opened without a gripper"):
        arm.move(0.05)


def test_a_stop_is_over_once_the_last_joint_rests(loop, arm):
    """The loop rests first; by 0.02 rad/s over 20 ms the joints do when one is slower."""
    begun, position, speed = loop.now, np.zeros(7), 0.0
    loop.pause = 1e-3

    def turn(orders):
        nonlocal speed
        assert orders.stop
        assert orders.stamp == -math.inf
        passed = loop.now - begun
        speed = 0.05 if passed < 1.0 else 0.015
        position[3] = 0.05 * min(passed, 1.0) + 0.015 * max(passed - 1.0, 0.0)
        moves = passed < 0.5
        loop.publish(
            phase=Phase.MOVING if passed < 0.6 else Phase.IDLE,
            resting=not moves,
            time=passed,
            joint_position=position.copy(),
        )

    loop.turn = turn
    arm.command(VELOCITY)
    arm.stop()
    assert speed == 0.015
    assert 1.02 < loop.now - begun < 1.05


def test_a_gentle_arm_has_the_time_to_brake_from_its_highest_speed(loop):
    """At a tenth of the acceleration, 10 rad/s^2, joint 7 of an FR3 brakes for 5.3 s."""
    arm = FrankaArm("arm", fr3, replace(CONFIG, dynamics=0.1))
    begun = loop.now

    def turn(orders):
        brakes = loop.now < begun + 5.26
        phase = Phase.MOVING if brakes else Phase.IDLE
        loop.publish(phase=phase, resting=not brakes, time=loop.now)

    loop.turn = turn
    turn(loop.orders)
    arm.stop()
    assert loop.now > begun + 5.26
    arm.close()
    assert 6 < loop.patience[0] < 12


def test_a_stop_that_does_not_come_is_an_error_and_a_stopped_clock_is_none(loop, arm):
    begun = loop.now
    loop.publish(phase=Phase.MOVING, resting=True)
    with pytest.raises(DriverError, match=r"cannot stop within 3 s\."):
        arm.stop()
    assert loop.now == pytest.approx(begun + 3, abs=0.03)
    loop.publish(phase=Phase.IDLE, resting=False)
    with pytest.raises(DriverError, match="cannot stop within 3 s"):
        arm.stop()
    loop.turn = lambda orders: loop.publish(
        resting=True, time=loop.now, joint_position=np.full(7, 0.03 * loop.now)
    )
    with pytest.raises(DriverError, match="cannot stop within 3 s"):
        arm.stop()
    loop.turn = lambda orders: None
    loop.publish(phase=Phase.FAULTED, resting=True)
    before = loop.now
    arm.stop()
    assert loop.now == pytest.approx(before, abs=0.03)
    loop.publish(phase=Phase.ENDED)
    with pytest.raises(DriverError, match="cannot stop: the process of the loop has"):
        arm.stop()


def test_a_recovery_is_asked_for_once_and_waited_for(loop, arm):
    arm.recover()
    assert loop.orders.recoveries == 0  # there is nothing to recover from

    def turn(orders):
        if orders.recoveries and loop.now > begun + 4.0:
            phase = Phase.IDLE if heals else Phase.FAULTED
            loop.publish(recoveries=orders.recoveries, phase=phase)

    loop.shared.message = "the stop button is pressed"
    loop.turn = turn
    for asked, heals in enumerate((False, True), 1):
        loop.publish(phase=Phase.FAULTED)
        begun = loop.now
        if heals:
            arm.recover()
        else:
            with pytest.raises(DriverError, match=r"^the stop button is pressed$"):
                arm.recover()
        assert loop.orders.recoveries == asked
        assert loop.now == pytest.approx(begun + 4.0, abs=0.03)
    assert arm.fault == ""
    loop.publish(phase=Phase.FAULTED)
    loop.turn = lambda orders: None
    with pytest.raises(DriverError, match=r"cannot recover within 15 s\. the stop button is"):
        arm.recover()


@pytest.mark.parametrize("hangs", [False, True])
def test_closing_asks_for_the_end_and_kills_only_a_loop_that_hangs(loop, hangs):
    def turn(orders):
        loop.alive = loop.alive and (hangs or not orders.end)

    with FrankaArm("arm", fr3, CONFIG):
        loop.turn = turn
    assert loop.orders.end
    assert loop.patience[0] == 3.0
    assert loop.killed == hangs


def test_the_gripper_is_the_drivers_with_the_settings(monkeypatch):
    calls = []

    class Gripper:
        def __init__(self, ip):
            calls.append(ip)

        def read_once(self):
            return SimpleNamespace(width=0.05)

        def __getattr__(self, name):
            return lambda *values: calls.append((name, *values)) or False

    driver = SimpleNamespace(Gripper=Gripper)
    monkeypatch.setattr(franka_arm, "import_pylibfranka", lambda: driver)
    hand = franka_arm.FrankaHand("arm", speed=0.1, force=40.0)
    assert hand.read_width() == 0.05
    assert hand.move(0.03) is False
    assert hand.squeeze()  # of whatever width: franka's own answer says how wide
    assert calls == ["arm", ("move", 0.03, 0.1), ("grasp", 0.0, 0.1, 40.0, 0.1, 0.1)]


def test_only_arms_of_seven_joints_are_driven():
    short = SerialChain(
        joint_names=panda.joint_names[:6],
        mounts=panda.mounts[:6],
        flange=panda.flange,
        tcp=panda.tcp,
        limits=replace(
            panda.limits,
            **{
                name: getattr(panda.limits, name)[:6]
                for name in ("lower", "upper", "velocity", "acceleration", "jerk", "torque")
            },
        ),
        ready=panda.ready[:6],
    )
    with pytest.raises(ValueError, match="7 joints"):
        FrankaArm("127.0.0.1", short, CONFIG)


@pytest.mark.parametrize(("lockstep", "longest"), [(False, 0.2), (True, 2.0)])
def test_a_reading_may_be_as_old_as_its_limit(loop, lockstep, longest):
    arm = FrankaArm("arm", fr3, replace(CONFIG, lockstep=lockstep))
    loop.now = 0.0
    loop.publish()
    loop.now = longest
    arm.read()
    loop.now = math.nextafter(longest, 3)
    with pytest.raises(DriverError, match="something delays its process"):
        arm.read()


def test_what_is_waited_for_may_come_at_the_last_moment(loop, arm):
    loop.now, loop.pause = 0.0, 1.0
    loop.publish(phase=Phase.FAULTED)
    loop.turn = lambda orders: loop.now == 16 and loop.publish(recoveries=1, phase=Phase.IDLE)
    arm.recover()  # a look at 15 s is the last but one
    loop.now = 0.0
    loop.publish(phase=Phase.FAULTED)
    loop.turn = lambda orders: None
    with pytest.raises(DriverError, match="cannot recover within 15 s"):
        arm.recover()
    assert loop.now == 16.0


def test_a_joint_at_just_the_speed_of_rest_moves(loop, arm):
    """0.0004 rad in 0.02 s, by readings at exact times."""
    times = {0: (0.0, 0.0), 1: (0.02, 0.0004), 2: (0.0625, 0.0004)}
    turns = iter(range(1, 20))
    loop.publish(resting=True, time=0.0, joint_position=np.zeros(7))

    def turn(orders):
        time, way = times[min(next(turns), 2)]
        loop.publish(time=time, joint_position=way * np.eye(7)[6])

    loop.turn = turn
    arm.stop()
    assert next(turns) == 3  # at rest by the second reading


def test_a_gripper_of_the_driver_has_the_settings_and_reports_its_width(loop, monkeypatch):
    opened = []

    class Gripper:
        width, closed = 0.03, False

        def __init__(self, open_driver, startup):
            opened.append((open_driver, startup))

        def close(self):
            self.closed = True

        def move(self, width):
            opened.append(width)

    monkeypatch.setattr(franka_arm, "GripperThread", Gripper)
    config = replace(CONFIG, gripper=True, grip_speed=0.07, grip_force=33.0)
    with FrankaArm("arm", fr3, config) as arm:
        assert arm.read().gripper_width == 0.03
        arm.move(0.05)
        gripper = arm.gripper
    assert gripper.closed
    (open_process, startup), width = opened
    assert (startup, width) == (60.0, 0.05)
    (hand,) = open_process.args
    assert hand.func is franka_arm.FrankaHand
    assert (hand.args, hand.keywords) == (("arm",), {"speed": 0.07, "force": 33.0})
