"""The simulated Panda as a LeRobot robot, and who leads it."""

import time

import numpy as np
import pytest
from lerobot.robots import make_robot_from_config
from lerobot.teleoperators import make_teleoperator_from_config
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from hrc_learn.kinematics import panda
from hrc_learn.lerobot.arm_robot import LoopWatch
from hrc_learn.lerobot.arm_teleoperators import ArmExpertConfig
from hrc_learn.lerobot.arm_values import GRIPPER, HAND, MARKER, PIXELS, ArmValues
from hrc_learn.lerobot.mujoco_arm import MovedCameraConfig, MujocoArmRobot, MujocoArmRobotConfig

JOINTS = ArmValues(panda).joints
FPS = 20.0


def test_what_a_robot_declares_it_reports(simulated):
    robot = simulated(scenario="grasping", fps=FPS, pixels=True, velocity=True, hand=True)
    values = robot.get_observation()
    assert values.keys() == robot.observation_features.keys()
    assert values.keys() >= {*JOINTS, *HAND, *PIXELS, GRIPPER}
    assert all(name.endswith((".pos", ".vel")) for name in values)
    assert all(isinstance(value, float) for value in values.values())


def test_the_sim_goes_where_it_is_sent_and_time_passes_by_actions(simulated):
    robot = simulated(scenario="grasping", fps=FPS)
    here = robot.get_observation()
    for k in range(10):
        wanted = {name: here[name] + 0.002 * k for name in JOINTS} | {GRIPPER: 0.06}
        sent = robot.send_action(wanted)
        assert sent == pytest.approx(wanted, abs=1e-6)
    there = robot.get_observation()
    assert robot.run.world.time == pytest.approx(10 / FPS)
    for name in JOINTS:
        assert there[name] == pytest.approx(here[name] + 0.018, abs=1e-3)
    assert there[GRIPPER] == pytest.approx(0.06, abs=3e-3)


def test_a_sim_begins_anew_with_the_recorders_next_episode(simulated, monkeypatch, caplog):
    """Not when the loop hangs within one."""
    clock = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    robot = simulated(scenario="grasping", fps=FPS, episode_time=2.0)

    def frame(pause):
        clock[0] += pause
        seen = robot.get_observation()
        robot.send_action({name: seen[name] for name in (*JOINTS, GRIPPER)})
        return robot.run.seed, robot.run.commands, robot.initial_configurations

    robot.get_observation()  # somebody looks before the first episode
    clock[0] += 5.0
    robot.get_observation()
    assert frame(0.0) == (0, 1, 0)
    assert frame(1.5) == (0, 2, 0)  # hangs
    assert frame(0.5 + 0.5 / FPS) == (0, 3, 0)  # the last frame, a little late
    assert not caplog.text
    assert frame(1.2 / FPS) == (1, 1, 1)  # saved; the next episode
    assert frame(1.9) == (1, 2, 1)
    assert frame(0.3) == (2, 1, 2)
    shown = f"0.2 s of the demonstration's {robot.run.scenario.duration:.1f} s"
    assert f"episode 0 of this recording ends before the job is done: {shown}" in caplog.text
    assert "episode 1 of this recording" in caplog.text
    assert "episode 2" not in caplog.text
    robot.disconnect()
    assert "episode 2 of this recording" in caplog.text


def test_a_job_that_is_done_is_a_whole_episode(simulated, caplog, monkeypatch):
    robot = simulated(scenario="grasping", fps=FPS, episode_time=2.0)
    seen = robot.get_observation()
    robot.send_action({name: seen[name] for name in (*JOINTS, GRIPPER)})
    monkeypatch.setattr(robot.run, "succeeded", lambda: True)
    robot.disconnect()
    assert not caplog.text


@pytest.mark.parametrize("in_real_time", [True, False])
def test_late_actions_of_an_arm_that_moves_on_are_told(
    simulated, monkeypatch, caplog, in_real_time
):
    robot, clock = simulated(scenario="grasping", fps=FPS), [0.0]
    monkeypatch.setattr(MujocoArmRobot, "in_real_time", in_real_time)
    robot._loop = LoopWatch("arm", FPS, lambda: clock[0], in_real_time=in_real_time)
    seen = robot.get_observation()
    for gap in (1.0, 1.0, 3.0):
        robot.send_action({name: seen[name] for name in (*JOINTS, GRIPPER)})
        clock[0] += gap / FPS
    robot.send_action({name: seen[name] for name in (*JOINTS, GRIPPER)})
    robot.disconnect()
    assert ("arm: 1 of 4 actions came late" in caplog.text) == in_real_time


def test_what_the_arm_meets_while_it_is_recorded_is_told(simulated, caplog, monkeypatch):
    robot = simulated(scenario="grasping", fps=FPS)
    asked = []

    def touched_since(time):
        asked.append(time)
        return ("hand touched table",) * (len(asked) > 2)

    monkeypatch.setattr(robot.world, "touched_since", touched_since)
    for _ in range(4):
        seen = robot.get_observation()
        robot.send_action({name: seen[name] for name in (*JOINTS, GRIPPER)})
    assert asked == pytest.approx([0.0, 0.0, 1 / FPS, 2 / FPS])  # since the last action
    robot.disconnect()
    assert f"in the recording, hand touched table for {2 / FPS:.2f} s" in caplog.text


@pytest.mark.parametrize(
    "device",
    [
        lambda folder: make_robot_from_config(MujocoArmRobotConfig(calibration_dir=folder)),
        lambda folder: make_teleoperator_from_config(ArmExpertConfig(calibration_dir=folder)),
    ],
    ids=["robot", "teleoperator"],
)
def test_devices_are_connected_and_disconnected_once(device, tmp_path):
    device = device(tmp_path)
    with pytest.raises(DeviceNotConnectedError, match="connect"):
        device.disconnect()
    device.connect()
    assert device.is_connected
    assert device.is_calibrated
    with pytest.raises(DeviceAlreadyConnectedError, match="already"):
        device.connect()
    device.disconnect()
    assert not device.is_connected


def test_what_is_not_connected_says_so(tmp_path):
    robot = make_robot_from_config(MujocoArmRobotConfig(calibration_dir=tmp_path))
    with pytest.raises(DeviceNotConnectedError, match="connect"):
        robot.get_observation()
    teleoperator = make_teleoperator_from_config(ArmExpertConfig(calibration_dir=tmp_path))
    teleoperator.connect()
    with pytest.raises(DeviceNotConnectedError, match="mujoco_arm or franka_panda"):
        teleoperator.get_action()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"scenario": "pouring"}, "no scenario 'pouring'"),
        ({"shelf": "attic"}, "no shelf 'attic'"),
        ({"pixels": True}, "object in the gripper"),
        ({"fps": 1.0}, "fps must be"),
        ({"imperfections": float("nan")}, "imperfections must be finite"),
        ({"episode_time": -1.0}, "episode_time must not be negative"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        MujocoArmRobotConfig(**settings)


@pytest.mark.parametrize(("distance", "angle"), [(0.0, 0.0), (0.1, 10.0)])
def test_markers_are_seen_by_the_camera_where_it_stands(simulated, distance, angle):
    moved = MovedCameraConfig(distance, angle, seed=3)
    robot = simulated(
        scenario="grasping", fps=20.0, pixels=True, marker=True, moved_camera=moved
    )
    values, run = robot.get_observation(), robot.run
    assert values.keys() == robot.observation_features.keys()
    place, poses = run.scenario.workplace, run.world.marker_poses()
    at_first = place.scene.camera.pose
    for names, marker in (
        (MARKER, place.tool_marker),
        (PIXELS, place.scene.objects[0].marker.id),
    ):
        pixel = run.camera.project(poses[marker][:3, 3])
        np.testing.assert_allclose([values[name] for name in names[:2]], pixel, atol=1.0)
    assert values[MARKER[2]] == 1.0
    assert np.linalg.norm(run.camera.pose[:3, 3] - at_first[:3, 3]) == pytest.approx(distance)
    turn = run.camera.pose[:3, :3] @ at_first[:3, :3].T
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) == pytest.approx(angle, abs=1e-4)
