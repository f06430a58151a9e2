"""Calls of a driver in its process, in order: the process is a thread of the test's."""

import os
import signal
import sys
import threading
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection
from types import SimpleNamespace

import numpy as np
import pytest

from hrc_learn.hardware import ArmProcess, DriverError, driver_process
from hrc_learn.hardware.driver_process import checked_velocity, ending_at_rest, imported
from hrc_learn.hardware.gripper import GripperProcess
from hrc_learn.protocols import ArmState
from hrc_learn.watchdog import WatchdogError

# Stand-ins are not of the annotated types.
pytestmark = pytest.mark.simulation

PATIENCE = 20.0


class Thread(threading.Thread):
    """A process that shares its memory with this one; to kill it does nothing.

    Its end of the connection is one of its own, as of a process.
    """

    killed = False

    def __init__(self, *, target, args, name, daemon):
        assert daemon  # it ends with the program
        connection, *arguments = args
        own = Connection(os.dup(connection.fileno()))

        def run():
            with own, suppress(RuntimeError):  # a process would print it
                target(own, *arguments)

        super().__init__(target=run, name=name, daemon=daemon)

    @property
    def pid(self):
        return 4711

    def kill(self):
        self.killed = True


@pytest.fixture(autouse=True)
def ignored(monkeypatch):
    """Signals that are handled otherwise, as only the main thread may do it."""
    handled = {}
    monkeypatch.setattr(signal, "signal", handled.__setitem__)
    monkeypatch.setattr(driver_process, "ByValue", lambda value: value)
    pipe = driver_process.multiprocessing.Pipe
    context = SimpleNamespace(Pipe=pipe, Process=Thread)
    monkeypatch.setattr(
        driver_process.multiprocessing, "get_context", lambda kind: {"spawn": context}[kind]
    )
    return handled


class Arm:
    """An arm that keeps what it is told, and may refuse it."""

    def __init__(self):
        self.calls, self.error = [], None

    def read(self):
        return ArmState(
            time=1.5,
            joint_position=np.arange(7.0),
            joint_velocity=np.zeros(7),
            gripper_width=0.04,
        )

    def command(self, velocity):
        if self.error is not None:
            raise self.error
        self.calls.append(("command", *velocity))

    def move(self, width):
        self.calls.append(("move", width))

    def stop(self):
        self.calls.append("stop")


def test_each_call_reaches_the_arm_and_its_end_is_at_rest(ignored):
    arm = Arm()
    with ArmProcess(lambda: arm, timeout=PATIENCE) as process:
        assert ignored == {signal.SIGINT: signal.SIG_IGN}
        assert process.pid == 4711
        state = process.read()
        assert (state.time, state.gripper_width) == (1.5, 0.04)
        np.testing.assert_array_equal(state.joint_position, np.arange(7.0))
        process.command([0.1, 0, 0, 0, 0, 0, 0.2])
        process.move(np.float32(0.5))
        process.feed()
        process.stop()
        assert process.trips == 0
        arm.error = ValueError("too fast")
        with pytest.raises(DriverError, match=r"^ValueError: too fast$"):
            process.command(np.zeros(7))
        arm.error = None
        process.command(np.zeros(7))
    assert arm.calls[:3] == [("command", 0.1, 0, 0, 0, 0, 0, 0.2), ("move", 0.5), "stop"]
    assert arm.calls[3] == ("command", *[0.0] * 7)
    assert set(arm.calls[4:]) == {"stop"}
    with pytest.raises(WatchdogError, match="the process of the arm is closed"):
        process.read()


def test_a_velocity_that_does_not_know_of_a_stop_is_not_carried_out(monkeypatch):
    dogs = []

    def watchdog(timeout, stop):
        dogs.append(
            SimpleNamespace(
                trips=2, fed=0, timeout=timeout, start=lambda: None, close=lambda: None
            )
        )
        dogs[0].feed = lambda: setattr(dogs[0], "fed", dogs[0].fed + 1)
        return dogs[0]

    monkeypatch.setattr(driver_process, "Watchdog", watchdog)
    arm = Arm()
    with ArmProcess(lambda: arm, timeout=PATIENCE) as process:
        assert process.trips == 2
        assert dogs[0].timeout == PATIENCE
        process.command(np.zeros(7))
        dogs[0].trips = 3  # it stops the arm meanwhile
        process.command(np.ones(7))
        assert arm.calls == [("command", *[0.0] * 7)]
        assert process.trips == 3
        process.command(np.ones(7))
        assert arm.calls[1:] == [("command", *[1.0] * 7)]
        assert dogs[0].fed == 3
        arm.error = OSError("refused")
        with pytest.raises(DriverError):
            process.command(np.ones(7))
        process.feed()
        assert dogs[0].fed == 4  # a velocity that is refused is no sign of life


def test_an_arm_that_cannot_be_opened_or_stopped_says_so(monkeypatch):
    def refuse():
        raise OSError("no route")

    with pytest.raises(DriverError, match=r"^OSError: no route$"):
        ArmProcess(refuse, timeout=1.0)
    for timeout in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match="timeout must be positive"):
            ArmProcess(Arm, timeout=timeout)
    monkeypatch.setattr(driver_process, "bring_to_rest", lambda stop, patience: False)
    with pytest.raises(WatchdogError, match="the arm could not be stopped within 60 s"):
        ArmProcess(Arm, timeout=PATIENCE).close()
    with pytest.raises(KeyError, match="another") as raised:
        fails_within(ArmProcess(Arm, timeout=PATIENCE))
    assert raised.value.__notes__ == ["the arm could not be stopped within 60 s."]


def fails_within(device):
    with device:
        raise KeyError("another")


def test_a_driver_that_does_not_answer_is_given_up():
    let = threading.Event()
    arm = Arm()
    arm.read = let.wait
    process = ArmProcess(lambda: arm, timeout=0.05)
    text = r"the process of the arm has not answered for 0\.05 s: make sure that the arm is at"
    for _ in range(2):
        with pytest.raises(WatchdogError, match=text):
            process.read()
    let.set()


def test_a_gripper_answers_from_its_process_and_is_killed_in_the_end():
    calls = []
    fingers = SimpleNamespace(
        read_width=lambda: 0.03,
        move=lambda width: calls.append(width) or False,
        squeeze=lambda: True,
    )
    gripper = GripperProcess(lambda: fingers)
    assert gripper.read_width() == 0.03
    assert gripper.move(0.05) is False
    assert gripper.squeeze() is True
    assert calls == [0.05]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_a_block_once_and_the_arm_at_rest(ignored, number, monkeypatch):
    """And the handlers from before come back; an ignored signal stays ignored."""
    monkeypatch.setattr(
        signal, "getsignal", lambda n: signal.SIG_IGN if n == signal.SIGHUP else "before"
    )
    monkeypatch.setattr(signal, "signal", lambda n, f: (ignored.update({n: f}), "before")[1])
    stops = []

    def stop():
        stops.append(1)
        ignored[number](number, None)  # once more, while the arm is brought to rest

    def run():
        with ending_at_rest(stop):
            ignored[number](number, None)

    kind = KeyboardInterrupt if number == signal.SIGINT else SystemExit
    with pytest.raises(kind) as ended:
        run()
    if kind is SystemExit:
        assert ended.value.code == 128 + number
    assert stops == [1]
    assert ignored == dict.fromkeys((signal.SIGTERM, signal.SIGINT), "before")
    stops.clear()
    with ending_at_rest(stop):
        pass
    assert stops == [1]


def test_an_arm_that_cannot_be_stopped_is_an_error_unless_there_is_another(monkeypatch, capsys):
    monkeypatch.setattr(driver_process, "bring_to_rest", lambda stop, patience: False)

    def run(error=None):
        with ending_at_rest(lambda: None, patience=3.0):
            if error is not None:
                raise error

    with pytest.raises(RuntimeError, match=r"the arm could not be stopped within 3 s\."):
        run()
    with pytest.raises(KeyError):
        run(KeyError("a bug"))
    assert capsys.readouterr().err.count("could not be stopped within 3 s") == 2


def test_velocities_are_checked_by_joint_and_rounding_is_cut():
    names, fastest = ("a", "b"), np.array([1.0, 2.0])
    check = partial(checked_velocity, names=names, fastest=fastest)
    np.testing.assert_array_equal(check([-0.5, 1.9]), [-0.5, 1.9])
    np.testing.assert_array_equal(check([-1 - 1e-7, 2 + 1e-7]), [-1.0, 2.0])
    for wrong, text in (
        ([0.0, -2.00001], r"b: -2\.000 rad/s is beyond its limit of 2\.000"),
        ([0.0], "2 finite numbers"),
        ([0.0, np.inf], "2 finite numbers"),
    ):
        with pytest.raises(ValueError, match=text):
            check(wrong)


def test_a_library_that_is_missing_is_named_with_the_advice(monkeypatch):
    assert imported("math", "no").pi > 3
    monkeypatch.setitem(sys.modules, "no_such_driver", None)
    with pytest.raises(ImportError, match=r"pip install it \(.*no_such_driver.*\)"):
        imported("no_such_driver", "pip install it")


def test_an_arm_has_a_minute_to_rest_and_its_process_a_second_to_end():
    calls = []
    process = ArmProcess(Arm, timeout=0.5)
    driver = process._driver
    process._driver = SimpleNamespace(
        call=lambda name, timeout: calls.append((name, timeout)) or True,
        end=lambda timeout: calls.append(timeout),
    )
    process.close()
    assert calls == [("close", 60.5), 1.5]
    driver.end(PATIENCE)


@pytest.mark.parametrize("hangs", [False, True])
def test_a_process_is_killed_if_it_hangs_and_only_then(hangs):
    let, arm = threading.Event(), Arm()
    process = ArmProcess(lambda: arm, timeout=0.05 if hangs else PATIENCE)
    driver = process._driver
    if hangs:
        arm.read = let.wait
        with pytest.raises(WatchdogError):
            process.read()
        threading.Timer(0.05, let.set).start()
    driver.end(0.01 if hangs else PATIENCE)
    assert driver.process.killed == hangs
    with pytest.raises(WatchdogError, match="has not answered" if hangs else "is closed"):
        process.read()


def test_an_answer_to_an_earlier_call_is_passed_over():
    """As after a signal that has cut off the wait for it."""
    ours, theirs = driver_process.multiprocessing.Pipe()
    driver = object.__new__(driver_process.DriverProcess)
    driver._name, driver._lost, driver._number, driver.news = "arm", "", 7, 0
    driver._calling, driver._connection = threading.Lock(), ours
    for number, value, news in ((6, "late", 1), (7, "interrupted", 2), (8, "now", 3)):
        theirs.send((number, value, "", news))
    assert driver.call("read", 5) == "now"
    assert theirs.recv() == (8, "read", 5)
    assert driver.news == 3
    theirs.close()
    for _ in range(2):
        with pytest.raises(WatchdogError, match="the process of the arm has ended"):
            driver.call("read", timeout=PATIENCE)


def test_patience_with_an_arm_that_does_not_stop_is_five_seconds_unless_told(monkeypatch):
    waited = []
    monkeypatch.setattr(
        driver_process, "bring_to_rest", lambda stop, patience: waited.append(patience) or True
    )
    with ending_at_rest(lambda: None):
        pass
    with ending_at_rest(lambda: None, patience=7.0):
        pass
    assert waited == [5.0, 7.0]
