"""The 1 kHz loop against franka-sim, which enforces what Franka's control box does: limits of
position, velocity, acceleration and jerk of each command, and fewer than 20 lost in a row.

Needs an environment of its own (tools/make_franka_sim.sh). What the arm does is read on the
side of the simulator, by its clock.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from franka_servers import Trace, franka_sim, loopback, needs_franka_sim
from loop_on_franka import loop_of, swing

from hrc_learn.hardware import DriverError, FrankaArm, FrankaConfig
from hrc_learn.kinematics import fr3 as FR3

pytestmark = [pytest.mark.slow, needs_franka_sim]

CONFIG = FrankaConfig(realtime=False, gripper=False)
READY = FR3.ready.numpy()
AT_REST = 0.2
"""Within which an arm has to rest whose loop has died [s]."""


@pytest.fixture
def server(tmp_path) -> Iterator[tuple[str, Path]]:
    host, trace = loopback(), tmp_path / "trace"
    with franka_sim(host, trace):
        yield host, trace


def drive(arm: FrankaArm, seconds: float, seed: int = 0) -> None:
    """Random velocities at random moments, about the ready posture."""
    rng, end = np.random.default_rng(seed), time.monotonic() + seconds
    while time.monotonic() < end:
        velocity = rng.uniform(-1.0, 1.0, 7) - (arm.read().joint_position - READY)
        arm.command(velocity)
        time.sleep(rng.uniform(0.005, 0.12))


def until_moving(arm: FrankaArm) -> float:
    """Swing until the arm does; when it began."""
    begin = time.monotonic()
    while np.abs(arm.read().joint_velocity).max() < 0.1:
        arm.command(swing(time.monotonic() - begin))
        time.sleep(0.02)
    return begin


def swing_for(arm: FrankaArm, seconds: float) -> None:
    begin = until_moving(arm)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        arm.command(swing(time.monotonic() - begin))
        arm.read()
        time.sleep(0.02)


def aborted(trace: Path) -> list[str]:
    """Motions that the simulator has aborted so far."""
    lines = trace.with_suffix(".log").read_text().splitlines()
    return [line for line in lines if "aborting the motion" in line]


def test_no_command_trips_anything_that_is_enforced(server):
    host, trace = server
    with FrankaArm(host, FR3, replace(CONFIG, gripper=True)) as arm:
        began = time.monotonic()
        arm.move(0.03)
        drive(arm, 20.0)
        arm.stop()
        drive(arm, 5.0, seed=1)
        ended = time.monotonic()
        report = arm.report
        assert arm.report.faults == 0, arm.fault
        assert arm.read().gripper_width == pytest.approx(0.03, abs=1e-3)
    assert aborted(trace) == []
    assert report.cycles > 10_000
    assert report.lost < 0.01 * report.cycles
    moved = Trace.read(trace)
    chosen = (moved.moment > began) & (moved.moment < ended)
    assert (np.ptp(moved.position[chosen], axis=0) > 0.2).all()
    # Of joints that are asked for up to 1 rad/s and drawn to the middle.
    assert (np.abs(moved.commanded[chosen]).max(axis=0) > 0.4).all()


@pytest.mark.parametrize("loss", [0.01, 0.05])
def test_lost_packets_trip_nothing(tmp_path, loss):
    host, trace = loopback(), tmp_path / "trace"
    with franka_sim(host, trace, "--loss", str(loss)), FrankaArm(host, FR3, CONFIG) as arm:
        drive(arm, 20.0)
        arm.stop()
        report = arm.report
        assert arm.report.faults == 0, arm.fault
    assert aborted(trace) == []
    # States that are lost; answers that are lost only the control box counts.
    assert 0.7 * loss < report.lost / (report.cycles + report.lost) < 2 * loss


def test_an_arm_whose_loop_is_killed_is_at_rest_at_once(server):
    host, trace = server
    rng, moments = np.random.default_rng(0), []
    for k in range(50):
        with FrankaArm(host, FR3, CONFIG) as arm:
            drive(arm, rng.uniform(0.2, 1.2), seed=k)
            os.kill(loop_of(arm), signal.SIGKILL)
            moments.append(time.monotonic())
            time.sleep(0.5)
            with pytest.raises(DriverError, match="connect again"):
                arm.read()
    moved = Trace.read(trace)
    speeds = [np.abs(moved.velocity[np.searchsorted(moved.moment, t)]).max() for t in moments]
    assert np.median(speeds) > 0.1, "they were killed in motion"
    rests = [moved.rest_after(t, 0.45) for t in moments]
    assert max(rests) > 0.005, "something was seen to come to rest"
    assert max(rests) <= AT_REST, rests


def test_a_stalled_loop_is_stopped_by_the_control_box_and_can_be_recovered(server):
    host, trace = server
    with FrankaArm(host, FR3, CONFIG) as arm:
        swing_for(arm, 1.0)
        os.kill(loop_of(arm), signal.SIGSTOP)
        stalled = time.monotonic()
        time.sleep(0.5)
        with pytest.raises(DriverError, match="something delays its process"):
            arm.read()
        assert Trace.read(trace).rest_after(stalled) <= AT_REST
        os.kill(loop_of(arm), signal.SIGCONT)
        while not arm.fault:
            time.sleep(0.01)
        with pytest.raises(DriverError, match=r"communication_constraints_violation.*recover"):
            arm.command(np.zeros(7))
        arm.recover()
        drive(arm, 2.0)
        assert arm.report.faults == 1
        assert arm.fault == ""


def test_a_short_stall_is_bridged(server):
    host, trace = server
    with FrankaArm(host, FR3, CONFIG) as arm:
        for _ in range(20):
            swing_for(arm, 0.1)
            os.kill(loop_of(arm), signal.SIGSTOP)
            time.sleep(0.005)
            os.kill(loop_of(arm), signal.SIGCONT)
        assert arm.report.faults == 0, arm.fault
        assert arm.report.lost >= 20
    assert aborted(trace) == []


def test_an_arm_that_nobody_commands_any_more_is_led_to_rest(server):
    host, trace = server
    program = Path(__file__).parents[1] / "loop_on_franka.py"
    paths = os.pathsep.join([str(program.parent), str(program.parents[1])])
    with subprocess.Popen(
        [sys.executable, program, host],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": paths},
    ) as commander:
        assert commander.stdout is not None
        loop = int(commander.stdout.readline())
        time.sleep(0.3)
        commander.kill()
        killed = time.monotonic()
    end = time.monotonic() + 10.0
    while Path(f"/proc/{loop}").exists() and time.monotonic() < end:
        time.sleep(0.01)
    assert not Path(f"/proc/{loop}").exists(), "the loop ends with who commands it"
    time.sleep(0.5)
    moved = Trace.read(trace)
    # The velocity holds for 0.15 s; from 0.4 rad/s at 3 rad/s^2 rest takes 0.13 s, and ramps.
    assert moved.rest_after(killed) <= CONFIG.timeout + 0.3
    assert aborted(trace) == []


def test_a_reflex_says_what_it_was(server):
    host, _ = server
    with FrankaArm(host, FR3, CONFIG) as arm:
        fold = np.array([0, 0, 0, -0.3, 0, -0.2, 0])  # the hand comes onto the shoulder
        with pytest.raises(DriverError, match=r"self_collision_avoidance_violation.*recover"):
            _keep_on(arm, fold)
        arm.recover()
        for _ in range(100):
            arm.command(-fold)
            time.sleep(0.02)
        assert arm.fault == ""


def _keep_on(arm: FrankaArm, velocity: np.ndarray) -> None:
    for _ in range(1000):
        arm.command(velocity)
        time.sleep(0.02)
