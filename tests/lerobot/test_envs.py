"""The simulated Panda's scenarios as an environment of LeRobot."""

import numpy as np
import pytest
from lerobot.teleoperators import make_teleoperator_from_config
from unchecked import shapes_unchecked

from hrc_learn.lerobot.envs import PandaEnvConfig
from hrc_learn.lerobot.teleoperators import PandaExpertConfig

FPS = 20


@pytest.mark.slow
def test_the_expert_succeeds_and_the_environment_says_so(simulated, tmp_path):
    """What was shown on the robot is done again in the environment, by poses of the hand."""
    settings = {"action_space": "ee", "pixels": True}
    robot = simulated(scenario="grasping", fps=float(FPS), seed=4, **settings)
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

    config = PandaEnvConfig(task="grasping", fps=FPS, **settings)
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
    env = PandaEnvConfig(task="grasping", fps=FPS, episode_length=2).create_envs(1)
    vector = env["panda"][0]
    state, _ = vector.reset(seed=0)
    still = state["agent_pos"].astype(np.float32)
    assert not vector.step(still)[3].any()
    *_, terminated, truncated, info = vector.step(still)
    assert truncated.all()
    assert not terminated.any()
    assert not info["final_info"]["is_success"].any()
    vector.close()
