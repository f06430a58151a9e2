"""LeRobot's own SO-101 follower, with the maker's SDK, on a simulated bus of its servos."""

import json
import math
import sys
import threading
import time
from functools import partial

import numpy as np
import pytest
from feetech_bus import GOAL, RANGES, TORQUE, FeetechBus, calibration, so101_servos

from hrc_learn.hardware import ArmFaultError, ArmProcess, LeRobotArm, LeRobotConfig
from hrc_learn.kinematics import panda
from hrc_learn.kinematics.registry import arm as named_arm

pytest.importorskip("lerobot")
pytest.importorskip("scservo_sdk")

pytestmark = pytest.mark.realtime

STEP = 2 * math.pi / 4095
"""One step of the encoder, as LeRobot counts a turn [rad]."""


def pause(seconds):
    threading.Event().wait(seconds)


@pytest.fixture(scope="module", autouse=True)
def _simulator_has_its_turn():
    """The SDK polls its port: the simulator's thread would wait 5 ms for the interpreter."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(2e-4)
    yield
    sys.setswitchinterval(before)


@pytest.fixture(scope="module")
def chain():
    return named_arm("so101").chain


@pytest.fixture
def bus():
    with FeetechBus(so101_servos()) as bus:
        yield bus


@pytest.fixture
def settings(bus, tmp_path):
    (tmp_path / "mine.json").write_text(json.dumps(calibration()))
    return {
        "type": "so101_follower",
        "port": bus.port,
        "id": "mine",
        "calibration_dir": str(tmp_path),
    }


@pytest.fixture
def arm(settings, chain):
    with LeRobotArm(settings, chain) as arm:
        yield arm


def drive(arm, velocity, seconds):
    """Command a velocity every 10 ms, then rest."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        arm.command(np.array(velocity))
        pause(0.01)
    arm.command(np.zeros(5))


def until(condition, seconds=5.0):
    """Wait until a condition holds; its value."""
    end = time.monotonic() + seconds
    while not (value := condition()) and time.monotonic() < end:
        pause(0.01)
    return value


def fault_of(call):
    """Text of the fault that a call raises within some seconds."""

    def raised():
        try:
            call()
        except ArmFaultError as error:
            return str(error)
        return ""

    return until(raised)


def test_velocities_move_the_servos_by_their_integral(arm, bus):
    before = [bus.servos[i].position for i in range(1, 7)]
    began = time.monotonic()
    drive(arm, (0.4, 0.0, -0.2, 0.0, 0.0), 0.8)
    lasted = time.monotonic() - began
    pause(0.3)
    moved = STEP * (np.array([bus.servos[i].position for i in range(1, 7)]) - before)
    # Two steps of the encoder, and the 10 ms of a command.
    assert moved[[0, 2]] == pytest.approx([0.4 * lasted, -0.2 * lasted], abs=2 * STEP + 0.006)
    assert moved[[1, 3, 4, 5]] == pytest.approx(0.0, abs=2 * STEP)
    steps = [goal for _, goal in bus.servos[1].goals]
    assert np.abs(np.diff(steps)).max() * STEP < 0.4 * 0.1  # no jump of more than 0.1 s


@pytest.mark.parametrize("use_degrees", [True, False])
def test_positions_are_radians_by_the_calibration_in_either_unit(
    use_degrees, settings, bus, chain
):
    middles = [sum(ends) / 2 for ends in RANGES.values()]
    for i, offset in enumerate((300, -200, 150, -77, 500), 1):
        bus.servos[i].position = middles[i - 1] + offset
    bus.servos[6].position = 2000 + 0.25 * 1500  # of 2000 to 3500
    with LeRobotArm(settings | {"use_degrees": use_degrees}, chain) as arm:
        state = arm.read()
        expected = STEP * np.array([300, -200, 150, -77, 500])
        assert state.joint_position == pytest.approx(expected, abs=STEP)
        assert state.gripper_width == pytest.approx(0.02, abs=1e-4)
        arm.move(0.06)
        assert until(lambda: abs(bus.servos[6].position - 3125) < 3)
        # LeRobot cuts positions to whole steps, so the first goal is within one.
        held = [bus.servos[i].word(GOAL) for i in range(1, 6)]
        assert held == pytest.approx(
            [middles[k] + e / STEP for k, e in enumerate(expected)], abs=2
        )


def test_reversed_joints_and_zeros_belong_to_the_description(settings, bus, chain):
    bus.servos[2].position += 200
    config = LeRobotConfig(zeros={"shoulder_lift": 0.5}, reversed=("shoulder_lift",))
    with LeRobotArm(settings, chain, config) as arm:
        assert arm.read().joint_position[1] == pytest.approx(0.5 - 200 * STEP, abs=STEP)
    with pytest.raises(ValueError, match="zeros or reversed: no joint named elbow"):
        LeRobotArm(settings, chain, LeRobotConfig(zeros={"elbow": 0.5}))


def test_a_velocity_holds_for_the_timeout_only(arm, bus):
    arm.command(np.array([0.5, 0.0, 0.0, 0.0, 0.0]))
    pause(0.6)
    moved = STEP * (bus.servos[1].word(GOAL) - 2050)
    assert 0.4 * 0.15 * 0.5 < moved <= 0.15 * 0.5 + STEP


def test_the_arm_keeps_within_its_description_and_its_calibrated_range(settings, bus, chain):
    bus.servos[2].position = 3100 - 20  # 20 steps from the end of its range, 1.69 rad
    with LeRobotArm(settings, chain) as arm:
        drive(arm, (0.0, 1.0, 0.0, 0.0, 0.0), 0.4)
        assert max(goal for _, goal in bus.servos[2].goals) <= 3100
        assert arm.read().joint_position[1] <= float(chain.limits.upper[1])


def test_commands_beyond_the_limits_are_refused_by_name(arm):
    with pytest.raises(ValueError, match=r"elbow_flex: 30.000 rad/s is beyond its limit"):
        arm.command(np.array([0.0, 0.0, 30.0, 0.0, 0.0]))
    with pytest.raises(ValueError, match="5 finite numbers"):
        arm.command(np.full(5, np.nan))
    with pytest.raises(ValueError, match="5 finite numbers"):
        arm.command(np.zeros(6))


def test_lost_and_garbled_replies_are_asked_for_again(arm, bus):
    for _ in range(3):
        bus.lose, bus.garble = 1, 1
        drive(arm, (0.2, 0.0, 0.0, 0.0, 0.0), 0.2)
    assert bus.lose == bus.garble == bus.refused == 0


def test_a_silent_bus_stops_the_arm_and_says_so(arm, bus):
    arm.command(np.array([0.3, 0.0, 0.0, 0.0, 0.0]))
    bus.silent.add(3)
    assert "servos hold the last positions" in fault_of(arm.read)
    assert "no reading of the arm" in fault_of(lambda: arm.command(np.zeros(5)))
    arm.stop()  # the servos hold by themselves
    with pytest.raises(ArmFaultError, match="bus does not answer"):
        arm.recover()
    bus.silent.clear()
    arm.recover()
    drive(arm, (0.1, 0.0, 0.0, 0.0, 0.0), 0.1)


def test_a_hot_servo_stops_the_arm_by_name_until_it_is_cool(arm, bus):
    bus.servos[2].heat()
    text = fault_of(lambda: arm.command(np.array([0.2, 0.0, 0.0, 0.0, 0.0])))
    assert "servo shoulder_lift reports temperature" in text
    pause(0.1)
    sent = len(bus.servos[1].goals)
    pause(0.2)
    assert len(bus.servos[1].goals) == sent
    with pytest.raises(ArmFaultError, match="temperature"):
        arm.recover()
    bus.servos[2].cool()
    arm.recover()
    assert bus.servos[2].memory[TORQUE] == 1
    drive(arm, (0.1, 0.0, 0.0, 0.0, 0.0), 0.1)


def test_a_blocked_joint_is_not_wound_up_and_stops_the_arm(settings, bus, chain):
    config = LeRobotConfig(lag=0.1, blocked=0.3)
    with LeRobotArm(settings, chain, config) as arm:
        bus.servos[4].blocked = True
        text = fault_of(lambda: arm.command(np.array([0.0, 0.0, 0.0, 0.5, 0.0])))
        assert "wrist_flex stays 0.10 rad behind its command" in text
        assert abs(bus.servos[4].word(GOAL) - bus.servos[4].position) * STEP < 0.1 + STEP
        assert arm.read().joint_velocity == pytest.approx(0.0, abs=0.05)


def test_what_cannot_be_opened_is_one_line_that_says_what_to_do(settings, bus, chain, tmp_path):
    def refused(error, match, chain=chain, **changed):
        with pytest.raises(error, match=match):
            LeRobotArm({**settings, **changed}, chain)

    refused(ValueError, "did you mean so101_follower", type="so101_folower")
    refused(ValueError, "--robot.type is missing", type=None)
    refused(ValueError, "baud", baud=3)
    refused(ConnectionError, "check cable, power and --robot.port", port="/dev/nothing")
    refused(ValueError, "so_follower has 5 joints .*the arm has 7", chain=panda)
    refused(ConnectionError, "lerobot-calibrate", id="another")
    bus.servos[3].put(9, 100)  # the servo's own limit is not the file's
    refused(ConnectionError, "or its servos hold another one")
    bus.silent.add(5)
    refused(ConnectionError, "check cable, power")


def test_an_arm_whose_loop_falls_silent_stops(settings, bus, chain):
    with ArmProcess(partial(LeRobotArm, settings, chain), timeout=0.15) as arm:
        assert arm.read().joint_position == pytest.approx(0.0, abs=2 * STEP)
        drive(arm, (0.5, 0.0, 0.0, 0.0, 0.0), 0.3)
        arm.command(np.array([0.5, 0.0, 0.0, 0.0, 0.0]))
        before = bus.servos[1].word(GOAL)
        pause(0.7)
        assert STEP * (bus.servos[1].word(GOAL) - before) < 0.5 * 0.25
    assert until(lambda: not bus.servos[1].memory[TORQUE])  # as LeRobot leaves it
