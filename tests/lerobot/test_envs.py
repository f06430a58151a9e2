"""The simulated Panda's scenarios as an environment of LeRobot."""

import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv
from lerobot.teleoperators import make_teleoperator_from_config
from unchecked import shapes_unchecked

from hrc_learn.kinematics import panda
from hrc_learn.lerobot.arm_teleoperators import ArmExpertConfig
from hrc_learn.lerobot.envs import ArmEnv, ArmEnvConfig
from hrc_learn.lerobot.mujoco_arm import ImagesConfig
from hrc_learn.teleoperation.scenarios import make_scenario

FPS = 20


@pytest.mark.slow
def test_the_expert_succeeds_and_the_environment_says_so(simulated, tmp_path):
    """What was shown on the robot is done again in the environment, by poses of the hand."""
    settings = {"action_space": "ee", "pixels": True}
    robot = simulated(scenario="grasping", fps=float(FPS), seed=4, **settings)
    expert = make_teleoperator_from_config(ArmExpertConfig(calibration_dir=tmp_path))
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

    config = ArmEnvConfig(task="grasping", fps=FPS, **settings)
    env = config.create_envs(1)["mujoco_arm"][0]
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
    env = ArmEnvConfig(task="grasping", fps=FPS, episode_length=2).create_envs(1)
    vector = env["mujoco_arm"][0]
    state, _ = vector.reset(seed=0)
    still = state["agent_pos"].astype(np.float32)
    assert not vector.step(still)[3].any()
    *_, terminated, truncated, info = vector.step(still)
    assert truncated.all()
    assert not terminated.any()
    assert not info["final_info"]["is_success"].any()
    vector.close()


def environment(**settings):
    config = ArmEnvConfig(task="grasping", fps=FPS, **settings)
    return config, ArmEnv(config.robot_config())


def held(env):
    """The action that keeps the arm where it is."""
    names = list(env._robot.action_features)
    values = env._robot.get_observation()
    return np.array([values[name] for name in names], dtype=np.float32)


def test_an_episode_has_a_quarter_more_time_than_a_demonstration():
    config, env = environment()
    duration = make_scenario("grasping", "middle", panda).duration
    assert config.gym_kwargs["max_episode_steps"] == round(1.25 * duration * FPS)
    env.close()


def test_the_job_must_stay_done_for_a_while(monkeypatch):
    """0.3 s, six actions; a thing that topples starts the count anew."""
    _, env = environment()
    env.reset(seed=0)
    still, told = held(env), []
    for done in (True, True, False, *[True] * 6):
        monkeypatch.setattr(env._robot.run, "succeeded", lambda done=done: done)
        _, reward, terminated, truncated, info = env.step(still)
        assert reward == float(terminated) == float(info["is_success"])
        assert not truncated
        told.append(terminated)
    assert told == [False] * 8 + [True]
    env.close()


def test_a_seed_is_a_beginning_and_others_are_drawn():
    config, env = environment()
    state, info = env.reset(seed=7)
    assert env._robot.run.seed == 7
    assert info == {"is_success": False}
    assert state["agent_pos"].shape == config.features["agent_pos"].shape

    def drawn():
        env.reset()
        return env._robot.run.seed

    seeds = [drawn() for _ in range(3)]
    assert len({*seeds}) == 3
    assert 2**16 < max(seeds) < 2**31
    env.reset(seed=7)
    assert [drawn() for _ in range(3)] == seeds
    assert env.render().shape == (180, 240, 3)
    env.close()
    env.close()  # twice is once


def test_another_arm_is_that_of_the_robot():
    config, env = environment(arm="fr3", hand=True)
    assert env._robot.name == "mujoco_fr3"
    assert config.features["agent_pos"].shape == (7 + 6 + 1,)
    state, _ = env.reset(seed=0)
    assert env.observation_space.contains(state)
    env.close()


def test_images_are_observed_as_declared():
    config, env = environment(images=ImagesConfig(kind="synthetic", width=64, height=48))
    assert config.features["pixels/front"].shape == (48, 64, 3)
    assert config.features_map["pixels/front"] == "observation.images.front"
    state, _ = env.reset(seed=0)
    assert env.observation_space.contains(state)
    assert state["pixels"]["front"].shape == (48, 64, 3)
    assert state["pixels"]["front"].any()
    image = env.observation_space["pixels"]["front"]
    assert (image.low.min(), image.high.max()) == (0, 255)
    assert env.action_space.contains(held(env))
    env.close()


def test_a_vector_has_environments_of_its_own():
    vector = ArmEnvConfig(task="grasping", fps=FPS).create_envs(2)["mujoco_arm"][0]
    assert isinstance(vector, SyncVectorEnv)
    state, _ = vector.reset(seed=[1, 2])
    assert state["agent_pos"].shape[0] == 2
    assert [env.unwrapped._robot.run.seed for env in vector.envs] == [1, 2]
    vector.close()
    (one,) = ArmEnvConfig(task=None).create_envs(1, use_async_envs=True)["mujoco_arm"].values()
    assert isinstance(one, SyncVectorEnv)
    assert one.get_attr("task") == ("placing",)
    one.close()
