"""An arm of LeRobot turn by turn: readings, clock and faults of its servos are the test's."""

import math
import threading
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from hrc_learn.hardware import (
    ArmFaultError,
    LeRobotArm,
    LeRobotConfig,
    lerobot_arm,
    lerobot_device,
)
from hrc_learn.hardware.lerobot_arm import led_goal
from hrc_learn.hardware.lerobot_device import JointUnits, in_words
from hrc_learn.kinematics.registry import arm as named_arm

# Stand-ins are not of the annotated types.
pytestmark = pytest.mark.simulation

CHAIN = named_arm("so101").chain
NAMES = CHAIN.joint_names
PERIOD = 0.02
TURN = 4096
"""Steps of a servo's encoder; LeRobot counts one less in a turn."""
PATIENCE = 20.0


def calibration(low=1000, high=3096, reverse=0):
    return SimpleNamespace(range_min=low, range_max=high, drive_mode=reverse)


class Servos:
    """A robot of LeRobot whose thread waits before each reading until the test lets it go on.

    Attributes:
        goals: Actions received.
        blocked: Joints that stay where they are.
        error: Raised by each reading, if any.
        status: Answers to the next questions for the servos' status; then 0.
        clock: Time, which goes on by a period with each reading [s].
    """

    name = "servos"

    def __init__(self, mode="DEGREES"):
        self.action_features = {f"{name}.pos": float for name in (*NAMES, "gripper")}
        self.at = dict.fromkeys(self.action_features, 0.0) | {"gripper.pos": 25.0}
        self.goals, self.blocked, self.error, self.status = [], set(), None, []
        self.clock, self.asked, self.torque, self.forgotten, self.gone = 10.0, 0, 0, 0, 0
        motor = SimpleNamespace(model="sts", norm_mode=SimpleNamespace(name=mode))
        self.bus = SimpleNamespace(
            motors=dict.fromkeys(NAMES, motor),
            calibration={name: calibration() for name in NAMES},
            model_resolution_table={"sts": TURN},
            model_ctrl_table={"sts": {"Status": (65, 1)}},
            sync_read=self._status,
            enable_torque=self._enable,
            port_handler=SimpleNamespace(ser=SimpleNamespace(reset_input_buffer=self._forget)),
        )
        self.turns = threading.Condition()
        self.waits, self.free, self.main = False, 0, threading.current_thread()
        self.freed, self.period = False, PERIOD

    def get_observation(self):
        with self.turns:
            if threading.current_thread() is not self.main:
                self.waits = True
                self.turns.notify_all()
                assert self.turns.wait_for(lambda: self.free or self.freed, PATIENCE)
                self.waits = False
                self.clock += self.free * self.period
                self.free = 0
        if self.error is not None:
            raise self.error
        return dict(self.at)

    def send_action(self, action):
        self.goals.append(action)
        free = {key: v for key, v in action.items() if key not in self.blocked}
        self.at |= free

    def disconnect(self):
        self.gone += 1

    def _status(self, register, *, normalize, num_retry):
        assert (register, normalize, num_retry) == ("Status", False, 2)
        self.asked += 1
        return self.status.pop(0) if self.status else dict.fromkeys(NAMES, 0)

    def _enable(self):
        self.torque += 1

    def _forget(self):
        self.forgotten += 1

    def turn(self, number=1):
        """Let the arm take so many turns."""
        with self.turns:
            for _ in range(number):
                assert self.turns.wait_for(lambda: self.waits, PATIENCE)
                self.free, self.waits = 1, False
                self.turns.notify_all()
            assert self.turns.wait_for(lambda: self.waits, PATIENCE)

    def let_go(self):
        """Turns are free from now on, and take no time by the clock."""
        with self.turns:
            self.freed = True
            self.turns.notify_all()

    @property
    def goal(self):
        """Position commanded last [rad]."""
        return np.radians([self.goals[-1][f"{name}.pos"] for name in NAMES])


@pytest.fixture
def servos(monkeypatch):
    servos = Servos()
    clock = SimpleNamespace(monotonic=lambda: servos.clock, sleep=lambda _: None)
    monkeypatch.setattr(lerobot_arm, "time", clock)
    monkeypatch.setattr(lerobot_arm, "open_device", lambda kind, settings: servos)
    return servos


@pytest.fixture
def connect(servos):
    arms = []

    def connect(**settings):
        arms.append(LeRobotArm({}, CHAIN, LeRobotConfig(**{"rate": 1 / PERIOD} | settings)))
        return arms[-1]

    yield connect
    servos.let_go()
    for arm in arms:
        arm.close()


def one(joint, value):
    return value * np.eye(len(NAMES))[joint]


def test_a_velocity_is_integrated_for_its_time_and_measured_by_the_slope(servos, connect):
    arm = connect()
    servos.turn()
    np.testing.assert_allclose(servos.goal, 0.0, atol=1e-12)
    assert servos.goals[-1]["gripper.pos"] == 25.0  # the gripper stays as it was found
    arm.command(one(1, 0.5))
    for k in range(1, 12):
        servos.turn()
        held = min(k * PERIOD, 0.15)
        np.testing.assert_allclose(servos.goal, one(1, 0.5 * held), atol=1e-12)
        if k == 6:  # five readings, in each of which it has gone on
            np.testing.assert_allclose(arm.read().joint_velocity, one(1, 0.5), atol=1e-9)
    state = arm.read()
    np.testing.assert_allclose(state.joint_position, one(1, 0.075), atol=1e-12)
    assert state.time == pytest.approx(servos.clock - 0.0)
    assert state.gripper_width == pytest.approx(0.02)
    servos.turn(5)
    np.testing.assert_allclose(arm.read().joint_velocity, 0.0, atol=1e-9)
    arm.command(one(1, -0.5))
    servos.turn(2)
    arm.command(one(0, 0.5))
    servos.turn(2)
    arm.stop()
    servos.turn(3)
    np.testing.assert_allclose(servos.goal, one(1, 0.055) + one(0, 0.02), atol=1e-12)


def test_the_gripper_opens_by_its_share_of_the_opening(servos, connect):
    arm = connect(opening=0.1)
    for width, percent in ((0.03, 30.0), (0.2, 100.0), (-0.1, 0.0)):
        arm.move(width)
        servos.turn()
        assert servos.goals[-1]["gripper.pos"] == pytest.approx(percent)
    servos.turn()
    assert arm.read().gripper_width == 0.0
    with pytest.raises(ValueError, match="width of the gripper must be a number"):
        arm.move(math.nan)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        *(({name: 0.0}, f"{name} must be positive") for name in ("rate", "opening", "lag")),
        ({"blocked": math.nan}, "blocked must be positive"),
        ({"timeout": math.inf}, "timeout must be finite"),
        ({"unit": "grad"}, "unit must be '' or deg or rad, but is 'grad'"),
    ],
)
def test_settings_are_checked(settings, message):
    with pytest.raises(ValueError, match=message):
        LeRobotConfig(**settings)


def test_a_joint_that_stays_behind_is_not_wound_up_and_stops_the_arm(servos, connect):
    arm = connect(lag=0.1, blocked=0.3)
    servos.blocked = {"elbow_flex.pos"}
    servos.turn()
    turns = 0
    while True:
        try:
            arm.command(one(2, 1.0))
        except ArmFaultError as error:
            text = str(error)
            break
        servos.turn()
        turns += 1
    # At 0.099 of 0.1 rad after five turns; then 0.3 s, which the next turn is beyond.
    assert turns == 5 + 16
    assert text.startswith("elbow_flex stays 0.10 rad behind its command: it is blocked")
    np.testing.assert_allclose(servos.goal, one(2, 0.1), atol=1e-9)
    sent = len(servos.goals)
    servos.turn(3)
    assert len(servos.goals) == sent
    servos.blocked = set()
    servos.at["elbow_flex.pos"] = 2.0
    servos.let_go()
    arm.recover()
    assert servos.torque == 1
    arm.command(one(2, 0.0))


def test_a_joint_that_catches_up_does_not_count_as_blocked(servos, connect):
    arm = connect(lag=0.1, blocked=0.3)
    servos.blocked = {"elbow_flex.pos"}
    for k in range(60):
        arm.command(one(2, 1.0))
        if k % 15 == 14:
            servos.at["elbow_flex.pos"] += math.degrees(0.05)
        servos.turn()


def test_two_readings_are_enough_for_a_velocity(servos, connect):
    arm = connect()
    np.testing.assert_array_equal(arm.read().joint_velocity, 0.0)
    servos.at[f"{NAMES[0]}.pos"] += math.degrees(0.01)
    servos.turn()
    np.testing.assert_allclose(arm.read().joint_velocity, one(0, 0.01 / PERIOD), atol=1e-9)


def test_a_silent_bus_is_a_fault_by_its_age_and_its_words(servos, connect):
    arm = connect()
    servos.turn()
    servos.error = TimeoutError("no reply\n of 3")
    servos.turn(20)
    arm.read()
    assert servos.forgotten == 20
    servos.turn()
    text = r"no reading of the arm for 0\.42 s \(no reply of 3\): its servos hold"
    for call in (arm.read, lambda: arm.command(np.zeros(5))):
        with pytest.raises(ArmFaultError, match=text):
            call()
    arm.stop()
    servos.let_go()
    with pytest.raises(
        ArmFaultError, match=r"the bus does not answer \(no reply of 3\): check"
    ):
        arm.recover()
    assert servos.torque == 0
    servos.error = None
    arm.recover()
    arm.command(np.zeros(5))
    assert servos.torque == 1


@pytest.mark.parametrize(
    ("status", "words"),
    [
        (1, "voltage"),
        (2 | 8, "angle sensor and current"),
        (4 | 32, "temperature and overload"),
        (16, "status 16"),
    ],
)
def test_an_alarm_that_is_confirmed_stops_the_arm_by_its_name(servos, connect, status, words):
    arm = connect()
    alarm = {**dict.fromkeys(NAMES, 0), "wrist_roll": status}
    servos.turn()
    # A late reply to another question: seen once, twice or three times, and then not.
    quiet = [dict.fromkeys(NAMES, 0)]
    for seen in (1, 2, 3):
        servos.status = [alarm] * seen + quiet
        servos.turn(26)
        arm.command(np.zeros(5))
        assert servos.status == []
    servos.status = [alarm] * 4
    servos.turn(26)
    text = f"servo wrist_roll reports {words}: let it cool down"
    with pytest.raises(ArmFaultError, match=text):
        arm.command(np.zeros(5))
    servos.let_go()
    servos.status = [alarm] * 4
    with pytest.raises(ArmFaultError, match=text):
        arm.recover()
    assert servos.torque == 0
    arm.recover()
    assert servos.torque == 1


def test_the_status_is_asked_for_each_half_second(servos, connect):
    connect()
    servos.turn(101)  # the first one at once
    assert servos.asked == 1 + 100 // 26


def test_the_goal_keeps_within_the_description_and_the_calibrated_range(servos, connect):
    servos.bus.calibration["shoulder_pan"] = calibration(low=1500, high=2500)
    arm = connect()
    for joint, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
        for _ in range(400):
            arm.command(one(joint, 0.9 * sign * float(CHAIN.limits.velocity[joint])))
            servos.turn()
        calibrated = (500 if joint == 0 else 1048) * 2 * math.pi / (TURN - 1)
        limit = float((CHAIN.limits.upper if sign > 0 else CHAIN.limits.lower)[joint])
        reached = sign * min(abs(limit), calibrated)
        assert servos.goal[joint] == pytest.approx(reached, abs=1e-9)


def test_limits_of_time_are_exclusive(servos, connect):
    """By a clock in 64ths of a second, which is exact."""
    servos.period = 1 / 64
    arm = connect(rate=64.0, lag=0.1, blocked=0.25, silence=0.375)
    servos.turn(65)
    assert servos.asked == 2  # at once, and after more than half a second
    servos.blocked = {"elbow_flex.pos"}
    arm.command(one(2, 1.0))
    turns = 0
    while not arm._fault:
        arm.command(one(2, 1.0))
        servos.turn()
        turns += 1
    # At 0.099 of 0.1 rad after seven turns; a quarter of a second is sixteen more.
    assert turns == 7 + 17
    servos.error = TimeoutError("no reply")
    servos.turn(24)
    arm.read()
    servos.turn()
    with pytest.raises(ArmFaultError, match=r"for 0\.39 s"):
        arm.read()


def test_readings_keep_their_rate_and_are_not_made_up_for_after_a_stall(servos, monkeypatch):
    begun, readings = servos.clock, []
    takes = iter([0.0, 0.005, 0.012, 0.07, 0.001, 0.02, 0.003, 0.0])

    class Event(threading.Event):
        def wait(self, timeout=None):
            servos.clock += timeout
            return self.is_set()

    monkeypatch.setattr(
        lerobot_arm,
        "threading",
        SimpleNamespace(Lock=threading.Lock, Thread=threading.Thread, Event=Event),
    )

    def read():
        readings.append(servos.clock - begun)
        servos.clock += next(takes, 0.0)
        return dict(servos.at)

    monkeypatch.setattr(servos, "get_observation", read)
    monkeypatch.setattr(Event, "is_set", lambda self: len(readings) >= 8)
    arm = LeRobotArm({}, CHAIN, LeRobotConfig(rate=50.0))
    arm._thread.join(PATIENCE)
    arm.close()
    # The first is the constructor's. The fourth takes 70 ms: the one that was due meanwhile
    # comes at once and one more after it, but not all that were missed.
    expected = [0.0, 0.0, 0.02, 0.04, 0.11, 0.111, 0.131, 0.15]
    np.testing.assert_allclose(readings, expected, atol=1e-9)


def test_a_device_is_tried_three_times_and_its_port_given_back_after_each():
    made = []

    def make(config):
        device = SimpleNamespace(released=[])
        device.bus = SimpleNamespace(disconnect=lambda **how: device.released.append(how))

        def connect(*, calibrate):
            assert not calibrate
            if len(made) <= config:
                raise ConnectionError("no reply")

        device.connect = connect
        made.append(device)
        return device

    for failures in (0, 1, 2, 3):
        made.clear()
        if failures < 3:
            assert lerobot_device._connected(make, failures) is made[failures]
        else:
            with pytest.raises(ConnectionError, match="no reply"):
                lerobot_device._connected(make, failures)
        assert len(made) == min(failures + 1, 3)
        held = [{"disable_torque": False}]
        assert [device.released for device in made] == [held] * failures + [[]] * (failures < 3)


@pytest.mark.parametrize("kind", ["robot", "teleop"])
def test_a_device_that_cannot_be_used_says_why(monkeypatch, kind):
    pytest.importorskip("lerobot")
    folder, maker = {
        "robot": ("robots", "make_robot_from_config"),
        "teleop": ("teleoperators", "make_teleoperator_from_config"),
    }[kind]
    device = SimpleNamespace(is_calibrated=True, gone=[], error=None)
    device.disconnect = lambda: device.gone.append(1)

    def connect(calibrate):
        if device.error is not None:
            raise device.error

    device.connect = connect
    config = SimpleNamespace(id="mine", port="/dev/a")
    monkeypatch.setattr(lerobot_device, "_config", lambda *_: config)
    monkeypatch.setattr(f"lerobot.{folder}.utils.{maker}", lambda given: device)
    open_it = partial(lerobot_device.open_device, kind, {"type": "x"})
    assert open_it() is device
    device.is_calibrated = False
    text = f"--{kind}.type=x has no calibration 'mine'.*lerobot-calibrate --{kind}.type=x "
    with pytest.raises(ConnectionError, match=f"{text}--{kind}.id=mine first"):
        open_it()
    assert device.gone == [1]
    device.error = OSError("two\nlines")
    text = rf"--{kind}.type=x cannot be reached at /dev/a \(two lines\): check .*--{kind}.port "
    with pytest.raises(ConnectionError, match=text):
        open_it()
    config.port = None
    with pytest.raises(ConnectionError, match=r"cannot be reached \(two lines\)"):
        open_it()
    device.error = ImportError("scservo_sdk")
    with pytest.raises(ModuleNotFoundError, match=r"maker's SDK: .*; scservo_sdk"):
        open_it()


def test_a_leader_arm_gives_radians_and_the_fraction_of_its_handle(monkeypatch):
    servos = Servos()
    servos.get_action = lambda: dict.fromkeys(servos.at, 30.0)
    opened = []
    monkeypatch.setattr(
        lerobot_device, "open_device", lambda *asked: opened.append(asked) or servos
    )
    leader = lerobot_device.LeaderArm({"type": "so101_leader"}, NAMES)
    assert opened == [("teleop", {"type": "so101_leader"})]
    position, fraction = leader.read()
    np.testing.assert_allclose(position, math.pi / 6)
    assert fraction == pytest.approx(0.3)
    leader.close()
    assert servos.gone == 1
    zeros, backwards = {NAMES[1]: 0.5}, NAMES[1:2]
    units = JointUnits.of(servos, NAMES, "", zeros, backwards)  # of the follower
    leader = lerobot_device.LeaderArm({"type": "so101_leader"}, NAMES, "", zeros, backwards)
    position, fraction = leader.read()
    assert position[1] == pytest.approx(0.5 - math.pi / 6)
    asked = units.action(position, fraction)
    assert asked == pytest.approx(servos.get_action())


def test_closing_ends_the_thread_and_disconnects(servos):
    arm = LeRobotArm({}, CHAIN)
    assert arm._thread.daemon  # a program that forgets to close it may end
    servos.let_go()
    arm.close()
    assert servos.gone == 1
    assert "lerobot" not in {thread.name for thread in threading.enumerate()}


def test_an_arm_that_cannot_be_read_is_disconnected(servos):
    servos.error = TimeoutError("no reply")
    with pytest.raises(TimeoutError):
        LeRobotArm({}, CHAIN)
    assert servos.gone == 1


def test_goals_keep_near_the_arm_and_lead_back_one_that_is_outside():
    ends = np.full(3, -1.0), np.full(3, 1.0)
    here = np.array([0.0, 0.95, 1.2])
    for goal, led in (
        (5.0, [0.3, 1.0, 1.2]),
        (-5.0, [-0.3, 0.65, 0.9]),
        (0.7, [0.3, 0.7, 0.9]),
    ):
        np.testing.assert_allclose(led_goal(np.full(3, goal), here, 0.3, *ends), led)
        mirrored = led_goal(np.full(3, -goal), -here, 0.3, *ends)
        np.testing.assert_allclose(mirrored, -np.array(led))


class TestUnits:
    """A joint's range is (3096 - 1000) steps, so that LeRobot's 100 % is half of it."""

    half = 2096 * math.pi / (TURN - 1)

    def test_degrees_are_degrees_and_a_range_is_its_half(self):
        units = JointUnits.of(Servos(), NAMES)
        np.testing.assert_allclose(units.scale, math.pi / 180)
        np.testing.assert_allclose(units.span, self.half)
        percent = JointUnits.of(Servos("RANGE_M100_100"), NAMES)
        np.testing.assert_allclose(percent.scale, self.half / 100)
        np.testing.assert_allclose(percent.span, self.half)
        turned = Servos("RANGE_M100_100")
        turned.bus.calibration["elbow_flex"] = calibration(reverse=1)
        scale = JointUnits.of(turned, NAMES).scale
        np.testing.assert_allclose(scale[2], -self.half / 100)
        np.testing.assert_allclose(scale[[0, 1, 3, 4]], self.half / 100)

    def test_zeros_and_reversed_joints_belong_to_the_description(self):
        units = JointUnits.of(
            Servos(), NAMES, zeros={NAMES[1]: 0.5}, reversed_joints=NAMES[1:2]
        )
        values = {f"{name}.pos": 90.0 for name in NAMES} | {"gripper.pos": 40.0}
        position, share = units.observed(values)
        expected = np.full(5, math.pi / 2)
        expected[1] = 0.5 - math.pi / 2
        np.testing.assert_allclose(position, expected)
        assert share == 0.4
        assert units.action(position, share) == pytest.approx(values)
        with pytest.raises(
            ValueError, match="zeros or reversed: no joint named elbow, hip; joints are"
        ):
            JointUnits.of(Servos(), NAMES, zeros={"hip": 0.1}, reversed_joints=("elbow",))

    def test_joints_go_by_their_names_or_else_by_their_order(self):
        servos = Servos()
        backwards = dict.fromkeys(reversed(servos.action_features), float)
        servos.action_features = backwards
        assert JointUnits.of(servos, NAMES).keys == tuple(f"{name}.pos" for name in NAMES)
        others = tuple("abcde")
        motors = tuple(key for key in backwards if key != "gripper.pos")
        assert JointUnits.of(servos, others, "rad").keys == motors
        with pytest.raises(
            ValueError, match=r"servos has 5 joints \(.*but the arm has 4 \(a, "
        ):
            JointUnits.of(servos, others[:4], "rad")

    @pytest.mark.parametrize(
        ("unit", "scale"), [("rad", 1.0), ("deg", math.pi / 180), ("", None)]
    )
    def test_a_robot_without_a_calibration_needs_a_unit(self, unit, scale):
        features = {f"{name}.pos": float for name in NAMES} | {"camera": (480, 640, 3)}
        bare = SimpleNamespace(name="bare", action_features=features)
        if scale is None:
            text = r"bare: the unit of shoulder_pan\.pos is in no calibration: give --config"
            with pytest.raises(ValueError, match=text):
                JointUnits.of(bare, NAMES)
            return
        units = JointUnits.of(bare, NAMES, unit)
        np.testing.assert_allclose(units.scale, scale)
        assert np.isinf(units.span).all()
        assert not units.gripper
        assert units.observed(dict.fromkeys(features, 1.0))[1] == 0.0
        assert "gripper.pos" not in units.action(np.zeros(5), 0.5)
        assert units.alarms(bare) == {}

    def test_a_joint_without_range_or_resolution_has_a_unit_only_in_degrees(self):
        for lacks in ("calibration", "model_resolution_table"):
            for mode in ("DEGREES", "RANGE_M100_100", "RANGE_0_100"):
                servos = Servos(mode)
                setattr(servos.bus, lacks, {})
                if mode == "DEGREES":
                    units = JointUnits.of(servos, NAMES)
                    np.testing.assert_allclose(units.scale, math.pi / 180)
                    assert np.isinf(units.span).all()
                    continue
                with pytest.raises(ValueError, match="is in no calibration"):
                    JointUnits.of(servos, NAMES)
        with pytest.raises(ValueError, match="is in no calibration"):
            JointUnits.of(Servos("RANGE_0_100"), NAMES)

    def test_one_servo_without_the_register_leaves_all_without_a_status(self):
        servos = Servos()
        units = JointUnits.of(servos, NAMES)
        other = SimpleNamespace(model="other")
        servos.bus.motors = {**servos.bus.motors, "wrist_roll": other}
        assert units.alarms(servos) == {}
        servos.bus.motors = {}
        assert units.alarms(servos) == {}

    def test_the_status_comes_from_the_register_that_all_servos_have(self):
        servos, asked = Servos(), []
        servos.bus.sync_read = lambda register, **_: asked.append(register) or {}
        units = JointUnits.of(servos, NAMES)
        for table in ({"Status": 1}, {"Hardware_Error_Status": 1}, {"Load": 1}):
            servos.bus.model_ctrl_table = {"sts": table}
            assert units.alarms(servos) == {}
        assert asked == ["Status", "Hardware_Error_Status"]


@pytest.mark.parametrize(
    ("error", "words"),
    [(OSError("a\n\tb"), "a b"), (OSError(), "OSError"), (OSError("x" * 500), "x" * 300)],
)
def test_an_error_is_one_short_line(error, words):
    assert in_words(error) == words


@pytest.mark.parametrize(
    ("settings", "kind", "message"),
    [
        ({"type": "so101_folower"}, ValueError, "did you mean so101_follower"),
        ({"type": "zzz"}, ValueError, "LeRobot has no such type; there are .*so101_follower"),
        ({}, ValueError, "--robot.type is missing"),
        (
            {"type": "so101_follower", "port": "/dev/none", "baud": 3},
            ValueError,
            r"--robot\.\*",
        ),
        (
            {"type": "so101_follower", "port": "/dev/none", "id": 5},
            (ConnectionError, ModuleNotFoundError),
            r"(be reached at /dev/none \(.*/dev/none.*check cable|needs its maker's SDK)",
        ),
    ],
)
def test_a_robot_that_cannot_be_opened_is_named_with_what_to_do(settings, kind, message):
    pytest.importorskip("lerobot")
    with pytest.raises(kind, match=message):
        lerobot_arm.open_device("robot", settings)
