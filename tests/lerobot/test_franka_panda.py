"""The real Panda as a LeRobot robot, by its driver on a simulated arm behind the protocol."""

import sys
import threading

import numpy as np
import pytest
import torch
from franky_servers import READY
from lerobot.robots import make_robot_from_config
from served_franka import served_franka

from hrc_learn.hardware import CollisionConfig, DriverError, Load
from hrc_learn.hardware.protocol_server import serve_world
from hrc_learn.kinematics import panda
from hrc_learn.lerobot.arm_values import GRIPPER, ArmValues
from hrc_learn.lerobot.franka_panda import FrankaPandaConfig
from hrc_learn.sim import SceneConfig, World

FPS = 20.0
JOINTS = ArmValues(panda).joints


pytestmark = pytest.mark.realtime


@pytest.fixture
def served(tmp_path):
    with served_franka(tmp_path, fps=FPS, tcp_speed=0.2) as served:
        yield served


def towards(joints, **more):
    return dict(zip(JOINTS, joints.tolist(), strict=True)) | more


def test_the_real_panda_is_led_within_limits(served):
    driver = served.robot._arm
    dynamics = driver._robot.relative_dynamics_factor
    assert dynamics.acceleration == dynamics.jerk == served.robot.config.dynamics
    velocities = served.drive(towards(READY + 0.4, **{GRIPPER: 0.04}), 80)
    limits = panda.limits
    assert (np.abs(velocities) <= limits.velocity.numpy()).all()
    change = np.abs(np.diff(velocities, axis=0, prepend=0))
    assert (change <= limits.acceleration.numpy() / FPS * 1.05).all()
    with served.server.running():
        values = served.robot.get_observation()
    assert [values[name] for name in JOINTS] == pytest.approx((READY + 0.4).tolist(), abs=5e-3)
    assert values[GRIPPER] == pytest.approx(0.04, abs=1e-3)
    assert driver.gripper.failure is None


def test_the_tool_of_the_real_panda_keeps_its_cap(served):
    goal, fastest = towards(READY + np.eye(7)[0]), 0.0
    for _ in range(30):
        served.drive(goal, 1)
        state = served.read()
        J = panda.jacobian(torch.from_numpy(state.joint_position))
        fastest = max(fastest, float((J @ torch.from_numpy(state.joint_velocity))[:3].norm()))
    assert 0.15 < fastest <= 0.2 * 1.02  # the servos overshoot a little


def test_a_loop_that_falls_silent_stops_the_real_panda(tmp_path):
    with served_franka(tmp_path, fps=FPS, timeout=0.3) as served:
        goal = towards(READY + 0.3)
        served.drive(goal, 5)
        assert np.abs(served.read().joint_velocity).max() > 0.05
        with served.server.running():
            for _ in range(1000):
                if served.robot.watchdog.tripped:
                    break
                threading.Event().wait(0.01)
        assert served.robot.watchdog.tripped
        served.server.advance(0.5)
        assert np.abs(served.read().joint_velocity).max() < 1e-2
        resumed = served.drive(goal, 1)[0]  # from rest again
        assert resumed.any()
        assert (np.abs(resumed) <= panda.limits.acceleration.numpy() / FPS * 1.05).all()


def test_the_gripper_squeezes_and_the_arm_rests_at_the_end(served):
    served.drive(towards(READY + 0.2, **{GRIPPER: 0.0}), 20)
    assert served.read().gripper_width < 0.04
    force = served.world.model.actuator("finger_left").forcerange
    assert force[1] == served.robot.config.grip_force
    with served.server.running():
        served.robot.disconnect()
    assert np.abs(served.world.arm.read().joint_velocity).max() < 1e-2
    assert not served.robot.is_connected


def test_the_drivers_options_reach_it(tmp_path):
    load, collision = Load(mass=0.4), CollisionConfig(torque=(30.0,) * 7)
    settings = {"load": load, "collision": collision, "dynamics": 0.2, "grip_speed": 0.05}
    config = FrankaPandaConfig(calibration_dir=tmp_path, ip="x", **settings)
    driver = config.driver()
    assert {name: getattr(driver, name) for name in settings} == settings
    assert driver.realtime == "enforce"
    with pytest.raises(ValueError, match="dynamics must be in"):
        FrankaPandaConfig(calibration_dir=tmp_path, ip="x", dynamics=0.0)


@pytest.mark.parametrize("own", [True, False])
def test_without_the_driver_the_cure_is_named(tmp_path, monkeypatch, own):
    (tmp_path / "franky.py").write_text("raise ImportError('not here')\n")
    monkeypatch.syspath_prepend(tmp_path)  # which the other process inherits
    monkeypatch.delitem(sys.modules, "franky", raising=False)
    config = FrankaPandaConfig(
        calibration_dir=tmp_path, ip="x", own_process=own, realtime="ignore"
    )
    robot = make_robot_from_config(config)
    error = DriverError if own else ImportError  # here it is the other process that imports
    with pytest.raises(error, match="pip install franky-control"):
        robot.connect()


def test_with_its_driver_in_another_process_a_silent_loop_is_stopped_and_goes_on_from_rest(
    tmp_path,
):
    world = World(SceneConfig(objects=()))
    world.reset(READY)
    with serve_world(world) as server, server.running():
        config = FrankaPandaConfig(
            calibration_dir=tmp_path, ip=server.address, fps=FPS, timeout=0.5, realtime="ignore"
        )
        robot = make_robot_from_config(config)
        robot.connect()
        goal = towards(READY + 0.3, **{GRIPPER: 0.04})
        for _ in range(4):
            robot.send_action(goal)
            threading.Event().wait(1 / FPS)
        trips = robot.watchdog.trips
        assert robot._arm.read().joint_velocity.any()
        for _ in range(1500):
            # Reading is no sign of life.
            if np.abs(robot._arm.read().joint_velocity).max() < 1e-3:
                break
            threading.Event().wait(0.02)
        assert robot.watchdog.trips == trips + 1
        robot.send_action(goal)
        threading.Event().wait(1 / FPS)
        resumed = np.array(robot._arm.read().joint_velocity)
        assert (np.abs(resumed) <= 2 * panda.limits.acceleration.numpy() / FPS).all()
        process = robot.watchdog._process
        robot.disconnect()
        process.join(60)
        assert process.exitcode == 0
