"""The real Panda as a LeRobot robot, on a fake of its driver."""

import sys
import time

import fake_franky
import numpy as np
import pytest
import torch
from lerobot.robots import make_robot_from_config

from hrc_learn.kinematics import panda
from hrc_learn.lerobot.panda_robot import GRIPPER, JOINTS
from hrc_learn.lerobot.robots import FrankaPandaConfig

READY = panda.ready.numpy()
FPS = 20.0


@pytest.fixture
def franka(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "franky", fake_franky)
    config = FrankaPandaConfig(
        calibration_dir=tmp_path, ip="172.16.0.2", fps=FPS, timeout=0.3, tcp_speed=0.2
    )
    robot = make_robot_from_config(config)
    robot.connect()
    return robot


def drive(robot, action, steps):
    """Send an action again and again; velocities that the fake was given."""
    driver, velocities = robot._arm._robot, []
    for _ in range(steps):
        robot.send_action(action)
        velocities.append(driver.dq.copy())
        driver.run(1 / FPS)
    return np.array(velocities)


def test_the_real_panda_is_led_within_limits(franka):
    driver = franka._arm._robot
    assert driver.relative_dynamics_factor == franka.config.dynamics
    assert driver.recovered == 1
    goal = dict(zip(JOINTS, (READY + 0.4).tolist(), strict=True)) | {GRIPPER: 0.04}
    velocities = drive(franka, goal, 80)
    limits = panda.limits
    assert (np.abs(velocities) <= limits.velocity.numpy()).all()
    change = np.abs(np.diff(velocities, axis=0, prepend=0))
    assert (change <= limits.acceleration.numpy() / FPS * (1 + 1e-9)).all()
    values = franka.get_observation()
    assert [values[name] for name in JOINTS] == pytest.approx((READY + 0.4).tolist(), abs=5e-3)
    motion = driver.motions[-1]
    assert motion.duration.milliseconds == 300
    assert franka._arm._gripper.calls == [("move", 0.04, 0.1)]  # once, not in every step


def test_the_tool_of_the_real_panda_keeps_its_cap(franka):
    goal = dict(zip(JOINTS, (READY + np.eye(7)[0]).tolist(), strict=True))
    driver = franka._arm._robot
    for _ in range(30):
        franka.send_action(goal)
        J = panda.jacobian(torch.from_numpy(driver.q))
        speed = float((J @ torch.from_numpy(driver.dq))[:3].norm())
        assert speed <= 0.2 * (1 + 1e-6)
        driver.run(1 / FPS)


def test_a_loop_that_falls_silent_stops_the_real_panda(franka):
    goal = dict(zip(JOINTS, (READY + 0.3).tolist(), strict=True))
    drive(franka, goal, 5)
    driver = franka._arm._robot
    deadline = time.monotonic() + 5
    while driver.dq.any() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert isinstance(driver.motions[-1], fake_franky.JointVelocityStopMotion)
    assert franka.watchdog.tripped
    resumed = drive(franka, goal, 1)[0]  # from rest again
    assert (np.abs(resumed) <= panda.limits.acceleration.numpy() / FPS + 1e-9).all()


def test_the_gripper_squeezes_and_the_arm_rests_at_the_end(franka):
    here = franka.get_observation()
    driver, gripper = franka._arm._robot, franka._arm._gripper
    franka.send_action({name: here[name] for name in JOINTS} | {GRIPPER: 0.0})
    assert gripper.calls == [("grasp", 0.0, franka.config.grip_force)]
    franka.disconnect()
    assert isinstance(driver.motions[-1], fake_franky.JointVelocityStopMotion)


def test_without_the_driver_the_cure_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "franky", None)
    robot = make_robot_from_config(FrankaPandaConfig(calibration_dir=tmp_path, ip="x"))
    with pytest.raises(ImportError, match="pip install franky-control"):
        robot.connect()
