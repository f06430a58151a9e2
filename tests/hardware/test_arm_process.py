"""Faults injected into a loop, its process, the watching process and the driver.

Bounds on time have a second to spare, as other programs run beside the tests.
"""

import contextlib
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from stubborn_arm import StubbornArm, events, wait_for

from hrc_learn.hardware import ArmProcess, DriverError
from hrc_learn.watchdog import WatchdogError

pytestmark = pytest.mark.realtime

TESTS = Path(__file__).parents[1]
VELOCITY = np.full(7, 0.1)
TIMEOUT, SPARE = 0.2, 1.0


@pytest.fixture
def log(tmp_path):
    return tmp_path / "log"


@pytest.fixture
def connect(log):
    opened = []

    def connect(timeout: float = TIMEOUT, **faults) -> ArmProcess:
        opened.append(ArmProcess(partial(StubbornArm, log, **faults), timeout=timeout))
        return opened[-1]

    yield connect
    for arm in opened:
        arm._driver.kill()


@pytest.fixture
def loop(log):
    """A program with a loop, and the process that watches its arm."""
    programs = []

    def start(kind: str = "process", hold: float = 0.0) -> tuple[subprocess.Popen, str]:
        program = TESTS / "loop_on_stubborn_arm.py"
        paths = os.pathsep.join([str(TESTS), str(TESTS.parent)])
        programs.append(
            subprocess.Popen(
                [sys.executable, program, kind, log, str(hold)],
                stdout=subprocess.PIPE,
                text=True,
                env={**os.environ, "PYTHONPATH": paths},
            )
        )
        says = programs[-1].stdout.readline().strip()
        wait_for(log, "command 0.1")
        return programs[-1], says

    yield start
    for program in programs:
        program.kill()
        program.wait()
        program.stdout.close()


def ended(pid: int, patience: float = 20.0) -> bool:
    end = time.monotonic() + patience
    while time.monotonic() < end:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
        except FileNotFoundError:
            return True
        if state == "Z":
            return True
        time.sleep(0.01)
    return False


def commands(log: Path) -> list[float]:
    return [moment for moment, _, event in events(log) if event.startswith("command")]


linux = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")


def test_the_loop_reads_commands_and_stops_at_the_end(connect, log):
    with connect() as arm:
        assert arm.read().joint_position.shape == (7,)
        arm.command(VELOCITY)
        arm.move(0.04)
    told = [event for _, _, event in events(log)]
    assert told[:3] == ["command 0.1", "move 0.04", "stop"]
    assert {pid for _, pid, _ in events(log)} == {arm.pid} != {os.getpid()}
    assert arm.trips == 0
    with pytest.raises(WatchdogError):
        arm.read()


def test_a_stop_that_fails_is_tried_until_it_works(connect, log):
    arm = connect(failing_stops=5)
    arm.command(VELOCITY)
    stopped = wait_for(log, "stop")
    assert [event for _, _, event in events(log)[1:]] == ["failed stop"] * 5 + ["stop"]
    # 0.02 + 0.04 + 0.08 + 0.16 + 0.32 s of pauses, each noticed 0.05 s late at most.
    assert stopped - commands(log)[-1] < TIMEOUT + 0.62 + 6 * 0.05 + SPARE
    arm.read()
    assert arm.trips == 1


def test_after_a_trip_the_first_command_brings_the_news_and_moves_nothing(connect, log):
    arm = connect()
    arm.command(VELOCITY)
    wait_for(log, "stop")
    arm.command(VELOCITY)
    assert arm.trips == 1
    assert len(commands(log)) == 1
    arm.command(VELOCITY / 2)
    assert events(log)[-1][2] == "command 0.05"


def test_a_driver_that_raises_tells_the_loop_and_counts_as_silence(connect, log):
    arm = connect(failing_commands=tuple(range(1, 1000)))
    arm.command(VELOCITY)
    first = commands(log)[0]
    with pytest.raises(DriverError, match="OSError: the control box is offline"):
        arm.command(VELOCITY)
    while not arm.trips and time.monotonic() < first + TIMEOUT + SPARE:
        with contextlib.suppress(DriverError):
            arm.command(VELOCITY)
        time.sleep(0.02)
    assert wait_for(log, "stop") - first < TIMEOUT + SPARE


@linux
def test_a_loop_learns_that_the_process_has_died(connect):
    arm = connect()
    arm.command(VELOCITY)
    os.kill(arm.pid, signal.SIGKILL)
    assert ended(arm.pid)
    with pytest.raises(WatchdogError, match="has ended"):
        arm.command(VELOCITY)
    with pytest.raises(WatchdogError):  # and stays so
        arm.feed()


def test_a_loop_learns_in_time_that_the_process_is_stopped(connect):
    arm = connect()
    arm.command(VELOCITY)
    os.kill(arm.pid, signal.SIGSTOP)
    began = time.monotonic()
    with pytest.raises(WatchdogError, match=r"has not answered for 0\.2 s"):
        arm.command(VELOCITY)
    assert TIMEOUT <= time.monotonic() - began < TIMEOUT + SPARE
    with pytest.raises(WatchdogError):
        arm.close()
    assert arm._driver.process.exitcode == -signal.SIGKILL  # or this program could not end


def test_a_driver_that_hangs_does_not_keep_the_arm_moving(connect, log):
    arm = connect(hanging_read=3.0)
    arm.command(VELOCITY)
    with pytest.raises(WatchdogError):
        arm.read()
    assert wait_for(log, "stop") - commands(log)[0] < TIMEOUT + SPARE


def test_answer_of_an_interrupted_call_is_not_taken_for_the_next(connect, log):
    arm = connect(hanging_read=0.3, timeout=20.0)

    def interrupt(number, frame):
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.1)
        with pytest.raises(KeyboardInterrupt):
            arm.read()
    finally:
        signal.signal(signal.SIGALRM, before)
    arm.stop()
    assert [event for *_, event in events(log)] == ["stop"]


def test_sigterm_stops_the_arm_before_the_process_ends(connect, log):
    arm = connect(failing_stops=2, timeout=30.0)
    arm.command(VELOCITY)
    os.kill(arm.pid, signal.SIGTERM)
    wait_for(log, "stop")
    arm._driver.process.join(20)
    assert arm._driver.process.exitcode == 128 + signal.SIGTERM


def test_an_arm_that_cannot_be_reached_is_told():
    with pytest.raises(DriverError, match="TypeError"):
        ArmProcess(partial(StubbornArm), timeout=1.0)


def test_a_timeout_must_be_positive(connect):
    with pytest.raises(ValueError, match="timeout must be positive"):
        connect(timeout=0.0)


@linux
def test_a_loop_that_holds_the_interpreter_has_its_arm_stopped(loop, log):
    loop(hold=2.0)
    stopped = wait_for(log, "stop")
    last = max(moment for moment in commands(log) if moment < stopped)
    assert TIMEOUT < stopped - last < TIMEOUT + SPARE


@linux
def test_a_process_that_is_stopped_has_its_arm_stopped(loop, log):
    program, _ = loop()
    program.send_signal(signal.SIGSTOP)
    stopped = wait_for(log, "stop")
    assert stopped - commands(log)[-1] < TIMEOUT + SPARE
    known = len(events(log))
    program.send_signal(signal.SIGCONT)
    # It does not know: its first command moves nothing, the next ones do again.
    wait_for(log, "command 0.1", after=known)


@linux
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_process_that_is_killed_has_its_arm_stopped_and_leaves_no_other(loop, log, number):
    program, watching = loop()
    program.send_signal(number)
    stopped = wait_for(log, "stop")
    assert stopped - commands(log)[-1] < SPARE  # it need not wait for the timeout
    assert ended(int(watching))


@linux
def test_ctrl_c_of_the_whole_terminal_leaves_the_stop_to_the_loop(loop, log):
    program, watching = loop()
    os.kill(int(watching), signal.SIGINT)
    program.send_signal(signal.SIGINT)
    wait_for(log, "stop")
    assert program.wait(20) != 0
    assert ended(int(watching))


@linux
@pytest.mark.parametrize(
    ("number", "status"),
    [(signal.SIGTERM, 143), (signal.SIGHUP, 129), (signal.SIGINT, -signal.SIGINT)],
)
def test_a_program_ends_with_its_arm_at_rest(loop, log, number, status):
    program, _ = loop("signals")
    program.send_signal(number)
    time.sleep(0.01)
    program.send_signal(number)  # a second one does not keep the arm from being stopped
    assert program.wait(20) == status
    assert [event for *_, event in events(log)][-4:] == ["failed stop"] * 3 + ["stop"]
