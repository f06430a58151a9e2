"""The real Panda as a LeRobot robot, by its driver on a simulated arm behind the protocol."""

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
from hrc_learn.lerobot.driven_arms import FrankaPandaConfig
from hrc_learn.sim import SceneConfig, World

FPS = 20.0
JOINTS = ArmValues(panda).joints


pytestmark = pytest.mark.realtime


def towards(joints, **more):
    return dict(zip(JOINTS, joints.tolist(), strict=True)) | more


def test_real_panda_moves_within_limits_squeezes_and_rests_at_the_end(tmp_path):
    """One connection does it all, as each starts a process."""
    with served_franka(tmp_path, fps=FPS, tcp_speed=0.2) as served:
        velocities = served.drive(towards(READY + 0.4, **{GRIPPER: 0.04}), 80)
        limits = panda.limits
        assert (np.abs(velocities) <= limits.velocity.numpy()).all()
        change = np.abs(np.diff(velocities, axis=0, prepend=0))
        assert (change <= limits.acceleration.numpy() / FPS * 1.05).all()
        with served.server.running():
            values = served.robot.get_observation()
        reached = [values[name] for name in JOINTS]
        assert reached == pytest.approx((READY + 0.4).tolist(), abs=5e-3)
        assert values[GRIPPER] == pytest.approx(0.04, abs=1e-3)

        goal, fastest = towards(READY + 0.4 - np.eye(7)[0]), 0.0
        for _ in range(30):
            served.drive(goal, 1)
            state = served.read()
            J = panda.jacobian(torch.from_numpy(state.joint_position))
            twist = J @ torch.from_numpy(state.joint_velocity)
            fastest = max(fastest, float(twist[:3].norm()))
        assert 0.15 < fastest <= 0.2 * 1.02  # the servos overshoot a little

        served.drive(towards(READY + 0.2, **{GRIPPER: 0.0}), 20)
        assert served.read().gripper_width < 0.04
        force = served.world.model.actuator("finger_left").forcerange
        assert force[1] == served.robot.config.grip_force
        with served.server.running():
            served.robot.disconnect()
        assert np.abs(served.world.arm.read().joint_velocity).max() < 1e-2
        assert not served.robot.is_connected


def test_options_of_the_driver_reach_it(tmp_path):
    load, collision = Load(mass=0.4), CollisionConfig(torque=(30.0,) * 7)
    settings = {"load": load, "collision": collision, "dynamics": 0.2, "grip_speed": 0.05}
    config = FrankaPandaConfig(calibration_dir=tmp_path, ip="x", **settings)
    driver = config.driver()
    assert {name: getattr(driver, name) for name in settings} == settings
    assert driver.realtime
    with pytest.raises(ValueError, match="dynamics must be in"):
        FrankaPandaConfig(calibration_dir=tmp_path, ip="x", dynamics=0.0)


def test_without_the_driver_the_cure_is_named(tmp_path, monkeypatch):
    (tmp_path / "franky.py").write_text("raise ImportError('not here')\n")
    monkeypatch.syspath_prepend(tmp_path)  # which the driver's process inherits
    config = FrankaPandaConfig(calibration_dir=tmp_path, ip="x", realtime=False)
    robot = make_robot_from_config(config)
    with pytest.raises(DriverError, match="pip install franky-control"):
        robot.connect()


def test_arm_of_a_silent_loop_stops_and_goes_on_from_rest(
    tmp_path,
):
    world = World(SceneConfig(objects=()))
    world.reset(READY)
    with serve_world(world) as server, server.running():
        config = FrankaPandaConfig(
            calibration_dir=tmp_path, ip=server.address, fps=FPS, timeout=0.5, realtime=False
        )
        robot = make_robot_from_config(config)
        robot.connect()
        goal = towards(READY + 0.3, **{GRIPPER: 0.04})
        for _ in range(4):
            robot.send_action(goal)
            threading.Event().wait(1 / FPS)
        trips = robot.arm.trips
        assert robot.arm.read().joint_velocity.any()
        for _ in range(1500):
            # Reading is no sign of life.
            if np.abs(robot.arm.read().joint_velocity).max() < 1e-3:
                break
            threading.Event().wait(0.02)
        assert robot.arm.trips == trips + 1
        robot.send_action(goal)
        threading.Event().wait(1 / FPS)
        resumed = np.array(robot.arm.read().joint_velocity)
        assert (np.abs(resumed) <= 2 * panda.limits.acceleration.numpy() / FPS).all()
        process = robot.arm._driver.process
        robot.disconnect()
        process.join(60)
        assert process.exitcode == 0
