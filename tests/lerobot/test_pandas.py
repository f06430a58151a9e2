"""The Pandas, those who lead them, their environment and smooth actions, in LeRobot."""

import json
import sys
import time

import fake_franky
import numpy as np
import pytest
import torch
from lerobot.envs.configs import EnvConfig
from lerobot.processor import PolicyProcessorPipeline, ProcessorStepRegistry
from lerobot.processor.converters import (
    batch_to_transition,
    policy_action_to_transition,
    transition_to_batch,
    transition_to_policy_action,
)
from lerobot.robots import RobotConfig, make_robot_from_config
from lerobot.teleoperators import TeleoperatorConfig, make_teleoperator_from_config
from lerobot.utils.errors import DeviceNotConnectedError
from unchecked import shapes_unchecked

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import panda
from hrc_learn.lerobot.connected import CONNECTED
from hrc_learn.lerobot.envs import PandaEnvConfig
from hrc_learn.lerobot.panda_names import (
    GRIPPER,
    HAND,
    JOINTS,
    PIXELS,
    action_of,
    hand_vector,
    target_of,
)
from hrc_learn.lerobot.processor.adding import (
    POSTPROCESSOR,
    PREPROCESSOR,
    add_smoothing,
    remove_smoothing,
)
from hrc_learn.lerobot.processor.limits import ActionLimits
from hrc_learn.lerobot.robots import FrankaPandaConfig, MujocoPanda, MujocoPandaConfig
from hrc_learn.lerobot.teleoperators import PandaExpertConfig, PandaPageConfig

READY = panda.ready.numpy()
FPS = 20.0


@pytest.fixture(autouse=True)
def nothing_left_connected(tmp_path, monkeypatch):
    yield
    for robot in list(CONNECTED):
        robot.disconnect()


def simulated(tmp_path, **settings):
    config = MujocoPandaConfig(calibration_dir=tmp_path, fps=FPS, **settings)
    robot = make_robot_from_config(config)
    assert isinstance(robot, MujocoPanda)
    robot.connect()
    return robot


def test_lerobot_knows_them_by_name():
    assert RobotConfig.get_choice_class("mujoco_panda") is MujocoPandaConfig
    assert RobotConfig.get_choice_class("franka_panda") is FrankaPandaConfig
    assert TeleoperatorConfig.get_choice_class("panda_expert") is PandaExpertConfig
    assert TeleoperatorConfig.get_choice_class("panda_page") is PandaPageConfig
    assert EnvConfig.get_choice_class("panda") is PandaEnvConfig
    for step in ("hrc_learn_watch_state", "hrc_learn_smooth_actions"):
        assert ProcessorStepRegistry.get(step)


@pytest.mark.parametrize("space", ["joint", "ee"])
def test_an_action_says_where_it_came_from(space):
    joints = READY + 0.1
    where, width = target_of(action_of(space, joints, 0.05))
    assert width == 0.05
    if isinstance(where, Pose):
        assert space == "ee"
        expected = panda.forward(torch.from_numpy(joints))
        assert float(where.twist_to(expected).abs().max()) < 1e-9
    else:
        assert space == "joint"
        np.testing.assert_array_equal(where, joints)


def test_rotation_vectors_go_on_past_half_a_turn():
    turned = [READY + np.array([0, 0, 0, 0, 0, d, 0]) for d in np.linspace(-0.2, 0.2, 9)]
    vectors = [hand_vector(turned[0])[3:]]
    for joints in turned[1:]:
        vectors.append(hand_vector(joints, vectors[-1])[3:])
    assert np.abs(np.diff(vectors, axis=0)).max() < 0.1


def test_an_action_without_joints_is_refused():
    with pytest.raises(ValueError, match=r"lacks panda_joint2\.pos"):
        target_of({JOINTS[0]: 0.0})


def test_what_a_robot_declares_it_reports(tmp_path):
    robot = simulated(tmp_path, scenario="grasping", pixels=True, velocity=True, hand=True)
    values = robot.get_observation()
    assert values.keys() == robot.observation_features.keys()
    assert values.keys() >= {*JOINTS, *HAND, *PIXELS, GRIPPER}
    assert all(name.endswith((".pos", ".vel")) for name in values)
    assert all(isinstance(value, float) for value in values.values())


def test_the_sim_goes_where_it_is_sent_and_time_passes_by_actions(tmp_path):
    robot = simulated(tmp_path, scenario="grasping")
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


def test_a_sim_that_pauses_begins_anew(tmp_path):
    robot = simulated(tmp_path, scenario="grasping", restart_after_pause=0.05)
    first = robot.get_observation()
    robot.send_action({name: first[name] for name in (*JOINTS, GRIPPER)})
    time.sleep(0.06)
    robot.get_observation()
    assert (robot.run.seed, robot.run.commands, robot.beginnings) == (1, 0, 1)


def test_a_robot_that_is_not_connected_says_so(tmp_path):
    robot = make_robot_from_config(MujocoPandaConfig(calibration_dir=tmp_path))
    with pytest.raises(DeviceNotConnectedError, match="connect"):
        robot.get_observation()
    teleoperator = make_teleoperator_from_config(PandaExpertConfig(calibration_dir=tmp_path))
    teleoperator.connect()
    with pytest.raises(DeviceNotConnectedError, match="mujoco_panda or franka_panda"):
        teleoperator.get_action()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"scenario": "pouring"}, "no scenario 'pouring'"),
        ({"shelf": "attic"}, "no shelf 'attic'"),
        ({"pixels": True}, "object in the hand"),
        ({"fps": 1.0}, "fps must be"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        MujocoPandaConfig(**settings)


@pytest.mark.slow
def test_the_expert_succeeds_and_the_environment_says_so(tmp_path):
    """What was shown on the robot is done again in the environment, by poses of the hand."""
    settings = {"action_space": "ee", "pixels": True}
    robot = simulated(tmp_path, scenario="grasping", seed=4, **settings)
    expert = make_teleoperator_from_config(PandaExpertConfig(calibration_dir=tmp_path))
    expert.connect()
    shown, first = [], robot.get_observation()
    with shapes_unchecked():
        for _ in range(round(robot.run.scenario.duration * FPS)):
            robot.get_observation()
            action = expert.get_action()
            assert action.keys() == robot.action_features.keys()
            robot.send_action(action)
            shown.append(list(action.values()))
    assert robot.run.succeeded()
    steps = np.abs(np.diff(np.array(shown)[:, :6], axis=0))
    assert steps.max() < 0.05  # no rotation vector changes sides
    robot.disconnect()

    config = PandaEnvConfig(task="grasping", fps=int(FPS), **settings)
    env = config.create_envs(1)["panda"][0]
    state, _ = env.reset(seed=4)
    assert state["agent_pos"].shape == (1, *config.features["agent_pos"].shape)
    np.testing.assert_allclose(state["agent_pos"][0], list(first.values()), rtol=1e-6)
    with shapes_unchecked():
        for action in np.array(shown, dtype=np.float32):
            state, reward, terminated, _truncated, info = env.step(action[None])
            if terminated.any():
                break
    assert terminated.all()
    assert reward == 1
    assert info["final_info"]["is_success"].all()
    env.close()


def test_an_episode_ends_when_its_time_is_up():
    env = PandaEnvConfig(task="grasping", fps=int(FPS), episode_length=2).create_envs(1)
    vector = env["panda"][0]
    state, _ = vector.reset(seed=0)
    still = state["agent_pos"].astype(np.float32)
    assert not vector.step(still)[3].any()
    *_, terminated, truncated, info = vector.step(still)
    assert truncated.all()
    assert not terminated.any()
    assert not info["final_info"]["is_success"].any()
    vector.close()


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


LIMITS = ActionLimits(
    names=["a.pos", "b.pos"],
    fps=50.0,
    velocity=[1.0, 2.0],
    acceleration=[4.0, 8.0],
    jerk=[40.0, 80.0],
    lower=[-1.0, None],
    upper=[1.0, None],
    state_columns=[1, -1],
)


@pytest.fixture
def checkpoint(tmp_path):
    """A checkpoint's processors, smoothing added."""
    normalise = {"registry_name": "normalizer_processor", "config": {}}
    for name, steps in (
        (PREPROCESSOR, [{"registry_name": "to_batch_processor", "config": {}}, normalise]),
        (POSTPROCESSOR, [{"registry_name": "to_batch_processor", "config": {}}]),
    ):
        (tmp_path / name).write_text(json.dumps({"name": "policy", "steps": steps}))
    add_smoothing(tmp_path, LIMITS)
    return tmp_path


def loaded(checkpoint):
    """The steps that were added, as LeRobot makes them of the files."""
    step = {}
    for name in (PREPROCESSOR, POSTPROCESSOR):
        for entry in json.loads((checkpoint / name).read_text())["steps"]:
            if entry["registry_name"].startswith("hrc_learn"):
                kind = ProcessorStepRegistry.get(entry["registry_name"])
                step[entry["registry_name"]] = kind(**entry["config"])
                assert step[entry["registry_name"]].get_config() == entry["config"]
    watch, smooth = step["hrc_learn_watch_state"], step["hrc_learn_smooth_actions"]
    before = PolicyProcessorPipeline(
        [watch], to_transition=batch_to_transition, to_output=transition_to_batch
    )
    after = PolicyProcessorPipeline(
        [smooth],
        to_transition=policy_action_to_transition,
        to_output=transition_to_policy_action,
    )
    before.reset()
    return before, after, smooth


def observe(before, a):
    before({"observation.state": torch.tensor([[9.0, a, 9.0]])})


def test_steps_are_put_at_both_ends_and_taken_out_again(checkpoint):
    add_smoothing(checkpoint, LIMITS)  # twice is once

    def names(file):
        steps = json.loads((checkpoint / file).read_text())["steps"]
        return [step["registry_name"] for step in steps]

    own = "hrc_learn_watch_state", "hrc_learn_smooth_actions"
    assert names(PREPROCESSOR) == [own[0], "to_batch_processor", "normalizer_processor"]
    assert names(POSTPROCESSOR) == ["to_batch_processor", own[1]]
    remove_smoothing(checkpoint)
    assert names(PREPROCESSOR) == ["to_batch_processor", "normalizer_processor"]
    assert names(POSTPROCESSOR) == ["to_batch_processor"]


def test_adding_to_no_checkpoint_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="pretrained_model"):
        add_smoothing(tmp_path, LIMITS)


def test_single_actions_start_where_the_robot_is_and_keep_the_limits(checkpoint):
    before, after, smooth = loaded(checkpoint)
    a = [0.3]
    for k in range(120):
        observe(before, a[-1])
        asked = torch.tensor([[0.5 + 0.3 * (k > 60), 0.0]])
        action = after(asked)
        assert action.shape == (1, 2)
        a.append(float(action[0, 0]))
    path = np.concatenate([[a[0]] * 3, a])
    for order, limit in ((1, 1.0), (2, 4.0), (3, 40.0)):
        # Single precision: 1e-7 rad, times fps^3.
        assert np.abs(np.diff(path, n=order)).max() * 50**order <= limit + 0.05
    assert a[60] == pytest.approx(0.5, abs=5e-3)
    assert a[-1] == pytest.approx(0.8, abs=5e-3)
    changes = smooth.changes
    assert changes.steps == 120
    assert changes.broken["jerk"] > 0
    assert changes.largest["a.pos"] == pytest.approx(0.3, abs=0.02)
    assert "120 actions changed" in str(changes)


def test_a_robot_that_was_put_somewhere_begins_an_episode(checkpoint):
    """lerobot-eval resets no processor between its episodes."""
    before, after, _ = loaded(checkpoint)
    for _ in range(20):
        observe(before, 0.0)
        after(torch.tensor([[0.0, 0.0]]))
    observe(before, 0.7)
    assert float(after(torch.tensor([[0.7, 0.0]]))[0, 0]) == pytest.approx(0.7, abs=1e-3)


def test_a_chunk_goes_on_where_the_robot_is_on_the_one_before(checkpoint):
    before, after, _ = loaded(checkpoint)
    t = torch.arange(1, 41, dtype=torch.float64) / 50
    wave = torch.stack([0.2 * (1 - torch.cos(2 * t)), 0 * t], dim=-1)[None]
    observe(before, 0.0)
    first = after(wave[:, :20])
    observe(before, float(first[0, 9, 0]))  # ten actions were carried out
    second = after(wave[:, 10:30])
    torch.testing.assert_close(second, wave[:, 10:30], atol=1e-6, rtol=0)


def test_actions_of_another_width_are_refused(checkpoint):
    _, after, _ = loaded(checkpoint)
    with pytest.raises(ValueError, match="3 values"):
        after(torch.zeros(1, 3))
